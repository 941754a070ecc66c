# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Mapper.outcomes: what became of each scan, while the log is throttled."""

from __future__ import annotations

from collections import Counter

import numpy as np

from surfel_mapper.mapping.surfel_map import SurfelMap
from test.pipeline.made_scans import add_pose, insert, mapper_with, S, scan_at


def outcomes_of(mapper, *scans):
    """Return what became of scans: stamp in s, outcome and cause."""
    mapper.outcomes = []
    insert(mapper, *scans)
    mapper.finish()
    return [(o.stamp_ns / S, o.outcome, o.cause) for o in mapper.outcomes]


def test_every_scan_has_one_outcome_with_its_cause():
    mapper = mapper_with(pose__max_wait_s=0.5, window__gate_distance_m=0.2)
    for stamp_s, x in ((1.0, 0.0), (2.0, 0.0), (3.0, 1.0), (4.0, 2.0)):
        add_pose(mapper, stamp_s, x)
    nothing = np.empty((0, 3), np.float32)
    far = np.full((9, 3), 1e30, np.float32)
    found = outcomes_of(
        mapper,
        scan_at(1.0),
        scan_at(2.0),  # the robot stands still
        scan_at(2.5, points=nothing),
        scan_at(3.0, points=far),
        scan_at(3.0),  # the same stamp once more
        scan_at(4.0),
        scan_at(9.0),
    )
    assert sorted(found) == [
        (1.0, 'mapped', ''),
        (2.0, 'gated', ''),
        (2.5, 'dropped', 'no_points'),
        (3.0, 'dropped', 'map_limit'),
        (3.0, 'dropped', 'stamp_repeated'),
        (4.0, 'mapped', ''),
        (9.0, 'dropped', 'no_pose'),
    ]
    counted = Counter(outcome for _, outcome, _ in found)
    counters = mapper.counters
    assert counted == {
        'mapped': counters.mapped,
        'gated': counters.gated,
        'dropped': sum(counters.dropped.values()),
    }


def test_forty_odd_stamps_are_forty_rows_though_the_log_has_few_lines(caplog):
    mapper = mapper_with(pose__source='identity')
    mapper.outcomes = []
    for number in range(40):
        insert(mapper, scan_at(100.0 + number), scan_at(2e9 + number, 'rear'))
    mapper.finish()
    odd = [o.stamp_ns // S for o in mapper.outcomes if o.cause == 'odd_stamp']
    assert odd == [2 * 10**9 + number for number in range(40)]
    assert len(caplog.records) < 40


def test_updates_have_the_outcome_with_source_points_and_times():
    mapper = mapper_with()
    mapper.outcomes = []
    add_pose(mapper, 1.0)
    (update,) = insert(mapper, scan_at(1.0))
    assert mapper.outcomes == [update.outcome]
    outcome = update.outcome
    assert (outcome.outcome, outcome.pose_source) == ('mapped', 'odometry')
    assert (outcome.num_points, outcome.milliseconds) == (update.num_points, update.milliseconds)


def test_a_mapped_scan_without_update_says_so(monkeypatch):
    mapper = mapper_with()
    add_pose(mapper, 1.0)

    def broken(self, *args):
        raise ZeroDivisionError

    monkeypatch.setattr(SurfelMap, 'surfels_changed', broken)
    assert outcomes_of(mapper, scan_at(1.0)) == [(1.0, 'mapped', 'internal_error')]


def test_clouds_that_were_not_decoded_are_counted_without_a_stamp():
    mapper = mapper_with()
    mapper.outcomes = []
    mapper.refuse_clouds('bad_cloud', '/points', 'cut', 2, 'lidar')
    assert [(o.stamp_ns, o.topic, o.cause) for o in mapper.outcomes] == [
        (None, '/points', 'bad_cloud')
    ] * 2


def test_outcomes_are_kept_only_if_asked_for():
    mapper = mapper_with(pose__source='identity')
    insert(mapper, scan_at(1.0))
    assert mapper.outcomes is None
