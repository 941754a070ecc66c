# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Directions of the rays of a lidar that met nothing.

REP 117 writes inf for a return beyond the range, and such a point has no direction of its own. In
an organised cloud its neighbours give it: points of a row have one elevation, those of a column
one azimuth but for an offset of the row. Points that are nan or 0 are unknown.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.scan import Scan

MOST_OFF = 0.6
"""Median error of the azimuth, in steps between columns, up to which rows are taken as beams."""

ROUNDS = 4
"""Rounds of fitting columns to rows and rows to columns; four leave less than 0.1 deg."""


def free_directions(scan: Scan) -> npt.NDArray[np.float32] | None:
    """
    Return unit vectors of the points at infinity, (K, 3); None without any.

    Parameters
    ----------
    scan : Scan
        With the cloud that it was read from, whose rows or columns are the beams of a lidar;
        None is returned for other clouds.

    """
    rows, columns = int(getattr(scan.msg, 'height', 0)), int(getattr(scan.msg, 'width', 0))
    if min(rows, columns) < 2 or rows * columns != len(scan):
        return None
    infinite = np.isinf(scan.points).any(axis=1).reshape(rows, columns)
    if not infinite.any():
        return None
    points = np.where(np.isfinite(scan.points), scan.points, 0.0).reshape(rows, columns, 3)
    if rows > columns:  # some drivers have a row for each azimuth
        return rays_of_beams(points.swapaxes(0, 1), infinite.T)
    return rays_of_beams(points, infinite)


def rays_of_beams(
    points: npt.NDArray[Any], infinite: npt.NDArray[np.bool_]
) -> npt.NDArray[np.float32] | None:
    """Return the directions of the infinite pixels of (beams, columns, 3)."""
    level = points[..., 0] + 1j * points[..., 1].astype(np.float64)
    reach = np.abs(level)
    known = reach > 0.0
    heading = np.divide(level, reach, out=np.zeros_like(level), where=known)
    slope = np.divide(points[..., 2], reach, out=np.zeros_like(reach), where=known)
    offset: npt.NDArray[np.complex128] = np.ones(len(points), np.complex128)
    for _ in range(ROUNDS):  # columns with gaps have other rows than those without
        across = unit((heading * offset.conj()[:, None]).sum(axis=0))
        offset = unit((heading * across.conj()).sum(axis=1))
    predicted = offset[:, None] * across
    step = 2.0 * np.pi / points.shape[1]
    off = np.abs(np.angle(heading[known] * predicted[known].conj()))
    if not len(off) or np.median(off) > MOST_OFF * step:
        return None
    beam = slope.sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    row, column = np.nonzero(infinite & (predicted != 0.0))
    found = predicted[row, column]
    rays = np.stack([found.real, found.imag, beam[row]], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays.astype(np.float32) if len(rays) else None


def unit(numbers: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
    """Return complex numbers scaled to length 1; 0 stays 0."""
    length = np.abs(numbers)
    result: npt.NDArray[np.complex128] = np.zeros_like(numbers)
    np.divide(numbers, length, out=result, where=length > 0.0)
    return result
