# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Registration: where a scan belongs on a map of surfels.

The scan is reduced to the means of its cells, and Gauss-Newton brings these onto the planes of
the surfels in whose voxels they lie; there is no search for neighbours. Where the prediction may
be off by more than a voxel, larger voxels come first, made of the same exact moments. A scan
that does not fit in the end is tried from other headings, as a hand turns a lidar faster than any
prediction.

The eigenvalues of the normal equations, turns scaled by the mean distance of what is seen, tell
which directions of motion the scan says nothing about (a tunnel, a plain). There the prediction
stays, after Zhang, Kaess and Singh 2016; the share of the information is compared, not its
amount, for which every sensor would need a threshold of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.plane_levels import PlaneLevels
from surfel_mapper.alignment.surfel_planes import SurfelPlanes
from surfel_mapper.config import RegistrationConfig
from surfel_mapper.geometry import compose, pose_matrix, q_xyzw, se3_exp, Transform
from surfel_mapper.kernels.layout import BITS, HALF
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.reducer import Reducer
from surfel_mapper.mapping.surfel_map import SurfelMap

TOLERANCE_M = 1e-4
"""A step that moves what is seen by less is the last."""

COARSE_TOLERANCE = 0.01
"""In coarser voxels: by less than this share of one."""

SEARCH_STEP_DEG = 7.5
SEARCH_CELLS = 3000
"""Headings are compared so many degrees apart, by so many cells."""

SEARCH_STARTS = 3
"""From the best so many headings the scan is aligned."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RegistrationResult:
    """
    Where a scan belongs.

    Attributes
    ----------
    T_map_sensor : (4, 4) float64
        Pose of the sensor.
    num_cells : int
        How many cells the scan has.
    overlap : float
        Share of them that meet a surfel which says something, in [0, 1].
    fit : float
        Share of these that fit it, in [0, 1].
    converged : bool
        Whether the last step was small.
    iterations : int
        Steps taken.
    information : (6, 6) float64
        Inverse of a covariance of position (m) and turn (rad) about the sensor, along the axes of
        the map; too large where neighbouring points are off alike.
    degenerate : (D, 6) float64
        Directions in which the prediction stayed, unit vectors, turns scaled by ``radius_m``.
    radius_m : float
        Root mean square of the levers by which what is seen says something about turns.

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

    @property
    def support(self) -> float:
        """Share of all cells that fit: what is best where the scan belongs."""
        return self.overlap * self.fit


class Registration:
    """
    Aligns scans to maps.

    Parameters
    ----------
    config : RegistrationConfig
        The settings; may be replaced at any time.
    voxel_size_m : float
        Of the maps.

    """

    def __init__(self, config: RegistrationConfig, voxel_size_m: float) -> None:
        """Keep the settings."""
        self.config = config
        self._voxel_size_m = voxel_size_m
        self._reducer = Reducer(config.cell_m or 0.5 * voxel_size_m)

    def cells(
        self, points: npt.ArrayLike, min_range_m: float = 0.0, max_range_m: float = math.inf
    ) -> npt.NDArray[np.float64]:
        """Return the means of the points (N, 3) of a scan in its cells, (K, 3) float64, m."""
        size_m = self.config.cell_m or 0.5 * self._voxel_size_m
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
    ) -> RegistrationResult:
        """
        Return where a scan belongs on a map.

        Parameters
        ----------
        cells : (K, 3) float64, m
            As ``cells`` returns them.
        surfel_map : SurfelMap
            Of the voxel size stated.
        starts : sequence of (4, 4) float64
            Where it may be, the likeliest first; degenerate directions stay as there. The others
            are tried where that does not fit.
        deviation_m : float
            How far cells may be off at the first start; decides where to begin and how much is
            believed.
        expected_support : float
            Other starts and headings are tried where less of the scan fits.

        """
        levels = PlaneLevels(self.config, surfel_map, cells, starts)
        found = self._descend(cells, levels, starts[0], deviation_m)
        if not (found.converged and found.support >= expected_support and self.fits(found)):
            width_m = levels.voxel_size_m(self.config.coarse_levels)
            others = [
                self._descend(cells, levels, start, width_m)
                for start in self._headings(cells, levels, starts)
            ]
            found = max([found, *others], key=lambda other: (other.converged, other.support))
        return found

    def fits(self, alignment: RegistrationResult) -> bool:
        """Return whether an alignment may be right, by what it says itself."""
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
        """Align from the level that a deviation asks for down to the map itself."""
        reach = max(3.0 * deviation_m / levels.voxel_size_m(0), 1.0)
        coarsest = min(self.config.coarse_levels, math.ceil(math.log2(reach)))
        found, iterations = None, 0
        for level in range(coarsest, -1, -1):
            pose = start if found is None else found.T_map_sensor
            size_m = levels.voxel_size_m(level)
            width_m = min(deviation_m, 0.5 * size_m)
            tolerance_m = COARSE_TOLERANCE * size_m if level else TOLERANCE_M
            finer = self._converge(cells, levels.planes(level), pose, width_m, tolerance_m)
            iterations += finer.iterations
            # the first scans of few beams may fill larger voxels only: they are better than none
            if found is None or finer.overlap >= self.config.min_overlap_ratio:
                found = finer
        assert found is not None, 'there is always level 0'
        return replace(found, iterations=iterations)

    def _converge(
        self,
        cells: npt.NDArray[np.float64],
        planes: SurfelPlanes,
        start: Transform,
        width_m: float,
        tolerance_m: float,
    ) -> RegistrationResult:
        """Take Gauss-Newton steps until they are small."""
        pose, iteration, moved_m = start, 0, math.inf
        least = self.config.min_information_ratio
        while True:
            hessian, gradient, overlap, fit = planes.equations(cells, pose, width_m)
            if moved_m < tolerance_m or iteration == self.config.max_iterations:
                break
            step, degenerate, radius_m = solve(hessian, gradient, least)
            pose = moved(pose, step)
            moved_m = math.hypot(*step[:3], *(radius_m * step[3:]))
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

    def _headings(
        self, cells: npt.NDArray[np.float64], levels: PlaneLevels, starts: Sequence[Transform]
    ) -> list[Transform]:
        """Return the starts that fit best, turned to all headings searched."""
        num = int(self.config.search_deg / SEARCH_STEP_DEG)
        if not num:
            return list(starts[1:])
        some = np.ascontiguousarray(cells[:: max(len(cells) // SEARCH_CELLS, 1)])
        planes = levels.planes(self.config.coarse_levels)
        width_m = levels.voxel_size_m(self.config.coarse_levels)
        turned = [
            moved(start, np.array([0.0, 0.0, 0.0, 0.0, 0.0, math.radians(k * SEARCH_STEP_DEG)]))
            for start in starts
            for k in range(-num, num + 1)
        ]
        found = [planes.equations(some, pose, width_m) for pose in turned]
        support = [overlap * fit for _, _, overlap, fit in found]
        best = np.argsort(support, kind='stable')[::-1][:SEARCH_STARTS]
        return [turned[place] for place in best]


def means(moments: ScanMoments) -> npt.NDArray[np.float64]:
    """Return the mean of the points of every voxel, (K, 3) float64, m."""
    inside = moments.total / moments.count[:, None] + (HALF + 0.5)
    places = (moments.voxel_index + inside / (1 << BITS)) * moments.voxel_size_m
    return np.ascontiguousarray(places, np.float64)


def solve(
    hessian: npt.NDArray[np.float64], gradient: npt.NDArray[np.float64], min_ratio: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], float]:
    """
    Return the Gauss-Newton step in the directions that are not degenerate.

    Parameters
    ----------
    hessian, gradient : (6, 6), (6,) float64
        Of position, m, and turn, rad.
    min_ratio : float
        Smallest eigenvalue of a direction that counts, where those of positions sum up to 1 and
        those of turns, scaled, as well.

    Returns
    -------
    step : (6,) float64
    degenerate : (D, 6) float64
        The directions left out, unit vectors, turns scaled.
    radius_m : float
        By which turns are scaled.

    """
    weight = float(np.trace(hessian[:3, :3]))
    if not weight > 0.0:
        return np.zeros(6), np.eye(6), 1.0
    radius_m = math.sqrt(float(np.trace(hessian[3:, 3:])) / weight) or 1.0
    scale = np.array([1.0, 1.0, 1.0, radius_m, radius_m, radius_m])
    values, vectors = np.linalg.eigh(hessian / (weight * np.outer(scale, scale)))
    known = values >= max(min_ratio, 1e-12)
    inverse = np.where(known, 1.0 / np.where(known, values, 1.0), 0.0)
    step = -(vectors @ (inverse * (vectors.T @ (gradient / (weight * scale))))) / scale
    return step, np.ascontiguousarray(vectors.T[~known]), radius_m


def moved(T_map_sensor: Transform, step: npt.NDArray[np.float64]) -> Transform:
    """Return a pose moved by step[:3], m, and turned about itself by the vector step[3:], rad."""
    turn = se3_exp(np.concatenate([np.zeros(3), step[3:]]))
    turned = compose(turn, T_map_sensor)
    return pose_matrix(T_map_sensor[:3, 3] + step[:3], q_xyzw(turned))
