# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper evaluate``: a map against a world, a cloud or another map; or a trajectory.

Trajectories are aligned first, maps if --align asks for it; a warning says if it looks needed.
"""

from __future__ import annotations

import argparse
import json
import logging
from pathlib import Path
from typing import Any, TYPE_CHECKING

from surfel_mapper.cli._arguments import add_bin_columns, positive_float, positive_int
from surfel_mapper.cli._output import show_lines
from surfel_mapper.cli._recordings import recorded_map
from surfel_mapper.cli._verbosity import add_verbosity
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.atomic import finite_or_none

if TYPE_CHECKING:
    from surfel_mapper.evaluation.map_files import Discs

SUMMARY = 'Compare a map with the truth or another map, or a trajectory with another.'

EXAMPLE = 'surfel-mapper evaluate street_surfels --truth street'

DEFAULT_M = 0.5
"""Default of --max-distance and --radius for maps without a voxel size, m."""

_log = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add(
        'map',
        type=Path,
        metavar='MAP',
        help='output of a replay or merge, or a file of it; a bag or a folder of scans, mapped as '
        'by `replay`; .tum, .txt, .csv: a trajectory',
    )
    add(
        '--truth',
        type=Path,
        required=True,
        metavar='TRUTH',
        help='a simulated bag, its world.json, points or a mesh (.ply, .obj, .stl, .glb) in a '
        'file, or another map; for a trajectory another one, or a simulated bag',
    )
    add(
        '--max-distance',
        type=positive_float,
        metavar='M',
        help='do not compare surfels farther from the truth than this (the voxel size)',
    )
    add(
        '--radius',
        type=positive_float,
        metavar='M',
        help='a place of the truth counts as found if a surfel is this near (the voxel size)',
    )
    add(
        '--max-difference',
        type=positive_float,
        default=0.01,
        metavar='S',
        help='compare poses at most this far apart in time (%(default)s)',
    )
    add(
        '--min-points',
        type=positive_int,
        default=5,
        metavar='N',
        help='points that a voxel needs to count as a surfel (%(default)s)',
    )
    add(
        '--align',
        action='store_true',
        help='move the map onto the truth first, if frames differ (trajectories always move)',
    )
    add(
        '--voxel-size',
        type=positive_float,
        metavar='M',
        help='edge of the voxels of recordings, mapped first, m (0.5; depth images 0.08)',
    )
    add_bin_columns(parser)
    add('--json', action='store_true', help='print as JSON')
    add_verbosity(parser)


def run(args: argparse.Namespace) -> int:
    """Compare and report."""
    from surfel_mapper.files.trajectory import SUFFIXES

    is_trajectory = args.map.suffix.lower() in SUFFIXES
    result = finite_or_none(trajectories(args) if is_trajectory else maps(args))
    content = {'map': str(args.map), 'truth': str(args.truth), **result}
    lines = trajectory_lines(result) if is_trajectory else map_lines(result)
    show_lines(json.dumps(content, allow_nan=False) if args.json else '\n'.join(lines))
    return 0


def maps(args: argparse.Namespace) -> dict[str, Any]:
    """Return the errors of a map."""
    from surfel_mapper.evaluation.comparison import CloudTruth, evaluate, Truth
    from surfel_mapper.evaluation.frames import (
        find_motion,
        known_starts,
        looks_needed,
        moved_discs,
    )
    from surfel_mapper.evaluation.mesh_truth import load_mesh
    from surfel_mapper.evaluation.truth import is_world, load_truth

    surfels = discs_of(args, args.map)
    truth: Truth
    digests: dict[str, Any] = {}
    if is_world(args.truth):
        truth = load_truth(args.truth)
    elif (mesh := load_mesh(args.truth)) is not None:
        truth = mesh
    else:
        reference = discs_of(args, args.truth)
        truth = CloudTruth(reference)
        digests = compared_digests(surfels, reference)
    size_m = surfels.voxel_size_m or DEFAULT_M
    max_distance_m = args.max_distance or size_m
    motion = None
    if args.align:
        motion = find_motion(surfels, truth, known_starts(args.map, args.truth), max_distance_m)
        surfels = moved_discs(surfels, motion.T_truth_map)
    elif reason := looks_needed(surfels, truth, max_distance_m):
        _log.warning('%s, %s: frames differ? %s; try --align', args.map, args.truth, reason)
    return {
        **evaluate(surfels, truth, max_distance_m=max_distance_m, radius_m=args.radius or size_m),
        **digests,
        **({} if motion is None else {'aligned': motion.summary()}),
    }


def discs_of(args: argparse.Namespace, path: Path) -> Discs:
    """Return the surfels of a map, of a recording that is mapped first, or points."""
    from surfel_mapper.evaluation.map_files import load_discs, of_map
    from surfel_mapper.files.latest_map import DRAWABLE

    surfel_map = recorded_map(args, path, DRAWABLE, args.voxel_size)
    if surfel_map is not None:
        return of_map(surfel_map, args.min_points)
    return load_discs(path, args.min_points, args.bin_columns)


def compared_digests(surfels: Discs, reference: Discs) -> dict[str, Any]:
    """Return whether two maps are equal to the bit, if both are exact."""
    if surfels.digest is None or reference.digest is None:
        return {}
    return {'equal': surfels.digest == reference.digest}


def map_lines(result: dict[str, Any]) -> list[str]:
    """Return the errors of a map as lines of text."""
    lines = [f'surfels {result["surfels"]}   compared {result["compared"]}']
    if 'aligned' in result:
        motion = result['aligned']
        lines.append(
            f'aligned   by {motion["moved_m"]:.3f} m, {motion["turned_deg"]:.3f} deg, from '
            f'{motion["start"]}; {motion["share_near"]:.0%} near the truth, '
            f'{motion["share_near_before"]:.0%} before'
        )
    for name, unit, factor in (('position_m', 'mm', 1e3), ('normal_deg', 'deg', 1.0)):
        if name in result:
            lines.append(f'{name.partition("_")[0]:9} {in_words(result[name], unit, factor)}')
    if result.get('normals_on_the_other_side') is not None:
        lines.append(f'normals on the other side {result["normals_on_the_other_side"]}')
    if result.get('completeness') is not None:
        radius = result['completeness_radius_m']
        lines.append(f'completeness {result["completeness"]:.2%} within {radius:g} m')
    else:
        lines.append('completeness unknown: for a world it needs the bag with simulation.json')
    if 'equal' in result:
        lines.append('equal to the bit' if result['equal'] else 'not equal to the bit')
    return lines


def with_unit(value: float | None, unit: str, factor: float = 1.0) -> str:
    """Return a number with its unit, or a dash for None."""
    return '-' if value is None else f'{value * factor:.3f} {unit}'


def in_words(errors: dict[str, float | None], unit: str, factor: float = 1.0) -> str:
    """Return errors as one line of text."""
    return '   '.join(f'{name} {with_unit(value, unit, factor)}' for name, value in errors.items())


def trajectories(args: argparse.Namespace) -> dict[str, Any]:
    """Return the errors of a trajectory."""
    from surfel_mapper.evaluation.trajectory_errors import compare
    from surfel_mapper.evaluation.truth import read_poses, true_poses
    from surfel_mapper.files.trajectory import read_trajectory, Trajectory
    from surfel_mapper.offline.motion_clock import path_shift_s

    files = [path for path in (args.map, args.truth) if not path.is_dir()]
    by_number = len(files) == 2 and all(read_trajectory(f).stamp_ns is None for f in files)
    estimated_ns, estimated = read_poses(args.map, by_number=by_number)
    true_ns, true = true_poses(args.truth, estimated_ns, by_number=by_number)
    if not by_number and not args.truth.is_dir():
        shift_s = path_shift_s(Trajectory.from_matrices(true, true_ns), estimated_ns, estimated)
        if shift_s is not None:
            _log.warning(
                '%s: by the motion, its times are %.3f s %s those of %s; errors compare poses of '
                'other times. Add %.3f s to its times',
                *(args.map, abs(shift_s), 'ahead of' if shift_s < 0 else 'behind', args.truth),
                shift_s,
            )
    try:
        return compare(
            estimated_ns,
            estimated,
            true_ns,
            true,
            max_difference_ns=round(args.max_difference * 1e9),
        )
    except ValueError as error:
        raise FileFormatError(f'{args.map}, {args.truth}: {error}') from error


def trajectory_lines(result: dict[str, Any]) -> list[str]:
    """Return the errors of a trajectory as lines of text."""
    lines = [f'poses {result["num_poses"]}']
    if result['on_a_line']:
        lines.append(
            'straight drive, or one whose errors exceed its width: its positions do not determine '
            'the rotation about it, on which the absolute rotation errors depend'
        )
    for kind in ('absolute', 'relative'):
        moved, turned = result[kind]['translation_m'], result[kind]['rotation_deg']
        lines.append(f'{kind} {in_words(moved, "mm", 1e3)}')
        lines.append(f'{" " * len(kind)} {in_words(turned, "deg")}')
    drift_m, drift_deg = result['drift_m_per_100m'], result['drift_deg_per_100m']
    lines.append(f'drift {with_unit(drift_m, "m")}, {with_unit(drift_deg, "deg")} in 100 m')
    return lines
