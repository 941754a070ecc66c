# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper merge``: finished maps into one, tile by tile, exactly.

The result has the digest of a map of all their scans. No process holds a whole map.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, TYPE_CHECKING

from surfel_mapper.cli._arguments import add_overwrite, add_workers, positive_int
from surfel_mapper.cli._display import add_open, open_file
from surfel_mapper.cli._output import show_lines
from surfel_mapper.cli._verbosity import add_verbosity
from surfel_mapper.compilation import clock
from surfel_mapper.errors import escaped
from surfel_mapper.offline.summary import rounded

if TYPE_CHECKING:
    from surfel_mapper.cluster.tiles import TiledMap

SUMMARY = 'Merge finished maps of one frame into one, tile by tile, exactly.'

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
    add('-o', '--output', type=Path, required=True, metavar='DIR', help='directory to write to')
    add_overwrite(parser)
    add(
        '--min-points',
        type=positive_int,
        default=5,
        metavar='N',
        help='points that a voxel needs to count as a surfel, for the figures (%(default)s)',
    )
    add_open(parser, 'map.png')
    add('--json', action='store_true', help='print the summary as JSON')
    add_verbosity(parser)
    add_workers(parser)


def run(args: argparse.Namespace) -> int:
    """Merge and report."""
    from surfel_mapper.cluster.executors import open_executor
    from surfel_mapper.cluster.tiles import merge_maps
    from surfel_mapper.files.atomic import check_free, write_json
    from surfel_mapper.viz.picture import draw_map

    check_free(args.output, args.overwrite)
    began = clock()
    with open_executor(args.workers, args.scheduler) as executor:
        tiled = merge_maps(args.maps, executor, args.output, args.min_points)
    summary = {
        'maps': [str(path) for path in args.maps],
        'points': tiled.points,
        **tiled.summary(),
        'seconds': clock() - began,
        'peak_memory_mb': {'merging': tiled.peak_bytes // 10**6},
    }
    picture = args.output / 'map.png'
    title = f'{len(args.maps)} maps: {rounded(tiled.points)} points, {tiled.surfels:,} surfels'
    draw_map(tiled.drawn, picture, title, origin_m=summary['origin_m'])
    write_json(args.output / 'summary.json', summary)
    show_lines(json.dumps(summary) if args.json else report(tiled, summary, picture))
    if args.open:
        open_file(picture)
    return 0


def report(tiled: TiledMap, summary: dict[str, Any], picture: Path) -> str:
    """Return the summary as lines of text."""
    return (
        f'{len(summary["maps"])} maps   points {rounded(tiled.points)}   '
        f'surfels {tiled.surfels}   tiles {tiled.tiles}   {summary["seconds"]:.1f} s\n'
        f'digest {tiled.digest}\n{escaped(f"{tiled.directory}   {picture}")}'
    )
