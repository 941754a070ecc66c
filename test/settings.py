# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The texts that repeat the settings: launch_configs/default.yaml and a table in README.md.

Both are written from the declarations in surfel_mapper/config.py by ``make settings``, and
test_configs.py compares them, so that a new setting cannot stay undocumented.
"""

from __future__ import annotations

import json
from pathlib import Path
import textwrap
from typing import Any

from surfel_mapper.config import Declaration, declarations

ROOT = Path(__file__).parents[1]
README = ROOT / 'README.md'
DEFAULT_YAML = ROOT / 'launch_configs' / 'default.yaml'
BEGIN = '<!-- settings: begin (written by `make settings`) -->\n'
END = '<!-- settings: end -->\n'

FAR = 1e6
"""A bound that only keeps numbers representable is left out."""

HEADER = """\
# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0

# Every setting at its default, for the node (--params-file) and for replay (--config). Copy it
# and keep only what you change. Written from surfel_mapper/config.py by `make settings`.
# In a list write every number with a point: ROS refuses a file where 0 stands beside 0.5.

/**:
  ros__parameters:
"""


def default_yaml() -> str:
    """Return the content of default.yaml."""
    text, stage = HEADER, None
    for declared in declarations():
        if declared.stage != stage:
            text += '\n' if stage else ''
            text += f'    {declared.stage}:\n' if declared.stage else ''
            stage = declared.stage
        indent = '      ' if stage else '    '
        comment = f'{declared.meaning} {allowed(declared)}'.strip()
        lines = [f'# {line}' for line in textwrap.wrap(comment, 97 - len(indent))]
        lines.append(f'{declared.key}: {yaml_value(declared.default)}')
        text += textwrap.indent('\n'.join(lines), indent) + '\n'
    return text


def readme_table() -> str:
    """Return the table of the README, between its markers."""
    rows = ['| setting | default | meaning |', '|---|---|---|']
    for declared in declarations():
        meaning = ' '.join(part for part in (declared.meaning, allowed(declared)) if part)
        name = f'`{declared.name}`{" *" if declared.live else ""}'
        rows.append(f'| {name} | `{yaml_value(declared.default)}` | {meaning} |')
    return BEGIN + '\n'.join(rows) + '\n' + END


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


def with_table(readme: str) -> str:
    """Return the README with the table as it should be between its markers."""
    before, _, rest = readme.partition(BEGIN)
    _, found, after = rest.partition(END)
    if not found:
        raise ValueError(f'{README}: markers of the settings not found')
    return before + readme_table() + after


if __name__ == '__main__':
    DEFAULT_YAML.write_text(default_yaml(), encoding='utf-8')
    README.write_text(with_table(README.read_text(encoding='utf-8')), encoding='utf-8')
