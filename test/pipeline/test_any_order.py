# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Mapper: for input in any order the counts add up and the map equals its window."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from surfel_mapper.mapping.surfel_map import SurfelMap
from test.pipeline.made_scans import (
    add_pose,
    assert_counts_add_up,
    dropped,
    mapper_with,
    scan_at,
)

pytestmark = pytest.mark.filterwarnings('error')
BAD = {
    'no frame': ('',),
    'no points': ('lidar', np.empty((0, 3))),
    'nan': ('lidar', np.full((3, 3), np.nan)),
    'far': ('lidar', np.full((3, 3), 1e20)),
}
EVENT = st.one_of(
    st.tuples(st.just('scan'), st.sampled_from([0.1, 0.2, 0.0, -0.3, -2.0, 0.7, 3.0])),
    st.tuples(st.just('pose'), st.sampled_from([0.0, 0.1, -0.1, 0.5, -5.0])),
    st.tuples(st.just('bad scan'), st.sampled_from(list(BAD))),
    st.tuples(st.sampled_from(['insert', 'insert', 'insert', 'clear']), st.none()),
)


@settings(max_examples=150)
@given(st.lists(EVENT, max_size=40), st.integers(0, 3), st.sampled_from([0.0, 0.3]))
def test_counts_add_up_and_the_map_is_its_window_for_any_input(events, limit, gate_m):
    mapper = mapper_with(
        window__max_scans=limit + 1, window__gate_distance_m=gate_m, pose__max_waiting_scans=4
    )
    now_s, updates = 10.0, 0
    for kind, value in events:
        if kind == 'scan':
            now_s += value
            mapper.add_scan(scan_at(now_s))
        elif kind == 'pose':
            add_pose(mapper, now_s + value, x=0.2 * now_s)
        elif kind == 'bad scan':
            now_s += 0.05
            mapper.add_scan(scan_at(now_s, *BAD[value]))
        elif kind == 'clear':
            mapper.clear()
        else:
            updates += len(list(mapper.insert_ready()))
    counters = mapper.counters
    waiting = counters.received - counters.mapped - counters.gated - sum(dropped(mapper).values())
    num_odd = len(mapper._pipeline.guard._odd)
    assert 0 <= waiting <= 4 + num_odd
    assert updates == counters.mapped
    alone = SurfelMap(0.5)
    for scan in mapper.window:
        alone.insert(scan.moments)
    assert mapper.map.digest() == alone.digest()
    before = sum(dropped(mapper).values())
    mapper.finish()
    assert sum(dropped(mapper).values()) == before + waiting
    assert_counts_add_up(mapper)
