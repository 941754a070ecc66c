# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""B-spline height fields: knots, reproduction, limits of their fits, NURBS export, solvers."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from surfel_mapper.models import bspline_multigrid
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
from surfel_mapper.models.bspline_multigrid import (
    conjugate_gradients,
    halved,
    refinement,
    Stencils,
)
from surfel_mapper.models.kernels.bspline import (
    add_differences,
    add_equations,
    coarsen_stencils,
    fit_fields,
    multiply_stencils,
    nonzero,
    relax_backward,
    relax_forward,
    solve_band,
)
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


def dense(matrix):
    """Return the full matrix (n, n) of stencils, by distances along x and y."""
    num_x, num_y = matrix.shape
    full = np.zeros((num_x, num_y, num_x, num_y))
    for x, y, other_x, other_y in np.ndindex(full.shape):
        dx, dy = other_x - x, other_y - y
        if max(abs(dx), abs(dy)) <= matrix.reach and (dx, dy) >= (0, 0):
            entry = matrix.entries[x * num_y + y, dx * (2 * matrix.reach + 1) + dy]
            full[x, y, other_x, other_y] = full[other_x, other_y, x, y] = entry
    return full.reshape(num_x * num_y, -1)


def random_stencils(shape, reach=3):
    """Return a positive definite matrix without entries beyond the grid."""
    rng, matrix = np.random.default_rng(sum(shape)), Stencils.zeros(shape, reach)
    index = np.argwhere(np.ones(shape))
    for dx in range(reach + 1):
        for dy in range(-reach if dx else 1, reach + 1):
            other = index + np.array([dx, dy])
            inside = ((other >= 0) & (other < shape)).all(axis=1)
            column = dx * (2 * reach + 1) + dy
            matrix.entries[inside, column] = rng.uniform(-1.0, 1.0, inside.sum())
    matrix.entries[:, 0] = 2.0 * matrix.entries.shape[1]
    return matrix


@both
@pytest.mark.parametrize('degree', [1, 3, 5])
def test_band_and_stencils_hold_the_normal_equations(call, degree):
    start, xy, z = scene(lambda x, y: np.sin(2 * x) + y**2, (9, 6), holes=True)
    start = initial_field(PITCH, ORIGIN, start.control[1:-1, 1:-1], np.ones((9, 6), bool), degree)
    weight = np.random.default_rng(3).uniform(0.5, 2.0, len(z))
    matrix = Stencils.zeros(start.control.shape, max(degree, 3))
    band, right = np.zeros((11 * 8, 5 * 8 + 6)), np.zeros((2, 11 * 8))
    for k, (stride, rows) in enumerate([(8, band), (matrix.stride, matrix.entries)]):
        parts = np.column_stack([xy, z]), weight, start.parts()
        call(add_equations, *parts, stride, rows, right[k])
        call(add_differences, *start.greville(), 0.05, stride, rows)
    columns, values, _ = design(start, xy)
    samples = np.zeros((len(z), 11 * 8))
    np.add.at(samples, (np.arange(len(z))[:, None], columns), values)
    expected = samples.T @ (weight[:, None] * samples)
    for axis, places in enumerate(start.greville()):
        before, after = np.diff(places)[:-1], np.diff(places)[1:]
        second = np.zeros((len(places) - 2, len(places)))
        for i, (b, a) in enumerate(zip(before, after, strict=True)):
            second[i, i : i + 3] = 2 * a / (a + b), -2.0, 2 * b / (a + b)
        bend = second.T @ second
        whole = np.kron(bend, np.eye(8)) if axis == 0 else np.kron(np.eye(11), bend)
        expected += 0.05 * whole
    np.testing.assert_allclose(dense(matrix), expected, atol=1e-13)
    full = sum(np.diag(band[: 88 - k, k], k) for k in range(46))
    np.testing.assert_allclose(full, np.triu(expected), atol=1e-13)
    np.testing.assert_array_equal(matrix.band(), band[:, : matrix.band().shape[1]])
    np.testing.assert_allclose(right, [samples.T @ (weight * z)] * 2, atol=1e-13)


@both
@pytest.mark.parametrize(('shape', 'reach'), [((9, 7), 3), ((6, 2), 3), ((5, 8), 4)])
def test_products_and_sweeps_of_stencils_equal_numpy(call, shape, reach):
    matrix = random_stencils(shape, reach)
    full, number = dense(matrix), shape[0] * shape[1]
    right = np.random.default_rng(1).normal(size=number)
    padded = matrix.padded(right)
    product, x, rest = np.empty((3, len(padded)))
    call(multiply_stencils, matrix.entries, matrix.offsets, padded, product)
    np.testing.assert_allclose(product[:number], full @ right, atol=1e-12)
    assert not product[number:].any()

    call(relax_forward, matrix.entries, matrix.offsets, padded, x, rest)
    forward = np.linalg.solve(np.tril(full), right)
    np.testing.assert_allclose(x[:number], forward, atol=1e-12)
    np.testing.assert_allclose(rest[:number], right - full @ forward, atol=1e-12)

    call(relax_backward, matrix.entries, matrix.offsets, padded, x, rest)
    expected = forward + np.linalg.solve(np.triu(full), right - full @ forward)
    np.testing.assert_allclose(x[:number], expected, atol=1e-12)


@both
@pytest.mark.parametrize(('shape', 'reach'), [((9, 7), 3), ((12, 8), 3), ((8, 11), 5)])
def test_coarse_stencils_are_the_galerkin_product(call, shape, reach):
    matrix = random_stencils(shape, reach)
    num_x, num_y = shape
    coarse = Stencils.zeros((num_y, halved(num_x)), reach)
    call(coarsen_stencils, matrix.entries, num_y, reach, coarse.entries)
    along_x, along_y = (refinement(number).toarray() for number in shape)
    fine = dense(matrix).reshape(num_x, num_y, num_x, num_y)
    expected = np.einsum('xyuv,xa,ub->yavb', fine, along_x, along_x)
    number = len(coarse.entries)
    np.testing.assert_allclose(dense(coarse), expected.reshape(number, number), atol=1e-12)
    expected = np.kron(along_x, along_y).T @ dense(matrix) @ np.kron(along_x, along_y)
    np.testing.assert_allclose(dense(matrix.coarser()), expected, atol=1e-12)


@pytest.mark.parametrize('number', [16, 17])
def test_refined_splines_are_the_same_curve(number):
    from scipy.interpolate import BSpline  # seconds to import

    coarse = np.random.default_rng(5).normal(size=halved(number))
    fine = refinement(number) @ coarse
    x = np.linspace(2.0, number - 3.0, 50)
    # a basis function is at the middle of its five knots: fine ones at i, coarse ones at 2 k - 2
    expected = BSpline(2.0 * np.arange(-3.0, len(coarse) + 1.0), coarse, 3)(x)
    np.testing.assert_allclose(BSpline(np.arange(-2.0, number + 2.0), fine, 3)(x), expected)


def rough_scene(cells):
    """Return a start, places, heights and weights: noise, empty cells and large holes."""
    rng = np.random.default_rng(7)
    x, y = np.meshgrid(np.arange(cells[0]), np.arange(cells[1]), indexing='ij')
    filled = (np.abs(x - y) < 0.4 * cells[0]) & (rng.random(cells) > 0.2)
    filled &= np.hypot(x - 30.0, y - 25.0) > 15.0
    xy = PITCH * np.stack([x, y], -1) + PITCH * rng.uniform(0.1, 0.9, (*cells, 2))
    z = np.sin(0.5 * xy[..., 0]) + 0.1 * xy[..., 1] + 0.02 * rng.standard_normal(cells)
    weight = np.ceil(400.0 / (1.0 + np.hypot(x - 50.0, y - 50.0)))
    start = initial_field(PITCH, np.zeros(2), z, filled, 3)
    return start, xy[filled], z[filled], weight[filled]


@pytest.mark.parametrize('cells', [(60, 45), (45, 60), (150, 30)])
@pytest.mark.parametrize('smoothing', [1e-3, 1e-2, 10.0])
def test_multigrid_equals_the_band(monkeypatch, cells, smoothing):
    samples = rough_scene(cells)
    expected = fit_pspline(*samples, smoothing)
    monkeypatch.setattr(bspline_multigrid, 'MOST_DIRECT', 1e5)
    monkeypatch.setattr(bspline_multigrid, 'solve_band', None)
    found = fit_pspline(*samples, smoothing)
    xy = samples[1]
    np.testing.assert_allclose(found.control, expected.control, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(found.heights(xy), expected.heights(xy), rtol=0.0, atol=1e-9)
    assert (found.control != expected.control).any()


def test_multigrid_of_heights_of_zero_is_zero(monkeypatch):
    monkeypatch.setattr(bspline_multigrid, 'MOST_DIRECT', 1e5)
    start, xy, z, weight = rough_scene((60, 45))
    assert not fit_pspline(start, xy, 0.0 * z, weight, 1e-2).control.any()


def test_fields_that_do_not_converge_are_solved_as_bands(monkeypatch):
    samples = rough_scene((60, 45))
    expected = fit_pspline(*samples, 1e-9)
    monkeypatch.setattr(bspline_multigrid, 'MOST_DIRECT', 1e5)
    monkeypatch.setattr(bspline_multigrid, 'MOST_STEPS', 5)
    found = fit_pspline(*samples, 1e-9)
    np.testing.assert_allclose(found.control, expected.control, rtol=0.0, atol=1e-12)


def test_steps_hardly_grow_with_the_size_of_a_field(monkeypatch):
    monkeypatch.setattr(bspline_multigrid, 'MOST_DIRECT', 1e5)
    monkeypatch.setattr(bspline_multigrid, 'MOST_STEPS', 40)
    for cells in [(40, 40), (80, 80), (160, 160)]:
        start, xy, z, weight = rough_scene(cells)
        matrix = Stencils.zeros(start.control.shape, 3)
        right, share = np.zeros(start.control.size), weight / weight.mean()
        layout = matrix.stride, matrix.entries
        add_equations(np.column_stack([xy, z]), share, start.parts(), *layout, right)
        add_differences(*start.greville(), 1e-2, *layout)
        matrix.entries[:, 0] += RIDGE
        assert conjugate_gradients(matrix, right) is not None


def test_memory_of_a_large_field_is_a_few_hundred_bytes_a_cell():
    samples = rough_scene((200, 200))
    fit_pspline(*samples, 1e-2)  # imports
    tracemalloc.start()
    fit_pspline(*samples, 1e-2)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 800 * 200 * 200  # 202^2 rows of 610 columns are 4,900
