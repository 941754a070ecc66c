# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Scans reduced to moments, against exact integers of a slow twin; refused and left out points.

All comparisons are of integers and exact. Points lie where quantisation could go wrong: on faces
of voxels, on points of the lattice and the numbers next to them, at -0.0, and far from the origin.
"""

import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from surfel_mapper.errors import MapLimitError
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.mapping.moments import check_arrays
from surfel_mapper.mapping.reducer import Reducer
from test.reference import as_twin, scan_moments

pytestmark = pytest.mark.filterwarnings('error')

SIZES_M = [0.5, 0.2, 0.1, 1.0 / 3.0, 7.0]


def random_pose(rng, spread_m):
    q = rng.normal(size=4)
    return pose_matrix(rng.uniform(-spread_m, spread_m, 3), q / np.linalg.norm(q))


@st.composite
def places(draw):
    """Draw a voxel size and points (N, 3) that lie where rounding matters."""
    size_m = draw(st.sampled_from(SIZES_M))
    lattice = st.integers(-(2**18), 2**18).map(lambda x: x * (size_m / 65536))
    face = st.integers(-3, 3).map(lambda k: k * size_m)
    beside = st.builds(math.nextafter, face, st.sampled_from([-math.inf, math.inf]))
    odd = st.sampled_from([0.0, -0.0, 5e-324, -5e-324, 1e-9, -1e-9, math.nan, math.inf, -math.inf])
    coordinate = lattice | face | beside | odd | st.floats(-3.0, 3.0)
    points = draw(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=8))
    return size_m, np.array(points)


@given(places(), st.booleans())
def test_moments_are_those_of_the_exact_twin(drawn, narrow):
    size_m, points = drawn
    points = points.astype(np.float32) if narrow else points
    origin = [0.3, -2.0, 1.5]

    moments = Reducer(size_m).reduce(points, origin=origin)

    assert as_twin(moments) == scan_moments(points, size_m, origin)
    entered = int(np.isfinite(points).all(axis=1).sum())
    assert moments.num_points == entered
    assert moments.left_out == (
        {'not_finite': len(points) - entered} if entered < len(points) else {}
    )


@pytest.mark.parametrize('dtype', [np.float32, np.float64])
@pytest.mark.parametrize('offset_m', [0.0, 1e4])
@pytest.mark.parametrize('size_m', [0.5, 0.2, 1.0 / 3.0])
def test_points_with_a_pose_are_quantised_in_the_map_frame(dtype, offset_m, size_m):
    rng = np.random.default_rng(7)
    points = rng.uniform(-4.0, 4.0, (1500, 3)).astype(dtype)
    pose = random_pose(rng, 3.0)
    pose[:3, 3] += [offset_m, -offset_m, 0.0]

    moments = Reducer(size_m).reduce(points, pose, origin=pose[:3, 3])

    assert as_twin(moments) == scan_moments(points, size_m, pose[:3, 3], pose)
    x, y, z = points.astype(np.float64).T
    there = np.stack([((r[0] * x + r[1] * y) + r[2] * z) + r[3] for r in pose[:3]], axis=1)
    assert as_twin(Reducer(size_m).reduce(there, origin=pose[:3, 3])) == as_twin(moments)


@pytest.mark.parametrize('num', [0, 1, 1023, 1024, 1025, 2048, 3000])
def test_any_number_of_points_is_reduced_completely(num):
    rng = np.random.default_rng(num)
    points = rng.uniform(-2.0, 2.0, (num, 3))
    points = np.repeat(points, rng.integers(1, 5, num), axis=0)[:num]  # runs in one voxel
    points[rng.random(num) < 0.1] = np.nan
    assert as_twin(Reducer(0.5).reduce(points)) == scan_moments(points, 0.5)


def test_the_order_of_points_does_not_matter():
    rng = np.random.default_rng(1)
    points = rng.normal(scale=2.0, size=(5000, 3)).astype(np.float32)
    reducer = Reducer(0.2)
    expected = as_twin(reducer.reduce(points))
    for _ in range(3):
        assert as_twin(reducer.reduce(rng.permutation(points))) == expected
    assert as_twin(reducer.reduce(points[np.lexsort(points.T)])) == expected


def test_moments_do_not_change_when_the_reducer_goes_on():
    rng = np.random.default_rng(3)
    reducer, points = Reducer(0.5), rng.uniform(-5.0, 5.0, (1000, 3))
    moments = reducer.reduce(points)
    before = as_twin(moments)
    reducer.reduce(rng.uniform(-5.0, 5.0, (1000, 3)))
    assert as_twin(moments) == before


@pytest.mark.parametrize('dtype', [np.int16, np.int64, np.uint8, np.float16, '>f4', '>f8'])
def test_points_of_any_numeric_type_keep_their_value(dtype):
    points = np.arange(30).reshape(10, 3).astype(dtype)
    assert as_twin(Reducer(0.5).reduce(points)) == scan_moments(points.astype(float), 0.5)


def test_points_are_left_out_by_range_both_ends_included():
    points = np.array([[2.0, 0, 0], [0, -3.0, 0], [0, 0, 4.0], [1.999, 0, 0], [0, 4.001, 0]])
    pose = pose_matrix([100.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])

    moments = Reducer(0.5).reduce(points, pose, min_range_m=2.0, max_range_m=4.0)

    assert moments.left_out == {'too_near': 1, 'too_far': 1}
    assert as_twin(moments) == scan_moments(points[:3], 0.5, pose=pose)


def test_every_point_left_out_is_counted_under_one_cause():
    nan, inf = math.nan, math.inf
    points = [
        [nan, 0, 0],
        [0, nan, inf],
        [inf, 0, 0],
        [0, -inf, 0],
        [0.01, 0, 0],
        [0, 0, 0],
        [9.0, 9.0, 9.0],
        [1e30, 0, 0],
        [0, -1e300, 0],
        [1, 1, 1],
    ]
    moments = Reducer(0.5).reduce(points, min_range_m=0.1, max_range_m=10.0)
    assert moments.left_out == {'not_finite': 4, 'too_near': 2, 'too_far': 3}
    assert moments.num_points == 1

    unlimited = Reducer(0.5).reduce(points)
    assert unlimited.left_out == {'not_finite': 4, 'beyond_map': 2}
    assert unlimited.num_points == 4


@pytest.mark.parametrize('huge', [1e6, 1e9, 1e19, 1e30, 1e154, 1e160, 1e300, 1.7e308])
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_huge_coordinates_lie_beyond_the_map(huge, dtype):
    with np.errstate(over='ignore'):
        points = np.array([[huge, 0, 0], [0, -huge, 0], [huge, -huge, huge]]).astype(dtype)
    cause = 'beyond_map' if np.isfinite(points).all() else 'not_finite'
    turned = random_pose(np.random.default_rng(6), 1.0)
    for pose in (None, turned):
        assert Reducer(0.5).reduce(points, pose).left_out == {cause: 3}


@pytest.mark.parametrize('axis', [0, 1, 2])
@pytest.mark.parametrize('size_m', [0.5, 0.2, 1000.0])
def test_the_voxel_indices_end_at_21_bits(axis, size_m):
    end = 2.0**20 * size_m
    inside = [-end, math.nextafter(end, 0.0)]
    # one that is not a power of two is rounded when it is scaled: leave it a lattice unit
    inside[1] -= 0.0 if size_m == 0.5 else size_m / 65536
    beyond = [math.nextafter(-end, -math.inf) - size_m / 65536, end]

    for value in inside:
        point = np.zeros((1, 3))
        point[0, axis] = value
        moments = Reducer(size_m).reduce(point)
        assert moments.left_out == {}
        assert as_twin(moments) == scan_moments(point, size_m)
        assert moments.voxel_index[0, axis] == (-(2**20) if value < 0 else 2**20 - 1)
    for value in beyond:
        point = np.zeros((1, 3))
        point[0, axis] = value
        assert Reducer(size_m).reduce(point).left_out == {'beyond_map': 1}


def test_sums_are_exact_up_to_2_to_the_23_points_and_refused_beyond():
    # the corner of a voxel: every product is 2^30, so their sum is 2^53
    points = np.zeros((2**23 + 1, 3), np.float32, order='F')
    reducer = Reducer(0.5)

    moments = reducer.reduce(points[:-1])

    assert moments.count.tolist() == [2**23]
    assert moments.total.tolist() == [[-(2**38)] * 3]
    assert moments.product.tolist() == [[2**53] * 6]
    with pytest.raises(MapLimitError, match='8388609 points in one voxel of one scan'):
        reducer.reduce(points)
    points[:] = math.nan
    assert reducer.reduce(points).left_out == {'not_finite': len(points)}


@pytest.mark.parametrize('num', [65535, 65536, 65537])
def test_sums_of_many_points_in_one_voxel_do_not_overflow(num):
    points = np.zeros((num, 3), np.float32)
    moments = Reducer(0.5).reduce(points, origin=[9.0, 0.25, 0.25])
    assert moments.total.dtype == (np.int32 if num < 65536 else np.int64)
    assert moments.total.tolist() == [[-num * 2**15] * 3]
    assert moments.product.tolist() == [[num * 2**30] * 6]
    assert as_twin(moments)[0, 0, 0][10:] == [num * 2**14, 0, 0]


def test_a_scan_with_a_full_voxel_is_summed_as_any_other():
    # in 70,000 points of one voxel, some others, in an order that no part of the scan has
    rng = np.random.default_rng(9)
    points = rng.uniform(0.0, 0.5, (71_000, 3))
    points[::71] += rng.integers(0, 3, (1000, 3))
    points[:3], points[5::9000] = [40.0, 0.1, 0.1], np.nan
    intensity = np.arange(71_000) % 256
    origin = np.array([1.0, 2.0, 3.0])

    moments = Reducer(0.5, ('intensity',)).reduce(
        points, origin=origin, columns={'intensity': intensity}
    )

    twin = scan_moments(points, 0.5, origin)
    assert max(row[0] for row in twin.values()) > 65536
    assert as_twin(moments) == twin
    plain = Reducer(0.5).reduce(points[::-1], origin=origin)  # its last part has a voxel more
    check_arrays(plain)  # raises unless every array has a row for each voxel
    assert as_twin(plain) == twin
    assert list(map(tuple, moments.voxel_index.tolist())) == list(twin)
    assert moments.left_out == {'not_finite': 8}
    finite = np.isfinite(points).all(axis=1)
    voxel = np.floor(points[finite] * 2.0)
    for index, total in zip(moments.voxel_index, moments.channels[:, 0], strict=True):
        inside = (voxel == index).all(axis=1)
        assert total == 256 * intensity[finite][inside].sum()


@pytest.mark.parametrize('distance_m', [0.0, 1e-160, 1e-3, 1.0, 1e4, 1e9])
def test_the_view_points_from_the_voxel_centre_to_the_sensor(distance_m):
    centre = np.array([0.25, -0.25, 1.25])
    for direction in ([1, 0, 0], [0, -1, 0], [1, 2, 2], [-3, 4, -12]):
        unit = np.array(direction) / np.linalg.norm(direction)
        origin = centre + distance_m * unit
        view = Reducer(0.5).reduce(centre[None], origin=origin).view[0]
        if (origin == centre).all():
            assert view.tolist() == [0, 0, 0]
        else:
            assert view.tolist() == np.rint(2**14 * unit).tolist()


def test_without_a_sensor_position_there_is_no_view():
    moments = Reducer(0.5).reduce(np.random.default_rng(8).uniform(-2.0, 2.0, (50, 3)))
    assert not moments.view.any()


@pytest.mark.parametrize('shape', [(3,), (2, 2), (2, 4), (1, 2, 3), (0, 2)])
def test_points_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match=r'points: shape .*expected \(N, 3\)'):
        Reducer(0.5).reduce(np.zeros(shape))


@pytest.mark.parametrize('dtype', [bool, complex, object, 'U4'])
def test_points_of_other_types_are_refused(dtype):
    with pytest.raises(ValueError, match='points: dtype'):
        Reducer(0.5).reduce(np.zeros((2, 3)).astype(dtype))


def test_an_invalid_pose_or_origin_is_refused():
    points, reducer = np.zeros((1, 3)), Reducer(0.5)
    for pose in (np.eye(3), np.full((4, 4), np.nan), np.diag([1, 1, np.inf, 1])):
        with pytest.raises(ValueError, match='T_map_sensor'):
            reducer.reduce(points, pose)
    for origin in ([0.0, 1.0], [0.0, math.nan, 0.0], [[0.0, 0.0, 0.0]]):
        with pytest.raises(ValueError, match='origin'):
            reducer.reduce(points, origin=origin)
