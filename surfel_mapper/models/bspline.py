# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Height fields: z(x, y) as a tensor product of B-splines over the grid of a patch.

A grid of N cells an axis has N + 2 control points, one beyond each end, and clamped knots. The
parameter is affine in x, as the least squares fit requires. Equally spaced control points would
bend x by up to 0.9 of a cell; as a NURBS patch they are placed at the Greville abscissae, where
x(u) is affine and z unchanged.

There are more control points than cells, so the fit is underdetermined. ``pspline`` adds second
differences (Eilers and Marx 1996), which fill holes and boundaries; ``lsqr`` takes the solution
nearest to the initial control points, the limit of gradient descent.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.bspline_multigrid import least_squares
from surfel_mapper.models.grid import Cells
from surfel_mapper.models.kernels.bspline import (
    clamped_knots,
    evaluate_basis,
    evaluate_field,
    fit_fields,
    greville_places,
)

Array = npt.NDArray[np.float64]

RIDGE = 1e-6
"""Weight that pulls control points without data nearby to 0."""

LSQR_STEPS = 2000
"""Most iterations of LSQR."""

MOST_AT_ONCE = 2e6
"""Multiplications of a banded solve, about 1 ms, above which a field is large."""

CACHED_AXES = 4096
"""Cached axes (knots, Greville abscissae): few different sizes occur."""


@lru_cache(CACHED_AXES)
def knots(num_cells: int, degree: int) -> Array:
    """
    Return the clamped knots for num_cells + 2 control points, in [0, 1]; cached, read-only.

    Parameters
    ----------
    num_cells : int
        Cells along the axis, at least 1.
    degree : int
        At most num_cells + 1.

    """
    found: Array = clamped_knots(num_cells, degree)
    return found


@lru_cache(CACHED_AXES)
def greville_cells(num_cells: int, degree: int) -> Array:
    """Return the Greville abscissae along an axis, in cells; cached, read-only."""
    found: Array = greville_places(knots(num_cells, degree), degree, 1.0)
    return found


def axis_degree(num_cells: int, degree: int) -> int:
    """Return the degree of the splines along an axis, reduced if it has too few cells."""
    return min(degree, num_cells + 1)


def basis(u: Array, knot: Array, degree: int) -> tuple[npt.NDArray[np.int64], Array, Array]:
    """
    Evaluate the non-zero basis functions.

    Parameters
    ----------
    u : (M,) float64
        Parameters in [0, 1].
    knot : (n,) float64
        See knots().
    degree : int
        Degree of the splines.

    Returns
    -------
    (M,) int64
        Index of the first non-zero basis function; the others follow it.
    (M, degree + 1) float64
        Their values; each row sums to 1.
    (M, degree + 1) float64
        Their derivatives.

    """
    first = np.empty(len(u), np.int64)
    values, slopes = np.empty((2, len(u), degree + 1))
    evaluate_basis(u, knot, degree, first, values, slopes)
    return first, values, slopes


@dataclass(frozen=True, slots=True, eq=False)
class HeightField:
    """
    A surface z(x, y) over a grid of cells.

    Attributes
    ----------
    pitch_m : float
        Edge of a cell.
    origin : (2,) float64, m
        Lowest corner of the grid.
    degrees : (2,) int
        Degrees along x and y.
    control : (Nx + 2, Ny + 2) float64, m
        Heights of the control points.

    """

    pitch_m: float
    origin: Array
    degrees: tuple[int, int]
    control: Array

    def heights(self, xy: Array) -> Array:
        """Return z at (M, 2) x and y, m; beyond the grid, that at its boundary; at nan, nan."""
        result = np.empty(len(xy))
        evaluate_field(np.ascontiguousarray(xy), self.parts(), result)
        return result

    def slopes(self, xy: Array) -> Array:
        """Return dz/dx and dz/dy at (M, 2) x and y."""
        result = np.empty((len(xy), 2))
        for axis in range(2):
            rows, weights, unit = design(self, xy, along=axis)
            result[:, axis] = unit * np.einsum('ij,ij->i', self.control.ravel()[rows], weights)
        return result

    def parts(self) -> tuple[Array, float, tuple[int, int], tuple[Array, Array], Array]:
        """Return the arguments of the kernels: origin, pitch, degrees, knots, control points."""
        x, y = self.degrees
        num_x, num_y = self.control.shape
        both = knots(num_x - 2, x), knots(num_y - 2, y)
        control = np.ascontiguousarray(self.control)
        return np.ascontiguousarray(self.origin), self.pitch_m, self.degrees, both, control

    def greville(self) -> tuple[Array, Array]:
        """Return x (Nx + 2,) and y (Ny + 2,) of the control points as a NURBS patch, m."""
        x, y = (
            self.origin[axis]
            + self.pitch_m * greville_cells(self.control.shape[axis] - 2, self.degrees[axis])
            for axis in range(2)
        )
        return x, y


def design(
    field: HeightField, xy: Array, along: int = -1
) -> tuple[npt.NDArray[np.int64], Array, float]:
    """
    Return the rows of the design matrix: control points and their weights for each location.

    Parameters
    ----------
    field : HeightField
        Grid and degrees; control points are not used.
    xy : (M, 2) float64, m
        Locations.
    along : int
        0 or 1: the derivative along that axis; -1: the height.

    Returns
    -------
    (M, W) int64
        Indices of the control points, y within x.
    (M, W) float64
        Their weights.
    float
        Factor of the derivatives.

    """
    firsts, parts, unit = [], [], 1.0
    for axis in range(2):
        cells, degree = field.control.shape[axis] - 2, field.degrees[axis]
        width_m = (cells + 1) * field.pitch_m
        u = (xy[:, axis] - field.origin[axis] + 0.5 * field.pitch_m) / width_m
        first, values, slopes = basis(np.clip(u, 0.0, 1.0), knots(cells, degree), degree)
        firsts.append(first[:, None] + np.arange(degree + 1))
        parts.append(slopes if axis == along else values)
        unit = 1.0 / width_m if axis == along else unit
    rows = firsts[0][:, :, None] * field.control.shape[1] + firsts[1][:, None, :]
    weights = parts[0][:, :, None] * parts[1][:, None, :]
    shape = len(xy), (field.degrees[0] + 1) * (field.degrees[1] + 1)
    return rows.reshape(shape), weights.reshape(shape), unit


def initial_field(
    pitch_m: float, origin: Array, heights: Array, filled: npt.NDArray[np.bool_], degree: int
) -> HeightField:
    """
    Return the field whose control points are the mean heights of the cells, 0 for empty cells.

    Parameters
    ----------
    pitch_m : float
        Edge of a cell.
    origin : (2,) float64, m
        Lowest corner of the grid.
    heights : (Nx, Ny) float64, m
        Mean z in each cell.
    filled : (Nx, Ny) bool
        Cells that hold points.
    degree : int
        Degree of the splines, reduced along axes with too few cells.

    """
    control = np.zeros((heights.shape[0] + 2, heights.shape[1] + 2))
    control[1:-1, 1:-1] = np.where(filled, heights, 0.0)
    degrees = axis_degree(heights.shape[0], degree), axis_degree(heights.shape[1], degree)
    return HeightField(pitch_m, origin, degrees, control)


def fit_lsqr(start: HeightField, xy: Array, z: Array) -> HeightField:
    """Return the least squares field of (M,) heights at (M, 2) nearest to the initial one."""
    from scipy.sparse import csr_array  # 0.4 s that mapping without models saves
    from scipy.sparse.linalg import lsqr

    rows, weights, _ = design(start, xy)
    shape = (len(xy), start.control.size)
    ends = np.arange(0, rows.size + 1, rows.shape[1])
    matrix = csr_array((weights.ravel(), rows.ravel(), ends), shape=shape)
    missing = z - matrix @ start.control.ravel()
    change = lsqr(matrix, missing, atol=1e-12, btol=1e-12, iter_lim=LSQR_STEPS)[0]
    control = start.control + change.reshape(start.control.shape)
    return HeightField(start.pitch_m, start.origin, start.degrees, control)


def fit_pspline(
    start: HeightField, xy: Array, z: Array, weight: Array, smoothing: float
) -> HeightField:
    """
    Return the field that minimises weighted squared residuals plus squared second differences.

    Parameters
    ----------
    start : HeightField
        Grid and degrees.
    xy, z, weight : (M, 2), (M,), (M,) float64
        Samples, m, and their weights.
    smoothing : float
        Weight of the second differences, for a mean weight of 1.

    Notes
    -----
    Up to 100 x 100 cells the equations are solved to rounding, larger ones to TOLERANCE of
    models/bspline_multigrid.py, in time and memory in proportion to the number of cells.

    """
    if start.control.shape[1] > start.control.shape[0]:  # the bandwidth is the short side
        turned = fit_pspline(transposed(start), xy[:, ::-1], z, weight, smoothing)
        return transposed(turned)
    samples, share = np.column_stack([xy, z]), weight / weight.mean()
    rules = smoothing, RIDGE
    control = least_squares(samples, share, start.parts(), start.greville(), rules)
    return HeightField(start.pitch_m, start.origin, start.degrees, control)


def is_small(sizes: npt.NDArray[np.int64], degree: int) -> npt.NDArray[np.bool_]:
    """Return which grids of (K, 2) cells have fields that ``fit_grids`` fits."""
    number = (sizes + 2).prod(axis=1)
    found: npt.NDArray[np.bool_] = number * (degree * sizes.min(axis=1)) ** 2 <= MOST_AT_ONCE
    return found


def fit_grids(
    cells: Cells, chosen: npt.NDArray[np.int64], degree: int, smoothing: float
) -> tuple[list[HeightField], Array]:
    """
    Return small fields that ``fit_pspline`` would fit to the means of their cells.

    Parameters
    ----------
    cells : Cells
        The cells of all patches.
    chosen : (F,) int64
        Patches whose fields are asked for; see is_small.
    degree : int
        Degree of the splines, reduced along axes with too few cells.
    smoothing : float
        Weight of the second differences, for a mean weight of 1.

    Returns
    -------
    list of HeightField
        F fields.
    (C,) float64, m
        Mean heights of the cells of these patches, nan for empty cells and other patches.

    """
    shapes = cells.sizes[chosen] + 2
    ends = np.cumsum(shapes.prod(axis=1))
    begin = ends - shapes.prod(axis=1)
    control = np.empty(int(ends[-1]) if len(ends) else 0)
    heights = np.full(len(cells.sums), np.nan)
    numbers = cells.first, cells.sizes
    rules = degree, smoothing, RIDGE
    fit_fields(
        cells.sums, numbers, chosen, cells.pitches, cells.origins, rules, begin, control, heights
    )
    parts = zip(
        cells.pitches[chosen].tolist(),
        cells.origins[chosen],
        shapes.tolist(),
        begin.tolist(),
        ends.tolist(),
        strict=True,
    )
    found = []
    for pitch_m, origin, (x, y), low, high in parts:
        degrees = axis_degree(x - 2, degree), axis_degree(y - 2, degree)
        own = control[low:high].reshape(x, y).copy()  # a view would keep those of all fields
        found.append(HeightField(pitch_m, origin, degrees, own))
    return found, heights


def transposed(field: HeightField) -> HeightField:
    """Return the field with x and y exchanged."""
    x, y = field.degrees
    return HeightField(field.pitch_m, field.origin[::-1], (y, x), field.control.T)
