# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Meshes of fields that are written into the blocks: closed, in place, and the same however made.

What a mesh has to be follows from the field: a vertex for every lattice edge on which the sign
changes, every side of a triangle shared by two, in opposite directions.
"""

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.tsdf.blocks import block_keys, BlockMap
from surfel_mapper.tsdf.mesh import Mesher

VOXEL_M = 0.1
SIDE = 4


def blocks_of(distance, first=(0, 0, 0), weight=1.0, color=None, **settings):
    """Return a map whose voxels from block first on hold a field, (x, y, z), in m."""
    sizes = dict(voxel_size_m=VOXEL_M, voxels_per_side=SIDE, truncation_m=10.0)  # none is torn
    blocks = BlockMap(TsdfConfig(color=color is not None, **{**sizes, **settings}))
    write(blocks, distance, first, weight, color)
    return blocks


def write(blocks, distance, first=(0, 0, 0), weight=1.0, color=None):
    """Write a field (x, y, z) and optional colours (x, y, z, 3) into blocks."""
    weight = np.broadcast_to(weight, distance.shape)
    counts = np.array(distance.shape) // SIDE
    for place in np.ndindex(*counts):
        part = tuple(slice(SIDE * p, SIDE * (p + 1)) for p in place)
        rows = blocks.place([np.add(place, first)])
        blocks.distance[rows] = distance[part].transpose(2, 1, 0).ravel()
        blocks.weight[rows] = weight[part].transpose(2, 1, 0).ravel()
        if color is not None:
            blocks.color[rows, :3] = color[part].transpose(3, 2, 1, 0).reshape(3, -1)
            blocks.color[rows, 3] = 1.0
        blocks.touch(rows, 1)


def centers(shape, first=(0, 0, 0)):
    """Return the centres of voxels, (*shape, 3) m."""
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing='ij'), axis=-1)
    return (index + np.multiply(first, SIDE) + 0.5) * VOXEL_M


def mesh_of(blocks):
    mesher = Mesher(blocks)
    mesher.update()
    return mesher.mesh()


def sides(mesh):
    """Return the sides of all triangles as a sorted list of (from, to)."""
    a, b, c = mesh.triangles.T
    return sorted(zip(np.concatenate([a, b, c]), np.concatenate([b, c, a]), strict=True))


def assert_closed(mesh):
    """Every side is there once in each direction, every vertex is used, none is there twice."""
    found = sides(mesh)
    assert len(set(found)) == len(found)
    assert found == sorted((b, a) for a, b in found)
    assert set(mesh.triangles.ravel()) == set(range(len(mesh.vertices)))
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)


def areas(mesh):
    """Return normals of triangles, as long as twice their areas."""
    a, b, c = mesh.vertices[mesh.triangles].transpose(1, 0, 2)
    return np.cross(b - a, c - a)


def as_triangles(mesh):
    """Return the triangles as places, in an order that does not depend on how they were made."""
    corners = mesh.vertices[mesh.triangles]
    turned = [np.roll(t, -np.lexsort(t.T)[0], axis=0).ravel() for t in corners]
    return sorted(map(tuple, turned))


def sphere(shape, radius_m, first=(0, 0, 0)):
    places = centers(shape, first)
    middle = np.add(places.reshape(-1, 3).mean(axis=0), [0.013, -0.021, 0.034])
    return np.linalg.norm(places - middle, axis=-1) - radius_m, middle


@pytest.mark.parametrize('first', [(0, 0, 0), (-2, -3, -1), (900_000, -900_000, 5)])
def test_a_sphere_is_closed_round_and_looks_outwards(first):
    distance, middle = sphere((16, 16, 16), 0.6, first)
    mesh = mesh_of(blocks_of(distance, first))

    assert_closed(mesh)
    offsets = mesh.vertices - middle
    # linear interpolation of the distance to a sphere is off by at most h^2 / 8 r
    assert np.abs(np.linalg.norm(offsets, axis=1) - 0.6).max() <= VOXEL_M**2 / (8 * 0.5)
    normals = areas(mesh)
    corner = offsets[mesh.triangles[:, 0]]
    volume = (normals * corner).sum() / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 0.6**3, rel=0.02)
    assert np.linalg.norm(normals, axis=1).sum() / 2.0 == pytest.approx(
        4.0 * np.pi * 0.6**2, rel=0.02
    )
    assert len(mesh.vertices) - len(mesh) * 3 // 2 + len(mesh) == 2  # Euler


@pytest.mark.parametrize('seed', range(20))
def test_any_field_gives_a_closed_mesh_with_a_vertex_for_every_change_of_sign(seed):
    rng = np.random.default_rng(seed)
    distance = rng.uniform(-1.0, 1.0, (12, 8, 8)).astype(np.float32)
    for axis in range(3):
        for end in (0, -1):
            np.moveaxis(distance, axis, 0)[end] = 1.0  # so that nothing leaves the map
    mesh = mesh_of(blocks_of(distance))

    assert_closed(mesh)
    expected = []
    for axis in range(3):
        low, high = (np.moveaxis(distance, axis, 0)[part] for part in (slice(-1), slice(1, None)))
        changes = np.argwhere((low < 0.0) != (high < 0.0))
        a, b = low[tuple(changes.T)].astype(float), high[tuple(changes.T)].astype(float)
        begin = np.insert(changes[:, 1:], axis, changes[:, 0], axis=1) + 0.5
        begin[:, axis] += a / (a - b)
        expected.append(begin * VOXEL_M)
    expected = np.concatenate(expected)
    order, wanted = np.lexsort(mesh.vertices.round(9).T), np.lexsort(expected.round(9).T)
    assert np.abs(mesh.vertices[order] - expected[wanted]).max() <= 1e-12


def test_a_mesh_made_bit_by_bit_is_the_one_made_at_once():
    rng = np.random.default_rng(3)
    distance, _ = sphere((16, 16, 16), 0.55)
    blocks = blocks_of(distance)
    mesher = Mesher(blocks)
    assert mesher.update() == 64
    for _ in range(5):
        index = rng.integers(0, 4, 3)
        rows = blocks.find(index[None])
        blocks.distance[rows] += rng.normal(scale=0.02, size=(1, SIDE**3))
        blocks.touch(rows, 2)
        looked_at = mesher.update()
        assert looked_at == np.prod(np.minimum(index + 1, 2))  # with those below
        mesh = mesher.mesh()
        assert as_triangles(mesh) == as_triangles(mesh_of(blocks))
        assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)
    assert mesher.update() == 0


def test_a_block_that_comes_later_closes_the_gap_and_one_that_leaves_opens_it():
    distance, _ = sphere((16, 16, 16), 0.6)
    whole = blocks_of(distance)
    missing = whole.copied(whole.find([[1, 1, 2]]))
    whole.remove(whole.find([[1, 1, 2]]))
    mesher = Mesher(whole)
    mesher.update()
    open_mesh = mesher.mesh()
    found = set(sides(open_mesh))
    assert any((b, a) not in found for a, b in found)
    whole.insert(missing)
    mesher.update()
    assert_closed(mesher.mesh())
    whole.remove(whole.find([[1, 1, 2]]))
    mesher.update()
    assert len(mesher.mesh()) < len(open_mesh) + 400
    assert int(block_keys(np.array([1, 1, 2]))) not in set(mesher.keys())


@pytest.mark.parametrize('weight', [0.0, 1e-5])
def test_voxels_that_were_not_observed_well_enough_have_no_surface(weight):
    distance, _ = sphere((16, 16, 16), 0.6)
    weights = np.where(centers((16, 16, 16))[..., 0] < 0.8, 1.0, weight)
    mesh = mesh_of(blocks_of(distance, weight=weights))
    assert len(mesh)
    assert mesh.vertices[:, 0].max() <= 0.75
    assert len(mesh_of(blocks_of(distance, weight=0.0))) == 0


def test_free_space_beside_a_shadow_has_no_surface_between_them():
    # Behind a wall at x = 0.42 the field falls to -0.25 m, in the shadow of its half y < 0.4;
    # beside the shadow it is free, +0.3 m.
    places = centers((8, 8, 8))
    wall = np.clip(0.42 - places[..., 0], -0.25, 0.3)
    distance = np.where(places[..., 1] < 0.4, wall, 0.3)
    torn, whole = (mesh_of(blocks_of(distance, truncation_m=tau_m)) for tau_m in (0.3, 0.51))
    assert whole.vertices[:, 0].max() == pytest.approx(0.75)
    assert torn.vertices[:, 0].max() <= 0.55  # as deep as half a voxel and the cube's edge
    in_front = np.isclose(torn.vertices[:, 0], 0.42)
    assert in_front.sum() > 20


def test_without_blocks_there_is_no_mesh():
    mesh = mesh_of(BlockMap(TsdfConfig()))
    assert (len(mesh), mesh.vertices.shape, mesh.triangles.shape) == (0, (0, 3), (0, 3))


def test_colours_are_mixed_along_the_edge():
    distance = np.broadcast_to(np.arange(8.0)[:, None, None] - 3.25, (8, 8, 8)) * 0.1
    color = np.zeros((8, 8, 8, 3))
    color[3], color[4] = [200.0, 100.0, 0.0], [40.0, 100.0, 80.0]
    mesh = mesh_of(blocks_of(distance.astype(np.float32), color=color))
    assert mesh.colors.shape == mesh.vertices.shape
    # a quarter of the way from voxel 3 to 4
    assert np.abs(mesh.vertices[:, 0] - 0.375).max() <= 1e-7
    assert set(map(tuple, mesh.colors.tolist())) == {(160, 100, 20)}
