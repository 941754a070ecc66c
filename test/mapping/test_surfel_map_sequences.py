# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SurfelMap under random sequences of adding, removing and merging, and under very long ones.

A machine of hypothesis works on a map and on the exact integers of a slow twin side by side: after
every step their digests are equal, and the voxels said to have changed are those touched.
"""

import math

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    initialize,
    invariant,
    precondition,
    rule,
    RuleBasedStateMachine,
)
import numpy as np
import pytest

from surfel_mapper.errors import NotInMapError
from surfel_mapper.mapping import moment_map as module
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import ARRAYS
from test.reference import add_moments, as_twin, digest, scan_moments

FRACTION = (
    st.integers(-(2**17), 2**17).map(lambda x: x / 65536)  # a point of the lattice
    | st.sampled_from([-1.0, 0.0, -0.0, 1.0])  # a face
    | st.sampled_from([-1.0, 0.0, 1.0]).map(lambda x: math.nextafter(x, -math.inf))
    | st.floats(-2.0, 2.0)
)
POINTS = st.lists(st.tuples(FRACTION, FRACTION, FRACTION), min_size=0, max_size=10)
ORIGIN = st.none() | st.tuples(*[st.floats(-50.0, 50.0)] * 3)


def in_order(surfels):
    """Return the bits of surfels, sorted by voxel, without the numbers of scans."""
    surfels = surfels.select(np.lexsort(surfels.voxel_index.T))
    return [getattr(surfels, name).tobytes() for name in ARRAYS if name != 'num_scans']


class MapBesideTwin(RuleBasedStateMachine):
    """A map and its twin; ``live`` holds the scans in both, ``touched`` the voxels by version."""

    @initialize(
        size_m=st.sampled_from([0.5, 0.2, 1.0 / 3.0]),
        offset_m=st.sampled_from([0.0, 1e4, -1e5]),
        logged=st.sampled_from([0, 3, 10, 2**18]),
    )
    def make(self, size_m, offset_m, logged):
        self.saved, module.LEAST = module.LEAST, logged
        self.map, self.twin = SurfelMap(size_m), {}
        self.size_m, self.offset_m = size_m, offset_m
        self.live, self.gone, self.touched, self.reported = [], [], {}, 0
        self.scans = {}

    def teardown(self):
        if hasattr(self, 'saved'):
            module.LEAST = self.saved
            self.check_against_the_live_scans_alone()

    def place(self, fractions, dtype=np.float64):
        points = np.array(fractions, np.float64).reshape(-1, 3) * self.size_m + self.offset_m
        return points.astype(dtype)

    def note(self, moments, sign=1):
        """Note the voxels that changed, and add or subtract their numbers of scans."""
        numbers = [1] * len(moments) if moments.num_scans is None else moments.num_scans.tolist()
        voxels = list(map(tuple, moments.voxel_index.tolist()))
        for voxel, number in zip(voxels, numbers, strict=True):
            self.scans[voxel] = self.scans.get(voxel, 0) + sign * number
        self.touched[self.map.version] = set(voxels)

    @rule(fractions=POINTS, origin=ORIGIN, dtype=st.sampled_from([np.float32, np.float64]))
    def add(self, fractions, origin, dtype):
        points = self.place(fractions, dtype)
        twin = scan_moments(points, self.size_m, origin)
        moments = self.map.add(points, origin)
        assert as_twin(moments) == twin
        self.note(moments)
        add_moments(self.twin, twin)
        self.live.append((moments, twin))

    @rule(fractions=POINTS, origin=ORIGIN, cut=st.integers(0, 10))
    def add_in_two_batches(self, fractions, origin, cut):
        points = self.place(fractions)
        whole = self.map.reduce(points, origin=origin)
        for part in (points[cut:], points[:cut]):
            moments = self.map.add(part, origin)
            self.note(moments)
        twin = scan_moments(points, self.size_m, origin)
        add_moments(self.twin, twin)
        self.live.append((whole, twin))  # to be removed at once

    @rule(batches=st.lists(st.tuples(POINTS, ORIGIN), max_size=3))
    def merge(self, batches):
        other, twin = SurfelMap(self.size_m), {}
        for fractions, origin in batches:
            points = self.place(fractions)
            other.add(points, origin)
            add_moments(twin, scan_moments(points, self.size_m, origin))
        self.map.merge(other)
        self.note(other.moments())
        add_moments(self.twin, twin)
        self.live.append((other.moments(), twin))

    @precondition(lambda self: self.live)
    @rule(number=st.integers(0, 99))
    def remove(self, number):
        moments, twin = self.live.pop(number % len(self.live))
        before = set(self.twin)
        emptied = self.map.remove(moments)
        self.note(moments, -1)
        add_moments(self.twin, twin, -1)
        self.scans = {voxel: self.scans[voxel] for voxel in self.twin}
        assert sorted(map(tuple, emptied.tolist())) == sorted(before - set(self.twin))
        self.gone.append((moments, twin))

    @precondition(lambda self: self.gone)
    @rule(number=st.integers(0, 99))
    def remove_again(self, number):
        moments, twin = self.gone[number % len(self.gone)]
        held = [(self.twin.get(voxel, [0] * 13), row) for voxel, row in twin.items()]
        if any(has[0] < row[0] or (has[0] == row[0] and has != row) for has, row in held):
            with pytest.raises(NotInMapError):
                self.map.remove(moments)

    @rule()
    def clear(self):
        self.map.clear()
        self.twin, self.live, self.reported = {}, [], self.map.version
        self.scans = {}
        self.touched = {self.map.version: set()}

    @rule(back=st.integers(0, 12), least=st.integers(0, 4))
    def ask_what_changed_since_a_version(self, back, least):
        since = self.map.version - back
        self.check_changed(self.map.surfels_changed(since=since, min_points=least), since, least)

    @rule(least=st.integers(0, 4))
    def ask_what_changed_since_the_last_time(self, least):
        since, self.reported = self.reported, self.map.version
        self.check_changed(self.map.surfels_changed(min_points=least), since, least)

    def check_changed(self, surfels, since, least):
        expected = self.counts(self.touched, since, least)
        voxels = [tuple(voxel) for voxel in surfels.voxel_index.tolist()]
        assert len(voxels) == len(set(voxels))
        found = dict(zip(voxels, surfels.num_points.tolist(), strict=True))
        assert found == expected

    def counts(self, voxels_at, since, least):
        """Return the points of voxels of versions after one that hold at least some."""
        voxels = set().union(*(v for version, v in voxels_at.items() if version > since))
        held = {v: self.twin[v][0] for v in voxels if v in self.twin}
        return {v: count for v, count in held.items() if count >= least}

    @invariant()
    def the_map_equals_its_twin(self):
        if hasattr(self, 'map'):
            assert self.map.num_voxels == len(self.twin)
            assert self.map.num_points == sum(row[0] for row in self.twin.values())
            assert self.map.digest() == digest(self.twin, self.size_m)
            surfels = self.map.surfels()
            voxels = map(tuple, surfels.voxel_index.tolist())
            expected = [min(max(self.scans[v], 1), self.twin[v][0]) for v in voxels]
            assert surfels.num_scans.tolist() == expected
            moments = self.map.moments()
            assert sorted(moments.num_scans.tolist()) == sorted(expected)

    def check_against_the_live_scans_alone(self):
        alone = SurfelMap(self.size_m)
        for moments, _ in self.live[::-1]:
            alone.insert(moments)
        assert self.map.digest() == alone.digest()
        assert in_order(self.map.surfels()) == in_order(alone.surfels())


TestMapBesideTwin = MapBesideTwin.TestCase
TestMapBesideTwin.settings = settings(max_examples=60, stateful_step_count=25)


def scans_at_10_km(num):
    rng = np.random.default_rng(21)
    origin = np.array([6000.0, -8000.0, 3.0])
    scans = []
    for _ in range(num):
        flat = rng.normal(scale=[0.4, 0.4, 0.01], size=(40, 3)) + origin
        scans.append((flat, origin + rng.normal(scale=4.0, size=3)))
    return scans


def test_a_window_of_ten_scans_is_the_same_after_100_000_cycles_at_10_km():
    surfel_map, scans = SurfelMap(0.5), scans_at_10_km(60)
    moments = [surfel_map.reduce(points, origin=origin) for points, origin in scans]
    for scan in moments[:10]:
        surfel_map.insert(scan)
    before, surfels = surfel_map.digest(), surfel_map.surfels()

    for cycle in range(100_020):  # a multiple of 60: it ends with the scans it began with
        surfel_map.insert(moments[(cycle + 10) % 60])
        surfel_map.remove(moments[cycle % 60])

    assert surfel_map.digest() == before
    assert in_order(surfel_map.surfels()) == in_order(surfels)
