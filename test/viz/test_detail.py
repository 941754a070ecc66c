# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Levels of detail are the exact coarser maps by tile, and stay within the limit of discs."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper import SurfelMap
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.viz.detail import DetailedMap, LEVELS

MIN_POINTS = 3


@pytest.fixture(scope='module')
def hills():
    """Return a map of rolling ground, 120 m x 80 m, on both sides of zero."""
    rng = np.random.default_rng(3)
    points = rng.uniform([-60.0, -40.0, 0.0], [60.0, 40.0, 0.0], (60_000, 3))
    points[:, 2] = 4.0 * np.sin(points[:, 0] / 9.0) * np.cos(points[:, 1] / 7.0)
    surfel_map = SurfelMap(0.5)
    surfel_map.add(points, origin=[0.0, 0.0, 20.0])
    return surfel_map


def detailed(surfel_map):
    return DetailedMap(surfel_map.moments(), MIN_POINTS)


def rows(surfels):
    """Return position, normal and number of points by voxel."""
    order = np.argsort(pack_keys(surfels.voxel_index))
    columns = (surfels.voxel_index, surfels.position, surfels.normal, surfels.num_points[:, None])
    return np.concatenate(columns, axis=1)[order]


@pytest.mark.parametrize('level', range(LEVELS + 1))
def test_tiles_of_a_level_are_the_coarser_map(hills, level):
    found = detailed(hills)
    parts = [rows(found.surfels(tile, level)) for tile in range(len(found))]
    expected = rows(hills.coarsen(level).surfels(MIN_POINTS))

    together = np.concatenate(parts)
    np.testing.assert_array_equal(
        together[np.argsort(pack_keys(together[:, :3].astype(int)))], expected
    )
    np.testing.assert_array_equal(found.counts[level], [len(part) for part in parts])


def test_surfels_lie_in_their_tile(hills):
    found = detailed(hills)
    for tile, place in enumerate(found.tiles):
        for level in (0, LEVELS):
            position = found.surfels(tile, level).position[:, :2]
            np.testing.assert_array_equal(
                np.floor(position / found.edge_m), [place] * len(position)
            )


@pytest.mark.parametrize('at_most', [400, 1000, 4000])
def test_the_limit_holds_and_levels_grow_with_the_distance(hills, at_most):
    found = detailed(hills)
    place = np.array([-50.0, 30.0, 0.0])
    level = found.choose(place, at_most)

    assert found.counts[level, np.arange(len(found))].sum() <= at_most
    low = found.tiles * found.edge_m
    away = np.maximum(np.maximum(low - place[:2], place[:2] - low - found.edge_m), 0.0)
    distance = np.hypot(*away.T)
    order = np.argsort(distance)
    assert (np.diff(level[order]) >= 0).all()
    assert level[order[0]] < level[order[-1]]


def test_a_map_within_the_limit_is_shown_whole(hills):
    found = detailed(hills)
    total = hills.num_surfels(MIN_POINTS)

    assert not found.choose([0.0, 0.0, 0.0], total).any()
    assert found.choose([0.0, 0.0, 0.0], total - 1).any()


def test_an_empty_map_has_no_tiles():
    found = detailed(SurfelMap(0.5))
    assert len(found) == 0
    assert len(found.choose([0.0, 0.0, 0.0], 10)) == 0
