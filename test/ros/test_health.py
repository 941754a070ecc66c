# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The warnings and errors of a node at the thresholds of the settings."""

from __future__ import annotations

from collections import Counter

import pytest

from surfel_mapper.config import DiagnosticsConfig
from surfel_mapper.ros.health import ERROR, findings, Interval, REMEDIES, WARN

LIMITS = DiagnosticsConfig(
    silence_s=2.0,
    warn_latency_s=0.3,
    error_latency_s=1.0,
    warn_dropped_ratio=0.1,
    error_dropped_ratio=0.5,
)


def found(limits=LIMITS, **happened):
    """Return all findings as (level, text)."""
    return list(findings(Interval(topic='/points', **happened), limits))


def test_a_healthy_node_has_no_findings():
    assert found(received=20, silent_s=0.04, latency_s=0.03) == []
    assert found() == []


@pytest.mark.parametrize(
    ('num_publishers', 'remedy'), [(0, 'remap points'), (1, 'publishers: 1; see fastdds_shm')]
)
def test_no_cloud_yet_is_a_warning_with_a_remedy(num_publishers, remedy):
    ((level, text),) = found(ever_received=False, num_publishers=num_publishers, silent_s=99.0)
    assert level == WARN
    assert text.startswith('no cloud on /points yet')
    assert remedy in text


def test_a_publisher_that_cannot_be_heard_is_named_instead_of_another_remedy():
    unheard = '/lidar publishes volatile, but qos_overrides./points is transient_local'
    for before in (False, True):
        ((_, text),) = found(ever_received=before, silent_s=9.0, unheard=unheard)
        assert unheard in text
        assert 'fastdds_shm' not in text
        assert 'alive' not in text


def test_other_topics_of_clouds_are_the_remedy_if_the_default_has_no_publisher():
    text = 'no publisher of /points; choose with -r points:=/velodyne_points'
    assert found(ever_received=False, num_publishers=0, alternatives=text) == [
        (WARN, f'no cloud on /points yet: {text}')
    ]


def test_clouds_of_which_none_was_ever_mapped_are_a_warning():
    ((level, text),) = found(received=20, never_mapped=40)
    assert level == WARN
    assert text.startswith('no cloud of 40 is mapped yet: they wait for poses or were dropped')
    ((_, text),) = found(received=20, never_mapped=40, dropped=Counter(no_pose=20))
    assert text.startswith('20 scans dropped just now')
    ((_, text),) = found(received=20, never_mapped=40, paused=True)
    assert text.startswith('paused')


def test_failing_checkpoints_are_an_error():
    text = 'checkpoints fail (no space); the last good one is 70 s old'
    assert found(received=20, checkpoints=text) == [(ERROR, text)]


def test_missing_poses_are_a_warning():
    text = 'pose.source auto takes registration: no topic gives the poses of the clouds'
    assert found(received=20, poses=text) == [(WARN, text)]


def test_silence_is_an_error_beyond_its_limit_only():
    assert found(silent_s=2.0) == []
    ((level, text),) = found(silent_s=2.1)
    assert level == ERROR
    assert 'no cloud on /points for 2.1 s' in text
    assert found(DiagnosticsConfig(silence_s=0.0), silent_s=1e5) == []


@pytest.mark.parametrize(
    ('num', 'level'), [(2, None), (3, WARN), (10, WARN), (11, ERROR), (20, ERROR)]
)
def test_the_share_of_drops_decides_between_warning_and_error(num, level):
    said = found(received=20, dropped=Counter(overload=num - 1, bad_cloud=1))
    assert [severity for severity, _ in said] == ([] if level is None else [level])
    if said:
        assert f'overload {num - 1}' in said[0][1]
        assert REMEDIES['overload' if num > 2 else 'bad_cloud'] in said[0][1]


@pytest.mark.parametrize(('latency_s', 'level'), [(0.3, None), (0.31, WARN), (1.01, ERROR)])
def test_latency_is_a_warning_or_an_error_beyond_its_limits(latency_s, level):
    said = found(latency_s=latency_s)
    assert [severity for severity, _ in said] == ([] if level is None else [level])


@pytest.mark.parametrize('off_s', [3 * 3600.0, -3 * 3600.0, 900.0])
def test_a_latency_of_minutes_means_another_clock(off_s):
    assert found(latency_s=off_s) == []


def test_a_layer_that_is_switched_off_is_a_warning_with_its_error():
    ((level, text),) = found(received=20, layers_off={'tsdf': 'MemoryError'})
    assert level == WARN
    assert text == 'layer tsdf is off until ~/clear, it failed repeatedly: MemoryError'


def test_a_total_loss_is_an_error_that_does_not_ask_for_the_lidar():
    for before in (False, True):
        said = found(loss='28 lost', ever_received=before, silent_s=9.0, num_publishers=1)
        assert said == [(ERROR, 'no cloud comes through: 28 lost')]
