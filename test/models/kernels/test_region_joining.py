# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Patches of known surfaces are joined to these surfaces, whatever the noise and their order."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.growth import owner_table, pieces_of
from surfel_mapper.models.joining import (
    chunk_boxes,
    described,
    join_patches,
    layers,
    separated,
    single_regions,
    touching_regions,
)
from surfel_mapper.models.kernels import region_joining
from surfel_mapper.models.kernels.region_joining import (
    describe_regions,
    join_layers,
    join_pair,
    join_smooth,
)
from surfel_mapper.models.thinning import thin
from test.kernels.modes import both, interpreted

SIZE_M = 0.05
VIEW = np.array([4.0, 0.2, 6.0])
CYLINDER, FLOOR, WALL = range(3)
SURFACES = np.repeat([CYLINDER, FLOOR, WALL], [6, 3, 2])


@pytest.fixture(autouse=True)
def heap_of_the_interpreter(request, monkeypatch):
    """Interpret what an interpreted kernel does with its heap: numba warns of lists of Python."""
    if 'call' in request.fixturenames and request.getfixturevalue('call') is interpreted:
        monkeypatch.setattr(region_joining, 'push', region_joining.push.py_func)


def scene(sigma_m):
    """Return points of six strips of a cylinder, three tiles of a floor, two of a wall."""
    rng = np.random.default_rng(4)
    parts = []
    for k in range(6):
        angle = np.radians(rng.uniform(12.0 * k - 36.0, 12.0 * k - 24.0, 900))
        along = rng.uniform(3.0, 4.0, 900)
        parts.append(np.column_stack([np.sin(angle), along, np.cos(angle)]))
    for k in range(3):
        x, y = rng.uniform(k, k + 1, 1500), rng.uniform(0.0, 1.0, 1500)
        parts.append(np.column_stack([x, y, np.zeros(1500)]))
    for k in range(2):
        y, z = rng.uniform(0.5 * k, 0.5 * k + 0.5, 900), rng.uniform(0.0, 1.0, 900)
        parts.append(np.column_stack([np.zeros(900), y, z]))
    owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts]).astype(np.int32)
    points = np.concatenate(parts)
    return points + sigma_m * rng.standard_normal(points.shape), owner


def pieces(points, owner):
    voxels = thin(points, SIZE_M).by_voxel()
    return pieces_of(voxels, owner_table(voxels, owner[voxels.rows]), int(owner.max()) + 1)


@pytest.mark.parametrize('sigma_m', [0.01, 0.015])
@pytest.mark.parametrize('seed', [0, 1])
def test_patches_of_one_surface_are_joined_and_no_others(sigma_m, seed):
    points, owner = scene(sigma_m)
    renumbered = np.random.default_rng(seed).permutation(len(SURFACES)).astype(np.int32)
    given = pieces(points, renumbered[owner])
    index, normals, curved = join_patches(given, VIEW, (sigma_m, 0.0), SIZE_M)
    of_patch = index[renumbered]
    assert len(normals) == 3
    for surface in (CYLINDER, FLOOR, WALL):
        (region,) = set(of_patch[surface == SURFACES].tolist())
        assert curved[region] == (surface == CYLINDER)
    np.testing.assert_allclose(normals[of_patch[6]], [0.0, 0.0, 1.0], atol=0.02)
    np.testing.assert_allclose(normals[of_patch[-1]], [1.0, 0.0, 0.0], atol=0.02)


@both
def test_layers_of_a_noisy_wall_join_the_largest(call):
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(0.0, 2.0, (9000, 2)), 0.02 * rng.normal(size=9000)])
    owner = np.digitize(points[:, 2], [-0.025, 0.025]).astype(np.int32)
    given = pieces(points, owner)
    regions = single_regions(given, VIEW, (0.02, 0.0), SIZE_M)
    order = layers(given.touching(), given, regions)
    call(join_layers, order, given.means, given.weights, given.starts, regions)
    assert regions.root.tolist() == [1, 1, 1]
    np.testing.assert_array_equal(regions.patch_normal[0], regions.patch_normal[1])


@both
def test_a_cylinder_turns_and_bends_by_its_arc(call):
    given = pieces(*scene(0.01))
    regions = single_regions(given, VIEW, (0.01, 0.0), SIZE_M)
    edges, adjacent = touching_regions(given.touching(), regions.root)
    state, floor = (given.means, given.weights, given.starts), (0.02 * SIZE_M) ** 2
    state = *state, chunk_boxes(given.means)
    call(join_smooth, edges, adjacent, *state, floor, regions)
    names = np.unique(regions.root)
    normals, found = np.empty((len(names), 3)), np.empty((len(names), 4))
    call(describe_regions, names, (*state, floor), regions, (0.0, 0.0, 0.0), normals, found)
    assert len(names) == 3
    round_one = np.searchsorted(names, regions.root[0])
    # 72 deg of radius 1 m; the turn of a parabola of equal arc is a little larger
    assert np.degrees(found[round_one, 1]) == pytest.approx(72.0, rel=0.1)
    heights = np.cos(np.radians(np.linspace(-36.0, 36.0, 1000)))
    # steep ends weigh less, by the squared cosine of the slope
    assert found[round_one, 2] == pytest.approx(np.sqrt(12.0) * heights.std(), rel=0.12)
    others = np.delete(found, round_one, axis=0)
    assert np.abs(others[:, 2]).max() < 0.01  # the noise
    np.testing.assert_allclose(others[:, 3], 0.01, rtol=0.15)


def test_joins_that_are_much_worse_planes_than_their_patches_are_undone():
    rng = np.random.default_rng(6)
    x, y = rng.uniform(0.0, 8.0, 20_000), rng.uniform(0.0, 1.0, 20_000)
    owner = np.floor(x).astype(np.int32)
    steps = np.where((owner < 6) & (owner % 2 == 0), 0.1, 0.0)  # six stairs up and down, a floor
    z = steps + 0.005 * rng.standard_normal(len(x))
    given = pieces(np.column_stack([x, y, z]), owner)
    single, regions = (single_regions(given, VIEW, (0.005, 0.0), SIZE_M) for _ in range(2))
    for small, large in ((1, 0), (2, 0), (3, 0), (4, 0), (5, 0), (7, 6)):
        join_pair(small, large, regions)
    state = given.means, given.weights, given.starts
    index, _, curved, is_worse = described(regions, state, SIZE_M)
    assert (curved.tolist(), is_worse.tolist()) == ([False, False], [True, False])
    regions = separated(regions, single, is_worse[index])
    index, normals, _, is_worse = described(regions, state, SIZE_M)
    assert index.tolist() == [0, 1, 2, 3, 4, 5, 6, 6]
    np.testing.assert_allclose(normals[:6], single.patch_normal[:6], atol=1e-12)
    assert not is_worse.any()
