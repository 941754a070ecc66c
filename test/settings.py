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

from surfel_mapper.config import allowed, declarations, settings_table, yaml_value

ROOT = Path(__file__).parents[1]
PAGE = ROOT / 'docs' / 'settings.md'
DEFAULT_YAML = ROOT / 'launch_configs' / 'default.yaml'
BEGIN = '<!-- settings: begin (written by `make settings`) -->\n'
END = '<!-- settings: end -->\n'

HEADER = """\
# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0

# Every setting at its default, for the node (--params-file) and for replay (--config). Copy it
# and keep only what you change. Written from surfel_mapper/config/ by `make settings`.
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
