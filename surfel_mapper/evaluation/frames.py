# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The motion from the frame of a map to the frame of its truth.

A map whose poses come from registration begins at the origin, wherever the truth does. The motion
is refined from one start after the other until most surfels fit: the trajectories of both if they
have scans of equal stamps, the frames as they are, and the place that KISS-Matcher finds by
features, whatever the motion. Surfels are moved onto the surfaces of the truth (point to plane;
points without normals: point to point) with the kernel of Geman and McClure, which narrows from
metres to a quarter of the distance at which surfels are compared.

Sources: Chen and Medioni 1991 for the distance to planes; Geman and McClure 1985 for the kernel;
Lim et al. 2025 (KISS-Matcher) for places without a start.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from surfel_mapper.errors import AlignmentError, FileFormatError
from surfel_mapper.evaluation.comparison import Truth
from surfel_mapper.evaluation.map_files import Discs
from surfel_mapper.evaluation.trajectory_errors import common_stamps
from surfel_mapper.evaluation.truth import is_world, read_poses, true_poses
from surfel_mapper.files.trajectory import trajectory_beside
from surfel_mapper.geometry import compose, inverse, rotation_angle, se3_exp, Transform

Floats = npt.NDArray[np.float64]

USED = 3000
"""Number of surfels that are moved: their mean residual is known to 2 % then."""

FIRST_WIDTHS = (2.0, 8.0)
"""
First widths of the kernel, as multiples of the distance, one after the other: the wide one reaches
farther, but surfels without a counterpart in the truth pull it aside.
"""

LAST_WIDTH = 0.25
"""Last width of the kernel, as a multiple of the distance."""

STEPS = 8
"""Steps at each width."""

SETTLED_M = 1e-4
"""A step of less, m, is the last at its width."""

MIN_SHARE = 0.6
"""Minimum share near each other of an alignment; a wrong one along a street has .45."""

CLEAR_SHARE = 0.8
"""Share at which no further start is tried."""

FEW_NEAR = 0.5
"""Share of surfels near the truth below which the frames look different."""

SAME_NS = 10_000_000
"""Scans of two trajectories are the same if their stamps differ by at most 10 ms."""

FEATURE_VOXEL_M = 0.5
"""Edge of the voxels to which KISS-Matcher thins, m; its features reach 2.5 m."""

KISS_MATCHER_HINT = "pip install 'surfel_mapper[align]' finds places without a start"


@dataclass(frozen=True, slots=True, eq=False)
class FrameMotion:
    """
    The motion of a map onto its truth.

    Attributes
    ----------
    T_truth_map : (4, 4) float64
    start : str
        How the start was found: ``trajectories``, ``frames`` or ``features``.
    share : float
        Share of the surfels near the truth after the motion, or of the truth near a surfel,
        whichever is larger, as one may be a part of the other.
    share_before : float
        The same before.

    """

    T_truth_map: Transform
    start: str
    share: float
    share_before: float

    def summary(self) -> dict[str, Any]:
        """Return it as plain numbers."""
        return {
            'start': self.start,
            'moved_m': float(np.linalg.norm(self.T_truth_map[:3, 3])),
            'turned_deg': float(np.degrees(rotation_angle(self.T_truth_map))),
            'T_truth_map': self.T_truth_map.tolist(),
            'share_near': self.share,
            'share_near_before': self.share_before,
        }


def find_motion(
    surfels: Discs, truth: Truth, guesses: Mapping[str, Transform], width_m: float
) -> FrameMotion:
    """
    Return the motion that moves a map onto its truth.

    Parameters
    ----------
    surfels : Discs
        The map.
    truth : Truth
        The reference.
    guesses : mapping of str to (4, 4) float64
        Approximate T_truth_map, by name, which are tried first.
    width_m : float
        Distance within which a surfel is near the truth.

    Raises
    ------
    AlignmentError
        If from no start 60 % of the surfels come near the truth, or of the truth near a surfel.

    """
    samples = truth.samples()
    some = thinned(surfels.position)
    wanted = None if samples is None else thinned(samples)

    def share_at(T_truth_map: Transform, near_m: float) -> float:
        shares = [share_near(moved(some, T_truth_map), truth, near_m)]
        if wanted is not None and len(surfels):
            back = (wanted - T_truth_map[:3, 3]) @ T_truth_map[:3, :3]
            shares.append(float((tree.query(back)[0] < 2.0 * near_m).mean()))
        return max(shares)

    tree = cKDTree(surfels.position)
    attempts, tried = [], []
    for name, start in starts(guesses, surfels.position, samples):
        tried.append(name)
        for first in FIRST_WIDTHS:
            T_truth_map = refined(some, truth, start, width_m, first)
            attempts.append((share_at(T_truth_map, LAST_WIDTH * width_m), name, T_truth_map))
        if max(share for share, _, _ in attempts) > CLEAR_SHARE:
            break
    _, name, T_truth_map = max(attempts, key=lambda attempt: attempt[0])
    share = share_at(T_truth_map, width_m)
    if share < MIN_SHARE:
        hint = '' if 'features' in tried else f'; {KISS_MATCHER_HINT}'
        raise AlignmentError(
            f'{share:.0%} of the map comes within {width_m:g} m of the truth, expected '
            f'{MIN_SHARE:.0%}; tried from: {", ".join(tried)}{hint}'
        )
    return FrameMotion(T_truth_map, name, share, share_at(np.eye(4), width_m))


def starts(
    guesses: Mapping[str, Transform], position: Floats, samples: Floats | None
) -> Iterator[tuple[str, Transform]]:
    """Yield names and approximate T_truth_map: guesses, the frames as they are, by features."""
    yield from guesses.items()
    yield 'frames', np.eye(4)
    if samples is None or not has_kiss_matcher():
        return
    import kiss_matcher

    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(FEATURE_VOXEL_M))
    solution = matcher.estimate(position.astype(np.float32), samples.astype(np.float32))
    if solution.valid:
        T_truth_map = np.eye(4)
        u, _, vt = np.linalg.svd(np.asarray(solution.rotation, np.float64))
        T_truth_map[:3, :3], T_truth_map[:3, 3] = u @ vt, solution.translation
        yield 'features', T_truth_map


def has_kiss_matcher() -> bool:
    """Return whether KISS-Matcher is installed, which finds a place without a start."""
    return find_spec('kiss_matcher') is not None


def looks_needed(surfels: Discs, truth: Truth, width_m: float) -> str:
    """
    Return why map and truth seem to be in different frames; empty if they do not.

    Parameters
    ----------
    surfels : Discs
        The map.
    truth : Truth
        The reference.
    width_m : float
        Distance within which a surfel is near the truth.

    """
    some = thinned(surfels.position)
    if not len(some):
        return ''
    share = share_near(some, truth, width_m)
    if share < FEW_NEAR:
        return f'{share:.0%} of the surfels are within {width_m:g} m of the truth'
    T_truth_map = refined(some, truth, np.eye(4), width_m, FIRST_WIDTHS[0])
    aligned = moved(some, T_truth_map)
    way_m = float(np.median(np.linalg.norm(aligned - some, axis=1)))
    off_m, off_after_m = median_off(some, truth, width_m), median_off(aligned, truth, width_m)
    if way_m > width_m / 20.0 and off_after_m < 0.5 * off_m:
        return f'a motion of {way_m:.3g} m halves the median error'
    return ''


def known_starts(map_path: Path, truth_path: Path) -> dict[str, Transform]:
    """
    Return T_truth_map by the trajectories of a map and its truth, if they have equal stamps.

    Parameters
    ----------
    map_path, truth_path : Path
        Output directory of a replay or a file in it; the truth may be a simulated bag.

    """
    mine = trajectory_beside(map_path)
    if mine is None:
        return {}
    stamps_ns, poses = read_poses(mine)
    try:
        if is_world(truth_path):
            directory = truth_path if truth_path.is_dir() else truth_path.parent
            other_ns, truth_poses = true_poses(directory, stamps_ns)
        else:
            truth_file = trajectory_beside(truth_path)
            if truth_file is None:
                return {}
            other_ns, truth_poses = read_poses(truth_file)
    except FileFormatError:  # a world without its drive
        return {}
    rows, other_rows = common_stamps(stamps_ns, other_ns, SAME_NS)
    if not len(rows):
        return {}
    centre = len(rows) // 2
    T_sensor_map = inverse(poses[rows[centre]])
    return {'trajectories': compose(truth_poses[other_rows[centre]], T_sensor_map)}


def refined(
    position: Floats, truth: Truth, start: Transform, width_m: float, first: float
) -> Transform:
    """Return T_truth_map after moving positions (K, 3) onto the truth from a start."""
    T_truth_map, scale = start, first
    while scale >= LAST_WIDTH:
        for _ in range(STEPS):
            step = gauss_newton_step(moved(position, T_truth_map), truth, scale * width_m)
            T_truth_map = compose(se3_exp(step), T_truth_map)
            if np.linalg.norm(step[:3]) < SETTLED_M:
                break
        scale /= 2.0
    return T_truth_map


def gauss_newton_step(position: Floats, truth: Truth, width_m: float) -> Floats:
    """Return the step (6,), m and rad, that moves positions (K, 3) towards the truth."""
    nearest = truth.nearest(position)
    valid = np.isfinite(nearest.point).all(axis=1) & (nearest.distance_m < 3.0 * width_m)
    if nearest.normal is not None:
        valid &= np.isfinite(nearest.normal).all(axis=1)
    if valid.sum() < 6:
        return np.zeros(6)
    xyz = position[valid]
    gap = xyz - nearest.point[valid]
    if nearest.normal is None:
        axes = np.broadcast_to(np.eye(3), (len(xyz), 3, 3))
    else:
        axes = nearest.normal[valid][:, None]
    off = np.einsum('kai,ki->ka', axes, gap)
    weight = (width_m**2 / ((off**2).sum(axis=1) + width_m**2)) ** 2
    centre = xyz.mean(axis=0)  # lever arms about the middle keep the system well conditioned
    turns = np.cross((xyz - centre)[:, None], axes)
    jacobian = np.concatenate([axes, turns], axis=2)
    hessian = np.einsum('kai,k,kaj->ij', jacobian, weight, jacobian)
    gradient = np.einsum('kai,k,ka->i', jacobian, weight, off)
    step = -np.linalg.lstsq(hessian, gradient, rcond=1e-9)[0]
    about_origin: Floats = np.concatenate([step[:3] - np.cross(step[3:], centre), step[3:]])
    return about_origin


def moved(position: Floats, T_truth_map: Transform) -> Floats:
    """Return positions (K, 3) of the map in the frame of the truth."""
    in_truth: Floats = position @ T_truth_map[:3, :3].T + T_truth_map[:3, 3]
    return in_truth


def moved_discs(surfels: Discs, T_truth_map: Transform) -> Discs:
    """Return a map in the frame of its truth."""
    normal = None if surfels.normal is None else surfels.normal @ T_truth_map[:3, :3].T
    return replace(surfels, position=moved(surfels.position, T_truth_map), normal=normal)


def share_near(position: Floats, truth: Truth, width_m: float) -> float:
    """Return the share of positions (K, 3) within a distance of a surface; 0 for none."""
    nearest = truth.nearest(position)
    near = (nearest.distance_m < 4.0 * width_m) & (nearest.off_m < width_m)
    return float(near.mean()) if len(near) else 0.0


def median_off(position: Floats, truth: Truth, width_m: float) -> float:
    """Return the median distance from the surfaces of those positions (K, 3) that are near."""
    nearest = truth.nearest(position)
    near = nearest.distance_m < width_m
    return float(np.median(nearest.off_m[near])) if near.any() else width_m


def thinned(position: Floats) -> Floats:
    """Return an even selection of at most USED positions (K, 3)."""
    return position[:: -(-len(position) // USED) or 1]
