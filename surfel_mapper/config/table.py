# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""All settings as a table, for the README and for ``surfel-mapper info --parameters``."""

from __future__ import annotations

import json
from typing import Any

from surfel_mapper.config.configuration import declarations
from surfel_mapper.config.settings import Declaration

FAR = 1e6
"""A bound that only keeps numbers representable is left out."""


def settings_table() -> str:
    """Return the table, in Markdown; a * marks what can be changed while the node runs."""
    rows = ['| setting | default | meaning |', '|---|---|---|']
    for declared in declarations():
        meaning = ' '.join(part for part in (declared.meaning, allowed(declared)) if part)
        name = f'`{declared.name}`{" *" if declared.live else ""}'
        rows.append(f'| {name} | `{yaml_value(declared.default)}` | {meaning} |')
    return '\n'.join(rows) + '\n'


def allowed(declared: Declaration) -> str:
    """Return which values a setting may have, or nothing where its meaning says it."""
    if declared.low is None or declared.high is None:
        return ''
    if declared.high >= FAR:
        return f'From {declared.low:g}.'
    return f'From {declared.low:g} to {declared.high:g}.'


def yaml_value(value: Any) -> str:
    """Return a default as ROS and YAML both read it: JSON is that."""
    return value if isinstance(value, str) and value else json.dumps(value)
