# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Directions of the rays of a lidar that met nothing.

REP 117 writes inf for a return beyond the range, and such a point has no direction of its own. In
an organised cloud its neighbours give it: points of a row have one elevation, those of a column
one azimuth but for an offset of the row. Points that are nan or 0 are unknown.

In a sweep of a moving lidar each direction is turned from the time of its ray to the stamp, as the
points are. The time is that of a return in the same column: drivers leave out others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.scan import Scan

MOST_OFF = 0.6
"""Median error of the azimuth, in steps between columns, up to which rows are taken as beams."""

ROUNDS = 4
"""Rounds of fitting columns to rows and rows to columns; four leave less than 0.1 deg."""

FAR_M = 1e9
"""Distance of points that are deskewed in place of directions, m: a sweep only turns these."""


def free_directions(
    scan: Scan, deskewed: Callable[[Scan], Scan] | None = None
) -> npt.NDArray[np.float32] | None:
    """
    Return unit vectors of the points at infinity, (K, 3); None without any.

    Parameters
    ----------
    scan : Scan
        With the cloud that it was read from, whose rows or columns are the beams of a lidar;
        None is returned for other clouds. Its points are not deskewed yet: that makes nan of inf.
    deskewed : callable, optional
        Deskews a scan with times. With it the directions are in the sensor frame at the stamp,
        without it each is in that at its own time.

    """
    rows, columns = int(getattr(scan.msg, 'height', 0)), int(getattr(scan.msg, 'width', 0))
    if min(rows, columns) < 2 or rows * columns != len(scan):
        return None
    infinite = np.isinf(scan.points).any(axis=1).reshape(rows, columns)
    if not infinite.any():
        return None
    points: npt.NDArray[Any] = np.where(np.isfinite(scan.points), scan.points, 0.0)
    points = points.reshape(rows, columns, 3)
    pixels = np.arange(len(scan)).reshape(rows, columns)
    if rows > columns:  # some drivers have a row for each azimuth
        points, infinite, pixels = points.swapaxes(0, 1), infinite.T, pixels.T
    rays, row, column = rays_of_beams(points, infinite)
    if not len(rays):
        return None
    if deskewed is None or scan.times is None:
        return rays
    times = replace(scan.times, offsets=scan.times.offsets[pixels[row, column]])
    far = replace(scan, points=FAR_M * rays, columns={}, times=times, msg=None)
    turned = deskewed(far).points
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return turned.astype(np.float32)


def rays_of_beams(
    points: npt.NDArray[Any], infinite: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """
    Return the directions of the infinite pixels of (beams, columns, 3), (K, 3).

    And for each the row (K,) and column (K,) of a pixel in its column that has a point.
    """
    level = points[..., 0] + 1j * points[..., 1].astype(np.float64)
    reach = np.abs(level)
    has_point = reach > 0.0
    heading = np.divide(level, reach, out=np.zeros_like(level), where=has_point)
    slope = np.divide(points[..., 2], reach, out=np.zeros_like(reach), where=has_point)
    offset: npt.NDArray[np.complex128] = np.ones(len(points), np.complex128)
    for _ in range(ROUNDS):  # columns with gaps have other rows than those without
        across = unit((heading * offset.conj()[:, None]).sum(axis=0))
        offset = unit((heading * across.conj()).sum(axis=1))
    predicted = offset[:, None] * across
    step = 2.0 * np.pi / points.shape[1]
    off = np.abs(np.angle(heading[has_point] * predicted[has_point].conj()))
    are_beams = len(off) > 0 and np.median(off) <= MOST_OFF * step
    beam = slope.sum(axis=1) / np.maximum(has_point.sum(axis=1), 1)
    row, column = np.nonzero(infinite & (predicted != 0.0) & are_beams)
    level_ray = predicted[row, column]
    rays = np.stack([level_ray.real, level_ray.imag, beam[row]], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays.astype(np.float32), has_point.argmax(axis=0)[column], column


def unit(numbers: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
    """Return complex numbers scaled to length 1; 0 stays 0."""
    length = np.abs(numbers)
    result: npt.NDArray[np.complex128] = np.zeros_like(numbers)
    np.divide(numbers, length, out=result, where=length > 0.0)
    return result
