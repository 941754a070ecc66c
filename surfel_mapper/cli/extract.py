# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper extract``: planes, surfaces and Gaussians of a cloud or a map, as files.

Every surfel of a map becomes nine points across its disc, so that its slope counts too, and the
voxels are half as large as those of the map.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.cli._arguments import real
from surfel_mapper.cli._output import show_lines

if TYPE_CHECKING:
    from surfel_mapper.models.multi_model import MultiModel

SUMMARY = 'Find planes, curved surfaces and Gaussians in a cloud or a map.'

EXAMPLE = 'surfel-mapper extract scan.pcd --voxel-size 0.02 --output models/'

MAPS = ('.npz', '.parquet')

FORMATS = ('json', 'obj', 'parquet', 'dxf', 'step')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'cloud',
        type=Path,
        metavar='CLOUD|MAP',
        help='.ply, .pcd, .bin, .las, .laz; or a map: .npz, .parquet, output of a replay',
    )
    parser.add_argument('--output', type=Path, required=True, metavar='DIR', help='directory')
    parser.add_argument(
        '--formats',
        nargs='+',
        choices=FORMATS,
        default=('json', 'obj'),
        metavar='FORMAT',
        help=f'of {", ".join(FORMATS)}; default json obj',
    )
    parser.add_argument(
        '--voxel-size', type=real, metavar='M', help='m (0.04; for a map half its voxel size)'
    )
    parser.add_argument(
        '--profile', default='robust', help="robust, or paper: the paper's rules to the letter"
    )
    parser.add_argument(
        '--noise',
        type=real,
        default=0.0,
        metavar='M',
        help='sigma of the range of the sensor (lidar: 0.02)',
    )
    parser.add_argument(
        '--noise-per-range-sq',
        type=real,
        default=0.0,
        metavar='S',
        help='sigma that grows with range^2, 1/m (Kinect: 0.001425)',
    )
    parser.add_argument(
        '--viewpoint',
        type=real,
        nargs=3,
        metavar=('X', 'Y', 'Z'),
        help='position of the sensor; default: the origin, or above the middle of a map',
    )
    parser.add_argument('--json', action='store_true', help='print the figures as JSON')


def run(args: argparse.Namespace) -> int:
    """Fit models, write the files, report."""
    from surfel_mapper.config import ModelsConfig
    from surfel_mapper.files.atomic import make_directory
    from surfel_mapper.files.model_files import write_models
    from surfel_mapper.kernels.compiling import before_compiling
    from surfel_mapper.layers.drawings import PointsPicture
    from surfel_mapper.layers.models.pictures import panels_of
    from surfel_mapper.models import evaluate, fit
    from surfel_mapper.viz.drawings import draw_points

    with before_compiling(announce):
        points, voxel_size_m, viewpoint, origin_m = read(args)
        config = ModelsConfig(
            voxel_size_m=voxel_size_m,
            profile=args.profile,
            noise_m=args.noise,
            noise_per_range_sq=args.noise_per_range_sq,
        )
        model = fit(points, config, viewpoint)
    make_directory(args.output)
    write_models(args.output, model.translated(origin_m), args.formats)
    picture = PointsPicture(
        file_name='models.png', panels=panels_of(points, model), viewpoint=viewpoint
    )
    draw_points(args.output / picture.file_name, picture)
    content = figures(model, evaluate(model, points), len(points))
    show_lines(json.dumps(content) if args.json else report(content))
    return 0


def announce() -> None:
    """Say on stderr why the first fit takes long."""
    print(
        'surfel-mapper extract: compiling kernels, about a minute of processor time, once per '
        'machine',
        file=sys.stderr,
        flush=True,
    )


def read(
    args: argparse.Namespace,
) -> tuple[npt.NDArray[Any], float, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return points (N, 3), size of voxels, viewpoint (3,) and the origin (3,) of the map, m."""
    from surfel_mapper.config import ModelsConfig
    from surfel_mapper.errors import FileFormatError
    from surfel_mapper.files import map_state, parquet, parquet_tiles
    from surfel_mapper.files.scan_files import read_scan, SUFFIXES
    from surfel_mapper.models.fitting import above, surfel_points

    args.cloud = exact_map(args.cloud)
    is_tiles = args.cloud.is_dir()
    if not args.cloud.exists():
        raise FileFormatError(f'{args.cloud}: no such file')
    if not is_tiles and args.cloud.suffix not in (*MAPS, *SUFFIXES):
        raise FileFormatError(
            f'{args.cloud}: expected a cloud ending in {", ".join(SUFFIXES)}, or a map ending in '
            f'{", ".join(MAPS)}'
        )
    origin_m: npt.NDArray[np.float64] = np.zeros(3)
    if is_tiles or args.cloud.suffix in MAPS:
        if is_tiles:
            surfel_map = parquet_tiles.read_tiles(args.cloud)
        elif args.cloud.suffix == '.npz':
            surfel_map, _ = map_state.load_map(args.cloud)
        else:
            surfel_map = parquet.read_map(args.cloud)
        surfels, origin_m = surfel_map.surfels(), surfel_map.origin_m
        points: npt.NDArray[Any] = surfel_points(surfels, surfel_map.voxel_size_m)
        voxel_size_m, viewpoint = 0.5 * surfel_map.voxel_size_m, above(surfels)
    else:
        points, columns = read_scan(args.cloud)
        if {'planarity', 'curvature', 'num_points'} <= set(columns):
            raise FileFormatError(
                f'{args.cloud}: surfels of a map, not points of a cloud; expected its map.npz or '
                'the output directory of the replay'
            )
        points = np.ascontiguousarray(points)
        voxel_size_m, viewpoint = ModelsConfig().voxel_size_m, np.zeros(3)
    if args.viewpoint is not None:
        viewpoint = np.array(args.viewpoint) - origin_m
    size_m = args.voxel_size if args.voxel_size is not None else voxel_size_m
    return points, size_m, viewpoint, origin_m


def exact_map(path: Path) -> Path:
    """Return the exact map in an output directory, a file or tiles; another path as it is."""
    from surfel_mapper.errors import FileFormatError
    from surfel_mapper.files.latest_map import EXACT, map_in

    found = map_in(path, EXACT) if path.is_dir() else path
    if found is None:
        raise FileFormatError(
            f'{path}: no map.npz, map.parquet or map/tile_i=*/tile_j=*/ in this directory'
        )
    return found


def figures(model: MultiModel, found: Any, num_points: int) -> dict[str, Any]:
    """Return the figures of the report; None for undefined ones."""
    values = {
        'points': num_points,
        'thinned': model.num_thinned,
        'planes': found.num_planes,
        'surfaces': found.num_surfaces,
        'gaussians': found.num_gaussians,
        'bytes': found.size_bytes,
        'compression': found.compression,
        'precision_rms_m': found.precision_rms_m,
        'completeness_rms_m': found.completeness_rms_m,
        'coverage': found.coverage,
    }
    return {name: None if value != value else value for name, value in values.items()}


def report(content: dict[str, Any]) -> str:
    """Return the figures as two lines of text."""
    c = {name: float('nan') if value is None else value for name, value in content.items()}
    return (
        f'points {c["points"]} (thinned to {c["thinned"]})   planes {c["planes"]}   '
        f'surfaces {c["surfaces"]}   Gaussians {c["gaussians"]}\n'
        f'precision {1e3 * c["precision_rms_m"]:.1f} mm   '
        f'completeness {1e3 * c["completeness_rms_m"]:.1f} mm   '
        f'coverage {100 * c["coverage"]:.1f} %   '
        f'{c["bytes"]} bytes, {c["compression"]:.0f} times smaller'
    )
