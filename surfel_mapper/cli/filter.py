# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper filter``: a chain of filters applied to clouds or bags, written as such."""

from __future__ import annotations

import argparse
from dataclasses import asdict
import json
from pathlib import Path
from typing import TYPE_CHECKING

from surfel_mapper.cli._arguments import add_bin_columns, add_overwrite
from surfel_mapper.cli._output import show_lines
from surfel_mapper.cli._settings import add_settings, configured
from surfel_mapper.cli._verbosity import add_verbosity, shown_progress

if TYPE_CHECKING:
    from surfel_mapper.offline.filtering import FilteredClouds

SUMMARY = 'Apply a chain of filters to clouds, folders of scans or bags.'

EXAMPLE = 'surfel-mapper filter chain.yaml scan.pcd --output filtered.ply'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'chain', metavar='CHAIN', help='YAML file of a chain; FILE#key for a list under a key'
    )
    parser.add_argument(
        'inputs',
        nargs='+',
        type=Path,
        metavar='IN',
        help='clouds in files as of `replay`, folders of them, or bags',
    )
    parser.add_argument(
        '-o',
        '--output',
        required=True,
        type=Path,
        metavar='OUT',
        help='.ply or .pcd for one cloud, a bag for one bag, else a directory',
    )
    parser.add_argument(
        '--topic',
        action='append',
        default=[],
        dest='topics',
        help='of a bag: filter the clouds of this topic only; may be repeated',
    )
    add_bin_columns(parser)
    add_settings(
        parser,
        'configuration whose frames.base_to_sensor is the pose of the sensor on the robot',
        shortcuts={},
    )
    add_overwrite(parser)
    parser.add_argument('--json', action='store_true', help='print the report as JSON')
    add_verbosity(parser)


def run(args: argparse.Namespace) -> int:
    """Filter, report."""
    from surfel_mapper.filters.chain import Chain
    from surfel_mapper.geometry import pose_matrix
    from surfel_mapper.offline.filtering import filter_clouds

    chain = Chain.load(args.chain)
    mount = configured(args).frames.mount_of('')
    with shown_progress(args, 'scan') as show:
        done = filter_clouds(
            chain,
            args.inputs,
            args.output,
            topics=args.topics,
            T_base_sensor=pose_matrix(mount[:3], mount[3:]) if mount else None,
            bin_columns=args.bin_columns,
            overwrite=args.overwrite,
            show=show,
        )
    content = {**asdict(done), 'outputs': [str(path) for path in done.outputs]}
    show_lines(json.dumps(content) if args.json else report(done))
    return 0


def report(done: FilteredClouds) -> str:
    """Return the report as text: a line of totals, and one for each filter."""
    refused = f' ({done.refused} refused)' if done.refused else ''
    lines = [f'scans {done.scans}{refused}   points {done.points_in} -> {done.points_out}']
    for name, counts in done.filters.items():
        times = counts['milliseconds']
        line = f'{name:28} {counts["points_in"]:>11} -> {counts["points_out"]:>11}'
        line += f'   {times["median"]:8.2f} ms a scan'
        if counts['not_finite']:
            line += f'   {counts["not_finite"]} not finite'
        lines.append(line)
    return '\n'.join(lines)
