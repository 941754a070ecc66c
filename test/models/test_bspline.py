# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""B-spline height fields: knots, reproduction, limits of their fits, NURBS export, band solver."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.bspline import (
    axis_degree,
    basis,
    design,
    fit_lsqr,
    fit_pspline,
    initial_field,
    knots,
    RIDGE,
)
from surfel_mapper.models.kernels.bspline import fit_fields, nonzero, solve_band
from test.kernels.modes import both

SIZES = [1, 2, 3, 4, 5, 30]
PITCH, ORIGIN = 0.3, np.array([-1.2, 0.6])


@pytest.mark.parametrize('cells', SIZES)
@pytest.mark.parametrize('degree', [1, 2, 3])
def test_knots_are_clamped_ascending_and_of_the_right_number(cells, degree):
    degree = axis_degree(cells, degree)
    knot = knots(cells, degree)
    assert len(knot) == cells + degree + 3
    assert (np.diff(knot) >= 0.0).all()
    assert (knot[: degree + 1] == 0.0).all()
    assert (knot[-degree - 1 :] == 1.0).all()
    assert (np.diff(knot[degree:-degree]) > 0.0).all()


@pytest.mark.parametrize('cells', SIZES)
def test_basis_functions_equal_scipy_and_sum_to_one(cells):
    from scipy.interpolate import BSpline  # seconds to import

    degree = axis_degree(cells, 3)
    knot, u = knots(cells, degree), np.linspace(0.0, 1.0, 57)
    first, values, slopes = basis(u, knot, degree)
    np.testing.assert_allclose(values.sum(axis=1), 1.0, atol=1e-12)
    control = np.random.default_rng(1).standard_normal(cells + 2)
    expected = BSpline(knot, control, degree)
    columns = first[:, None] + np.arange(degree + 1)
    np.testing.assert_allclose((control[columns] * values).sum(1), expected(u), atol=1e-12)
    np.testing.assert_allclose(
        (control[columns] * slopes).sum(1), expected.derivative()(u), atol=1e-9
    )


def scene(function, cells=(9, 6), holes=False):
    """Return a start, places, heights: a place in the middle of every cell."""
    x, y = np.meshgrid(np.arange(cells[0]), np.arange(cells[1]), indexing='ij')
    xy = ORIGIN + PITCH * (np.stack([x, y], -1) + 0.5)
    z = function(xy[..., 0], xy[..., 1])
    filled = np.ones(cells, bool)
    if holes:
        filled[3:5, 2:4] = False
    start = initial_field(PITCH, ORIGIN, z, filled, 3)
    return start, xy[filled], z[filled]


@pytest.mark.parametrize('cells', [(1, 1), (2, 1), (3, 4), (9, 6), (5, 30)])
@pytest.mark.parametrize('solver', ['lsqr', 'pspline'])
def test_planes_are_reproduced(cells, solver):
    start, xy, z = scene(lambda x, y: 0.3 * x - 0.2 * y + 0.1, cells)
    ones = np.ones(len(z))
    field = fit_lsqr(start, xy, z) if solver == 'lsqr' else fit_pspline(start, xy, z, ones, 1e-2)
    scale = max(np.ptp(z), 0.1)
    assert np.abs(field.heights(xy) - z).max() < 1e-4 * scale


def test_quadrics_are_reproduced_and_holes_are_filled():
    def bowl(x, y):
        return 0.4 * x**2 - 0.1 * x * y + 0.2 * y**2

    start, xy, z = scene(bowl, holes=True)
    field = fit_pspline(start, xy, z, np.ones(len(z)), 1e-6)
    assert np.abs(field.heights(xy) - z).max() < 1e-3 * np.ptp(z)
    hole = ORIGIN + PITCH * np.array([[4.0, 3.0], [3.5, 2.5]])
    expected = bowl(hole[:, 0], hole[:, 1])
    usual = fit_pspline(start, xy, z, np.ones(len(z)), 1e-2)
    np.testing.assert_allclose(usual.heights(hole), expected, atol=0.05 * np.ptp(z))


def test_lsqr_equals_the_limit_of_gradient_descent():
    start, xy, z = scene(lambda x, y: np.sin(2 * x) + y**2, (4, 3))
    rows, weights, _ = design(start, xy)
    matrix = np.zeros((len(z), start.control.size))
    np.add.at(matrix, (np.arange(len(z))[:, None], rows), weights)
    control = start.control.ravel().copy()
    step = 1.0 / np.linalg.norm(matrix, 2) ** 2
    for _ in range(200_000):
        change = step * (matrix.T @ (z - matrix @ control))
        control += change
        if np.abs(change).max() < 1e-13:
            break
    found = fit_lsqr(start, xy, z).control.ravel()
    np.testing.assert_allclose(found, control, atol=1e-6)


def test_pspline_minimises_its_cost():
    start, xy, z = scene(lambda x, y: np.sin(2 * x) + y**2, (3, 7))
    weight = np.linspace(0.5, 1.5, len(z))
    weight /= weight.mean()
    field = fit_pspline(start, xy, z, weight, 0.05)

    def cost(control):
        other = type(field)(field.pitch_m, field.origin, field.degrees, control)
        bend = 0.0
        for axis, place in enumerate(other.greville()):
            rows = np.moveaxis(control, axis, 0)
            slope = np.diff(rows, axis=0) / np.diff(place)[:, None]
            before, after = np.diff(place)[:-1, None], np.diff(place)[1:, None]
            bend += ((np.diff(slope, axis=0) * 2 * before * after / (before + after)) ** 2).sum()
        misfit = (weight * (z - other.heights(xy)) ** 2).sum()
        return misfit + 0.05 * bend + 1e-6 * (control**2).sum()

    least, rng = cost(field.control), np.random.default_rng(2)
    for _ in range(30):
        assert cost(field.control + 1e-4 * rng.standard_normal(field.control.shape)) > least


@both
def test_small_fields_at_once_equal_lapack(call):
    rng = np.random.default_rng(4)
    sizes = np.array([(9, 6), (1, 1), (2, 7), (5, 5), (1, 8)])
    ends = np.cumsum(sizes.prod(axis=1))
    first = ends - sizes.prod(axis=1)
    number = rng.integers(0, 4, ends[-1]).astype(float)  # some cells are empty
    number[first] = 2.0
    pitches, origins = rng.uniform(0.2, 0.5, len(sizes)), rng.normal(size=(len(sizes), 2))
    places = [
        origin + pitch * (np.argwhere(np.ones(size)) + rng.uniform(0.1, 0.9, (size.prod(), 2)))
        for origin, pitch, size in zip(origins, pitches, sizes, strict=True)
    ]
    means = np.column_stack([np.concatenate(places), rng.normal(size=ends[-1])])
    sums = np.column_stack([means * number[:, None], number])
    chosen = np.array([0, 1, 2, 4])
    counts = (sizes[chosen] + 2).prod(axis=1)
    begin = np.cumsum(counts) - counts
    control, heights = np.empty(counts.sum()), np.full(ends[-1], np.nan)
    rules = 3, 1e-2, RIDGE
    cells = first, sizes
    call(fit_fields, sums, cells, chosen, pitches, origins, rules, begin, control, heights)
    for k, at, num in zip(chosen, begin, counts, strict=True):
        low, high = first[k], ends[k]
        used = number[low:high] > 0.0
        xyz, filled = means[low:high], used.reshape(sizes[k])
        start = initial_field(pitches[k], origins[k], xyz[:, 2].reshape(sizes[k]), filled, 3)
        weight = number[low:high][used]
        expected = fit_pspline(start, xyz[used, :2], xyz[used, 2], weight, 1e-2).control
        np.testing.assert_allclose(
            control[at : at + num].reshape(expected.shape), expected, rtol=1e-7, atol=1e-9
        )
        expected = np.where(used, xyz[:, 2], np.nan)
        np.testing.assert_allclose(heights[low:high], expected, rtol=1e-14)
    assert np.isnan(heights[first[3] : ends[3]]).all()


def test_slopes_are_the_derivatives_of_the_heights():
    start, xy, z = scene(lambda x, y: np.sin(2 * x) + y**2)
    field = fit_pspline(start, xy, z, np.ones(len(z)), 1e-3)
    step = 1e-6
    for axis in range(2):
        by = step * np.eye(2)[axis]
        expected = (field.heights(xy + by) - field.heights(xy - by)) / (2 * step)
        np.testing.assert_allclose(field.slopes(xy)[:, axis], expected, atol=1e-6)


@pytest.mark.parametrize('cells', [(1, 1), (5, 3), (9, 6)])
def test_heights_and_slopes_are_nan_at_nan_only(cells):
    start, xy, z = scene(lambda x, y: 0.3 * x - 0.2 * y, cells)
    field = fit_pspline(start, xy, z, np.ones(len(z)), 1e-2)
    places = np.array([[np.nan, xy[0, 1]], [xy[0, 0], np.nan], [np.nan, np.nan], xy[0]])
    assert np.isnan(field.heights(places)).tolist() == [True, True, True, False]
    assert np.isnan(field.slopes(places)).tolist() == [[True] * 2] * 3 + [[False] * 2]


@both
def test_basis_at_nan_stays_within_the_knots(call):
    knot, values, lower = knots(4, 3), np.empty(4), np.empty(4)
    assert 0 <= call(nonzero, np.nan, knot, 3, values, lower) <= 6 - 4
    assert np.isnan(values).all()


@pytest.mark.parametrize('cells', [(1, 2), (4, 5), (12, 3)])
def test_greville_points_make_the_same_surface_a_nurbs_patch(cells):
    from scipy.interpolate import BSpline  # seconds to import

    start, xy, z = scene(lambda x, y: x**2 - y, cells)
    field = fit_pspline(start, xy, z, np.ones(len(z)), 1e-2)
    control = field.greville()
    for axis in range(2):
        degree, width = field.degrees[axis], (cells[axis] + 1) * PITCH
        u = (xy[:, axis] - ORIGIN[axis] + 0.5 * PITCH) / width
        assert ((u >= 0.0) & (u <= 1.0)).all()
        place = BSpline(knots(cells[axis], degree), control[axis], degree)(u)
        np.testing.assert_allclose(place, xy[:, axis], atol=1e-12)


@pytest.mark.parametrize(('number', 'width'), [(1, 1), (3, 8), (40, 1), (40, 7), (40, 40)])
def test_band_solver_equals_numpy(number, width):
    rng = np.random.default_rng(number + width)
    band, right = rng.uniform(-1.0, 1.0, (number, width)), rng.normal(size=number)
    band[:, 0] = 2.0 * width + 1.0  # more than the rest of its row and column together
    full = np.zeros((number, number))
    for i in range(number):
        for k in range(min(width, number - i)):
            full[i, i + k] = full[i + k, i] = band[i, k]
    expected = np.linalg.solve(full, right)
    solve_band(band, right)
    np.testing.assert_allclose(right, expected, rtol=1e-12, atol=1e-12)
