# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper merge``: finished maps into one, exactly, written in tiles.

The result has the digest of a map of all their scans. Without pyarrow it is one file, map.npz.
"""

from __future__ import annotations

import argparse
from importlib.util import find_spec
import json
import logging
from pathlib import Path
from typing import Any

from surfel_mapper.cli._arguments import add_overwrite, positive_int
from surfel_mapper.cli._display import add_open, open_file
from surfel_mapper.cli._output import show_lines
from surfel_mapper.cli._verbosity import add_verbosity
from surfel_mapper.compilation import clock
from surfel_mapper.errors import counted, escaped
from surfel_mapper.offline.summary import rounded

_log = logging.getLogger(__name__)

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


def run(args: argparse.Namespace) -> int:
    """Merge and report."""
    from surfel_mapper.files.atomic import check_free, make_directory, write_json
    from surfel_mapper.files.map_state import FILE, save_map
    from surfel_mapper.files.merging import merged
    from surfel_mapper.files.parquet_tiles import check_dataset, tiles_in, write_tiles
    from surfel_mapper.viz.picture import draw_map

    check_free(args.output, args.overwrite)
    began = clock()
    has_tiles = find_spec('pyarrow') is not None
    output = args.output / ('map' if has_tiles else FILE)
    if has_tiles:
        check_dataset(output)
    total = merged(args.maps)
    if has_tiles:
        write_tiles(output, total)
    else:
        _log.warning('pyarrow is not installed: %s is written instead of tiles', output)
        make_directory(args.output)
        save_map(output, total)
    surfels = total.surfels(args.min_points, covariance=True)
    summary = {
        'maps': [str(path) for path in args.maps],
        'points': total.num_points,
        'voxels': total.num_voxels,
        'surfels': len(surfels),
        'tiles': len(tiles_in(output)) if has_tiles else 0,
        'voxel_size_m': total.voxel_size_m,
        'origin_m': total.origin_m.tolist(),
        'digest': total.digest(),
        'seconds': clock() - began,
    }
    picture = args.output / 'map.png'
    title = f'{counted(len(args.maps), "map")}: {rounded(total.num_points)} points, '
    title += counted(len(surfels), 'surfel')
    draw_map(surfels, picture, title, origin_m=summary['origin_m'])
    write_json(args.output / 'summary.json', summary)
    show_lines(json.dumps(summary) if args.json else report(summary, output, picture))
    if args.open:
        open_file(picture)
    return 0


def report(summary: dict[str, Any], output: Path, picture: Path) -> str:
    """Return the summary as lines of text."""
    return (
        f'{counted(len(summary["maps"]), "map")}   points {rounded(summary["points"])}   '
        f'surfels {summary["surfels"]}   tiles {summary["tiles"]}   {summary["seconds"]:.1f} s\n'
        f'digest {summary["digest"]}\n{escaped(f"{output}   {picture}")}'
    )
