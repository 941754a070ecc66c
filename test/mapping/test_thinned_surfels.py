# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A limited number of surfels of a map: exact number, same choice every time, even in space."""

import numpy as np
import pytest

from surfel_mapper.mapping.surfel_map import SurfelMap


def grid(reach):
    return np.stack(np.meshgrid(*[np.arange(-reach, reach)] * 3), axis=-1).reshape(-1, 3)


def map_of(voxels, num_points=1):
    surfel_map = SurfelMap(1.0)
    surfel_map.add(np.repeat(voxels + 0.5, num_points, axis=0))
    return surfel_map


def selected(surfel_map, number):
    return set(map(tuple, surfel_map.surfels(1, at_most=number).voxel_index.tolist()))


@pytest.mark.parametrize('number', [0, 1, 99, 100, 101])
def test_at_most_limits_the_number_of_surfels(number):
    assert len(selected(map_of(grid(3)[:100]), number)) == min(number, 100)


def test_selected_voxels_stay_selected_as_the_map_grows_in_any_order():
    rng = np.random.default_rng(1)
    voxels = rng.permutation(grid(15))
    small = selected(map_of(voxels[:20_000]), 5000)
    large = selected(map_of(voxels), 5000)
    assert selected(map_of(rng.permutation(voxels)), 5000) == large
    assert len(small & large) / 5000 == pytest.approx(20_000 / 27_000, abs=0.02)


def test_selected_voxels_are_spread_evenly_in_space():
    chosen = map_of(grid(20)).surfels(1, at_most=8000).voxel_index
    blocks = np.unique((chosen + 20) // 10, axis=0, return_counts=True)[1]  # 64 of 1000 voxels
    expected = 8000 / 64
    # binomial: the standard deviation of a block is 10.5; five of them do not occur by chance
    assert np.abs(blocks - expected).max() < 5 * 10.5
    assert len(blocks) == 64
    assert np.ptp(np.bincount(chosen[:, 2] + 20)) < 12 * np.sqrt(8000 / 40)


def test_the_limit_applies_after_min_points():
    surfel_map = map_of(grid(5), num_points=3)
    assert len(surfel_map.surfels(3, at_most=2000)) == len(surfel_map.surfels(3)) == 1000
    assert len(surfel_map.surfels(3, at_most=200)) == 200
    assert len(surfel_map.surfels(4, at_most=200)) == 0
