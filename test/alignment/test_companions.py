# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Cells that move along with the sensor are told from those of standing surfaces."""

import numpy as np
import pytest

from surfel_mapper.alignment.companions import companions
from surfel_mapper.geometry import pose_matrix

VOXEL_M, NOISE_M = 0.5, 0.02

AHEAD = pose_matrix((0.8, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def wall(x_m, seed):
    """Return 800 cells on a wall across x, with noise."""
    rng = np.random.default_rng(seed)
    y, z = rng.uniform((-5.0, 0.0), (5.0, 4.0), (800, 2)).T
    return np.column_stack([x_m + rng.normal(scale=NOISE_M, size=800), y, z])


def side(y_m, seed):
    """Return 800 cells on a wall along x, with noise."""
    return wall(y_m, seed)[:, [1, 0, 2]]


def shares(cells, previous, motion):
    """Return the shares of companions among every 800 cells."""
    moves = companions(np.concatenate(cells), np.concatenate(previous), motion, VOXEL_M, NOISE_M)
    return moves.reshape(len(cells), -1).mean(axis=1)


def test_a_wall_that_keeps_its_distance_moves_along():
    previous = wall(10.2, 1), wall(-7.7, 2), side(4.2, 3)
    cells = wall(10.2, 4), wall(-8.5, 5), side(4.2, 6)  # one moves along, two stand

    moving, standing, along = shares(cells, previous, AHEAD)

    assert moving > 0.6  # beyond the last full voxels there is no surface
    assert standing < 0.02
    assert along < 0.02  # looks the same from everywhere, and says nothing


@pytest.mark.parametrize('motion_m', [0.0, 0.05])
def test_no_cell_moves_along_with_a_sensor_at_rest(motion_m):
    motion = pose_matrix((motion_m, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    assert not shares([wall(10.2, 1)], [wall(10.2, 2)], motion).any()


def test_a_new_wall_is_no_companion():
    assert not shares([wall(6.2, 1)], [wall(10.2, 2)], AHEAD).any()
