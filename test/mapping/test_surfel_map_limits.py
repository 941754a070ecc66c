# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""SurfelMap: its limits; refused calls change nothing."""

import math

import numpy as np
import pytest

from surfel_mapper.errors import MapError, MapLimitError, NotInMapError
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from test.mapping.made_maps import assert_unchanged_by, made_up, map_of, scans_at
from test.reference import as_twin, digest, scan_moments

pytestmark = pytest.mark.filterwarnings('error')


@pytest.mark.parametrize('beyond', [2.0**19, -(2.0**19) - 1e-9, 1e9, -1e30, 1e300])
def test_points_beyond_the_voxel_indices_are_refused(beyond):
    surfel_map = map_of(scans_at(0.0, num=1))
    points = [[0.0, 0.0, 0.0], [0.0, beyond, 0.0]]
    match = r'1 of 2 points lie outside of \[-524288, 524288\) m'
    assert_unchanged_by(surfel_map, MapLimitError, match, surfel_map.add, points)


def test_the_outermost_voxels_can_be_used():
    end = 2.0**19
    points = np.array([[-end, -end, -end], [math.nextafter(end, 0.0)] * 3])
    surfel_map = map_of([(points, [0.0, 0.0, 0.0])])
    assert surfel_map.digest() == digest(scan_moments(points, 0.5, [0.0, 0.0, 0.0]), 0.5)
    surfels = surfel_map.surfels()
    assert sorted(surfels.voxel_index.tolist()) == [[-(2**20)] * 3, [2**20 - 1] * 3]
    assert np.abs(np.sort(surfels.position, axis=0) - points).max() < 0.5 / 65536


def test_removing_what_is_not_held_is_refused():
    scans = scans_at(0.0)
    surfel_map = map_of(scans[:2])
    absent = SurfelMap(0.5).add(scans[2][0], scans[2][1])
    assert_unchanged_by(
        surfel_map, NotInMapError, r'voxel \[.*\] does not hold', surfel_map.remove, absent
    )


def test_removing_twice_is_refused():
    surfel_map = SurfelMap(0.5)
    first, second = scans_at(0.0, num=2)
    moments = surfel_map.add(*first)
    surfel_map.add(second[0] + 2.0, second[1])  # shares many voxels, not all
    surfel_map.remove(moments)
    assert_unchanged_by(surfel_map, NotInMapError, 'only removed once', surfel_map.remove, moments)


def test_removing_the_same_number_of_other_points_is_refused():
    held, other = np.full((4, 3), 0.1), np.full((4, 3), 0.1)
    other[2, 1] = 0.2
    surfel_map = map_of([(held, [5.0, 0.0, 0.0])])
    empty = SurfelMap(0.5)
    for points, origin in [(other, [5.0, 0.0, 0.0]), (held, [0.0, 5.0, 0.0]), (held, None)]:
        moments = empty.reduce(points, origin=origin)
        assert_unchanged_by(surfel_map, NotInMapError, 'not hold', surfel_map.remove, moments)


@pytest.mark.parametrize('operation', ['insert', 'remove', 'merge'])
def test_moments_for_another_voxel_size_or_level_are_refused(operation):
    scans = scans_at(0.0, num=1)
    surfel_map = map_of(scans)
    for other in (map_of(scans, 0.25), SurfelMap(0.5, level=1)):
        argument = other if operation == 'merge' else other.moments()
        assert_unchanged_by(
            surfel_map,
            MapError,
            f'{other.voxel_size_m:g} m, level {other.level}; this map has 0.5 m, level 0',
            getattr(surfel_map, operation),
            argument,
        )


@pytest.mark.parametrize('size_m', [0.0, -0.5, math.nan, math.inf])
def test_an_invalid_voxel_size_is_refused(size_m):
    with pytest.raises(ValueError, match='voxel_size_m'):
        SurfelMap(size_m)


def test_a_voxel_holds_up_to_2_to_the_31_points():
    corners = [(-32768, -32768, -32768), (32767, 32767, -32768)]
    voxels = [(0, 0, 0), (7, -7, 7)]
    surfel_map = SurfelMap(0.5)
    surfel_map.insert(made_up(voxels, [2**31 - 2, 10], corners))
    assert_unchanged_by(
        surfel_map,
        MapLimitError,
        'a voxel would hold 2147483650 points; at most 2147483648',
        surfel_map.insert,
        made_up(voxels, [4, 4]),
    )
    last = made_up(voxels[:1], [2], corners)
    surfel_map.insert(last)
    assert as_twin(surfel_map.moments())[0, 0, 0][4] == 2**30 * (2**30 + 32767**2)
    assert_unchanged_by(
        surfel_map, MapLimitError, 'at most', surfel_map.insert, made_up(voxels[:1], [1])
    )
    surfel_map.insert(made_up(voxels[1:], [2**31 - 10]))  # another voxel still has room

    surfels = surfel_map.surfels()
    row = int(np.flatnonzero((surfels.voxel_index == 0).all(axis=1))[0])
    # half of the points at either end of a diagonal: variance half of its length squared / 2
    variance = 2.0 * (65535 / 2 * 0.5 / 65536) ** 2
    np.testing.assert_allclose(surfels.eigenvalues[row], [0, 0, variance], rtol=1e-9, atol=1e-15)
    assert surfels.num_points[row] == 2**31


def test_a_coarser_map_holds_a_quarter_of_that_with_each_level():
    surfel_map = SurfelMap(0.5, level=2)
    moments = made_up([(1, 2, 3)], [2**27])
    coarse = ScanMoments(
        voxel_size_m=0.5,
        level=2,
        **dict(zip(('key', 'count', 'total', 'product', 'view'), moments.arrays, strict=True)),
    )
    surfel_map.insert(coarse)
    assert_unchanged_by(
        surfel_map, MapLimitError, 'at most 134217728', surfel_map.merge, surfel_map
    )
