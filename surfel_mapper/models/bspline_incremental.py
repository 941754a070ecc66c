# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Large height fields of a map that changes are refitted only near changes.

A cell whose mean height changed by less than ``still_m`` keeps the height that it was fitted
with. Control points farther than ``MARGIN`` cells from a change stay as they are: its influence
decays within that distance.
The knots depend on the number of cells, so large grids grow by blocks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.bspline import (
    continued,
    design,
    HeightField,
    initial_field,
    knots,
    RIDGE,
)
from surfel_mapper.models.bspline_solvers import FieldSamples, relax

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

SMOOTHING = 1e-2
"""Weight of the second differences."""

LAST_STEP = 3.0
"""
Conjugate gradients stop when no control point moves farther, in ``still_m``: those beyond the
cells move most, 99 % of the heights in cells are within ``still_m`` of the solution then.
"""
MARGIN = 5
"""Cells around a change whose control points are refitted."""
DEGREE = 3
"""Degree of the splines."""
BLOCK = 16
"""Grids start and end at multiples of this number of cells."""


MOST_AT_ONCE = 2e6
"""Multiplications of a banded solve, about 1 ms, above which a field is large."""


def is_large(size: npt.NDArray[np.int64]) -> bool:
    """Return whether a grid of (2,) cells has a field that is fitted by fit_field."""
    return float((size + 2).prod() * (DEGREE * size.min()) ** 2) > MOST_AT_ONCE


@dataclass(frozen=True, slots=True, eq=False)
class FittedField:
    """
    A field and its input.

    Attributes
    ----------
    field : HeightField
        Result of the fit.
    heights : (Nx, Ny) float64, m
        Mean heights of the cells, nan for empty cells.

    """

    field: HeightField
    heights: Array


def fit_field(
    pitch_m: float, origin: Array, sums: Array, before: FittedField | None, still_m: float
) -> FittedField:
    """
    Return the field that fits the mean heights of many cells; others see fit_cells.

    Parameters
    ----------
    pitch_m : float
        Edge of a cell.
    origin : (2,) float64, m
        Lowest corner of the grid.
    sums : (Nx, Ny, 4) float64
        Sums of x, y, z and number of the points in every cell.
    before : FittedField, optional
        The previous field, over cells of the same lattice.
    still_m : float
        Change of a height that does not matter, m.

    """
    origin, sums = in_blocks(pitch_m, origin, sums)
    filled: Mask = sums[..., 3] > 0.0
    means = sums[..., :3] / np.where(filled, sums[..., 3], 1.0)[..., None]
    heights = np.where(filled, means[..., 2], np.nan)
    start = initial_field(pitch_m, origin, means[..., 2], filled, DEGREE)
    known = np.zeros(start.control.shape, np.bool_)
    known[1:-1, 1:-1] = touched = filled
    if before is not None:
        touched = taken_over(before, start, heights, known, still_m)
        means[..., 2] = np.where(filled, heights, 0.0)
    field = relaxed(start, means, (filled, touched, known), still_m)
    return FittedField(field, heights)


def in_blocks(pitch_m: float, origin: Array, sums: Array) -> tuple[Array, Array]:
    """Return origin and cells of the grid, extended to multiples of BLOCK cells."""
    first = np.rint(origin / pitch_m).astype(np.int64)
    low = first % BLOCK
    high = -(first + sums.shape[:2]) % BLOCK
    padding = [*zip(low, high, strict=True), (0, 0)]
    lowest = (first - low).astype(np.float64) * pitch_m
    return lowest, np.pad(sums, padding)


def taken_over(
    before: FittedField, start: HeightField, heights: Array, known: Mask, still_m: float
) -> Mask:
    """
    Copy the previous field into the initial one, and restore heights that hardly changed.

    Returns
    -------
    (Nx, Ny) bool
        Cells that have to be refitted.

    """
    old = before.field
    step = np.rint((old.origin - start.origin) / start.pitch_m).astype(np.int64)
    new, was = overlap(start.control.shape, old.control.shape, step)
    # control points away from filled cells were not fitted
    start.control[new] = np.where(known[new], start.control[new], 0.0)
    valid = influential(~np.isnan(before.heights), old)
    start.control[new] = np.where(valid[was], old.control[was], start.control[new])
    known[new] |= valid[was]
    earlier = np.full(heights.shape, np.nan)
    new, was = overlap(heights.shape, before.heights.shape, step)
    earlier[new] = before.heights[was]
    still = np.abs(heights - earlier) < still_m
    heights[still] = earlier[still]
    touched: Mask = ~(still | (np.isnan(heights) & np.isnan(earlier)))
    if heights.shape != before.heights.shape or step.any():  # the knots have moved
        touched = ~np.isnan(heights)
    return touched


def overlap(
    new: tuple[int, ...], old: tuple[int, ...], step: npt.NDArray[np.int64]
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Return the slices where two grids overlap; the old one starts `step` cells into the new."""
    low = [max(int(s), 0) for s in step]
    high = [max(min(int(s) + o, n), a) for s, o, n, a in zip(step, old, new, low, strict=True)]
    here = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    there = tuple(slice(a - int(s), b - int(s)) for a, b, s in zip(low, high, step, strict=True))
    return here, there


def relaxed(
    start: HeightField, means: Array, masks: tuple[Mask, Mask, Mask], still_m: float
) -> HeightField:
    """Return a large field, refitted near touched cells; masks: filled, touched, known points."""
    filled, touched, known = masks
    active = influential(filled, start)
    control = np.where(active, continued(start.control, known), start.control)
    free = active & near_cells(touched)
    xyz = means[filled]
    rows, weights, _ = design(start, xyz[:, :2])
    samples = FieldSamples(rows, weights, xyz[:, 2], np.ones(len(xyz)))
    rules = SMOOTHING, RIDGE, LAST_STEP * still_m
    control = relax(samples, start.greville(), (active, free), rules, control)
    return HeightField(start.pitch_m, start.origin, start.degrees, control)


def influential(filled: Mask, field: HeightField) -> Mask:
    """Return the control points (Nx + 2, Ny + 2) on which heights in cells (Nx, Ny) depend."""
    found = filled
    for axis, number in enumerate(filled.shape):
        degree, knot = field.degrees[axis], knots(number, field.degrees[axis])
        ends = (np.arange(number + 1) + 0.5) / (number + 1)  # of the cells, as parameters
        spans = np.clip(np.searchsorted(knot, ends, side='right') - 1, degree, number + 1)
        points = np.zeros((number + 2, found.shape[1]), np.bool_)
        for cell, (low, high) in enumerate(zip(spans[:-1] - degree, spans[1:] + 1, strict=True)):
            points[low:high] |= found[cell]
        found = points.T
    return found


def near_cells(touched: Mask) -> Mask:
    """Return the control points (Nx + 2, Ny + 2) up to MARGIN cells from touched cells."""
    from scipy.ndimage import maximum_filter  # seconds to import

    points = np.pad(touched, 1)
    return np.asarray(maximum_filter(points, 2 * MARGIN + 1, mode='constant'), np.bool_)
