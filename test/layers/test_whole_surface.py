# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Mesh and file of a drive from its archive, region by region: those of all blocks in one map."""

from functools import partial

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files import tsdf_archive
from surfel_mapper.files.mesh_ply import write_mesh_parts
from surfel_mapper.files.tsdf_archive import BlockArchive
from surfel_mapper.files.tsdf_state import save_tsdf, save_tsdf_parts
from surfel_mapper.layers.distance_field import whole_surface
from surfel_mapper.layers.distance_field.layer import cleared
from surfel_mapper.layers.distance_field.whole_surface import merged_parts, surface_parts
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.mesh import Mesher, together
from test.tsdf.test_mesh import SIDE, write


@pytest.fixture(autouse=True)
def small_regions(monkeypatch):
    monkeypatch.setattr(tsdf_archive, 'REGION', 2)
    monkeypatch.setattr(whole_surface, 'REGION', 2)
    monkeypatch.setattr(tsdf_archive, 'CHUNK', 40)


def hilly(config, shape=(9, 6, 5), first=(-4, -3, -2)):
    """Return a map of a surface through many blocks, with colours and labels."""
    rng = np.random.default_rng(5)
    blocks = BlockMap(config)
    size = np.array(shape) * SIDE
    x, y, z = (np.arange(n) for n in size)
    height = 10.0 + 3.0 * np.sin(0.3 * x)[:, None] + 4.0 * np.cos(0.23 * y)[None]
    distance = np.clip(0.1 * (z[None, None] - height[..., None]), -0.3, 0.3)
    distance += rng.normal(0.0, 0.005, distance.shape)
    write(blocks, distance.astype(np.float32), first)
    rows = blocks.rows()
    blocks.color[rows, :3] = rng.uniform(0.0, 255.0, (len(rows), 3, SIDE**3)).astype(np.float32)
    blocks.color[rows, 3] = 1.0
    blocks.votes[rows] = rng.integers(0, 5, (len(rows), *blocks.votes.shape[1:]))
    return blocks


def config(**settings):
    return TsdfConfig(
        voxel_size_m=0.1,
        voxels_per_side=SIDE,
        truncation_m=0.3,
        color=True,
        semantics='majority',
        num_labels=3,
        **settings,
    )


def archived(tmp_path, blocks, *, stay=0.3, twice=0.2):
    """Move most blocks into an archive, some of them in two visits; return it."""
    rng = np.random.default_rng(1)
    archive = BlockArchive(tmp_path / 'archive')
    rows = rng.permutation(blocks.rows())
    archive.add(blocks.copied(rows[: int(twice * len(rows))]))
    for part in np.array_split(rows[int(stay * len(rows)) :], 9):
        archive.add(blocks.remove(part))
    return archive


def corners(mesh):
    """Return the triangles by coordinates, colours and labels of their corners, sorted."""
    vertices = np.column_stack([mesh.vertices, mesh.colors, mesh.labels])
    table = vertices[mesh.triangles].reshape(len(mesh), -1)
    return table[np.lexsort(table.T)]


def test_parts_are_the_mesh_of_all_blocks(tmp_path):
    blocks = hilly(config())
    archive = archived(tmp_path, blocks)
    together_in_memory = BlockMap(blocks.config)
    for part in archive:
        together_in_memory.merge(part)
    together_in_memory.merge(blocks.copied(blocks.rows()))
    mesher = Mesher(together_in_memory)
    mesher.update()
    expected = mesher.mesh()
    parts = list(surface_parts(blocks, archive))
    found = together(parts)
    assert len(expected) > 1000
    assert len(parts) > 8
    np.testing.assert_array_equal(corners(found), corners(expected))
    assert len(found.vertices) == len(expected.vertices)  # welded between regions


def test_memory_holds_one_region(tmp_path, monkeypatch):
    blocks = hilly(config())
    archive = archived(tmp_path, blocks, stay=0.0)
    sizes = []
    update = Mesher.update
    monkeypatch.setattr(
        Mesher, 'update', lambda one: sizes.append(one._blocks.num_blocks) or update(one)
    )
    list(surface_parts(blocks, archive))
    assert max(sizes) <= 3**3  # 2^3 of its own, and the borders of the regions above


def test_field_without_blocks_has_an_empty_mesh(tmp_path):
    (part,) = surface_parts(BlockMap(config()), BlockArchive(tmp_path))
    assert len(part) == 0


def test_written_parts_read_as_one_mesh(tmp_path):
    plyfile = pytest.importorskip('plyfile')
    blocks = hilly(config())
    archive = archived(tmp_path, blocks)
    parts = list(surface_parts(blocks, archive))
    write_mesh_parts(tmp_path / 'mesh.ply', iter(parts), (10.0, 20.0, 30.0))
    read = plyfile.PlyData.read(str(tmp_path / 'mesh.ply'))
    expected = together(parts)
    vertex = read['vertex']
    np.testing.assert_array_equal(
        np.column_stack([vertex['x'], vertex['y'], vertex['z']]),
        expected.vertices + np.array([10.0, 20.0, 30.0]),
    )
    np.testing.assert_array_equal(vertex['label'], expected.labels)
    np.testing.assert_array_equal(np.vstack(read['face']['vertex_indices']), expected.triangles)


def test_damaged_archive_leaves_the_old_mesh(tmp_path):
    blocks = hilly(config())
    archive = archived(tmp_path, blocks)
    files = sorted((tmp_path / 'archive').rglob('*.npz'))
    files[len(files) // 2].write_bytes(b'rubbish')
    target = tmp_path / 'mesh.ply'
    target.write_bytes(b'old')
    with pytest.raises(FileFormatError, match=r'\.npz'):
        write_mesh_parts(target, surface_parts(blocks, archive))
    assert target.read_bytes() == b'old'
    assert sorted(path.name for path in tmp_path.iterdir()) == ['archive', 'mesh.ply']


@pytest.mark.parametrize('chunk', [40, 10**6])
def test_cleared_region_of_the_archive_stays_clear_and_later_blocks_come_in(
    tmp_path, monkeypatch, chunk
):
    monkeypatch.setattr(tsdf_archive, 'CHUNK', chunk)
    blocks = hilly(config())
    whole = blocks.copied(blocks.rows())
    archive = archived(tmp_path, blocks, stay=0.0)
    settings = blocks.config

    def contains(points):
        return points[:, 0] < 0.55

    archive.edit(lambda part: cleared(part, config=settings, contains=contains))
    left = together(list(surface_parts(BlockMap(settings), archive)))
    assert left.vertices[:, 0].min() >= 0.55
    first = whole.part(np.flatnonzero(whole.index[:, 0] == -4))
    archive.add(first)  # the place is visited again
    again = together(list(surface_parts(BlockMap(settings), archive)))
    assert -1.6 < again.vertices[:, 0].min() < -1.4
    assert not ((again.vertices[:, 0] > -1.1) & (again.vertices[:, 0] < 0.55)).any()


@pytest.mark.parametrize('stay', [0.0, 0.3])
def test_saved_archive_is_the_file_of_all_blocks_in_memory(tmp_path, stay):
    blocks = hilly(config())
    archive = archived(tmp_path, blocks, stay=stay)
    together_in_memory = BlockMap(blocks.config)
    for part in archive:
        together_in_memory.merge(part)
    together_in_memory.merge(blocks.copied(blocks.rows()))
    save_tsdf(tmp_path / 'memory.npz', together_in_memory)
    parts = partial(merged_parts, blocks, archive)
    save_tsdf_parts(tmp_path / 'disk.npz', blocks.config, parts)
    assert (tmp_path / 'disk.npz').read_bytes() == (tmp_path / 'memory.npz').read_bytes()
    assert len(np.load(tmp_path / 'disk.npz')['index']) > 200
