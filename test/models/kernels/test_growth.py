# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Voxel neighbours, and points of cubes, against brute force."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.noise import NoiseSamples, sampled_rows
from surfel_mapper.models.thinning import thin

SIZE = 0.1


def by_voxel(points, size=SIZE):
    thinned = thin(points, size)
    return thinned, thinned.by_voxel()


@pytest.mark.parametrize(
    'extent',
    [
        (1.0, 0.3, 0.6),
        (1.0, 0.1, 1.0),
        (0.1, 1.0, 1.0),
        (1.0, 0.2, 1.0),
        (0.2, 1.0, 1.0),
        (0.1, 0.1, 9.0),
        (0.2, 0.1, 5.0),
    ],
)  # walls and poles one or two voxels thick
def test_neighbours_equal_brute_force(extent):
    points = np.random.default_rng(2).uniform(0.0, 1.0, (150, 3)) * extent
    thinned, voxels = by_voxel(points)
    index = np.floor(thinned.means / SIZE).astype(int)
    first, rows = voxels.adjacent
    for i in range(len(index)):
        near = np.abs(index - index[i]).max(axis=1) == 1
        assert sorted(rows[first[i] : first[i + 1]].tolist()) == np.flatnonzero(near).tolist()


def test_points_of_cubes_are_taken_evenly_from_the_voxels_with_means_inside():
    points = np.random.default_rng(3).uniform(0.0, 1.0, (2000, 3))
    thinned, voxels = by_voxel(points)
    samples = NoiseSamples(points, thinned.rows, thinned.starts, thinned.means)
    seeds, halves = np.arange(0, len(thinned.means), 7), np.linspace(0.01, 0.4, 143)
    halves = halves[: len(seeds)]
    rows = sampled_rows(samples, seeds, halves, 30)
    assert (rows[:, 29] >= 0).any()
    assert (rows[:, 29] < 0).any()
    for seed, half, own in zip(seeds, halves, rows, strict=True):
        inside = (np.abs(thinned.means - thinned.means[seed]) <= half).all(axis=1)
        of_cube = np.flatnonzero(np.repeat(inside, np.diff(voxels.starts)))
        number = min(len(of_cube), 30)
        expected = of_cube[np.arange(number) * len(of_cube) // number]
        assert own.tolist() == [*expected, *[-1] * (30 - number)]
