# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Surfel as an object: empty ones, operators, copies, types of points, refused input."""

import copy

import numpy as np
import pytest

from surfel_mapper.mapping.surfel import Surfel
from test.mapping.surfel_promises import assert_promises

pytestmark = pytest.mark.filterwarnings('error')


def test_a_new_surfel_holds_nothing():
    surfel = Surfel()

    assert_promises(surfel)
    assert surfel.empty
    np.testing.assert_array_equal(surfel.sum, np.zeros(3))
    np.testing.assert_array_equal(surfel.sum_squares, np.zeros(6))


def test_removing_as_many_points_as_held_or_more_empties():
    points = np.random.default_rng(1).normal(size=(9, 3))
    for removed in (points, np.concatenate([points, points]), Surfel.from_points(points)):
        surfel = Surfel.from_points(points)
        surfel.remove(removed)
        assert surfel == Surfel()
    surfel = Surfel()
    surfel.remove(points[0])
    assert surfel == Surfel()


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


def test_returned_arrays_are_writeable_and_copies_independent():
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


@pytest.mark.parametrize(
    ('points', 'named'),
    [
        ([1.0, 2.0], r'shape \(2,\)'),
        (np.zeros((4, 2)), r'shape \(4, 2\)'),
        (np.zeros((2, 2, 3)), r'shape \(2, 2, 3\)'),
        ([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]], 'found nan'),
        ([0.0, -np.inf, 0.0], 'found -inf'),
        ([0.0, 2e100, 0.0], r'found 2e\+100'),
        (['a', 'b', 'c'], 'dtype <U1'),
        ([True, False, True], 'dtype bool'),
        (None, 'dtype object'),
    ],
)
def test_invalid_points_are_refused_and_change_nothing(points, named):
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
def test_invalid_statistics_are_refused(stats, named):
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
def test_invalid_positions_are_refused(arguments, named):
    with pytest.raises(ValueError, match=named):
        Surfel.from_position(*arguments)


def test_a_number_of_points_that_is_no_whole_number_is_refused():
    with pytest.raises(TypeError, match='expected a whole number'):
        Surfel.from_stats(np.zeros(3), np.zeros(6), 3.0)


def test_an_array_and_a_surfel_add_up_in_one_order_only():
    with pytest.raises(TypeError, match='unsupported operand'):
        np.zeros(3) + Surfel()
