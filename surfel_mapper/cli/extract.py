# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper extract``: planes, surfaces and Gaussians of a cloud or a map, as files.

models.smm is always written; the figures of the report are those of its content.

Every surfel of a map becomes nine points across its disc, so that its slope counts too, and the
voxels are half as large as those of the map.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
import json
import logging
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.cli._arguments import add_bin_columns, add_formats, add_overwrite
from surfel_mapper.cli._display import add_open, open_file
from surfel_mapper.cli._output import show_lines
from surfel_mapper.cli._recordings import recorded_map
from surfel_mapper.cli._settings import add_settings, configured_stage
from surfel_mapper.cli._verbosity import add_verbosity
from surfel_mapper.compilation import stage

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfel_map import SurfelMap
    from surfel_mapper.models.multi_model import MultiModel

SUMMARY = 'Find planes, curved surfaces and Gaussians in a cloud or a map.'

EXAMPLE = 'surfel-mapper extract scan.pcd --voxel-size 0.02 --formats json,obj -o models/ --open'

MAPS = ('.npz', '.parquet')

_log = logging.getLogger(__name__)

FORMATS = ('json', 'parquet', 'obj', 'glb')

DEFAULT = ('json',)
"""Formats without --formats."""

SHORTCUTS = {
    '--voxel-size': (
        'models.voxel_size_m',
        'm (for a cloud 0.04 to 0.3 by its extent; for a map half its voxel size)',
    ),
    '--noise': ('models.noise_m', 'sigma of the range of the sensor, m (lidar: 0.02)'),
    '--noise-per-range-sq': (
        'models.noise_per_range_sq',
        'sigma that grows with range^2, 1/m (Kinect: 0.001425)',
    ),
}
"""Options for the settings that matter first."""

SIZES_M, DISTANCE_VOXELS = (0.04, 0.3), 50
"""Limits of the default voxel size for a cloud, m, and the number of voxels in the median distance
of the points from their middle: frames of depth cameras get 0.04 m, a street 0.3 m."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'cloud',
        type=Path,
        metavar='CLOUD|MAP|BAG',
        help='points in a file, as of `replay`; a map: .npz, .parquet, output of a replay; or a '
        'bag or a folder of scans, mapped as by `replay`',
    )
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='DIR', help='directory to write to'
    )
    add_bin_columns(parser)
    add_overwrite(parser)
    add_formats(parser, FORMATS, DEFAULT)
    add_settings(
        parser,
        shortcuts=SHORTCUTS,
        set_help='setting of the models, as models.min_points=100; repeatable (docs/models.md '
        'lists all)',
    )
    parser.add_argument(
        '--profile',
        type=lambda name: ('models.profile', name),
        dest='settings',
        action='append',
        help="robust (default), or paper: the paper's rules to the letter",
    )
    parser.add_argument(
        '--viewpoint',
        type=float,
        nargs=3,
        metavar=('X', 'Y', 'Z'),
        help='position of the sensor; default: VIEWPOINT of a PCD, the origin, or above a map',
    )
    add_open(parser, 'models.png')
    parser.add_argument('--json', action='store_true', help='print the figures as JSON')
    add_verbosity(parser)


def run(args: argparse.Namespace) -> int:
    """Fit models, write the files, report."""
    from surfel_mapper.config import ModelsConfig
    from surfel_mapper.files.atomic import check_free, make_directory
    from surfel_mapper.files.model_files import PACKED, write_models, write_packed
    from surfel_mapper.layers.models.pictures import picture_of
    from surfel_mapper.models import evaluate, fit
    from surfel_mapper.models import read as read_models
    from surfel_mapper.viz.drawings import draw_points

    check_free(args.output, args.overwrite)
    config = configured_stage(args, ModelsConfig)
    with stage(1, 2, 'reading'):
        points, voxel_size_m, viewpoint, origin_m = read(args)
    if 'models.voxel_size_m' not in dict(args.settings):
        config = replace(config, voxel_size_m=voxel_size_m)
    _log.info('%s: %d points, voxels of %g m', args.cloud, len(points), config.voxel_size_m)
    with stage(2, 2, 'fitting'):
        model = fit(points, config, viewpoint)
    make_directory(args.output)
    whole = model.translated(origin_m)
    packed = write_packed(args.output / PACKED, whole)
    write_models(args.output, whole, args.formats or DEFAULT)
    model = replace(read_models(packed).translated(-origin_m), labels=model.labels)
    picture = picture_of(points, model, viewpoint)
    draw_points(args.output / picture.file_name, picture)
    content = figures(model, evaluate(model, points), len(points))
    show_lines(json.dumps(content) if args.json else report(content))
    if args.open:
        open_file(args.output / picture.file_name)
    return 0


def read(
    args: argparse.Namespace,
) -> tuple[npt.NDArray[Any], float, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return points (N, 3), default voxel size, viewpoint (3,) and origin (3,) of the map, m."""
    from surfel_mapper.files.pcd import read_viewpoint
    from surfel_mapper.models.fitting import above, surfel_points

    surfel_map = map_of(args)
    origin_m: npt.NDArray[np.float64] = np.zeros(3)
    if surfel_map is not None:
        surfels, origin_m = surfel_map.surfels(covariance=True), surfel_map.origin_m
        # the order of rows depends on the history of the map, and sums in the last bits on it
        surfels = surfels.select(np.lexsort(surfels.voxel_index.T))
        points: npt.NDArray[Any] = surfel_points(surfels, surfel_map.voxel_size_m)
        voxel_size_m, viewpoint = 0.5 * surfel_map.voxel_size_m, above(surfels)
    else:
        points = cloud_of(args)
        voxel_size_m, viewpoint = voxel_size_of(points), np.zeros(3)
        if args.cloud.suffix.lower() == '.pcd':
            viewpoint = np.array(read_viewpoint(args.cloud)[:3])
    if args.viewpoint is not None:
        viewpoint = np.array(args.viewpoint) - origin_m
    return points, voxel_size_m, viewpoint, origin_m


def map_of(args: argparse.Namespace) -> SurfelMap | None:
    """Return the map in a file or a directory, or that of a recording; None for a cloud."""
    from surfel_mapper.errors import FileFormatError
    from surfel_mapper.files.arrays import is_cloud
    from surfel_mapper.files.latest_map import EXACT, map_in
    from surfel_mapper.files.scan_files import SUFFIXES
    from surfel_mapper.mapping.surfel_map import SurfelMap

    size_m = dict(args.settings).get('models.voxel_size_m')
    surfel_map = recorded_map(args, args.cloud, EXACT, 2.0 * size_m if size_m else None)
    if surfel_map is not None:
        return surfel_map
    path, suffix = args.cloud, args.cloud.suffix.lower()
    if path.is_dir() and map_in(path, EXACT) is None:
        raise FileFormatError(
            f'{path}: no map.npz, map.parquet or map/tile_i=*/tile_j=*/ in this directory, nor a '
            'bag or scans'
        )
    if not path.exists():
        raise FileFormatError(f'{path}: no such file')
    if path.is_dir() or (suffix in MAPS and not is_cloud(path)):
        return SurfelMap.load(path)
    if suffix not in SUFFIXES:
        raise FileFormatError(
            f'{path}: expected a cloud ending in {", ".join(SUFFIXES)}, a map ending in '
            f'{", ".join(MAPS)}, or a bag'
        )
    return None


def cloud_of(args: argparse.Namespace) -> npt.NDArray[Any]:
    """Return the points (N, 3) in a file."""
    from surfel_mapper.errors import FileFormatError
    from surfel_mapper.files.scan_files import scan_reader

    points, columns = scan_reader([args.cloud], args.bin_columns)(args.cloud)
    if {'planarity', 'curvature', 'num_points'} <= set(columns):
        raise FileFormatError(
            f'{args.cloud}: surfels of a map, not points of a cloud; expected its map.npz or '
            'the output directory of the replay'
        )
    if not np.isfinite(points).all(axis=1).any():
        raise FileFormatError(f'{args.cloud}: none of its {len(points)} points is finite')
    return np.ascontiguousarray(points)


def voxel_size_of(points: npt.NDArray[Any]) -> float:
    """Return the default voxel size for a cloud (N, 3), m."""
    points = points[np.isfinite(points).all(axis=1) & points.any(axis=1)]  # 0, 0, 0: no return
    if not len(points):
        return SIZES_M[0]
    distances_m = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return float(np.clip(round(float(np.median(distances_m)) / DISTANCE_VOXELS, 2), *SIZES_M))


def figures(model: MultiModel, evaluation: Any, num_points: int) -> dict[str, Any]:
    """Return the figures of the report; None for undefined ones."""
    values = {
        'points': num_points,
        'voxel_size_m': model.voxel_size_m,
        'thinned': model.num_thinned,
        'planes': evaluation.num_planes,
        'surfaces': evaluation.num_surfaces,
        'gaussians': evaluation.num_gaussians,
        'bytes': evaluation.size_bytes,
        'compression': evaluation.compression,
        'precision_rms_m': evaluation.precision_rms_m,
        'completeness_rms_m': evaluation.completeness_rms_m,
        'coverage': evaluation.coverage,
    }
    return {name: None if value != value else value for name, value in values.items()}


def report(content: dict[str, Any]) -> str:
    """Return the figures as two lines of text."""
    c = {name: float('nan') if value is None else value for name, value in content.items()}
    return (
        f'points {c["points"]} (thinned to {c["thinned"]} in voxels of {c["voxel_size_m"]:g} m)   '
        f'planes {c["planes"]}   surfaces {c["surfaces"]}   Gaussians {c["gaussians"]}\n'
        f'precision {1e3 * c["precision_rms_m"]:.1f} mm   '
        f'completeness {1e3 * c["completeness_rms_m"]:.1f} mm   '
        f'coverage {100 * c["coverage"]:.1f} %   '
        f'{c["bytes"]} bytes, {c["compression"]:.0f} times smaller'
    )
