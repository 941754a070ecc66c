# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The texts that repeat the settings: launch_configs/default.yaml and the table in docs/settings.md.

Both are written from the declarations in surfel_mapper/config/ by ``make settings``, and
test_configs.py compares them, so that a new setting cannot stay undocumented.
"""

from __future__ import annotations

from pathlib import Path
import textwrap

from surfel_mapper.config import (
    allowed,
    declarations,
    FIRST,
    first_ones,
    settings_table,
    yaml_value,
)

ROOT = Path(__file__).parents[1]
PAGE = ROOT / 'docs' / 'settings.md'
DEFAULT_YAML = ROOT / 'launch_configs' / 'default.yaml'
BEGIN = '<!-- settings: begin (written by `make settings`) -->\n'
END = '<!-- settings: end -->\n'

HEADER = """\
# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0

# Every setting at its default, for the node (--params-file) and for replay (--config). Copy it
# and keep only what you change; the first ten matter most. Written from the declarations in
# surfel_mapper/config/ by `make settings`.
# In a list write every number with a point: ROS refuses a file where 0 stands beside 0.5.

/**:
  ros__parameters:
"""


def default_yaml() -> str:
    """Return the content of default.yaml."""
    text, stage = HEADER, None
    for declared in first_ones():
        text += entry(declared, declared.name, '    ')
    for declared in declarations():
        if declared.name in FIRST:
            continue
        if declared.stage != stage:
            text += '\n'
            text += f'    {declared.stage}:\n' if declared.stage else ''
            stage = declared.stage
        text += entry(declared, declared.key, '      ' if stage else '    ')
    return text


def entry(declared, key, indent):
    """Return the lines of a setting in default.yaml."""
    comment = f'{declared.meaning} {allowed(declared)}'.strip()
    lines = [f'# {line}' for line in textwrap.wrap(comment, 97 - len(indent))]
    lines.append(f'{key}: {yaml_value(declared.default)}')
    return textwrap.indent('\n'.join(lines), indent) + '\n'


def with_table(page: str) -> str:
    """Return the page with the current table between its markers."""
    before, _, rest = page.partition(BEGIN)
    _, found, after = rest.partition(END)
    if not found:
        raise ValueError(f'{PAGE}: markers of the settings not found')
    return before + BEGIN + settings_table() + END + after


if __name__ == '__main__':
    DEFAULT_YAML.write_text(default_yaml(), encoding='utf-8')
    PAGE.write_text(with_table(PAGE.read_text(encoding='utf-8')), encoding='utf-8')
