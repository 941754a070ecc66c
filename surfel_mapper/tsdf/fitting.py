# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fit the projection model of a lidar to the points of a scan, and check the quality of the fit.

Candidates for the beams are the median elevations of the rings, the clusters of the elevations,
and evenly spaced rows; the steps of azimuth follow from the angles between neighbouring points of
a beam, so that a partial revolution gives the same model as a full one. ``fit_share`` measures a
candidate on points: merged clouds, solid-state patterns and clouds given about another origin than
the optical centre fit no candidate, and have no model.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.kernels.projection import project
from surfel_mapper.tsdf.kernels import range_image as kernels
from surfel_mapper.tsdf.range_image import limits
from surfel_mapper.tsdf.sensors import LidarModel

Float64 = npt.NDArray[np.float64]

USUAL_ROWS = 64
"""Number of evenly spaced beams assumed if neither rings nor clusters of elevations are found."""

MAX_ROWS = 512
"""Limit of the fitted rows; more clusters of elevations are no beams."""

MAX_COLUMNS = 4096
"""Limit of the fitted columns: no lidar has more, merged clouds of several sensors seem to."""

SMALLEST_STEP_DEG = 0.01
"""Rings nearer than this are one beam: some drivers number their columns as rings."""

CLUSTER_GAP_DEG = 0.05
"""Elevations farther apart than this belong to different beams; the densest lidars have 0.09."""

NEAR_M = 0.1
"""Nearer points are ignored: many drivers send zeros for missing returns."""

STEEPEST = math.sin(math.radians(89.9))
"""Sine of the largest elevation; above, the azimuth of a point is hardly defined."""

LEAST_FIT = 0.9
"""
Smallest share of fitting points for a model to be used; see ``fit_share``. Real lidars have 0.92
to 0.99; clouds of several sensors, solid-state patterns and shifted origins 0.03 to 0.88.
"""


@dataclass(frozen=True, kw_only=True)
class Angles:
    """
    Directions of the valid points of a cloud.

    Attributes
    ----------
    elevation, azimuth : (K,) float64, deg
        Of each point.
    range_m : (K,) float64
        Distance from the sensor.
    ring : (K,) int or None
        Beam number of each point.

    """

    elevation: Float64
    azimuth: Float64
    range_m: Float64
    ring: npt.NDArray[Any] | None

    @classmethod
    def of(cls, points: npt.NDArray[Any], ring: npt.NDArray[Any] | None = None) -> Angles:
        """Return the directions of the points that are finite, beyond NEAR_M and not overhead."""
        x, y, z = points.T.astype(np.float64)
        with np.errstate(over='ignore', invalid='ignore'):  # of any float64, nan too
            range_m = np.sqrt(x * x + y * y + z * z)
            valid = np.isfinite(range_m) & (range_m > NEAR_M) & (np.abs(z) < STEEPEST * range_m)
        x, y, z, range_m = x[valid], y[valid], z[valid], range_m[valid]
        return cls(
            elevation=np.degrees(np.arcsin(z / range_m)),
            azimuth=np.degrees(np.arctan2(y, x)),
            range_m=range_m,
            ring=None if ring is None else ring[valid],
        )


def candidates(
    points: npt.NDArray[Any],
    ring: npt.NDArray[Any] | None = None,
    *,
    min_range_m: float,
    max_range_m: float,
) -> list[LidarModel]:
    """
    Return the candidates for the lidar of a scan, with a full circle, the most certain first.

    Parameters
    ----------
    points : (N, 3) float
        In the frame of the sensor, m; nan for no return.
    ring : (N,) int, optional
        Beam number of each point.
    min_range_m, max_range_m : float
        As in LidarModel.

    Raises
    ------
    CloudFormatError
        If the elevations of the points do not span two beams.

    """
    angles = Angles.of(points, ring)
    elevations = angles.elevation
    if len(elevations) < 2 or np.ptp(elevations) < 1e-3:
        raise CloudFormatError(
            f'{len(elevations)} points between '
            f'{elevations.min(initial=0.0):.3g} and {elevations.max(initial=0.0):.3g} deg of '
            'elevation, expected those of a lidar with two beams or more'
        )
    ranges: dict[str, Any] = {'min_range_m': min_range_m, 'max_range_m': max_range_m}
    models = []
    tables = []
    if angles.ring is not None:
        tables.append(beam_elevations(elevations, angles.ring))
    far = angles.range_m >= np.median(angles.range_m)
    tables += [clustered_elevations(values) for values in (elevations, elevations[far])]
    for beams in tables:
        if 1 < len(beams) <= MAX_ROWS:
            steps = azimuth_steps(angles, nearest_beam(elevations, beams))
            models.append(
                LidarModel(
                    rows=len(beams),
                    columns=steps,
                    first_azimuth_deg=first_azimuth(angles, steps),
                    beam_elevations_deg=tuple(beams.tolist()),
                    **ranges,
                )
            )
    low, high = float(elevations.min()), float(elevations.max())
    even: Float64 = np.asarray(np.linspace(high, low, USUAL_ROWS), np.float64)
    steps = azimuth_steps(angles, nearest_beam(elevations, even))
    models.append(
        LidarModel(
            rows=USUAL_ROWS,
            columns=steps,
            first_azimuth_deg=first_azimuth(angles, steps),
            vertical_fov_deg=high - low,
            vertical_fov_top_deg=high,
            **ranges,
        )
    )
    return models


def best_fit(
    points: npt.NDArray[Any],
    ring: npt.NDArray[Any] | None,
    voxel_size_m: float,
    **properties: Any,
) -> tuple[LidarModel | None, float]:
    """
    Return the candidate of the largest ``fit_share``, or None below LEAST_FIT, and that share.

    Parameters
    ----------
    points, ring
        As candidates.
    voxel_size_m : float
        Edge of a voxel.
    properties
        Ranges, as candidates.

    Raises
    ------
    CloudFormatError
        If the elevations of the points do not span two beams.

    """
    models = candidates(points, ring, **properties)
    shares = [fit_share(model, points, voxel_size_m) for model in models]
    best = int(np.argmax(shares))
    return (models[best] if shares[best] >= LEAST_FIT else None), shares[best]


def beam_elevations(elevations: Float64, ring: npt.NDArray[Any]) -> Float64:
    """Return the median elevation of each ring, descending, deg; nearly equal ones once."""
    order = np.argsort(ring, kind='stable')
    _, first = np.unique(ring[order], return_index=True)
    medians = [float(np.median(group)) for group in np.split(elevations[order], first[1:])]
    ordered = np.sort(medians)[::-1]
    return ordered[np.diff(ordered, prepend=np.inf) < -SMALLEST_STEP_DEG]


def clustered_elevations(elevations: Float64) -> Float64:
    """
    Return the medians of the clusters of elevations, descending, deg.

    The clusters of far points are sharper, because the beams of a lidar start some centimetres off
    its centre. The clusters of all points include the beams that only see the near ground.
    """
    ordered = np.sort(elevations)
    groups = np.split(ordered, np.flatnonzero(np.diff(ordered) > CLUSTER_GAP_DEG) + 1)
    least = max(0.001 * len(ordered), 3.0)
    return np.array([float(np.median(group)) for group in groups if len(group) >= least])[::-1]


def nearest_beam(elevations: Float64, beams: Float64) -> npt.NDArray[np.int64]:
    """Return the number of the nearest of descending beams for each elevation, (K,)."""
    ascending = beams[::-1]
    rank = np.searchsorted(0.5 * (ascending[1:] + ascending[:-1]), elevations)
    return len(beams) - 1 - rank


def azimuth_steps(angles: Angles, beam: npt.NDArray[np.int64]) -> int:
    """
    Return the number of columns of a full circle, from the steps between points of a beam.

    The median step is that of neighbours as long as less than half of the returns are missing;
    columns are at least as many as the fullest beam has points.
    """
    order = np.lexsort((angles.azimuth, beam))
    steps = np.diff(angles.azimuth[order])
    same = (np.diff(beam[order]) == 0) & (steps > 1e-3)
    if not same.any():
        return 2
    steps = steps[same]
    # around the median, because holes are long and repeated returns are short; the lower one,
    # because the mean of two very different steps is near neither
    median = float(np.quantile(steps, 0.5, method='lower'))
    step = float(np.mean(steps[(steps > 0.6 * median) & (steps < 1.4 * median)]))
    return int(np.clip(round(360.0 / step), 2, MAX_COLUMNS))


def first_azimuth(angles: Angles, columns: int) -> float:
    """
    Return the azimuth of the first of the columns of a full circle, within half a step of 180 deg.

    The columns go through the points: half a step beside them every point is moved by as much,
    and the error of the mesh of a street doubles. It is the circular mean of the points' places
    between columns; if they are spread evenly, any place is as good.
    """
    step = 360.0 / columns
    turns = np.exp(2j * np.pi * ((angles.azimuth - 180.0) / step))
    return 180.0 + step * float(np.angle(turns.mean())) / (2.0 * np.pi)


def fit_share(
    model: LidarModel,
    points: npt.NDArray[Any],
    voxel_size_m: float,
    *,
    num_checked: int | None = None,
) -> float:
    """
    Return the share of points that a range image of the model represents.

    A point fits if it lies within a voxel of the ray of its pixel, if the range of its pixel is
    its own within two voxels, and if a neighbouring row and a neighbouring column have a range
    too, so that voxels between them are observed.

    Parameters
    ----------
    model : LidarModel
        The candidate.
    points : (N, 3) float
        In the frame of the sensor, m.
    voxel_size_m : float
        Edge of a voxel.
    num_checked : int, optional
        Number of points looked at, evenly picked; all by default.

    Returns
    -------
    float
        In [0, 1]; of the points beyond the smallest range, 0 without any.

    """
    points = np.ascontiguousarray(points)
    image = np.zeros((model.rows, model.columns + model.wraps), np.float32)
    source = np.full((model.rows, model.columns), -1, np.int32)
    kernels.from_points(points, model.projection, limits(model), image, source)
    points = points[:: max(len(points) // (num_checked or len(points) or 1), 1)]
    x, y, z = (np.ascontiguousarray(axis, np.float32) for axis in points.T)
    distance, u, v = (np.empty(len(points), np.float32) for _ in range(3))
    kind, parameters, elevations = model.projection
    project(x, y, z, kind, parameters, elevations, distance, u, v)
    valid = (distance >= model.min_range_m) & np.isfinite(distance)
    if not valid.any():
        return 0.0
    inside = valid & (u >= -0.5)
    distance, u, v = distance[inside], u[inside], v[inside]
    row = np.clip(np.rint(v).astype(np.int64), 0, model.rows - 1)
    column = np.rint(u).astype(np.int64) % model.columns
    gaps = np.abs(np.diff(model.elevations_rad))
    gap = gaps[np.minimum(v.astype(np.int64).clip(0), len(gaps) - 1)]
    level = np.cos(model.elevations_rad[row]) * model.pitch_rad[1]
    reach = np.minimum(distance, model.max_range_m)  # farther points only free the space up to it
    offset = reach * np.hypot((v - row) * gap, (u - np.rint(u)) * level)
    filled = image[:, : model.columns] > 0.0
    beside = np.roll(filled, 1, axis=1) | np.roll(filled, -1, axis=1)
    above = np.zeros_like(filled)
    above[1:] |= filled[:-1]
    above[:-1] |= filled[1:]
    fits = offset <= voxel_size_m
    fits &= reach - image[row, column] <= 2.0 * voxel_size_m
    fits &= (beside & above)[row, column]
    return float(fits.sum() / valid.sum())
