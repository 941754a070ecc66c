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

from surfel_mapper.mapping.moments import pack_keys
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


def test_a_merge_is_the_map_of_the_union_in_any_order():
    scans = scans_at(1e4)
    expected = map_of(scans).digest()
    parts = [map_of(scans[:1]), map_of(scans[1:4]), map_of([]), map_of(scans[4:])]
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]):
        whole = SurfelMap(0.5)
        for number in order:
            whole.merge(parts[number])
        assert whole.digest() == expected
    assert parts[1].digest() == map_of(scans[1:4]).digest()  # the merged map is unchanged


def test_many_voxels_come_and_go_as_in_a_dict():
    rng = np.random.default_rng(11)
    surfel_map, expected, live = SurfelMap(0.5), {}, []
    most = 0
    for step in range(40):
        if step < 20 or (step % 2 and live):
            points = rng.uniform([-30.0, 9970.0, -30.0], [30.0, 10030.0, 30.0], (12_000, 3))
            live.append(surfel_map.add(points))
            for voxel, count in zip(live[-1].key.tolist(), live[-1].count.tolist(), strict=True):
                expected[voxel] = expected.get(voxel, 0) + count
        else:
            moments = live.pop(rng.integers(len(live)))
            gone = surfel_map.remove(moments)
            emptied = set()
            for voxel, count in zip(moments.key.tolist(), moments.count.tolist(), strict=True):
                expected[voxel] -= count
                if expected[voxel] == 0:
                    del expected[voxel]
                    emptied.add(voxel)
            assert set(pack_keys(gone).tolist()) == emptied
        most = max(most, len(expected))
        assert surfel_map.num_voxels == len(expected)
    assert most > 1e5

    held = surfel_map.moments()
    assert dict(zip(held.key.tolist(), held.count.tolist(), strict=True)) == expected
    alone = SurfelMap(0.5)
    for moments in live[::-1]:
        alone.insert(moments)
    assert surfel_map.digest() == alone.digest()


def test_rows_of_voxels_that_left_are_used_again():
    rng = np.random.default_rng(12)
    surfel_map, live = SurfelMap(0.5), []
    for step in range(60):
        points = rng.uniform([20.0 * step, 0.0, 0.0], [20.0 * step + 18.0, 18.0, 18.0], (3000, 3))
        live.append(surfel_map.add(points))
        if step == 4:
            settled = surfel_map.nbytes
        if step >= 4:
            surfel_map.remove(live.pop(0))
    # rows and segments: a fifth more than at step 4 for the chance in counts of voxels
    assert surfel_map.nbytes < 1.2 * settled


def test_a_cleared_map_is_as_a_new_one_but_for_its_version():
    surfel_map = map_of(scans_at(0.0))
    before = surfel_map.version
    surfel_map.clear()
    assert surfel_map.version > before
    assert surfel_map.digest() == SurfelMap(0.5).digest()
    assert surfel_map.nbytes == SurfelMap(0.5).nbytes
    for since in (None, 0, before, surfel_map.version):
        assert len(surfel_map.surfels_changed(since=since)) == 0
    surfel_map.add([[1.0, 1.0, 1.0]])
    assert surfel_map.surfels_changed(since=before).voxel_index.tolist() == [[2, 2, 2]]
    assert surfel_map.digest() == map_of([([[1.0, 1.0, 1.0]], None)]).digest()


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
