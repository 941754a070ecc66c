# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SurfelMap: adding, removing and merging whole scans, many voxels, and what changed.

Random sequences of these are in test_surfel_map_sequences.py, limits and refusals in
test_surfel_map_limits.py. Maps are compared with the exact integers of a slow twin, and with each
other by digest; there are no tolerances.
"""

import numpy as np
import pytest

from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SlidingWindow
from test.mapping.made_maps import map_of, scans_at
from test.reference import add_moments, as_twin, digest, scan_moments

pytestmark = pytest.mark.filterwarnings('error')


@pytest.mark.parametrize('offset_m', [0.0, 1e4, -2.5e5])
def test_a_map_holds_the_sum_of_its_scans(offset_m):
    surfel_map, expected = SurfelMap(0.5), {}
    for points, origin in scans_at(offset_m):
        surfel_map.add(points, origin)
        add_moments(expected, scan_moments(points, 0.5, origin))

    assert as_twin(surfel_map.moments()) == expected
    assert surfel_map.digest() == digest(expected, 0.5)
    assert len(surfel_map) == surfel_map.num_voxels == len(expected)
    assert surfel_map.num_points == sum(row[0] for row in expected.values())


def test_removing_a_scan_leaves_no_trace():
    *stay, leaves = scans_at(1e4)
    surfel_map = SurfelMap(0.5)
    moments = surfel_map.add(*leaves)
    for points, origin in stay:
        surfel_map.add(points, origin)

    surfel_map.remove(moments)

    assert surfel_map.digest() == map_of(stay).digest()
    assert surfel_map.num_points == 5 * 400


def test_the_digest_tells_maps_apart():
    points, origin = scans_at(0.0, num=1)[0]
    voxel, unit = np.array([0.5, 0.0, 0.0]), np.array([0.5 / 65536, 0.0, 0.0])
    digests = {
        SurfelMap(0.5).digest(),
        SurfelMap(0.2).digest(),
        SurfelMap(0.5, level=1).digest(),
        map_of([(points, origin)]).digest(),
        map_of([(points, None)]).digest(),
        map_of([(points, -origin)]).digest(),
        map_of([(points, origin)], 0.2).digest(),
        map_of([(points[1:], origin)]).digest(),
        map_of([(points + voxel, origin)]).digest(),
        map_of([(points + unit, origin)]).digest(),
        map_of([(points, origin)] * 2).digest(),
    }
    assert len(digests) == 11


def test_the_digest_depends_on_neither_order_nor_batches():
    scans = scans_at(1e4)
    expected = map_of(scans).digest()
    assert map_of(scans[::-1]).digest() == expected
    in_batches = [(part, o) for points, o in scans for part in np.array_split(points[::-1], 7)]
    assert map_of(in_batches).digest() == expected


def test_returned_surfels_do_not_change_with_the_map():
    scans = scans_at(0.0)
    surfel_map = map_of(scans[:3])
    surfels, moments = surfel_map.surfels(), surfel_map.moments()
    position, total = surfels.position.copy(), moments.total.copy()
    for points, origin in scans[3:]:
        surfel_map.add(points, origin)
    assert (surfels.position == position).all()
    assert (moments.total == total).all()


@pytest.mark.parametrize('far', [2**21, -(2**21), 2**30])
def test_voxels_beyond_the_range_of_indices_are_not_in_the_map(far):
    surfel_map = SurfelMap(0.5)
    surfel_map.add([[0.1, 0.6, 0.1]])
    for index in ([0, 0, far], [far, 1, 0]):
        assert len(surfel_map.moments(np.array([index]))) == 0
    assert len(surfel_map.moments(np.array([[0, 1, 0], [2**64 - 1, 1, 0]], np.uint64))) == 1
    window = SlidingWindow(surfel_map)
    assert len(window.drop_voxels(np.array([[0, 0, far]]))) == 0
    assert surfel_map.num_voxels == 1


def test_rows_that_were_never_used_are_refused():
    surfel_map = SurfelMap(0.5)
    surfel_map.add([[0.1, 0.6, 0.1]])
    with pytest.raises(IndexError, match='rows 500 to 500, expected 0 to 0'):
        surfel_map.surfels_of(np.array([500]))
