# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SlidingWindow: exact limits, and a map that equals the sum of the remaining scans.

The expected scans are found by brute force: the longest end of the sequence that is within all
limits.
"""

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from surfel_mapper.config import WindowConfig
from surfel_mapper.errors import MapLimitError
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SlidingWindow, WindowedScan
from test import reference

pytestmark = pytest.mark.filterwarnings('error')

S = 10**9


def window_with(limits, **settings):
    """Return an empty window with some limits, and its map."""
    surfel_map = SurfelMap(0.5)
    settings = {'max_scans': 0, **limits, **settings}
    max_voxels = settings.pop('max_voxels', 0)
    return SlidingWindow(surfel_map, WindowConfig(**settings), max_voxels=max_voxels), surfel_map


def scan_at(surfel_map, number, stamp_s, position, keep_points=False):
    """Return a scan of some random points near a position."""
    rng = np.random.default_rng(number)
    points = rng.normal(size=(rng.integers(1, 30), 3)).astype(np.float32)
    pose = np.eye(4)
    pose[:3, 3] = position
    return WindowedScan(
        moments=surfel_map.reduce(points, pose, origin=pose[:3, 3]),
        stamp_ns=round(stamp_s * S),
        T_map_sensor=pose,
        points=points if keep_points else None,
    )


def drive(num, seed):
    """Return stamps in s and positions of a drive, some of its steps at a standstill."""
    rng = np.random.default_rng(seed)
    stamps = np.cumsum(rng.uniform(0.05, 0.2, num)).round(6)
    positions = np.cumsum(rng.normal(size=(num, 3)) * rng.integers(0, 2, (num, 1)), axis=0)
    return list(zip(stamps.tolist(), positions.tolist(), strict=True))


def check_drive(limits, num=25, seed=0, keep_points=False):
    """Drive a window and the brute force side by side; return all evictions."""
    window, surfel_map = window_with(limits, keep_points=keep_points)
    scans, seen, evictions = [], [], []
    for number, (stamp_s, position) in enumerate(drive(num, seed)):
        scan = scan_at(surfel_map, number, stamp_s, position, keep_points)
        voxels = set(map(tuple, scan.moments.voxel_index.tolist()))
        scans.append(scan)
        seen.append((stamp_s, position, scan.nbytes, voxels))
        evictions += window.insert(scan)

        live = [scans[i] for i in reference.window(seen, limits)]
        assert [scan.stamp_ns for scan in window] == [scan.stamp_ns for scan in live]
        assert len(window) == len(live)
        assert window.newest is scan
        assert window.nbytes == sum(scan.nbytes for scan in live)
        alone = SurfelMap(0.5)
        for scan in live:
            alone.insert(scan.moments)
        assert surfel_map.digest() == alone.digest()
    gone = [eviction.scan.stamp_ns for eviction in evictions]
    assert gone == [scan.stamp_ns for scan in scans[: len(scans) - len(window)]]
    return evictions


LIMITS = {
    'max_scans': [1, 2, 7],
    'max_age_s': [0.001, 0.3, 1.0],
    'max_distance_m': [0.001, 2.0, 7.0],
    'max_bytes': [1, 5000, 12_000],
    'max_voxels': [1, 60, 150],
}


@pytest.mark.parametrize('name', list(LIMITS))
@pytest.mark.parametrize('keep_points', [False, True])
def test_each_limit_is_honoured_to_the_scan(name, keep_points):
    for value in LIMITS[name]:
        evictions = check_drive({name: value}, keep_points=keep_points)
        assert evictions
        assert {eviction.limit for eviction in evictions} == {name}


@settings(max_examples=40)
@given(
    st.fixed_dictionaries({}, optional={k: st.sampled_from(v) for k, v in LIMITS.items()}).filter(
        bool
    ),
    st.integers(0, 1000),
)
def test_the_first_limit_reached_evicts(limits, seed):
    evictions = check_drive(limits, num=12, seed=seed)
    assert {eviction.limit for eviction in evictions} <= set(limits)


def test_scans_exactly_at_a_limit_stay():
    window, surfel_map = window_with({'max_age_s': 0.3, 'max_distance_m': 3.0})
    for number in range(8):
        window.insert(scan_at(surfel_map, number, 0.1 * number, [number, 0, 0]))
        assert len(window) == min(number + 1, 4)


def test_distance_is_measured_along_the_way():
    window, surfel_map = window_with({'max_distance_m': 2.5})
    for number in range(10):  # to and fro: never more than 1 m away
        window.insert(scan_at(surfel_map, number, number, [number % 2, 0, 0]))
    assert len(window) == 3


def test_sensors_apart_travel_as_far_as_each_alone():
    window, surfel_map = window_with({'max_distance_m': 2.5})
    for number in range(10):  # 1 m a turn, the rear sensor 2.1 m behind
        for place, frame_id in ((number, 'front'), (number - 2.1, 'rear')):
            scan = scan_at(surfel_map, number, number, [place, 0, 0])
            window.insert(replace(scan, frame_id=frame_id))
    assert [scan.stamp_ns // S for scan in window] == [7, 7, 8, 8, 9, 9]


def test_sensors_apart_at_a_standstill_travel_nothing():
    window, surfel_map = window_with({'max_distance_m': 0.001})
    for number in range(30):
        place, frame_id = ((0, 'front'), (-2.1, 'rear'))[number % 2]
        scan = scan_at(surfel_map, number, number, [place, 0, 0])
        window.insert(replace(scan, frame_id=frame_id))
    assert len(window) == 30


def test_the_last_pose_of_a_frame_outlives_its_scan():
    window, surfel_map = window_with({'max_scans': 1})
    rear = replace(scan_at(surfel_map, 0, 0, [-2.1, 0, 0]), frame_id='rear')
    front = replace(scan_at(surfel_map, 1, 1, [0, 0, 0]), frame_id='front')
    window.insert(rear)
    window.insert(front)

    assert list(window) == [front]
    assert window.last_pose('rear') is rear.T_map_sensor
    assert window.last_pose('front') is front.T_map_sensor
    assert window.last_pose('roof') is None
    window.clear()
    assert window.last_pose('front') is None


def test_without_limits_every_scan_stays_in_the_map():
    window, surfel_map = window_with({})
    alone = SurfelMap(0.5)
    for number in range(30):
        scan = scan_at(surfel_map, number, number, [number, 0, 0])
        assert window.insert(scan) == []
        alone.insert(scan.moments)
        assert surfel_map.digest() == alone.digest()
        assert len(window) == number + 1
        assert window.newest is scan
        assert window.nbytes == scan.nbytes  # the others are not kept: they never leave


def test_without_limits_scans_are_kept_for_their_points():
    window, surfel_map = window_with({}, keep_points=True)
    scans = [scan_at(surfel_map, n, n, [n, 0, 0], keep_points=True) for n in range(5)]
    for scan in scans:
        window.insert(scan)
    assert list(window) == scans
    assert window.nbytes == sum(scan.moments.nbytes + scan.points.nbytes for scan in scans)


@pytest.mark.parametrize('min_points', [1, 2, 4])
def test_an_eviction_names_the_voxels_that_fell_below_min_points(min_points):
    window, surfel_map = window_with({'max_scans': 4})
    held, live, fallen = {}, [], 0
    for number in range(20):
        scan = scan_at(surfel_map, number, number, [0.05 * number, 0, 0])
        twin = reference.as_twin(scan.moments)
        reference.add_moments(held, twin)
        live.append(twin)
        before = {voxel for voxel, row in held.items() if row[0] >= min_points}
        for eviction in window.insert(scan, min_points):
            reference.add_moments(held, live.pop(0), -1)
            after = {voxel for voxel, row in held.items() if row[0] >= min_points}
            named = list(map(tuple, eviction.fallen.tolist()))
            assert len(named) == len(set(named))
            assert set(named) == before - after
            before = after
            fallen += len(named)
    assert fallen > 0


def test_a_scan_that_the_map_refuses_changes_nothing():
    window, surfel_map = window_with({'max_scans': 2})
    for number in range(3):
        window.insert(scan_at(surfel_map, number, number, [number, 0, 0]))
    good = scan_at(surfel_map, 9, 9.0, [50.0, 0, 0])
    too_many = good.moments.count.astype(np.int64) + 2**31
    bad = replace(good, moments=replace(good.moments, count=too_many))
    before, stamps, nbytes = surfel_map.digest(), [s.stamp_ns for s in window], window.nbytes

    with pytest.raises(MapLimitError):
        window.insert(bad)

    assert surfel_map.digest() == before
    assert [scan.stamp_ns for scan in window] == stamps
    assert window.nbytes == nbytes


def test_new_limits_hold_from_the_next_scan_on():
    window, surfel_map = window_with({'max_scans': 10})
    for number in range(10):
        window.insert(scan_at(surfel_map, number, number, [number, 0, 0]))
    window.config = WindowConfig(max_scans=3)
    assert len(window) == 10
    assert len(window.insert(scan_at(surfel_map, 10, 10, [10, 0, 0]))) == 8
    window.config = WindowConfig(max_scans=5)
    for number in range(11, 15):
        window.insert(scan_at(surfel_map, number, number, [number, 0, 0]))
    assert len(window) == 5
    window.max_voxels = 1
    window.insert(scan_at(surfel_map, 15, 15, [15, 0, 0]))
    assert len(window) == 1


# Clearing


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.booleans())
def test_voxels_that_are_dropped_leave_the_map_and_the_scans(seed, keep_points):
    rng = np.random.default_rng(seed)
    window, surfel_map = window_with({'max_scans': 4}, keep_points=keep_points)
    for number in range(6):
        window.insert(scan_at(surfel_map, number, number, rng.normal(size=3), keep_points))
    held = surfel_map.moments()
    chosen = held.voxel_index[rng.random(len(held)) < 0.4]
    counts = dict(zip(map(tuple, held.voxel_index.tolist()), held.count.tolist(), strict=True))

    fallen = window.drop_voxels(np.concatenate([chosen, [[900, 0, 0]], chosen[:1]]), 3)

    gone = {tuple(index) for index in chosen.tolist()}
    assert {tuple(index) for index in fallen.tolist()} == {v for v in gone if counts[v] >= 3}
    left = {tuple(index) for index in surfel_map.moments().voxel_index.tolist()}
    assert left == set(counts) - gone
    assert window.nbytes == sum(scan.nbytes for scan in window)
    alone = SurfelMap(0.5)
    for scan in window:
        alone.insert(scan.moments)
        if keep_points:
            pose = scan.T_map_sensor
            again = surfel_map.reduce(scan.points, pose, origin=pose[:3, 3])
            assert sorted(again.key) == sorted(scan.moments.key)
            assert again.num_points == scan.moments.num_points
    assert surfel_map.digest() == alone.digest()
    for number in range(6, 10):
        window.insert(scan_at(surfel_map, number, number, (50.0, 0.0, 0.0), keep_points))
    assert len(surfel_map.moments(chosen)) == 0
    assert surfel_map.moments().voxel_index[:, 0].min() > 80


def test_voxels_of_settled_scans_are_dropped_too():
    window, surfel_map = window_with({})
    for number in range(3):
        window.insert(scan_at(surfel_map, number, number, (0.0, 0.0, 0.0)))
    window.drop_voxels(surfel_map.moments().voxel_index)
    assert surfel_map.num_voxels == 0
    assert len(window) == 3
    assert window.newest.moments.num_points == 0


@pytest.mark.parametrize(
    ('changes', 'error', 'message'),
    [
        ({'T_map_sensor': None}, ValueError, r'T_map_sensor: shape \(\), expected \(4, 4\)'),
        ({'T_map_sensor': np.eye(3)}, ValueError, r'T_map_sensor: shape \(3, 3\)'),
        ({'stamp_ns': None}, ValueError, 'stamp_ns: None, expected whole nanoseconds'),
        ({'moments': None}, TypeError, 'moments: a NoneType, expected a ScanMoments'),
    ],
)
def test_a_scan_that_a_window_cannot_hold_is_refused_before_the_map_has_it(
    changes, error, message
):
    scan = scan_at(SurfelMap(0.5), 0, 0.0, (0, 0, 0))
    with pytest.raises(error, match=message):
        replace(scan, **changes)
