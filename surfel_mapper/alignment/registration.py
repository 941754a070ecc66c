# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Registration: the pose of a scan on a map of surfels, by point-to-plane Gauss-Newton.

The scan is reduced to the means of its cells, and Gauss-Newton moves these onto the planes of the
surfels of their voxels; there is no neighbour search. If the prediction may be off by more than a
voxel, larger voxels come first, made of the same exact moments. A scan that finally does not fit
is tried from other headings, because a hand turns a lidar faster than any prediction.

The eigenvalues of the normal equations, rotations scaled by the mean lever, tell the directions of
motion that the scan does not determine (a tunnel, a plain). In these the prediction is kept, after
Zhang, Kaess and Singh 2016. The share of the information is compared, not its amount, which would
need a threshold for every sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.kernels.steps import solve_step
from surfel_mapper.alignment.scan_view import ScanView
from surfel_mapper.alignment.surfel_planes import means, PlaneLevels, SurfelPlanes
from surfel_mapper.arguments import Record
from surfel_mapper.config import RegistrationConfig
from surfel_mapper.geometry import (
    compose,
    inverse,
    pose_matrix,
    q_xyzw,
    rotation_angle,
    Transform,
)
from surfel_mapper.mapping.reducer import Reducer
from surfel_mapper.mapping.surfel_map import SurfelMap

TOLERANCE_M = 1e-4
"""Displacement of the points by a step, m, below which iteration ends."""

COARSE_TOLERANCE = 0.01
"""The same in coarser voxels, as a share of the voxel size."""

COARSE_CELLS = 4000
"""Maximum number of cells that are aligned to coarser voxels."""

SAME_VOXELS = 0.03
"""Displacement of the points, as a share of the voxel size, up to which cells keep their surfels
between two steps: 3 % of the cells at most would meet another one."""

LEAST_RATIO = 1e-12
"""Share of the information below which a direction is never determined: rounding."""

LEAST_FINER = 0.45
"""Overlap, as a share of that of the voxels twice as large, below which the pose of these is kept:
few beams fill some voxels with single rings, which move with the sensor."""

SPARSE = 0.35
"""Overlap below which larger voxels are tried even if the prediction was right."""

SEARCH_STEP_DEG = 7.5
"""Step of the heading search, deg."""

ROUGH_CELLS, ROUGH_STEPS, ROUGH_PLACES = 1000, 8, 12
"""Cells and Gauss-Newton steps with which the search compares all headings, and the number of best
places from which it goes on: a third of the time of converging from every heading."""

SEARCH_CELLS = 3000
"""Number of cells with which it goes on from these."""

SEARCH_STARTS = 4
"""Number of best places of the search from which the whole scan is aligned."""

STEPS_ALONG = (-3, -2, -1, 1, 2, 3)
"""Starts along an undetermined direction, in halves of the largest voxel from the prediction."""

RELOCATED = 8
"""Number of best places in the whole map from which the whole scan is aligned."""

MAX_SEEN_THROUGH = 0.1
"""Share of surfaces seen through from which on a pose far from the prediction has to be searched
for: at most 0.05 at right poses of a dense lidar, 0.14 and more at wrong ones."""

FIT_POWER, SEEN_THROUGH_POWER = 3, 12
"""A place counts by its overlap, times its fit to the first power, times (1 - seen through) to the
second: what contradicts a place outweighs cells that meet some surfel there."""

AMBIGUOUS = 0.9
"""Places with this share of the best support fit equally well; the nearest is taken."""

FARTHER = 1.5
"""A place that needs this times the motion of the nearest is no rival of it."""

SAME_PLACE_DEG = 10.0
"""Poses of the search that differ by less, and by less than a voxel, are one place."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class RegistrationResult(Record):
    """
    Pose of a scan, and measures of its reliability.

    Attributes
    ----------
    T_map_sensor : (4, 4) float64
        Pose of the sensor.
    num_cells : int
        Number of cells of the scan.
    overlap : float
        Share of the cells that hit a usable surfel, in [0, 1].
    fit : float
        Share of these cells that fit the surfel, in [0, 1].
    converged : bool
        Whether the last step was below the tolerance.
    iterations : int
        Number of steps.
    information : (6, 6) float64
        Inverse covariance of position (m) and rotation (rad) about the sensor, along the axes of
        the map; too large if the errors of neighbouring points are correlated.
    degenerate : (D, 6) float64
        Directions in which the prediction is kept, unit vectors, rotations scaled by ``radius_m``.
    radius_m : float
        Root mean square lever of the cells, by which rotations are scaled.
    rival : float
        Support of another place that fits about equally well and is about as near to the starts;
        0 if there is none, or if the first start fitted and no search was needed.
    is_found : bool
        The place was found by a search and differs from that of the first start.
    expected : RegistrationResult, optional
        The place aligned from the first start, if a search found another.
    seen_through : float
        Share of the surfaces of the map in view that the scan sees through, in [0, 1]; nan if the
        pose is near the first start and no search was needed.
    level : int
        Level of the map that overlap and fit refer to.
    companions : float
        Share of the cells that move along with the sensor, in [0, 1]; see alignment/companions.py.

    """

    T_map_sensor: Transform
    num_cells: int
    overlap: float
    fit: float
    converged: bool
    iterations: int
    information: npt.NDArray[np.float64]
    degenerate: npt.NDArray[np.float64]
    radius_m: float
    rival: float = 0.0
    is_found: bool = False
    expected: RegistrationResult | None = None
    seen_through: float = math.nan
    level: int = 0
    companions: float = 0.0

    @property
    def support(self) -> float:
        """Share of all cells that fit."""
        return self.overlap * self.fit

    @property
    def score(self) -> float:
        """How well a place explains the scan, to be compared with other places."""
        agreement = self.fit**FIT_POWER * (1.0 - self.seen_through) ** SEEN_THROUGH_POWER
        return self.overlap * agreement


class Registration:
    """
    Aligns scans to maps.

    Parameters
    ----------
    config : RegistrationConfig
        The settings; may be replaced at any time.
    voxel_size_m : float
        Voxel size of the maps.

    """

    def __init__(self, config: RegistrationConfig, voxel_size_m: float) -> None:
        self.config = config
        self._voxel_size_m = voxel_size_m
        self._reducer = Reducer(config.cell_m or 0.5 * voxel_size_m)

    @property
    def cell_m(self) -> float:
        """Edge of the cells that a scan is reduced to, m."""
        return self.config.cell_m or 0.5 * self._voxel_size_m

    def cells(
        self, points: npt.ArrayLike, min_range_m: float = 0.0, max_range_m: float = math.inf
    ) -> npt.NDArray[np.float64]:
        """Return the mean of the points (N, 3) of a scan in each cell, (K, 3) float64, m."""
        size_m = self.cell_m
        if size_m != self._reducer.voxel_size_m:
            self._reducer = Reducer(size_m)
        moments = self._reducer.reduce(points, min_range_m=min_range_m, max_range_m=max_range_m)
        step = -(-len(moments) // self.config.max_cells) or 1
        return means(moments.select(slice(None, None, step)))

    def align(
        self,
        cells: npt.NDArray[np.float64],
        surfel_map: SurfelMap,
        starts: Sequence[Transform],
        deviation_m: float,
        expected_support: float = 0.0,
        is_lost: bool = False,
    ) -> RegistrationResult:
        """
        Return the pose of a scan on a map.

        Parameters
        ----------
        cells : (K, 3) float64, m
            Cells of the scan, from ``cells``.
        surfel_map : SurfelMap
            A map of the given voxel size.
        starts : sequence of (4, 4) float64
            Possible poses, the likeliest first; degenerate directions keep its value. The others
            are tried if it does not fit.
        deviation_m : float
            Expected error of the cells at the first start; determines the coarsest level and the
            width of the robust kernel.
        expected_support : float
            Other starts and headings are tried if less of the scan fits.
        is_lost : bool
            The starts are guesses: they are all tried, and of places that fit about equally well
            each is a rival of the best, however far it is.

        """
        levels = PlaneLevels(self.config, surfel_map, cells, starts)
        result = self._descend(cells, levels, starts[0], deviation_m)
        is_usual = result.converged and result.support >= expected_support and self.fits(result)
        is_predicted = deviation_m <= self._voxel_size_m and not is_lost
        if is_usual and is_predicted and self._is_near(result, starts[0]):
            return result
        view = ScanView(cells)
        result = self._viewed(result, view, levels)
        if is_usual and not is_lost and result.seen_through <= MAX_SEEN_THROUGH:
            return result
        width_m = levels.voxel_size_m(self.config.coarse_levels)
        searched = [
            self._viewed(self._descend(cells, levels, start, width_m), view, levels)
            for start in self._searched_poses(cells, levels, starts)
        ]
        results = self._at_one_level([result, *searched], cells, levels)
        chosen = self._chosen(results, starts, is_lost)
        if self._is_near(chosen, result.T_map_sensor):
            return chosen
        return replace(chosen, is_found=True, expected=results[0])

    def determined(
        self,
        result: RegistrationResult,
        cells: npt.NDArray[np.float64],
        surfel_map: SurfelMap,
        starts: Sequence[Transform],
    ) -> RegistrationResult:
        """
        Return a degenerate result of ``align``, or one nearby that determines more directions.

        The end of a corridor determines the motion along it, but no cell of it meets a surfel if
        the start is off by more than a voxel. So starts along the undetermined directions are
        aligned to the largest voxels, and the whole scan from the best of those. It is for starts
        without a prediction: in a hall seen by 90 deg predictions were better than this.

        Parameters
        ----------
        result : RegistrationResult
            The degenerate result.
        cells : (K, 3) float64, m
            Cells of the scan.
        surfel_map : SurfelMap
            The map.
        starts : sequence of (4, 4) float64
            Those of the result; of places that fit about equally well the nearest is taken.

        """
        levels = PlaneLevels(self.config, surfel_map, cells, starts)
        level, num = self.config.coarse_levels, len(result.degenerate)
        planes, some = levels.planes(level), thinned(cells, SEARCH_CELLS)
        size_m = planes.voxel_size_m
        steps = result.degenerate / np.repeat([1.0, result.radius_m], 3)
        rough = [
            self._converge(
                *(some, planes, moved(result.T_map_sensor, number * 0.5 * size_m * step)),
                *(size_m, COARSE_TOLERANCE * size_m, self.config.max_iterations),
            )
            for step in steps
            for number in STEPS_ALONG
        ]
        candidates = [coarse for coarse in rough if len(coarse.degenerate) < num]
        view, results = ScanView(cells), []
        for pose in self._distinct_poses(candidates, SEARCH_STARTS):
            candidate = self._viewed(self._descend(cells, levels, pose, size_m), view, levels)
            fits = candidate.converged and candidate.support >= AMBIGUOUS * result.support
            is_determined = len(candidate.degenerate) < num
            if fits and is_determined and candidate.seen_through <= MAX_SEEN_THROUGH:
                results.append(candidate)
        return self._chosen(results, starts, is_lost=False) if results else result

    def relocate(
        self,
        cells: npt.NDArray[np.float64],
        surfel_map: SurfelMap,
        poses_tried: Sequence[Transform],
    ) -> RegistrationResult:
        """
        Return the pose of a scan that may be at any of some places, of PlaceSearch.

        Each place that fits about as well as the best one is its rival.

        Parameters
        ----------
        cells : (K, 3) float64, m
            Cells of the scan, from ``cells``.
        surfel_map : SurfelMap
            A map of the given voxel size.
        poses_tried : sequence of (4, 4) float64
            Possible poses, at least one.

        """
        level, some = self.config.coarse_levels, thinned(cells, ROUGH_CELLS)
        rough = []
        for pose in poses_tried:  # levels of its own: those of all would be the whole map
            planes = PlaneLevels(self.config, surfel_map, some, [pose]).planes(level)
            size_m = planes.voxel_size_m
            tolerance_m = COARSE_TOLERANCE * size_m
            rough.append(self._converge(some, planes, pose, size_m, tolerance_m, ROUGH_STEPS))
        view, results = ScanView(cells), []
        for pose in self._distinct_poses(rough, RELOCATED):
            levels = PlaneLevels(self.config, surfel_map, cells, [pose])
            result = self._descend(cells, levels, pose, levels.voxel_size_m(level))
            results.append(self._viewed(result, view, levels))
        return replace(self._chosen(results, poses_tried[:1], is_lost=True), is_found=True)

    def seen_through(
        self, cells: npt.NDArray[np.float64], surfel_map: SurfelMap, T_map_sensor: Transform
    ) -> float:
        """Return the share of the surfaces of a map that a scan at a pose sees through."""
        surfaces = PlaneLevels(self.config, surfel_map, cells, [T_map_sensor]).surfaces
        return ScanView(cells).seen_through(surfaces, T_map_sensor, self._voxel_size_m)

    def _is_near(self, result: RegistrationResult, pose: Transform) -> bool:
        """Return whether a result is at the same place as a pose, within a voxel."""
        return is_near(result.T_map_sensor, pose, self._voxel_size_m)

    def _viewed(
        self, result: RegistrationResult, view: ScanView, levels: PlaneLevels
    ) -> RegistrationResult:
        """Return a result with the share of the map that its scan sees through."""
        share = view.seen_through(levels.surfaces, result.T_map_sensor, self._voxel_size_m)
        return replace(result, seen_through=share)

    def _at_one_level(
        self,
        results: Sequence[RegistrationResult],
        cells: npt.NDArray[np.float64],
        levels: PlaneLevels,
    ) -> list[RegistrationResult]:
        """
        Return results with overlap and fit at the coarsest level of any of them.

        More cells meet a surfel in larger voxels: results of two levels cannot be compared.
        """
        level = max(result.level for result in results)
        planes, width_m = levels.planes(level), 0.5 * levels.voxel_size_m(level)
        compared = []
        for result in results:
            if result.level < level:
                *_, overlap, fit = planes.equations(cells, result.T_map_sensor, width_m)
                result = replace(result, overlap=overlap, fit=fit, level=level)
            compared.append(result)
        return compared

    def _chosen(
        self, results: Sequence[RegistrationResult], starts: Sequence[Transform], is_lost: bool
    ) -> RegistrationResult:
        """
        Return the nearest of the results that fit about equally well, with its rival.

        If the scan is lost, return the best one.
        """
        best = max(results, key=lambda result: (result.converged, result.score))
        if not (best.converged and best.score > 0.0):
            return best

        def motion_m(result: RegistrationResult) -> float:
            off = [compose(inverse(start), result.T_map_sensor) for start in starts]
            return min(math.hypot(*T[:3, 3], best.radius_m * rotation_angle(T)) for T in off)

        equal = [p for p in results if p.converged and p.score >= AMBIGUOUS * best.score]
        nearest = best if is_lost else min(equal, key=motion_m)
        reach_m = math.inf if is_lost else FARTHER * motion_m(nearest)
        rivals = [
            result.support
            for result in equal
            if motion_m(result) < reach_m and not self._is_near(result, nearest.T_map_sensor)
        ]
        return replace(nearest, rival=max(rivals, default=0.0))

    def fits(self, alignment: RegistrationResult) -> bool:
        """Return whether overlap and fit reach their minimum."""
        config = self.config
        return (
            alignment.fit >= config.min_fit_ratio and alignment.overlap >= config.min_overlap_ratio
        )

    def _descend(
        self,
        cells: npt.NDArray[np.float64],
        levels: PlaneLevels,
        start: Transform,
        deviation_m: float,
    ) -> RegistrationResult:
        """Align from the level that a deviation requires down to the map itself."""
        reach = max(3.0 * deviation_m / levels.voxel_size_m(0), 1.0)
        coarsest = min(self.config.coarse_levels, math.ceil(math.log2(reach)))
        result, iterations = None, 0
        for level in range(coarsest, -1, -1):
            pose = start if result is None else result.T_map_sensor
            size_m = levels.voxel_size_m(level)
            width_m = min(deviation_m, 0.5 * size_m)
            tolerance_m = COARSE_TOLERANCE * size_m if level else TOLERANCE_M
            some = thinned(cells, COARSE_CELLS) if level else cells
            most = self.config.max_iterations
            finer = self._converge(some, levels.planes(level), pose, width_m, tolerance_m, most)
            iterations += finer.iterations
            if result is None or finer.overlap >= LEAST_FINER * result.overlap:
                result = replace(finer, level=level)
        assert result is not None, 'there is always level 0'
        if not coarsest and result.overlap < SPARSE:
            return self._descend(cells, levels, start, levels.voxel_size_m(0))
        return replace(result, num_cells=len(cells), iterations=iterations)

    def _converge(
        self,
        cells: npt.NDArray[np.float64],
        planes: SurfelPlanes,
        start: Transform,
        width_m: float,
        tolerance_m: float,
        max_iterations: int,
    ) -> RegistrationResult:
        """Iterate Gauss-Newton steps until they are below the tolerance."""
        pose, iteration, moved_m = start, 0, math.inf
        least = self.config.min_information_ratio
        rows, placed_m = planes.rows_at(cells, pose), 0.0
        while True:
            if placed_m > SAME_VOXELS * planes.voxel_size_m:
                rows, placed_m = planes.rows_at(cells, pose), 0.0
            hessian, gradient, overlap, fit = planes.equations(cells, pose, width_m, rows)
            if moved_m < tolerance_m or iteration == max_iterations:
                break
            step, degenerate, radius_m = solve(hessian, gradient, least)
            pose = moved(pose, step)
            moved_m = math.hypot(*step[:3], *(radius_m * step[3:]))
            placed_m += moved_m
            iteration += 1
        return RegistrationResult(
            T_map_sensor=pose,
            num_cells=len(cells),
            overlap=overlap,
            fit=fit,
            converged=moved_m < tolerance_m,
            iterations=iteration,
            information=hessian,
            degenerate=degenerate,
            radius_m=radius_m,
        )

    def _searched_poses(
        self, cells: npt.NDArray[np.float64], levels: PlaneLevels, starts: Sequence[Transform]
    ) -> list[Transform]:
        """
        Return the best poses that a coarse alignment of some cells finds.

        Every start is turned in steps and aligned to the largest voxels. Comparing headings
        without aligning them would compare errors of position: a hall of two symmetries then
        takes the wrong corner.
        """
        planes = levels.planes(self.config.coarse_levels)
        size_m = planes.voxel_size_m
        poses = turned(starts, int(self.config.search_deg / SEARCH_STEP_DEG))
        stages = (
            (ROUGH_CELLS, ROUGH_STEPS, ROUGH_PLACES),
            (SEARCH_CELLS, self.config.max_iterations, SEARCH_STARTS),
        )
        for num_cells, num_steps, num_places in stages:
            some = thinned(cells, num_cells)
            results = [
                self._converge(some, planes, pose, size_m, COARSE_TOLERANCE * size_m, num_steps)
                for pose in poses
            ]
            poses = self._distinct_poses(results, num_places)
        return poses

    def _distinct_poses(self, results: list[RegistrationResult], num: int) -> list[Transform]:
        """Return the poses of the best supported results at different places."""
        poses: list[Transform] = []
        for result in sorted(results, key=lambda result: result.support, reverse=True):
            pose = result.T_map_sensor
            if not any(is_near(pose, chosen, self._voxel_size_m) for chosen in poses):
                poses.append(pose)
            if len(poses) == num:
                break
        return poses


def thinned(cells: npt.NDArray[np.float64], num: int) -> npt.NDArray[np.float64]:
    """Return an even selection of cells (K, 3), less than twice a number of them."""
    return np.ascontiguousarray(cells[:: max(len(cells) // num, 1)])


def turned(starts: Sequence[Transform], num: int) -> list[Transform]:
    """Return starts turned about the vertical by up to ``num`` steps to both sides."""
    steps = [math.radians(k * SEARCH_STEP_DEG) for k in range(-num, num + 1)]
    return [
        moved(start, np.array([0.0, 0.0, 0.0, 0.0, 0.0, angle]))
        for start in starts
        for angle in steps
    ]


def is_near(T_a: Transform, T_b: Transform, distance_m: float) -> bool:
    """Return whether two poses are at the same place within a distance and SAME_PLACE_DEG."""
    off = compose(inverse(T_a), T_b)
    is_close = math.dist(T_a[:3, 3], T_b[:3, 3]) < distance_m
    return is_close and rotation_angle(off) < math.radians(SAME_PLACE_DEG)


def solve(
    hessian: npt.NDArray[np.float64], gradient: npt.NDArray[np.float64], min_ratio: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], float]:
    """
    Return the Gauss-Newton step in the directions that are not degenerate.

    Parameters
    ----------
    hessian, gradient : (6, 6), (6,) float64
        For position, m, and rotation, rad.
    min_ratio : float
        Smallest eigenvalue of a determined direction, scaled so that the eigenvalues of position
        sum to 1 and those of rotation too.

    Returns
    -------
    step : (6,) float64
    degenerate : (D, 6) float64
        The undetermined directions, unit vectors, rotations scaled.
    radius_m : float
        Scale of rotations.

    """
    step, values, vectors = np.empty(6), np.empty(6), np.empty((6, 6))
    least = max(min_ratio, LEAST_RATIO)
    radius_m = float(solve_step(hessian, gradient, least, step, values, vectors))
    return step, vectors[values < least], radius_m


def moved(T_map_sensor: Transform, step: npt.NDArray[np.float64]) -> Transform:
    """Return a pose moved by step[:3], m, and rotated in place by the vector step[3:], rad."""
    half = 0.5 * math.hypot(*step[3:])
    scale = 0.5 * math.sin(half) / half if half > 0.0 else 0.5
    turn = pose_matrix((0.0, 0.0, 0.0), [*(scale * step[3:]), math.cos(half)])
    return pose_matrix(T_map_sensor[:3, 3] + step[:3], q_xyzw(compose(turn, T_map_sensor)))
