# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Text on the terminal, without the control characters of names in it.

Names of topics, columns, frames and files come from outside, and may have ends of lines in them.
"""

from __future__ import annotations

import sys
from typing import Any

from surfel_mapper.errors import escaped


def printable(value: Any) -> Any:
    """Return plain values as JSON has them, every text in them as one line."""
    if isinstance(value, dict):
        return {escaped(str(key)): printable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [printable(item) for item in value]
    return escaped(value) if isinstance(value, str) else value


def show_lines(text: str, *, to_stderr: bool = False) -> None:
    """Print lines of text with control characters escaped."""
    lines = '\n'.join(map(escaped, text.split('\n')))
    print(lines, file=sys.stderr if to_stderr else sys.stdout, flush=True)
