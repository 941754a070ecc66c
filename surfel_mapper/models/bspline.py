# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Height fields: z(x, y) as a tensor product of B-splines over the grid of a patch.

A grid of N cells an axis has N + 2 control points, one beyond each end, and clamped knots. The
parameter is affine in x, as the least squares fit requires. Equally spaced control points would
bend x by up to 0.9 of a cell; as a NURBS patch they are placed at the Greville abscissae, where
x(u) is affine and z unchanged.

There are more control points than cells, so the fit is underdetermined. ``fit_pspline`` adds
second differences (Eilers and Marx 1996), which fill holes and boundaries. ``fit_nearest`` takes
the solution nearest to the initial control points, the limit of gradient descent.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import Record
from surfel_mapper.models.bspline_solvers import (
    FieldSamples,
    is_direct,
    relax,
    second_differences,
    solve_band,
)
from surfel_mapper.models.grid import Cells
from surfel_mapper.models.kernels.splines import basis_functions, tensor_heights

Array = npt.NDArray[np.float64]

RIDGE = 1e-6
"""Weight that pulls control points without data nearby to 0."""

NEAREST = 1e-9
"""The same for the change from the initial control points: the smallest of equally good ones."""

CACHED_AXES = 4096
"""Cached axes (knots, Greville abscissae, penalty): few different sizes occur."""


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
    pieces = num_cells + 2 - degree
    inner = np.arange(1, pieces) / pieces
    return np.concatenate([np.zeros(degree + 1), inner, np.ones(degree + 1)])


@lru_cache(CACHED_AXES)
def greville_cells(num_cells: int, degree: int) -> Array:
    """Return the Greville abscissae along an axis, in cells; cached, read-only."""
    knot, number = knots(num_cells, degree), num_cells + 2
    means = sum(knot[k : k + number] for k in range(1, degree + 1)) / degree
    return np.asarray(means * (number - 1) - 0.5, np.float64)


@lru_cache(CACHED_AXES)
def penalty(num_cells: int, degree: int) -> Array:
    """Return three diagonals (3, N) of the squared second differences along an axis; cached."""
    second = second_differences(greville_cells(num_cells, degree))
    product = np.pad(second.T @ second, ((0, 3), (0, 0)))
    return np.stack([np.diagonal(product, -k) for k in range(3)])


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
    basis_functions(u, knot, degree, first, values, slopes)
    return first, values, slopes


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class HeightField(Record):
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
        (first_x, x, _), (first_y, y, _) = (self._basis(xy, axis) for axis in range(2))
        result = np.empty(len(xy))
        tensor_heights(first_x, x, first_y, y, self.control, result)
        return result

    def slopes(self, xy: Array) -> Array:
        """Return dz/dx and dz/dy at (M, 2) x and y."""
        (first_x, x, slope_x), (first_y, y, slope_y) = (self._basis(xy, k) for k in range(2))
        along = np.empty((2, len(xy)))
        tensor_heights(first_x, slope_x, first_y, y, self.control, along[0])
        tensor_heights(first_x, x, first_y, slope_y, self.control, along[1])
        return np.stack([along[0] / self.width_m(0), along[1] / self.width_m(1)], axis=1)

    def _basis(self, xy: Array, axis: int) -> tuple[npt.NDArray[np.int64], Array, Array]:
        """Return the basis functions along an axis at locations (M, 2); see basis."""
        cells, degree = self.control.shape[axis] - 2, self.degrees[axis]
        u = (xy[:, axis] - self.origin[axis] + 0.5 * self.pitch_m) / self.width_m(axis)
        return basis(np.clip(u, 0.0, 1.0), knots(cells, degree), degree)

    def width_m(self, axis: int) -> float:
        """Return the width of the range of the parameter along an axis, m."""
        return (self.control.shape[axis] - 1) * self.pitch_m

    def greville(self) -> tuple[Array, Array]:
        """Return x (Nx + 2,) and y (Ny + 2,) of the control points as a NURBS patch, m."""
        x, y = (
            self.origin[axis]
            + self.pitch_m * greville_cells(self.control.shape[axis] - 2, self.degrees[axis])
            for axis in range(2)
        )
        return x, y


def samples_of(field: HeightField, xy: Array, z: Array, share: Array) -> FieldSamples:
    """Return (M,) heights at (M, 2) locations, m, and their weights as samples of a field."""
    (first_x, x, _), (first_y, y, _) = (field._basis(xy, axis) for axis in range(2))
    return FieldSamples((first_x, x, first_y, y), z, share)


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


def fit_nearest(start: HeightField, xy: Array, z: Array) -> HeightField:
    """Return the least squares field of (M,) heights at (M, 2) nearest to the initial one."""
    flat = HeightField(start.pitch_m, start.origin, start.degrees, np.zeros_like(start.control))
    missing, rules = z - start.heights(xy), (0.0, NEAREST)
    change = fit_pspline(flat, xy, missing, np.ones(len(z)), rules)
    control = start.control + change.control
    return HeightField(start.pitch_m, start.origin, start.degrees, control)


def fit_pspline(
    start: HeightField, xy: Array, z: Array, weight: Array, rules: tuple[float, float]
) -> HeightField:
    """
    Return the field that minimises weighted squared residuals plus squared second differences.

    Parameters
    ----------
    start : HeightField
        Grid and degrees.
    xy, z, weight : (M, 2), (M,), (M,) float64
        Samples, m, and their weights.
    rules : (float, float)
        Weight of the second differences, for a mean weight of 1, and of the squares of heights.

    Notes
    -----
    Up to 100 x 100 cells the equations are solved to rounding. In larger fields control points on
    which no sample depends have the height of the nearest other one.

    """
    return fit_samples(start, samples_of(start, xy, z, weight / weight.mean()), rules)


def fit_samples(
    start: HeightField, samples: FieldSamples, rules: tuple[float, float]
) -> HeightField:
    """Return the field of fit_pspline; the weights of the samples have the mean 1."""
    if start.control.shape[1] > start.control.shape[0]:  # the bandwidth is the short side
        return transposed(fit_samples(transposed(start), samples.transposed(), rules))
    if is_direct(start.control.shape, max(*start.degrees, 2)):
        num_x, num_y = start.control.shape
        penalties = penalty(num_x - 2, start.degrees[0]), penalty(num_y - 2, start.degrees[1])
        control = solve_band(samples, penalties, rules)
        return HeightField(start.pitch_m, start.origin, start.degrees, control)
    active = np.zeros(start.control.shape, np.bool_)
    active.ravel()[samples.design(start.control.shape[1])[0]] = True
    initial = continued(start.control, start.control != 0.0)
    control = relax(samples, start.greville(), active, rules, initial)
    if rules[0] > 0.0:
        control = continued(control, active)
    return HeightField(start.pitch_m, start.origin, start.degrees, control)


def continued(control: Array, fitted: npt.NDArray[np.bool_]) -> Array:
    """Return control points (Nx, Ny) where unknown ones have the height of the nearest other."""
    from scipy.ndimage import distance_transform_edt  # seconds to import

    if not fitted.any():
        return control
    x, y = distance_transform_edt(~fitted, return_distances=False, return_indices=True)
    nearest: Array = control[x, y]
    return nearest


def fit_cells(
    cells: Cells, patch: int, degree: int, smoothing: float | None
) -> tuple[HeightField, Array]:
    """
    Return the field of a patch, and the heights of its points above it, m.

    Without smoothing the field is fitted to the mean heights of the cells.

    Parameters
    ----------
    cells : Cells
        The cells of all patches.
    patch : int
        Their patch.
    degree : int
        Degree of the splines, reduced along axes with too few cells.
    smoothing : float or None
        Weight of the second differences, for a mean weight of 1; None for fit_nearest.

    """
    sums, (num_x, num_y) = cells.sums[cells.of(patch)], cells.sizes[patch]
    used = sums[:, 3] > 0.0
    means = np.full((len(sums), 3), np.nan)
    means[used] = sums[used, :3] / sums[used, 3:]
    heights = means[:, 2].reshape(num_x, num_y)
    filled = used.reshape(num_x, num_y)
    origin = cells.origins[patch].copy()
    start = initial_field(float(cells.pitches[patch]), origin, heights, filled, degree)
    points, first = cells.points
    own = points[first[patch] : first[patch + 1]]
    if smoothing is None:
        field = fit_nearest(start, means[used, :2], means[used, 2])
        return field, own[:, 2] - field.heights(own[:, :2])
    samples = samples_of(start, own[:, :2], own[:, 2], np.ones(len(own)))
    field = fit_samples(start, samples, (smoothing, RIDGE))
    return field, samples.z - samples.heights(field.control)


def transposed(field: HeightField) -> HeightField:
    """Return the field with x and y exchanged."""
    x, y = field.degrees
    return HeightField(field.pitch_m, field.origin[::-1], (y, x), field.control.T)
