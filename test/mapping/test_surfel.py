# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Surfel against exact rational arithmetic, and on known shapes."""

from fractions import Fraction
from pathlib import Path
import re

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from surfel_mapper.mapping.surfel import Surfel
from test.mapping.surfel_promises import (
    assert_normal,
    assert_promises,
    EPS,
    FAR_M,
    POINT,
    POINTS,
    rounding,
    trace,
)
from test.reference import exact_moments

pytestmark = pytest.mark.filterwarnings('error')


# Exact arithmetic


def assert_equals_exactly_summed(surfel, points, steps, largest):
    num_points, total, scatter = exact_moments(points)
    assert surfel.num_points == num_points
    scale = np.abs(points).sum(axis=0) + np.sqrt(largest * num_points)
    for axis in range(3):
        error = Fraction(surfel.sum[axis]) - total[axis]
        assert abs(error) <= rounding(steps) * scale[axis]
    for k in range(6):
        error = Fraction(surfel.sum_squares[k]) - scatter[k]
        assert abs(error) <= rounding(steps) * largest


@given(st.data(), st.sampled_from([0.0, 1.0]), st.sampled_from([1.0, 1 / 3]))
def test_any_sequence_of_adding_and_removing_leaves_the_statistics_of_what_is_left(
    data, far, scale
):
    surfel, batches, largest = Surfel(), [], 0.0
    steps = data.draw(st.integers(1, 15))
    for _ in range(steps):
        if batches and data.draw(st.booleans()):
            batch = batches.pop(data.draw(st.integers(0, len(batches) - 1)))
            change = surfel.remove
        else:
            batch = data.draw(POINTS) * scale + far * FAR_M
            batches.append(batch)
            change = surfel.add
        for operand in data.draw(
            st.sampled_from([[batch], list(batch), [Surfel.from_points(batch)]])
        ):
            change(operand)
        largest = max(largest, trace(surfel))
        assert_promises(surfel)

    if batches:
        assert_equals_exactly_summed(surfel, np.concatenate(batches), 12 * steps, largest)
    else:
        assert surfel == Surfel()


@given(st.lists(POINTS, min_size=1, max_size=6))
def test_no_bit_is_lost_ten_kilometres_from_the_origin(batches):
    near, far = Surfel(), Surfel()
    for batch in batches:
        near.add(batch)
        far.add(batch + FAR_M)
    near.remove(batches[-1])
    far.remove(batches[-1] + FAR_M)

    np.testing.assert_array_equal(far.sum_squares, near.sum_squares)
    np.testing.assert_array_equal(far.eigenvectors(), near.eigenvectors())
    assert far.planarity() == near.planarity() or np.isnan(near.planarity())
    np.testing.assert_allclose(far.mean(), near.mean() + FAR_M, rtol=2 * EPS)


@given(POINTS, st.randoms(use_true_random=False))
def test_order_and_batching_make_no_difference_beyond_rounding(points, random):
    order = list(range(len(points)))
    random.shuffle(order)
    cut = random.randint(0, len(points))
    batch, each, merged = Surfel.from_points(points), Surfel(), Surfel()
    for k in order:
        each.add(points[k])
    for part in (points[order[:cut]], points[order[cut:]]):
        merged.add(Surfel.from_points(part))

    tolerance = rounding(len(points)) * trace(batch)
    for other in (each, merged):
        assert other.num_points == batch.num_points
        np.testing.assert_array_equal(other.sum, batch.sum)  # exact on the lattice
        np.testing.assert_allclose(other.sum_squares, batch.sum_squares, rtol=0, atol=tolerance)


def test_a_thousand_cycles_of_adding_and_removing_leave_little_more_than_rounding():
    rng = np.random.default_rng(1)
    plane = rng.uniform(-0.25, 0.25, (200, 3)) * [1, 1, 0.02]
    surfel = Surfel.from_points(plane + FAR_M)
    expected, largest = surfel.copy(), 0.0
    for _ in range(1000):
        batch = rng.uniform(-0.25, 0.25, (200, 3)) * [1, 1, 0.02] + FAR_M
        surfel.add(batch)
        largest = max(largest, trace(surfel))
        surfel.remove(batch)

    np.testing.assert_allclose(
        surfel.sum_squares, expected.sum_squares, rtol=0, atol=rounding(2000) * largest
    )


# Shapes known in advance


def grid(directions, steps=range(-5, 6)):
    """Return points at integer combinations of some directions."""
    weights = np.stack(np.meshgrid(*[steps] * len(directions), indexing='ij'), axis=-1)
    return weights.reshape(-1, len(directions)) @ np.array(directions, dtype=float)


@pytest.mark.parametrize(
    ('u', 'v', 'normal'),
    [
        ([1, 0, 0], [0, 1, 0], [0, 0, 1]),
        ([0, 1, 0], [0, 0, 1], [1, 0, 0]),
        ([2, 2, 1], [-2, 1, 2], [1 / 3, -2 / 3, 2 / 3]),
        ([3, 4, 0], [0, 0, 5], [0.8, -0.6, 0]),
    ],
)
def test_a_square_grid_is_a_plane_of_planarity_one(u, v, normal):
    surfel = Surfel.from_points(grid([u, v]) + FAR_M)

    # variance along each direction: 11 offsets of mean square 10, 121 points
    assert_normal(surfel.normal(), np.array(normal), 8 * EPS)
    expected = 10 * np.dot(u, u) * 121 / 120
    np.testing.assert_allclose(surfel.eigenvalues(), [0, expected, expected], rtol=8 * EPS)
    assert surfel.planarity() == pytest.approx(1.0, abs=8 * EPS)
    assert surfel.curvature() == 0.0


def test_a_ball_has_planarity_zero_and_curvature_a_third():
    surfel = Surfel.from_points(np.concatenate([np.eye(3), -np.eye(3)]))

    np.testing.assert_allclose(surfel.eigenvalues(), [0.4, 0.4, 0.4], rtol=4 * EPS)
    assert surfel.planarity() == pytest.approx(0.0, abs=8 * EPS)
    assert surfel.curvature() == pytest.approx(1 / 3, abs=4 * EPS)


@given(POINT.filter(np.any), POINT, st.integers(2, 20), st.sampled_from([1.0, 1 / 3, 1e-6, 1e5]))
def test_on_a_line_two_eigenvalues_and_the_planarity_are_zero(direction, start, count, scale):
    points = (start + FAR_M) * scale + np.arange(count)[:, None] * direction * scale
    each = Surfel()
    for point in points:
        each.add(point)

    for surfel in (Surfel.from_points(points), each):
        assert surfel.eigenvalues()[:2].tolist() == [0.0, 0.0]
        assert surfel.eigenvalues()[2] > 0.0
        assert surfel.planarity() == surfel.curvature() == 0.0
        unit = direction / np.linalg.norm(direction)
        # the points lie on the line as far as their own rounding lets them
        length = np.linalg.norm(points[-1] - points[0])
        off_line = EPS * np.abs(points).max() / length
        assert abs(surfel.normal() @ unit) <= 8 * EPS + 4 * off_line


@given(POINT, st.integers(2, 20))
def test_equal_points_have_no_normal(point, count):
    points = np.tile(point / 3 + FAR_M, (count, 1))
    each = Surfel()
    for row in points:
        each.add(row)

    for surfel in (Surfel.from_points(points), each):
        assert not surfel.eigenvalues().any()
        assert np.isnan(surfel.normal()).all()
        assert np.isnan(surfel.planarity())
        np.testing.assert_array_equal(surfel.mean(), points[0])


@pytest.mark.parametrize('scale', [1e99, 1e50, 1e-50, 1e-150])
def test_very_large_and_very_small_shapes_are_shapes(scale):
    surfel = Surfel.from_points(grid([[2, 2, 1], [-2, 1, 2]]) * scale / 20)

    assert_normal(surfel.normal(), np.array([1, -2, 2]) / 3, 16 * EPS)
    assert surfel.planarity() == pytest.approx(1.0, abs=16 * EPS)


def test_a_surfel_is_made_of_arrays_lists_iterators_or_nothing():
    points = np.random.default_rng(3).normal(size=(20, 3))
    expected = Surfel.from_points(points)
    for each in (points, points.tolist(), iter(points), (p for p in points), map(list, points)):
        assert Surfel(each) == expected
    assert Surfel(expected) == expected
    for empty in ((), [], iter([]), np.empty((0, 3))):
        assert Surfel(empty).empty
        assert Surfel.from_points(empty) == Surfel()
    surfel = Surfel(points)
    surfel.remove(iter(points[:5]))
    surfel.add(iter([]))
    assert surfel.num_points == 15


def test_the_page_about_surfels_runs():
    page = (Path(__file__).parents[2] / 'docs/surfel.md').read_text(encoding='utf-8')
    code = re.findall(r'```python\n(.*?)```', page, re.DOTALL)
    assert len(code) == 3
    exec('\n'.join(code), {})  # asserts the statements of the page
