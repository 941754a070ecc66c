# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Folds: which surfaces turn too far, and how their pieces are halved."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.models.folds import folded, percentile

LIMIT = math.cos(math.radians(60.0))


def fan(low_deg, high_deg, number):
    """Return unit normals evenly between two angles about y."""
    angle = np.radians(np.linspace(low_deg, high_deg, number))
    return np.stack([np.sin(angle), np.zeros(number), np.cos(angle)], axis=1)


def mean_of(normals):
    mean = normals.mean(axis=0)
    return mean / np.linalg.norm(mean)


def test_a_fan_is_halved_in_its_middle():
    normals = fan(-85.0, 85.0, 40)
    side = folded(normals, mean_of(normals), LIMIT)
    assert side is not None
    assert side.tolist() in ([True] * 20 + [False] * 20, [False] * 20 + [True] * 20)


def test_two_unequal_bundles_are_parted_where_the_gap_is():
    normals = np.concatenate([fan(-90.0, -70.0, 9), fan(50.0, 90.0, 15)])
    side = folded(normals, np.array([0.0, 0.0, 1.0]), LIMIT)
    assert side is not None
    assert len(set(side[:9])) == 1
    assert len(set(side[9:])) == 1
    assert side[0] != side[9]


@pytest.mark.parametrize(
    'normals', [fan(-50.0, 50.0, 30), fan(80.0, 80.0, 1), np.repeat(fan(80.0, 80.0, 1), 5, 0)]
)
def test_what_turns_less_or_cannot_be_halved_stays_whole(normals):
    assert folded(normals, np.array([0.0, 0.0, 1.0]), LIMIT) is None


@pytest.mark.parametrize('number', [1, 2, 3, 50, 51, 52, 200])
def test_percentiles_are_those_of_numpy(number):
    values = np.random.default_rng(number).normal(size=number)
    for share in (0.0, 2.0, 50.0, 100.0):
        assert percentile(values, share) == pytest.approx(np.percentile(values, share))
