# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables of the settings, apart from their declarations; the most important ones come first."""

from __future__ import annotations

from collections.abc import Iterable
import json
from typing import Any

from surfel_mapper.config.configuration import declarations
from surfel_mapper.config.settings import Declaration

FIRST = (
    'map.voxel_size_m',
    'map.min_points',
    'window.max_scans',
    'window.max_age_s',
    'window.max_distance_m',
    'frames.fixed',
    'frames.base_to_sensor',
    'input.min_range_m',
    'input.max_range_m',
    'pose.source',
)
"""The settings that matter most; tables and default.yaml begin with them."""

LARGE = 1e6
"""Upper bounds from here on only keep numbers representable; the table leaves them out."""


def first_ones() -> list[Declaration]:
    """Return the declarations of the settings that matter most, in order."""
    by_name = {declared.name: declared for declared in declarations()}
    return [by_name[name] for name in FIRST]


def settings_table() -> str:
    """Return the tables in Markdown; * marks settings that can change while the node runs."""
    by_group: dict[str, list[Declaration]] = {}
    for declared in declarations():
        if declared.name not in FIRST:
            by_group.setdefault(declared.name.rpartition('.')[0], []).append(declared)
    general = by_group.pop('')
    texts = [f'## Those that matter most\n\n{table_of(first_ones())}']
    texts += [f'## `{group}`\n\n{table_of(by_group[group])}' for group in by_group]
    return '\n'.join([*texts, f'## General\n\n{table_of(general)}'])


def table_of(declared_ones: Iterable[Declaration]) -> str:
    """Return a table of settings."""
    rows = ['| setting | default | meaning |', '|---|---|---|']
    for declared in declared_ones:
        meaning = ' '.join(text for text in (declared.meaning, allowed(declared)) if text)
        name = f'`{declared.name}`{" *" if declared.live else ""}'
        rows.append(f'| {name} | `{yaml_value(declared.default)}` | {meaning} |')
    return '\n'.join(rows) + '\n'


def allowed(declared: Declaration) -> str:
    """Return the bounds or choices as a sentence; empty if the meaning states them."""
    if not all(choice in declared.meaning for choice in declared.choices):
        return f'One of {", ".join(declared.choices)}.'
    if not declared.is_number:
        return ''
    if declared.high >= LARGE:
        return f'From {declared.low:g}.'
    return f'From {declared.low:g} to {declared.high:g}.'


def yaml_value(value: Any) -> str:
    """Return a default in a form that ROS and YAML both read: JSON."""
    return value if isinstance(value, str) and value else json.dumps(value)
