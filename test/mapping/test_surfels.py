# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfels of a map: means, eigenvalues, normals and shapes, by definition and at the edges.

Expected values come from exact rational scatters of the quantised points, decomposed by
numpy.linalg.eigh. Tolerances: both solvers are right to some 1e-15 e2, so eigenvalues are compared
to 1e-12 e2 and normals to 1e-6 rad where the two smallest are apart by 1e-4 e2.
"""

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from surfel_mapper.mapping.surfel_map import SurfelMap
from test.reference import as_twin, surfel

pytestmark = pytest.mark.filterwarnings('error')

UNIT_M = 1.0 / 65536


def map_of(points, origin=None, voxel_size_m=1.0):
    surfel_map = SurfelMap(voxel_size_m)
    surfel_map.add(points, origin)
    return surfel_map


def on_lattice(*places):
    """Return points in the middle of cells of the lattice of 1 m voxels, (N, 3)."""
    return (np.array(places, np.float64).reshape(-1, 3) + 0.5) * UNIT_M


def one_surfel(points, origin=None, voxel_size_m=1.0):
    """Return the row of the only surfel of some points, as a dict."""
    surfels = map_of(points, origin, voxel_size_m).surfels()
    assert len(surfels) == 1
    names = ('position', 'normal', 'planarity', 'curvature', 'eigenvalues', 'num_points')
    return {name: getattr(surfels, name)[0] for name in names}


def assert_as_twin(surfel_map):
    """Compare every surfel of a map with its twin, made from the exact moments."""
    twins = as_twin(surfel_map.moments())
    surfels = surfel_map.surfels()
    assert len(surfels) == len(twins)
    for row, voxel in enumerate(map(tuple, surfels.voxel_index.tolist())):
        twin = surfel(voxel, twins[voxel], surfel_map.voxel_size_m)
        e0, e1, e2 = twin['eigenvalues']
        size = abs(twin['position']).max() + surfel_map.voxel_size_m
        assert surfels.num_points[row] == twin['num_points']
        assert abs(surfels.position[row] - twin['position']).max() <= 4e-16 * size
        assert abs(surfels.eigenvalues[row] - twin['eigenvalues']).max() <= 1e-12 * e2
        assert (np.diff(surfels.eigenvalues[row], prepend=0.0) >= 0.0).all()
        if e2 == 0.0:
            shape = [*surfels.normal[row], surfels.planarity[row], surfels.curvature[row]]
            assert np.isnan(shape).all()
            continue
        trace = e0 + e1 + e2
        assert abs(surfels.planarity[row] - 2.0 * (e1 - e0) / trace) <= 1e-12
        assert abs(surfels.curvature[row] - e0 / trace) <= 1e-12
        assert 0.0 <= surfels.planarity[row] <= 1.0
        assert 0.0 <= surfels.curvature[row] <= (1.0 + 1e-15) / 3.0
        assert abs(np.linalg.norm(surfels.normal[row]) - 1.0) <= 1e-15
        if e1 - e0 > 1e-4 * e2:
            signed = surfels.normal[row]
            if twin['towards'] < 1e-6:  # seen from the side: either sign is as good
                signed = signed * np.sign(signed @ twin['normal'])
            assert np.linalg.norm(signed - twin['normal']) <= 1e-6


@pytest.mark.parametrize('voxel_size_m', [0.5, 0.2, 1.0 / 3.0])
@pytest.mark.parametrize('offset_m', [0.0, 1e4])
@pytest.mark.parametrize('shape', ['plane', 'ball', 'line', 'few', 'patch'])
def test_surfels_are_those_of_the_exact_twin(voxel_size_m, offset_m, shape):
    rng = np.random.default_rng(31)
    scale, num = {
        'plane': ([2.0, 2.0, 1e-3], 3000),
        'ball': ([0.6, 0.6, 0.6], 2000),
        'line': ([4.0, 1e-3, 1e-4], 500),
        'few': ([1.5, 1.5, 1.5], 60),
        'patch': ([1e-3, 1e-4, 1e-5], 2000),  # some lattice units wide
    }[shape]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = rng.normal(scale=scale, size=(num, 3)) @ turn + offset_m
    surfel_map = SurfelMap(voxel_size_m)
    surfel_map.add(points[::2], turn[2] * 7.0 + offset_m)
    surfel_map.add(points[1::2], turn[2] * 9.0 - turn[1] + offset_m)
    assert_as_twin(surfel_map)


PLACE = st.integers(0, 65535)


@given(st.lists(st.tuples(PLACE, PLACE, PLACE), min_size=1, max_size=6), st.integers(1, 200))
def test_any_points_repeated_any_number_of_times_are_as_the_twin_says(places, times):
    assert_as_twin(map_of(np.repeat(on_lattice(*places), times, axis=0), [3.0, 2.0, 1.0]))


@given(st.tuples(PLACE, PLACE, PLACE), st.integers(1, 3000))
def test_equal_points_have_a_place_and_no_shape(place, times):
    row = one_surfel(np.repeat(on_lattice(place), times, axis=0), origin=[0.0, 0.0, 9.0])
    assert abs(row['position'] - on_lattice(place)).max() <= 1e-15
    assert row['eigenvalues'].tolist() == [0.0, 0.0, 0.0]
    assert np.isnan([*row['normal'], row['planarity'], row['curvature']]).all()


@given(st.tuples(PLACE, PLACE, PLACE), st.tuples(PLACE, PLACE, PLACE), st.integers(1, 60))
def test_two_places_have_planarity_0_and_a_normal_across_the_line(a, b, times):
    if a == b:
        return
    row = one_surfel(np.repeat(on_lattice(a, b), times, axis=0))
    line = np.subtract(b, a) / np.linalg.norm(np.subtract(b, a))
    assert row['planarity'] == 0.0
    assert row['curvature'] == 0.0
    assert row['eigenvalues'][:2].tolist() == [0.0, 0.0]
    assert abs(np.linalg.norm(row['normal']) - 1.0) <= 1e-15
    assert abs(row['normal'] @ line) <= 1e-14


@given(
    st.tuples(*[st.integers(-1300, 1300)] * 3).filter(any),
    st.sets(st.integers(-12, 12), min_size=3),
)
def test_points_on_a_line_have_planarity_0(step, multiples):
    middle = np.array([32768, 32768, 32768])
    row = one_surfel(on_lattice(*[middle + k * np.array(step) for k in multiples]))
    assert row['planarity'] == 0.0
    assert row['curvature'] == 0.0
    assert abs(row['normal'] @ step) <= 1e-14 * np.linalg.norm(step)


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_a_square_across_an_axis_is_a_perfect_plane(axis):
    square = np.array([[a, b, 0.5] for a in (0.25, 0.5, 0.75) for b in (0.25, 0.5, 0.75)])
    row = one_surfel(np.roll(square, axis + 1, axis=1))
    expected = np.zeros(3)
    expected[axis] = 1.0
    assert row['normal'].tolist() == expected.tolist()
    assert row['planarity'] == 1.0
    assert row['curvature'] == 0.0
    # nine points, six of them 0.25 m off along each axis: 6 / 8 of 1/16
    np.testing.assert_allclose(row['eigenvalues'], [0.0, 6 / 128, 6 / 128], rtol=1e-15)
    assert abs(row['position'] - 0.5).max() <= UNIT_M


@pytest.mark.parametrize('side', [1.0, -1.0])
@pytest.mark.parametrize('seed', range(10))
def test_normals_are_turned_to_the_side_they_are_seen_from(side, seed):
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = rng.uniform(-0.2, 0.2, (50, 3)) * [1, 1, 0.05] @ turn + 0.5
    normal = one_surfel(points, origin=0.5 + side * 5.0 * turn[2] + turn[0])['normal']
    assert normal @ (side * turn[2]) > 0.99


def test_the_majority_of_points_determines_the_view():
    flat = np.random.default_rng(1).uniform([0.1, 0.1, 0.49], [0.9, 0.9, 0.51], (90, 3))
    surfel_map = map_of(flat[:60], [0.5, 0.5, 9.0])
    below = surfel_map.add(flat[60:], [0.5, 0.5, -9.0])
    assert surfel_map.surfels().normal[0, 2] > 0.99
    more = surfel_map.add(flat[:31], [0.5, 0.5, -9.0])
    assert surfel_map.surfels().normal[0, 2] < -0.99
    surfel_map.remove(more)
    assert surfel_map.surfels().normal[0, 2] > 0.99
    surfel_map.remove(below)
    assert surfel_map.surfels().normal[0, 2] > 0.99


@pytest.mark.parametrize('seed', range(10))
def test_without_a_sensor_the_largest_component_of_a_normal_is_positive(seed):
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points = rng.uniform(-0.2, 0.2, (40, 3)) * [1, 1, 0.05] @ turn + 0.5
    for seen in (None, [0.5, 0.5, 0.5]):  # at the centre there is no direction either
        normal = one_surfel(points, origin=seen)['normal']
        assert normal[np.argmax(abs(normal))] > 0.0


def test_the_first_of_equally_large_components_is_positive():
    # the plane x + y = 1: its normal is +-(1, 1, 0); the plane x = y: +-(1, -1, 0)
    middle = [0.25, 0.5, 0.75]
    falling = one_surfel([[a, 1.0 - a, c] for a in middle for c in middle])['normal']
    rising = one_surfel([[a, a, c] for a in middle for c in middle])['normal']
    assert falling == pytest.approx([0.5**0.5, 0.5**0.5, 0.0], abs=1e-12)
    assert abs(rising) == pytest.approx([0.5**0.5, 0.5**0.5, 0.0], abs=1e-12)
    assert rising[np.argmax(abs(rising))] > 0.0  # argmax: the first of equals


def test_a_plane_seen_exactly_from_the_side_has_the_sign_of_no_sensor():
    square = np.array([[a, b, 0.5] for a in (0.25, 0.5, 0.75) for b in (0.25, 0.5, 0.75)])
    assert one_surfel(square, origin=[9.0, 0.5, 0.5])['normal'].tolist() == [0.0, 0.0, 1.0]


def test_a_surfel_lies_in_its_voxel():
    points = np.random.default_rng(3).uniform(-3.0, 3.0, (500, 3))
    surfels = map_of(points, voxel_size_m=0.25).surfels()
    assert (np.floor(surfels.position / 0.25) == surfels.voxel_index).all()
    assert surfels.voxel_index.dtype == np.int32
    assert surfels.num_points.dtype == np.int64


def test_an_empty_map_has_no_surfels():
    surfels = SurfelMap(0.5).surfels()
    assert len(surfels) == 0
    assert surfels.position.shape == (0, 3)
