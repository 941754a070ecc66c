# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Bisection of bent and overlapping surfaces."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.models.charts import chart_side
from surfel_mapper.models.kernels.charts import (
    bisect_folded,
    find_small_curved,
    FOLD_PERCENTILE,
    is_folded,
    MOST_FOLDED,
)
from test.kernels.modes import both

LIMIT = math.cos(math.radians(60.0))


def fan(low_deg, high_deg, number):
    """Return unit normals evenly between two angles about y."""
    angle = np.radians(np.linspace(low_deg, high_deg, number))
    return np.stack([np.sin(angle), np.zeros(number), np.cos(angle)], axis=1)


def mean_of(normals):
    mean = normals.mean(axis=0)
    return mean / np.linalg.norm(mean)


def bisected(call, normals, mean):
    """Return one half of folded normals, None for others."""
    side = np.empty(len(normals), bool)
    return side if call(bisect_folded, normals, mean, LIMIT, side) else None


@both
def test_fan_of_normals_is_bisected_in_its_middle(call):
    normals = fan(-85.0, 85.0, 40)
    side = bisected(call, normals, mean_of(normals))
    assert side is not None
    assert side.tolist() in ([True] * 20 + [False] * 20, [False] * 20 + [True] * 20)


@both
@pytest.mark.parametrize(
    'normals', [fan(-50.0, 50.0, 30), fan(80.0, 80.0, 1), np.repeat(fan(80.0, 80.0, 1), 5, 0)]
)
def test_slightly_bent_or_inseparable_normals_stay_whole(call, normals):
    assert bisected(call, normals, np.array([0.0, 0.0, 1.0])) is None


def halved(normals, points):
    """Return one half of a part, of columns of 1 m in which 4 m are high; None for a whole one."""
    return chart_side(normals, points, LIMIT, 1.0)


def test_chart_is_bisected_if_folded_or_overlapping():
    level = np.stack([*np.mgrid[0:6, 0:4].reshape(2, -1) + 0.5, np.zeros(24)], axis=1)
    up = np.tile([0.0, 0.0, 1.0], (48, 1))
    ramps = np.concatenate([level, np.add(level, [0.0, 0.0, 5.0])])
    assert halved(up, np.concatenate([level, np.add(level, [0.0, 0.0, 3.9])])) is None
    assert halved(up, np.concatenate([level, np.add(level, [6.0, 0.0, 5.0])])) is None
    assert halved(up, ramps).tolist() == [False] * 24 + [True] * 24

    bent = fan(-85.0, 85.0, 48)
    side = halved(bent, np.concatenate([level, np.add(level, [6.0, 0.0, 0.0])]))
    assert len(set(side[:24])) == len(set(side[24:])) == 1
    assert side[0] != side[-1]


@both
@pytest.mark.parametrize('number', [2, 3, 50, 51, 52, 200, 1200])
def test_a_fold_is_a_percentile_below_the_limit_or_too_many_normals(call, number):
    rng, up = np.random.default_rng(number), np.array([0.0, 0.0, 1.0])
    for odd in range(min(number, 30)):
        normals = np.concatenate([fan(-59.0, 59.0, number - odd), fan(61.0, 65.0, odd)])
        normals = normals[rng.permutation(number)]
        cosines = normals @ up
        low = np.percentile(cosines, 100.0 - FOLD_PERCENTILE) < LIMIT
        assert call(is_folded, normals, up, LIMIT) == (low or odd > MOST_FOLDED)


@both
def test_small_curved_charts_of_few_points_are_dropped(call):
    bent, flat = fan(-10.0, 10.0, 14), fan(-7.0, 7.0, 4)
    flat[0] *= -1.0  # normals may face either side
    normal = np.concatenate([bent, fan(-10.0, 10.0, 15), bent, flat])
    starts = np.cumsum([0, 14, 15, 14, 4])
    count = np.full(len(normal), 20)
    count[29:43] = 72  # 1008 points
    order = np.random.default_rng(7).permutation(len(normal))
    rows, found = np.argsort(order), np.empty(4, bool)
    limit = math.cos(math.radians(15.0))
    call(find_small_curved, rows, starts, count[order], normal[order], limit, found)
    assert found.tolist() == [True, False, False, False]
