# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Voxels chosen from many: as many as asked for, the same ones always, evenly in space."""

import numpy as np
import pytest

from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.thinning import thinned


def grid(reach):
    return np.stack(np.meshgrid(*[np.arange(-reach, reach)] * 3), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize('number', [0, 1, 99, 100, 101])
def test_no_more_are_chosen_than_asked_for(number):
    keys = pack_keys(grid(3))[:100]
    chosen = thinned(keys, number)
    assert len(chosen) == min(number, 100)
    assert (np.diff(chosen) > 0).all()


def test_voxels_stay_chosen_while_the_map_grows_and_whatever_their_order():
    rng = np.random.default_rng(1)
    keys = rng.permutation(pack_keys(grid(15)))
    small = set(keys[:20_000][thinned(keys[:20_000], 5000)].tolist())
    large = set(keys[thinned(keys, 5000)].tolist())
    shuffled = rng.permutation(keys)
    assert set(shuffled[thinned(shuffled, 5000)].tolist()) == large
    assert len(small & large) / 5000 == pytest.approx(20_000 / 27_000, abs=0.02)


def test_voxels_are_chosen_evenly_in_space():
    places = grid(20)
    chosen = places[thinned(pack_keys(places), 8000)]
    blocks = np.unique((chosen + 20) // 10, axis=0, return_counts=True)[1]  # 64 of 1000 voxels
    expected = 8000 / 64
    # binomial: 10.5 is the standard deviation of a block, 5 of them are not met by chance
    assert np.abs(blocks - expected).max() < 5 * 10.5
    assert len(blocks) == 64
    assert np.ptp(np.bincount(chosen[:, 2] + 20)) < 12 * np.sqrt(8000 / 40)


def test_a_map_returns_so_many_of_its_surfels():
    surfel_map = SurfelMap(1.0)
    surfel_map.add(np.repeat(grid(5) + 0.5, 3, axis=0))
    everything = surfel_map.surfels(3)
    assert len(surfel_map.surfels(3, at_most=2000)) == len(everything) == 1000
    some = surfel_map.surfels(3, at_most=200)
    assert len(some) == 200
    assert len(surfel_map.surfels(4, at_most=200)) == 0
    chosen = thinned(pack_keys(everything.voxel_index), 200)
    assert set(map(tuple, everything.voxel_index[chosen])) == set(map(tuple, some.voxel_index))
