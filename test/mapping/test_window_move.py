# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Moving scans of a window: exact, all or nothing, and exact eviction afterwards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper.config import WindowConfig
from surfel_mapper.errors import MapLimitError
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SlidingWindow, WindowedScan


def shifted(x):
    T = np.eye(4)
    T[0, 3] = x
    return T


def scan_at(surfel_map, points, T, stamp_ns=0):
    moments = surfel_map.reduce(points, T, origin=T[:3, 3])
    return WindowedScan(moments=moments, stamp_ns=stamp_ns, T_map_sensor=T, points=points)


@pytest.fixture
def window():
    rng = np.random.default_rng(4)
    surfel_map = SurfelMap(0.5)
    window = SlidingWindow(surfel_map, WindowConfig(max_scans=3))
    for number in range(3):
        points = rng.uniform(-3.0, 3.0, (500, 3))
        window.insert(scan_at(surfel_map, points, shifted(0.3 * number), number))
    return surfel_map, window


def rebuilt(scans):
    surfel_map = SurfelMap(0.5)
    for scan in scans:
        surfel_map.insert(scan_at(surfel_map, scan.points, scan.T_map_sensor).moments)
    return surfel_map


def moved(surfel_map, window, changes):
    scans = list(window)
    return {
        place: replace(scan_at(surfel_map, scans[place].points, T), stamp_ns=place)
        for place, T in changes.items()
    }


def test_voxels_that_fell_below_are_named_once_and_only_those(window):
    surfel_map, window = window
    before = surfel_map.surfels(3).voxel_index

    fallen = window.move(moved(surfel_map, window, {0: shifted(7.0), 1: shifted(0.1)}), 3)

    after = {tuple(index) for index in surfel_map.surfels(3).voxel_index.tolist()}
    expected = {tuple(index) for index in before.tolist()} - after
    assert len(fallen) == len(expected)
    assert {tuple(index) for index in fallen.tolist()} == expected


def test_nothing_moves_if_one_scan_cannot(window):
    surfel_map, window = window
    before, poses = surfel_map.digest(), [scan.T_map_sensor for scan in window]
    changes = moved(surfel_map, window, {0: shifted(7.0), 1: shifted(9.0)})
    full = changes[1].moments
    count = np.full_like(full.count, 2**31 - 1, dtype=np.int64)
    changes[1] = replace(changes[1], moments=replace(full, count=count * 4))

    with pytest.raises(MapLimitError):
        window.move(changes)

    assert surfel_map.digest() == before
    assert all(scan.T_map_sensor is pose for scan, pose in zip(window, poses, strict=True))


def test_the_way_is_measured_anew(window):
    surfel_map, window = window
    window.config = WindowConfig(max_scans=0, max_distance_m=2.0)

    window.move(moved(surfel_map, window, {1: shifted(1.5), 2: shifted(3.0)}))
    evicted = window.insert(scan_at(surfel_map, np.zeros((1, 3)), shifted(3.0), 3))

    assert [eviction.limit for eviction in evicted] == ['max_distance_m']
    assert surfel_map.digest() == rebuilt(window).digest()


@pytest.mark.parametrize('place', [-1, 3])
def test_a_place_without_a_scan_is_refused(window, place):
    surfel_map, window = window
    before = surfel_map.digest()
    scan = scan_at(surfel_map, np.ones((1, 3)), shifted(9.0))
    with pytest.raises(IndexError, match=f'scan {place} of 3 kept ones'):
        window.move({place: scan})
    assert surfel_map.digest() == before
