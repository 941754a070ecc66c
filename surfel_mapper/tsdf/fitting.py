# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fit the projection model of a lidar to the points of a scan.

With ring numbers each beam gets the median elevation of its points; without them the beams are
evenly spaced between the lowest and the highest point. The number of columns is the number of
points of the fullest beam.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.tsdf.sensors import LidarModel

USUAL_ROWS = 64
"""Number of beams assumed without ring numbers and settings."""

MAX_COLUMNS = 4096
"""Limit of the fitted columns: no lidar has more, merged clouds of several sensors seem to."""

SMALLEST_STEP_DEG = 0.01
"""Rings nearer than this are one beam: some drivers number their columns as rings."""

NEAR_M = 0.1
"""Nearer points are ignored: many drivers send zeros for missing returns."""


def fitted_lidar(
    points: npt.NDArray[Any],
    ring: npt.NDArray[Any] | None = None,
    *,
    rows: int = 0,
    columns: int = 0,
    min_range_m: float,
    max_range_m: float,
) -> LidarModel:
    """
    Return the model of the lidar, with a full circle, that measured these points.

    Parameters
    ----------
    points : (N, 3) float
        In the frame of the sensor, m; nan for no return.
    ring : (N,) int, optional
        Beam number of each point.
    rows, columns : int
        Beams and azimuth steps; 0 means fitted.
    min_range_m, max_range_m : float
        As in LidarModel.

    Raises
    ------
    CloudFormatError
        If the elevations of the points do not span two beams.

    """
    ranges = np.linalg.norm(points, axis=1)
    known = np.isfinite(ranges) & (ranges > NEAR_M)
    elevations = np.degrees(np.arcsin(points[known, 2].astype(np.float64) / ranges[known]))
    if len(elevations) < 2 or np.ptp(elevations) < 1e-3:
        raise CloudFormatError(
            f'{len(elevations)} points between '
            f'{elevations.min(initial=0.0):.3g} and {elevations.max(initial=0.0):.3g} deg of '
            'elevation, expected those of a lidar with two beams or more'
        )
    if ring is not None and not rows:
        beams = beam_elevations(elevations, ring[known])
        fullest = int(np.unique(ring, return_counts=True)[1].max())
        if len(beams) > 1:
            return LidarModel(
                rows=len(beams),
                columns=columns or min(max(fullest, 2), MAX_COLUMNS),
                beam_elevations_deg=tuple(beams.tolist()),
                min_range_m=min_range_m,
                max_range_m=max_range_m,
            )
    rows = rows or USUAL_ROWS
    return LidarModel(
        rows=rows,
        columns=columns or min(max(-(-len(points) // rows), 2), MAX_COLUMNS),
        vertical_fov_deg=float(np.ptp(elevations)),
        vertical_fov_top_deg=float(elevations.max()),
        min_range_m=min_range_m,
        max_range_m=max_range_m,
    )


def beam_elevations(
    elevations: npt.NDArray[np.float64], ring: npt.NDArray[Any]
) -> npt.NDArray[np.float64]:
    """Return the median elevation of each ring, descending, deg; nearly equal ones once."""
    order = np.argsort(ring, kind='stable')
    _, first = np.unique(ring[order], return_index=True)
    medians = [float(np.median(part)) for part in np.split(elevations[order], first[1:])]
    found = np.sort(medians)[::-1]
    return found[np.diff(found, prepend=np.inf) < -SMALLEST_STEP_DEG]
