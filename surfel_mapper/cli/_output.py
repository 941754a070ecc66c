# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Text on the terminal, without the control characters of names in it.

Names of topics, columns, frames and files come from outside. On its own because no verb imports
another.
"""

from __future__ import annotations

import sys

from surfel_mapper.errors import escaped


def show_lines(text: str, *, to_stderr: bool = False) -> None:
    """Print lines of text with control characters escaped."""
    lines = '\n'.join(map(escaped, text.split('\n')))
    print(lines, file=sys.stderr if to_stderr else sys.stdout, flush=True)
