# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Normals of a single cloud, without a map: estimate_normals.

The normals are those of the filter ``surface_normal``, with a result that is as long as the input.
(A module of its own: a function for users, where the other modules hold filters.)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_numbers
from surfel_mapper.filters.base import as_scan
from surfel_mapper.filters.columns import NORMALS
from surfel_mapper.filters.shapes import SurfaceNormal


def estimate_normals(
    points: npt.ArrayLike,
    *,
    num_neighbours: int = 16,
    max_distance_m: float = np.inf,
    viewpoint: npt.ArrayLike | None = (0.0, 0.0, 0.0),
    threads: int = 1,
) -> npt.NDArray[np.float64]:
    """
    Return the normal of every point of a cloud, from its nearest neighbours.

    Parameters
    ----------
    points : (N, 3) float, m
        The cloud; coordinates of UTM are fine as float64.
    num_neighbours : int
        Neighbours of a point, itself included; 3 or more.
    max_distance_m : float
        Largest distance of a neighbour.
    viewpoint : (3,) float, m, optional
        Position of the sensor, to which the normals are turned; None: their signs are arbitrary.
    threads : int
        Threads that share the search; the result does not depend on it.

    Returns
    -------
    (N, 3) float64
        Unit vectors; nan for points that are not finite or have fewer than two neighbours.

    Raises
    ------
    ValueError
        If shapes or types are wrong.
    ConfigError
        If a number is out of bounds.

    Examples
    --------
    >>> import numpy as np
    >>> floor = np.random.default_rng(0).uniform(0, [1, 1, 0], (100, 3))
    >>> normals = estimate_normals(floor, num_neighbours=10, viewpoint=[0, 0, 2])
    >>> bool(np.allclose(normals, [0, 0, 1]))
    True

    """
    chosen = SurfaceNormal(
        num_neighbours=num_neighbours, max_distance_m=max_distance_m, threads=threads
    )
    all_points: npt.NDArray[Any] = as_scan(points).points
    finite = np.isfinite(all_points).all(axis=1)
    result = np.full((len(all_points), 3), np.nan)
    if not finite.any():
        return result
    valid_points = all_points[finite].astype(np.float64)
    origin = valid_points[0]
    normals = np.asarray(chosen.apply(valid_points - origin).columns[NORMALS], np.float64)
    if viewpoint is not None:
        sensor = as_numbers('viewpoint', viewpoint)
        if sensor.shape != (3,) or not np.isfinite(sensor).all():
            raise ValueError(f'viewpoint: {viewpoint}, expected x y z, finite')
        sight = sensor - valid_points
        normals = np.where((normals * sight).sum(axis=1)[:, None] < 0.0, -normals, normals)
    result[finite] = normals
    return result
