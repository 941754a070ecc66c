# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What is said to be wrong with a node, and how badly, at the thresholds of the settings."""

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
    """Return (level, text) of everything that is wrong."""
    return list(findings(Interval(topic='/points', **happened), limits))


def test_nothing_is_wrong_where_scans_come_and_are_mapped():
    assert found(received=20, silent_s=0.04, latency_s=0.03) == []
    assert found() == []


@pytest.mark.parametrize(
    ('num_publishers', 'remedy'), [(0, 'remap points'), (1, '1 publish there; see fastdds_shm')]
)
def test_no_cloud_so_far_is_a_warning_with_what_to_look_for(num_publishers, remedy):
    ((level, text),) = found(ever_received=False, num_publishers=num_publishers, silent_s=99.0)
    assert level == WARN
    assert text.startswith('no cloud on /points yet')
    assert remedy in text


def test_silence_is_an_error_beyond_its_limit_only():
    assert found(silent_s=2.0) == []
    ((level, text),) = found(silent_s=2.1)
    assert level == ERROR
    assert 'no cloud on /points for 2.1 s' in text
    assert found(DiagnosticsConfig(silence_s=0.0), silent_s=1e5) == []


@pytest.mark.parametrize(
    ('num', 'level'), [(2, None), (3, WARN), (10, WARN), (11, ERROR), (20, ERROR)]
)
def test_drops_are_a_warning_or_an_error_by_their_share(num, level):
    said = found(received=20, dropped=Counter(overload=num - 1, bad_cloud=1))
    assert [severity for severity, _ in said] == ([] if level is None else [level])
    if said:
        assert f'overload {num - 1}' in said[0][1]
        assert REMEDIES['overload' if num > 2 else 'bad_cloud'] in said[0][1]


def test_any_drop_is_a_warning_by_default():
    ((level, text),) = found(DiagnosticsConfig(), received=1000, dropped=Counter(no_points=1))
    assert (level, text) == (WARN, '1 scans dropped just now (no_points 1)')


def test_a_pause_is_a_warning_and_its_drops_are_no_fault():
    ((level, text),) = found(received=20, dropped=Counter(paused=20), paused=True)
    assert level == WARN
    assert text.startswith('paused')


@pytest.mark.parametrize(('latency_s', 'level'), [(0.3, None), (0.31, WARN), (1.01, ERROR)])
def test_latency_is_a_warning_or_an_error_beyond_its_limits(latency_s, level):
    said = found(latency_s=latency_s)
    assert [severity for severity, _ in said] == ([] if level is None else [level])


def test_stamps_of_another_time_and_limits_of_zero_are_no_latency():
    assert found(latency_s=3e8) == []
    assert found(latency_s=-3e8) == []
    assert found(DiagnosticsConfig(warn_latency_s=0.0, error_latency_s=0.0), latency_s=9.0) == []


def test_what_the_middleware_lost_is_handed_on():
    assert found(loss='3 lost, do this') == [(WARN, '3 lost, do this')]
