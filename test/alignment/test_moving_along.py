# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Cells that move along: at the same place as in the scan before, against the motion."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.alignment.moving_along import moving_along, staying

CELL_M = 0.25
MOTION_M = np.array([0.8, 0.0, 0.0])

AHEAD, LEFT, UP = np.eye(3)


def centres(low, high):
    """Return the centres of all cells of a box, (K, 3) m."""
    axes = [np.arange(a, b, CELL_M) + CELL_M / 2 for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)


REAR = centres((10.0, -1.0, 0.0), (10.1, 1.0, 3.0))
"""A wall ahead, across the motion."""

SIDE = centres((-5.0, 3.0, 0.0), (5.0, 3.1, 3.0))
"""A wall along the motion."""

FLOOR = centres((-8.0, -6.0, -1.75), (8.0, -3.0, -1.7))


def found(cells, before, normal):
    normals = np.broadcast_to(normal, cells.shape)
    return moving_along(cells, before, MOTION_M, normals, CELL_M)


def test_a_wall_across_the_motion_moves_along_if_it_stays_where_it_was():
    assert found(REAR, REAR, AHEAD).all()
    assert found(REAR, REAR, np.full(3, np.nan)).all()  # no surfel there: new to the map


def test_a_wall_that_comes_nearer_stands():
    assert not found(REAR, REAR + MOTION_M, AHEAD).any()


def test_ground_and_walls_along_the_motion_say_nothing():
    assert not found(FLOOR, FLOOR, UP).any()
    assert not found(SIDE, SIDE, LEFT).any()


@pytest.mark.parametrize(('off_m', 'moves'), [(0.06, True), (0.09, False)])
def test_a_place_is_the_same_within_three_tenths_of_a_cell_along_the_motion(off_m, moves):
    half_m = 0.5 * off_m * AHEAD
    assert found(REAR - half_m, REAR + half_m, AHEAD).all() == moves


def test_the_edge_of_what_moves_along_does_too():
    edge, away = REAR[:1] - [0.4, 0.0, 0.0], REAR[:1] - [0.6, 0.0, 0.0]
    cells = np.concatenate([REAR, edge, away])
    assert found(cells, REAR, AHEAD).tolist() == [True] * (len(REAR) + 1) + [False]


def test_nothing_moves_along_without_a_scan_before():
    assert not found(REAR, np.empty((0, 3)), AHEAD).any()
    assert not len(found(np.empty((0, 3)), REAR, AHEAD))


def test_the_share_that_stays_counts_surfaces_across_the_motion_alone():
    cells = np.concatenate([REAR, REAR + 2.0 * AHEAD, FLOOR])
    before = np.concatenate([REAR, REAR + 2.8 * AHEAD, FLOOR])
    normals = np.concatenate([np.tile(AHEAD, (2 * len(REAR), 1)), np.tile(UP, (len(FLOOR), 1))])
    share = staying(cells, before, MOTION_M, normals, CELL_M)
    assert share == 0.5
    assert staying(FLOOR, FLOOR, MOTION_M, np.tile(UP, (len(FLOOR), 1)), CELL_M) == 0.0
    assert staying(REAR, REAR[:0], MOTION_M, np.tile(AHEAD, (len(REAR), 1)), CELL_M) == 0.0
