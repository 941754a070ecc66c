# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfel against exact rational arithmetic, on known shapes, and at its edges.

Tolerances. EPS = 2^-52. One step of float64 may be off by a few EPS of the largest scatter held
on the way (removing leaves the rounding of what was there), and steps add up as a random walk of
half an EPS each: ``rounding(steps)`` = (4 + sqrt(steps) / 2) EPS.
"""

import copy
from fractions import Fraction

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from surfel_mapper.mapping.surfel import Surfel
from test.reference import exact_moments

pytestmark = pytest.mark.filterwarnings('error')

EPS = np.finfo(np.float64).eps
UNIT = 16 * EPS  # LAPACK's eigenvectors: 8.5 EPS were found in 10^4 examples

# The lattice of 2^-10 m: sums, and the shift to 10 km, are exact in float64.
LATTICE = st.integers(-512, 512).map(lambda k: k / 1024)
POINT = st.tuples(LATTICE, LATTICE, LATTICE).map(np.array)
POINTS = st.lists(POINT, min_size=1, max_size=12).map(np.array)
FAR_M = np.array([6000.0, -6400.0, 4800.0])


def rounding(steps):
    return (4.0 + np.sqrt(steps) / 2.0) * EPS


def trace(surfel):
    return surfel.sum_squares[[0, 3, 5]].sum()


def assert_normal(normal, expected, tolerance):
    """The sign of an eigenvector is free."""
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=UNIT)
    np.testing.assert_allclose(
        normal * np.sign(normal @ expected), expected, rtol=0, atol=tolerance
    )


def assert_promises(surfel):
    """What holds of every surfel whatsoever."""
    n, values, vectors = surfel.num_points, surfel.eigenvalues(), surfel.eigenvectors()
    assert surfel.empty == (n == 0)
    assert np.isnan(surfel.mean()).all() == (n == 0)
    assert np.isfinite(values).all()
    assert (values >= 0.0).all()
    assert (np.diff(values) >= 0.0).all()
    if n < 2:
        assert not values.any()
        assert not surfel.covariance().any()
    if values[2] == 0.0:
        assert np.isnan(vectors).all()
        assert np.isnan(surfel.normal()).all()
        assert np.isnan(surfel.planarity())
        assert np.isnan(surfel.curvature())
    else:
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(3), rtol=0, atol=UNIT)
        np.testing.assert_array_equal(surfel.normal(), vectors[:, 0])
        assert (vectors.max(axis=0) >= -vectors.min(axis=0)).all()
        assert 0.0 <= surfel.planarity() <= 1.0
        assert 0.0 <= surfel.curvature() <= 1 / 3


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
def test_ten_kilometres_from_the_origin_not_a_bit_is_lost(batches):
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


def test_of_a_normal_the_largest_component_is_positive():
    for axis in np.eye(3):
        for sign in (1, -1):
            tilt = sign * (axis + 0.3 * np.roll(axis, 1) - 0.2 * np.roll(axis, 2))
            u = np.cross(tilt, [0.1, 0.7, 0.4])
            normal = Surfel.from_points(grid([u, np.cross(tilt, u)])).normal()
            assert normal[np.abs(normal).argmax()] > 0.0


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


@given(POINT.filter(np.any), POINTS, st.integers(2, 9))
def test_a_line_and_a_repeated_point_are_known_after_others_were_removed(direction, others, count):
    line = np.arange(count)[:, None] * direction / 3
    surfel = Surfel.from_points(line)
    surfel.add(others)
    surfel.remove(others)
    assert surfel.eigenvalues()[:2].tolist() == [0.0, 0.0]
    assert surfel.planarity() == 0.0

    surfel = Surfel.from_points(np.tile(direction / 3, (count, 1)))
    for other in others:
        surfel.add(other)
    for other in others:
        surfel.remove(other)
    assert np.isnan(surfel.normal()).all()


# Edges


def test_a_new_surfel_holds_nothing():
    surfel = Surfel()

    assert_promises(surfel)
    assert surfel.empty
    np.testing.assert_array_equal(surfel.sum, np.zeros(3))
    np.testing.assert_array_equal(surfel.sum_squares, np.zeros(6))


@pytest.mark.parametrize('nothing', [Surfel(), np.empty((0, 3))], ids=['surfel', 'batch'])
def test_adding_or_removing_nothing_changes_nothing(nothing):
    points = np.random.default_rng(1).normal(size=(9, 3))
    surfel, expected = Surfel.from_points(points), Surfel.from_points(points)

    surfel.add(nothing)
    surfel.remove(nothing)

    assert surfel == expected
    assert Surfel() + nothing == Surfel() - nothing == Surfel()


def test_removing_as_many_points_as_held_or_more_empties():
    points = np.random.default_rng(1).normal(size=(9, 3))
    for removed in (points, np.concatenate([points, points]), Surfel.from_points(points)):
        surfel = Surfel.from_points(points)
        surfel.remove(removed)
        assert surfel == Surfel()
    surfel = Surfel()
    surfel.remove(points[0])
    assert surfel == Surfel()


def test_removing_down_to_one_point_leaves_no_scatter():
    points = np.random.default_rng(1).normal(size=(9, 3)) + FAR_M
    surfel = Surfel.from_points(points)

    surfel.remove(points[:8])

    assert not surfel.sum_squares.any()
    # the sums held about the first point, some 9 m long together, were rounded
    np.testing.assert_allclose(surfel.mean(), points[8], rtol=EPS, atol=9 * EPS)
    assert_promises(surfel)


def test_removing_what_was_never_added_gives_no_negative_eigenvalue():
    surfel = Surfel.from_points(grid([[1, 0, 0], [0, 1, 0]]))

    surfel.remove([0.0, 0.0, 9.0])

    assert surfel.sum_squares[5] < 0.0
    assert_promises(surfel)


def test_clearing_empties_and_the_surfel_can_be_used_again():
    points = np.random.default_rng(1).normal(size=(9, 3))
    surfel = Surfel.from_points(points)
    surfel.clear()
    assert surfel == Surfel()

    surfel.add(points)
    assert surfel == Surfel.from_points(points)


def test_operators_are_adding_and_removing():
    points = np.random.default_rng(1).normal(size=(2, 9, 3))
    a, b = Surfel.from_points(points[0]), Surfel.from_points(points[1])
    a_before, total = a.copy(), a.copy()
    total += b

    assert a + b == total
    assert a == a_before
    total -= b
    assert (a + b) - b == total
    assert a + points[1][0] == a + Surfel.from_points(points[1][0])
    assert a - a == Surfel()
    a += a
    assert a.num_points == 18


def test_equal_means_the_same_count_sum_and_scatter():
    surfel = Surfel.from_stats([1.0, 2.0, 3.0], [6.0, 1.0, 2.0, 5.0, 3.0, 4.0], 4)

    assert surfel == Surfel.from_stats([1.0, 2.0, 3.0], [6.0, 1.0, 2.0, 5.0, 3.0, 4.0], 4)
    assert surfel != Surfel.from_stats([1.0, 2.0, 3.0], [6.0, 1.0, 2.0, 5.0, 3.0, 4.0], 5)
    assert surfel != Surfel.from_stats([1.0, 2.5, 3.0], [6.0, 1.0, 2.0, 5.0, 3.0, 4.0], 4)
    assert surfel != Surfel.from_stats([1.0, 2.0, 3.0], [6.0, 1.0, 2.0, 5.0, 3.0, 4.5], 4)
    assert surfel != 'a surfel'
    with pytest.raises(TypeError, match='unhashable'):
        hash(surfel)


@given(POINTS, st.sampled_from([1.0, 1 / 3, 1e5]))
def test_the_statistics_of_a_surfel_make_an_equal_one(points, scale):
    points = points * scale + FAR_M
    surfel = Surfel.from_points(points)

    again = Surfel.from_stats(surfel.sum, surfel.sum_squares, surfel.num_points)

    assert again == surfel
    tolerance = 2 * EPS * np.abs(points).max()  # the sum is rounded
    np.testing.assert_allclose(again.mean(), surfel.mean(), rtol=0, atol=tolerance)


def test_statistics_of_no_points_are_those_of_the_empty_surfel():
    assert Surfel.from_stats([1.0, 2.0, 3.0], [1.0, 0.5, 0.25, 2.0, 0.125, 3.0], 0) == Surfel()


def test_a_position_is_one_point_and_its_scatter_counts_once_others_come():
    scatter = [[3.0, 0.5, 0.25], [9.0, 2.0, 0.125], [9.0, 9.0, 1.0]]
    surfel = Surfel.from_position([1, 2, 3], scatter)

    assert surfel.num_points == 1
    assert surfel.sum.tolist() == [1, 2, 3]
    assert surfel.sum_squares.tolist() == [3.0, 0.5, 0.25, 2.0, 0.125, 1.0]
    assert_promises(surfel)
    assert Surfel.from_position([1, 2, 3]) == Surfel.from_points([1, 2, 3])

    surfel.add([1, 2, 3])
    upper = np.triu(scatter)
    np.testing.assert_array_equal(surfel.covariance(), upper + np.triu(upper, 1).T)


def test_what_is_returned_may_be_written_to_and_copies_are_independent():
    points = np.random.default_rng(1).normal(size=(9, 3))
    surfel, expected = Surfel.from_points(points), Surfel.from_points(points)
    points[:] = np.nan
    copies = [surfel.copy(), copy.copy(surfel), copy.deepcopy(surfel)]

    for array in (surfel.sum, surfel.sum_squares, surfel.mean(), surfel.normal()):
        array[:] = np.nan
    surfel.covariance()[:] = np.nan
    assert surfel == expected
    surfel.add([1, 2, 3])
    assert copies == [expected] * 3

    empty = Surfel()
    empty.sum_squares[:] = np.nan
    assert Surfel() == empty


@pytest.mark.parametrize('dtype', [np.float32, np.int16, np.uint8])
def test_points_of_other_types_are_widened(dtype):
    points = np.arange(27, dtype=dtype).reshape(9, 3) ** 2

    assert Surfel.from_points(points) == Surfel.from_points(points.astype(np.float64))
    assert Surfel.from_points(points.tolist()) == Surfel.from_points(points)


@pytest.mark.parametrize('scale', [1e99, 1e50, 1e-50, 1e-150])
def test_very_large_and_very_small_shapes_are_shapes(scale):
    surfel = Surfel.from_points(grid([[2, 2, 1], [-2, 1, 2]]) * scale / 20)

    assert_normal(surfel.normal(), np.array([1, -2, 2]) / 3, 16 * EPS)
    assert surfel.planarity() == pytest.approx(1.0, abs=16 * EPS)


def test_below_what_can_be_squared_points_count_as_equal():
    assert_promises(Surfel.from_points(grid([[2, 2, 1], [-2, 1, 2]]) * 1e-200))


@pytest.mark.parametrize(
    ('points', 'named'),
    [
        ([1.0, 2.0], r'shape \(2,\)'),
        (5.0, r'shape \(\)'),
        (np.zeros((4, 2)), r'shape \(4, 2\)'),
        (np.zeros((2, 2, 3)), r'shape \(2, 2, 3\)'),
        ([], r'shape \(0,\)'),
        ([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]], 'found nan'),
        ([0.0, -np.inf, 0.0], 'found -inf'),
        ([0.0, 2e100, 0.0], r'found 2e\+100'),
        (['a', 'b', 'c'], 'dtype <U1'),
        ([True, False, True], 'dtype bool'),
        ([1j, 0, 0], 'dtype complex128'),
        (None, 'dtype object'),
    ],
)
def test_what_is_no_point_is_refused_and_changes_nothing(points, named):
    surfel = Surfel.from_points(np.eye(3))

    for change in (surfel.add, surfel.remove, Surfel.from_points):
        with pytest.raises(ValueError, match=f'points: {named}'):
            change(points)

    assert surfel == Surfel.from_points(np.eye(3))


@pytest.mark.parametrize(
    ('stats', 'named'),
    [
        (([1.0, 2.0], np.zeros(6), 3), r'sum: shape \(2,\)'),
        ((np.zeros(3), np.zeros((3, 3)), 3), r'sum_squares: shape \(3, 3\)'),
        (([np.nan, 0.0, 0.0], np.zeros(6), 3), 'sum: found nan'),
        ((np.zeros(3), np.full(6, np.inf), 3), 'sum_squares: found inf'),
        ((np.zeros(3), np.zeros(6), -1), 'num_points: -1'),
        ((np.zeros(3), np.zeros(6), 2**53 + 1), 'num_points: 9007199254740993'),
    ],
)
def test_what_are_no_statistics_is_refused(stats, named):
    with pytest.raises(ValueError, match=named):
        Surfel.from_stats(*stats)


@pytest.mark.parametrize(
    ('arguments', 'named'),
    [
        (([1.0, 2.0],), r'position: shape \(2,\)'),
        ((np.zeros((1, 3)),), r'position: shape \(1, 3\)'),
        (([1.0, np.nan, 0.0],), 'position: found nan'),
        ((np.zeros(3), np.zeros(6)), r'scatter: shape \(6,\)'),
        ((np.zeros(3), np.full((3, 3), np.nan)), 'scatter: found nan'),
    ],
)
def test_what_is_no_position_is_refused(arguments, named):
    with pytest.raises(ValueError, match=named):
        Surfel.from_position(*arguments)


def test_a_number_of_points_that_is_no_whole_number_is_refused():
    with pytest.raises(TypeError, match='integer'):
        Surfel.from_stats(np.zeros(3), np.zeros(6), 3.0)


def test_an_array_and_a_surfel_add_up_in_one_order_only():
    with pytest.raises(TypeError, match='unsupported operand'):
        np.zeros(3) + Surfel()
