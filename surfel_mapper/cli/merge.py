# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper merge``: finished maps into one, exactly, written in tiles.

The result has the digest of a map of all their scans.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import time

from surfel_mapper.cli._arguments import positive_int
from surfel_mapper.cli._output import show_lines
from surfel_mapper.errors import escaped
from surfel_mapper.offline.summary import rounded

SUMMARY = 'Merge finished maps of one frame into one, exactly.'

EXAMPLE = 'surfel-mapper merge monday_surfels tuesday_surfels --output week'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add(
        'maps',
        nargs='+',
        type=Path,
        metavar='DIR',
        help='output of a replay or a merge, or a file of it, map.npz or map.parquet',
    )
    add('--output', type=Path, required=True, metavar='DIR', help='directory to write to')
    add(
        '--min-points',
        type=positive_int,
        default=5,
        metavar='N',
        help='points that a voxel needs to count as a surfel, for the figures (%(default)s)',
    )
    add('--json', action='store_true', help='print the summary as JSON')


def run(args: argparse.Namespace) -> int:
    """Merge and report."""
    from surfel_mapper.files.atomic import write_json
    from surfel_mapper.files.merging import merged
    from surfel_mapper.files.parquet_tiles import check_dataset, tiles_in, write_tiles

    began = time.perf_counter()
    directory = args.output / 'map'
    check_dataset(directory)
    total = merged(args.maps)
    write_tiles(directory, total)
    summary = {
        'maps': [str(path) for path in args.maps],
        'points': total.num_points,
        'voxels': total.num_voxels,
        'surfels': total.num_surfels(args.min_points),
        'tiles': len(tiles_in(directory)),
        'voxel_size_m': total.voxel_size_m,
        'origin_m': total.origin_m.tolist(),
        'digest': total.digest(),
        'seconds': time.perf_counter() - began,
    }
    write_json(args.output / 'summary.json', summary)
    if args.json:
        print(json.dumps(summary))
        return 0
    show_lines(
        f'{len(args.maps)} maps   points {rounded(total.num_points)}   '
        f'surfels {summary["surfels"]}   tiles {summary["tiles"]}   {summary["seconds"]:.1f} s\n'
        f'digest {summary["digest"]}\n{escaped(str(directory))}'
    )
    return 0
