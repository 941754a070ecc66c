# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper filters``: every filter that a chain may have, with its parameters."""

from __future__ import annotations

import argparse
import inspect
import json
import textwrap
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from surfel_mapper.filters.base import Filter

SUMMARY = 'List the filters for --filters, with parameters, defaults and bounds.'

EXAMPLE = 'surfel-mapper filters voxel_grid'

WIDTH = 99


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'names', nargs='*', metavar='NAME', help="only these; our names or libpointmatcher's"
    )
    parser.add_argument('--json', action='store_true', help='print as JSON')


def run(args: argparse.Namespace) -> int:
    """List the filters."""
    from surfel_mapper.filters.registry import all_filters, find

    classes = [find(name) for name in args.names] or all_filters()
    listed = [as_mapping(cls) for cls in classes]
    print(json.dumps(listed) if args.json else '\n\n'.join(map(described, listed)))
    return 0


def as_mapping(cls: type[Filter]) -> dict[str, Any]:
    """Return everything about a filter as plain values; infinite ones as text."""
    from surfel_mapper.config import plain, settings_of

    return {
        'name': cls.name,
        'libpointmatcher': cls.libpointmatcher,
        'meaning': (inspect.getdoc(cls) or '').partition('\n')[0],
        'parameters': [
            {
                'name': setting.name,
                'libpointmatcher': setting.libpointmatcher,
                'type': setting.kind,
                'default': plain(setting.default),
                'libpointmatcher_default': plain(setting.libpointmatcher_default),
                'allowed': setting.allowed,
                'meaning': setting.meaning,
            }
            for setting in settings_of(cls)
        ],
    }


def described(content: dict[str, Any]) -> str:
    """Return a filter for people: a line about it, and below one for each parameter."""
    libpointmatcher = f' ({content["libpointmatcher"]})' if content['libpointmatcher'] else ''
    lines = [f'{content["name"]}{libpointmatcher}', *textwrap.wrap(content['meaning'], WIDTH - 2)]
    for item in content['parameters']:
        name = f'{item["name"]} ({item["libpointmatcher"]})' if libpointmatcher else item['name']
        name = name.removesuffix(' ()')
        default = item['default'] or "''"
        if libpointmatcher and item['libpointmatcher_default'] != item['default']:
            default += f' ({item["libpointmatcher_default"]} under the other name)'
        allowed = f' in {item["allowed"]}' if item['allowed'].startswith('[') else ''
        choices = f' of {item["allowed"]}' if item['allowed'] and not allowed else ''
        line = f'{name}: {default}, {item["type"]}{allowed}{choices}. {item["meaning"]}'
        lines += textwrap.wrap(line, WIDTH - 4, initial_indent='  ', subsequent_indent='      ')
    return '\n  '.join(lines)
