# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The distance field of a mapper is saved, loaded, archived and cleared with its map."""

import os

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.parquet_tiles import write_tiles
from surfel_mapper.files.ply import read_points
from surfel_mapper.pipeline.checkpoints import Checkpoints, load_start
from surfel_mapper.pipeline.regions import Box
from surfel_mapper.pipeline.saved_state import load_mapper, save_mapper
from surfel_mapper.ros.map_files import load_map, save_map
from test import extras
from test.layers.test_distance_field import insert, mapper_with, RAYS


def field_of(mapper):
    blocks = mapper.tsdf.blocks
    rows = blocks.rows()
    rows = rows[np.lexsort(blocks.index(rows).T)]
    return blocks.copied(rows)


def assert_same_field(found, expected):
    np.testing.assert_array_equal(found.index, expected.index)
    np.testing.assert_array_equal(found.field, expected.field)
    np.testing.assert_array_equal(found.stamp_ns, expected.stamp_ns)


def test_a_saved_field_comes_back_with_its_map_and_continues(tmp_path):
    settings = {'output.directory': str(tmp_path)}
    mapper, other = mapper_with(**settings), mapper_with(**settings)
    insert(mapper, 1)
    answer = save_map(mapper)
    assert 'map.tsdf.npz' in answer
    insert(other, 1, (30.0, 0.0, 0.0))
    load_map(other, '')
    assert other.map.digest() == mapper.map.digest()
    assert_same_field(field_of(other), field_of(mapper))
    for one in (mapper, other):
        insert(one, 2, (1.0, 0.0, 0.0))
    assert_same_field(field_of(other), field_of(mapper))


def test_a_map_without_a_field_leaves_an_empty_one(tmp_path):
    plain = mapper_with(**{'layers.tsdf.enabled': False})
    insert(plain, 1)
    save_mapper(tmp_path / 'map.npz', plain)
    mapper = mapper_with()
    insert(mapper, 1)
    load_mapper(tmp_path, mapper)
    assert (mapper.map.num_voxels > 0, mapper.tsdf.blocks.num_blocks) == (True, 0)


def test_the_field_of_an_earlier_run_is_not_loaded_with_newer_tiles(tmp_path):
    extras.load('pyarrow')
    mapper, later = mapper_with(), mapper_with()
    insert(mapper, 1)
    save_mapper(tmp_path / 'map.npz', mapper)
    os.utime(tmp_path / 'map.npz', ns=(0, 0))
    insert(later, 1, (30.0, 0.0, 0.0))
    write_tiles(tmp_path / 'map', later.map)
    load_mapper(tmp_path, mapper)
    assert mapper.map.digest() == later.map.digest()
    assert mapper.tsdf.blocks.num_blocks == 0


def test_a_damaged_or_different_field_changes_nothing(tmp_path):
    mapper = mapper_with()
    insert(mapper, 1)
    save_mapper(tmp_path / 'map.npz', mapper)
    other = mapper_with(**{'layers.tsdf.voxel_size_m': 0.25})
    insert(other, 1, (3.0, 0.0, 0.0))
    before, digest = field_of(other), other.map.digest()
    with pytest.raises(FileFormatError, match='voxel_size_m'):
        load_mapper(tmp_path / 'map.npz', other)
    (tmp_path / 'map.tsdf.npz').write_bytes(b'no')
    with pytest.raises(FileFormatError):
        load_mapper(tmp_path / 'map.npz', other)
    assert_same_field(field_of(other), before)
    assert other.map.digest() == digest


@pytest.mark.parametrize('start', ['latest', 'file'])
def test_a_checkpoint_and_map_load_have_the_field(tmp_path, start):
    settings = {'output.directory': str(tmp_path)}
    mapper = mapper_with(**settings)
    checkpoints = Checkpoints(mapper)
    insert(mapper, 1)
    checkpoints.save()
    insert(mapper, 2, (1.0, 0.0, 0.0))
    newest = checkpoints.save()
    load = 'latest' if start == 'latest' else str(newest)
    other = mapper_with(**settings, **{'map.load': load})
    load_start(other)
    assert_same_field(field_of(other), field_of(mapper))


def test_a_cleared_region_is_unknown_in_the_field():
    mapper = mapper_with()
    insert(mapper, 1)
    field = mapper.tsdf.field
    places = np.array([[5.0, 0.3, 0.3], [-5.0, 0.3, 0.3], [4.9, 0.3, 0.1]])
    assert np.isfinite(field.sample(places)).all()
    blocks_before, mesh = len(field), len(field.mesh())
    mapper.clear_region(Box((2.0, -3.0, -3.0), (8.0, 3.0, 3.0)))
    assert np.isnan(field.sample(places)).tolist() == [True, False, True]
    assert len(field) < blocks_before
    assert 0 < len(field.mesh()) < mesh
    assert not (
        (field.mesh().vertices > [2.2, -2.8, -2.8]).all(axis=1)
        & (field.mesh().vertices < [8.0, 2.8, 2.8]).all(axis=1)
    ).any()


def test_labels_of_points_colour_the_mesh_and_are_in_the_file(tmp_path):
    mapper = mapper_with(
        **{
            'layers.tsdf.semantics': 'single',
            'layers.tsdf.dynamic_labels': [3.0],
        }
    )
    y = RAYS.reshape(-1, 3)[:, 1]
    labels = np.select([y > 0.5, y > 0.0, y > -0.5], [1, 2, -1], 3).astype(np.int32)
    insert(mapper, 1, label=labels)
    mesh = mapper.tsdf.mesh()
    deep = np.abs(mesh.vertices[:, 1] / 5.0)
    for low, high, label in ((0.55, 1.0, 1), (0.05, 0.45, 2)):
        part = (mesh.vertices[:, 1] / 5.0 > low) & (deep < high)
        assert part.sum() > 100
        assert set(mesh.labels[part].tolist()) == {label}
    known = (mesh.vertices[:, 1] < -0.25) & (mesh.vertices[:, 1] > -2.25)
    assert set(mesh.labels[known].tolist()) == {-1}
    assert mesh.vertices[:, 1].min() > -2.7  # moving objects leave no surface
    pairs = np.unique(np.column_stack([mesh.labels, mesh.colors]), axis=0)
    assert len(pairs) == len(np.unique(mesh.labels)) == 3
    mapper.tsdf.write(tmp_path, ())
    np.testing.assert_array_equal(read_points(tmp_path / 'mesh.ply')['label'], mesh.labels)
