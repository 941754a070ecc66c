# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""B-spline height fields: knots, reproduction, limits of their fits, NURBS export, solvers."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.bspline import (
    axis_degree,
    basis,
    fit_nearest,
    fit_pspline,
    initial_field,
    knots,
    penalty,
    RIDGE,
    samples_of,
)
from surfel_mapper.models.bspline_solvers import second_differences, solve_band

SIZES = [1, 2, 3, 4, 5, 30]
PITCH, ORIGIN = 0.3, np.array([-1.2, 0.6])


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
@pytest.mark.parametrize('solver', ['nearest', 'pspline'])
def test_planes_are_reproduced(cells, solver):
    start, xy, z = scene(lambda x, y: 0.3 * x - 0.2 * y + 0.1, cells)
    ones = np.ones(len(z))
    field = (
        fit_nearest(start, xy, z)
        if solver == 'nearest'
        else fit_pspline(start, xy, z, ones, (1e-2, RIDGE))
    )
    scale = max(np.ptp(z), 0.1)
    assert np.abs(field.heights(xy) - z).max() < 1e-4 * scale


@pytest.mark.parametrize('cells', [(1, 1), (3, 4), (9, 6)])
def test_nearest_field_is_the_least_change_of_the_least_squares(cells):
    start, xy, z = scene(lambda x, y: np.sin(3 * x) * y, cells, holes=cells == (9, 6))
    rows, weights = samples_of(start, xy, z, z).design(start.control.shape[1])
    matrix = np.zeros((len(z), start.control.size))
    np.add.at(matrix, (np.arange(len(z))[:, None], rows), weights)
    change = np.linalg.pinv(matrix) @ (z - matrix @ start.control.ravel())
    expected = start.control + change.reshape(start.control.shape)
    np.testing.assert_allclose(fit_nearest(start, xy, z).control, expected, atol=1e-6)


def test_quadrics_are_reproduced_and_holes_are_filled():
    def bowl(x, y):
        return 0.4 * x**2 - 0.1 * x * y + 0.2 * y**2

    start, xy, z = scene(bowl, holes=True)
    field = fit_pspline(start, xy, z, np.ones(len(z)), (1e-6, RIDGE))
    assert np.abs(field.heights(xy) - z).max() < 1e-3 * np.ptp(z)
    hole = ORIGIN + PITCH * np.array([[4.0, 3.0], [3.5, 2.5]])
    expected = bowl(hole[:, 0], hole[:, 1])
    usual = fit_pspline(start, xy, z, np.ones(len(z)), (1e-2, RIDGE))
    np.testing.assert_allclose(usual.heights(hole), expected, atol=0.05 * np.ptp(z))


@pytest.mark.parametrize('cells', [(9, 6), (1, 1), (2, 7), (1, 8)])
def test_banded_fields_equal_the_dense_normal_equations(cells):
    rng = np.random.default_rng(4)
    start, xy, z = scene(lambda x, y: np.sin(2 * x) + y**2, cells, holes=cells == (9, 6))
    share = rng.uniform(0.5, 2.0, len(z))
    rows, weights = samples_of(start, xy, z, share).design(start.control.shape[1])
    samples = np.zeros((len(z), start.control.size))
    np.add.at(samples, (np.arange(len(z))[:, None], rows), weights)
    expected = samples.T @ (share[:, None] * samples) + RIDGE * np.eye(start.control.size)
    num_x, num_y = start.control.shape
    for axis, places in enumerate(start.greville()):
        before, after = np.diff(places)[:-1], np.diff(places)[1:]
        second = np.zeros((len(places) - 2, len(places)))
        for i, (b, a) in enumerate(zip(before, after, strict=True)):
            second[i, i : i + 3] = 2 * a / (a + b), -2.0, 2 * b / (a + b)
        np.testing.assert_allclose(second_differences(places), second)
        bend = second.T @ second
        whole = np.kron(bend, np.eye(num_y)) if axis == 0 else np.kron(np.eye(num_x), bend)
        expected += 0.05 * whole
    control = np.linalg.solve(expected, samples.T @ (share * z))
    penalties = [penalty(*axis) for axis in zip(cells, start.degrees, strict=True)]
    found = solve_band(samples_of(start, xy, z, share), penalties, (0.05, RIDGE))
    np.testing.assert_allclose(found.ravel(), control, rtol=1e-6, atol=1e-8)


def test_slopes_are_the_derivatives_of_the_heights():
    start, xy, z = scene(lambda x, y: np.sin(2 * x) + y**2)
    field = fit_pspline(start, xy, z, np.ones(len(z)), (1e-3, RIDGE))
    step = 1e-6
    for axis in range(2):
        by = step * np.eye(2)[axis]
        expected = (field.heights(xy + by) - field.heights(xy - by)) / (2 * step)
        np.testing.assert_allclose(field.slopes(xy)[:, axis], expected, atol=1e-6)


@pytest.mark.parametrize('cells', [(1, 2), (4, 5), (12, 3)])
def test_greville_points_make_the_same_surface_a_nurbs_patch(cells):
    from scipy.interpolate import BSpline  # seconds to import

    start, xy, z = scene(lambda x, y: x**2 - y, cells)
    field = fit_pspline(start, xy, z, np.ones(len(z)), (1e-2, RIDGE))
    control = field.greville()
    for axis in range(2):
        degree, width = field.degrees[axis], (cells[axis] + 1) * PITCH
        u = (xy[:, axis] - ORIGIN[axis] + 0.5 * PITCH) / width
        assert ((u >= 0.0) & (u <= 1.0)).all()
        place = BSpline(knots(cells[axis], degree), control[axis], degree)(u)
        np.testing.assert_allclose(place, xy[:, axis], atol=1e-12)
