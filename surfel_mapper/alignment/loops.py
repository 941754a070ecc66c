# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Poses of keyframes that agree with the loops between them, and the loops that are wrong.

The graph is that of LUM. Keyframes are vertices; an edge has six virtual points, 10 m from the
sensor along its axes, whose weights state how well the motion between two keyframes is known:
odometry by a share of the step, a loop by ``LOOP_SIGMA_M``. A loop that is wrong must not bend the
map: its weight is that of Geman and McClure's kernel, whose width falls from all residuals to that
of a right loop while the poses are solved (graduated non-convexity). So a loop is kept if bending
the odometry for it costs less than doubting it, given all other loops.

Source: Lu and Milios 1997; Yang, Antonante, Tzoumas and Carlone 2020 for the robust solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.angles import poses_of, transforms
from surfel_mapper.alignment.correspondences import moved
from surfel_mapper.alignment.lum import LUM
from surfel_mapper.alignment.window import ANCHORS
from surfel_mapper.errors import AlignmentError, counted
from surfel_mapper.geometry import compose, inverse, Transform

Floats = npt.NDArray[np.float64]

LOOP_SIGMA_M = 0.05
"""Standard deviation of the anchors of a verified loop: 5 cm, or 0.3 deg at 10 m."""

ODOMETRY_LEAST_M = 0.005
"""Minimum standard deviation of the anchors of an odometry edge, m."""

WIDTH = 5.0
"""Residual, in standard deviations of a loop, at which its weight is a quarter."""

NARROWING = 1.6
"""Factor by which the kernel gets narrower in a round."""

STEPS = 3
"""Steps of LUM in a round."""

KEPT = 0.25
"""Minimum final weight of a loop that counts as right."""


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """
    A motion between two keyframes that are not consecutive: measured, or a candidate.

    Attributes
    ----------
    source, target : int
        Numbers of the keyframes, the later one first.
    T_target_source : (4, 4) float64
        Pose of the source in the frame of the target; of a candidate about 1 m and 2 deg off if it
        is right.
    support : float
        Share of the source that fits the target, in [0, 1].
    votes : int
        Features that recognised it; 0 if it follows from the poses.

    """

    source: int
    target: int
    T_target_source: Transform
    support: float = 1.0
    votes: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class LoopSolution:
    """
    Poses that agree with the loops.

    Attributes
    ----------
    T_map_key : (K, 4, 4) float64
        Poses of the keyframes; the first is unchanged.
    weights : (L,) float64
        Final weight of every loop, in [0, 1].
    is_kept : (L,) bool
        Whether each loop is used; the others are wrong.

    """

    T_map_key: Floats
    weights: Floats
    is_kept: npt.NDArray[np.bool_]


def solve_loops(T_map_key: Floats, loops: Sequence[Loop], drift_ratio: float) -> LoopSolution:
    """
    Return the poses of keyframes that agree with odometry and all loops that are right.

    Parameters
    ----------
    T_map_key : (K, 4, 4) float64
        Poses by odometry, in the order of the path.
    loops : sequence of Loop
        Verified loops; some may be wrong.
    drift_ratio : float
        Standard deviation of a step of odometry, as a share of its length.

    Raises
    ------
    AlignmentError
        If there are fewer than two keyframes, or a loop names one that does not exist.

    """
    poses = np.asarray(T_map_key, np.float64)
    if len(poses) < 2:
        raise AlignmentError(f'{counted(len(poses), "keyframe")}, expected two or more')
    for loop in loops:
        if not 0 <= loop.target < loop.source < len(poses):
            raise AlignmentError(
                f'loop {loop.source} -> {loop.target}: expected a later and an earlier one of '
                f'{len(poses)} keyframes'
            )
    if not loops:
        return LoopSolution(poses.copy(), np.empty(0), np.empty(0, bool))
    graph = _LoopGraph(poses, loops, drift_ratio)
    weights: Floats = np.ones(len(loops))
    graph.solve(weights)
    residual = graph.residuals()
    width = max(2.0 * float(residual.max()) / WIDTH**2, 1.0)
    while True:
        reach = width * WIDTH**2
        weights = (reach / (graph.residuals() + reach)) ** 2
        graph.solve(weights)
        if width == 1.0:
            break
        width = max(width / NARROWING, 1.0)
    weights = (WIDTH**2 / (graph.residuals() + WIDTH**2)) ** 2
    is_kept = weights >= KEPT
    graph.solve(np.where(is_kept, 1.0, 0.0))
    solved = graph.T_map_key
    solved[0] = poses[0]  # bit for bit
    return LoopSolution(solved, weights, is_kept)


class _LoopGraph:
    """The graph of LUM: keyframes, odometry and loops, as pairs of virtual points."""

    def __init__(self, T_map_key: Floats, loops: Sequence[Loop], drift_ratio: float) -> None:
        self._T_map_first = T_map_key[0]
        self._loops = loops
        num, size = len(T_map_key), len(ANCHORS)
        points = [[ANCHORS] for _ in range(num)]
        self._rows = []
        for loop in loops:
            self._rows.append(size * len(points[loop.target]))
            points[loop.target].append(moved(ANCHORS, loop.T_target_source))
        steps = [compose(inverse(T_map_key[v]), T_map_key[v - 1]) for v in range(1, num)]
        for v, T_v_before in enumerate(steps, start=1):
            points[v].append(moved(ANCHORS, T_v_before))
        start = poses_of(inverse(self._T_map_first) @ T_map_key, np.zeros((num, 6)))
        self._lum = LUM(max_iterations=STEPS)
        for v in range(num):
            self._lum.add_point_cloud(np.concatenate(points[v]), start[v] if v else None)
        number = np.arange(size)
        for v, T_v_before in enumerate(steps, start=1):
            sigma_m = max(drift_ratio * float(np.linalg.norm(T_v_before[:3, 3])), ODOMETRY_LEAST_M)
            pairs = np.stack([number, size * (len(points[v]) - 1) + number], axis=1)
            self._lum.set_correspondences(v - 1, v, pairs, _weights(sigma_m))

    def solve(self, weights: Floats) -> None:
        """Move the keyframes, with given weights of the loops."""
        number = np.arange(len(ANCHORS))
        for loop, row, weight in zip(self._loops, self._rows, weights.tolist(), strict=True):
            pairs = np.stack([number, row + number], axis=1)
            matrices = weight * _weights(LOOP_SIGMA_M)
            self._lum.set_correspondences(loop.source, loop.target, pairs, matrices)
        self._lum.compute()

    @property
    def T_map_key(self) -> Floats:
        """The current poses, (K, 4, 4)."""
        return np.asarray(self._T_map_first @ transforms(self._lum.graph.poses))

    def residuals(self) -> Floats:
        """Return the mean squared gap of the anchors of every loop, in variances, (L,)."""
        T = transforms(self._lum.graph.poses)
        result = np.empty(len(self._loops))
        for row, loop in enumerate(self._loops):
            T_target_source = compose(inverse(T[loop.target]), T[loop.source])
            gap = moved(ANCHORS, T_target_source) - moved(ANCHORS, loop.T_target_source)
            result[row] = (gap * gap).sum() / (len(ANCHORS) * LOOP_SIGMA_M**2)
        return result


def _weights(sigma_m: float) -> Floats:
    """Return the weights (6, 3, 3) of an edge whose anchors have a standard deviation."""
    return np.tile(np.eye(3) / (len(ANCHORS) * sigma_m**2), (len(ANCHORS), 1, 1))
