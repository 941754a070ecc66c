# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A dataset of tiles is the map, whole or as before it was written."""

import shutil

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.parquet import read_map, write_map
from surfel_mapper.files.parquet_tiles import (
    dataset_in,
    read_tiles,
    Tile,
    TILE_BITS,
    tiles_in,
    write_tiles,
)
from surfel_mapper.mapping.moments import pack_keys, ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from test import extras

pytestmark = extras.needs('pyarrow')


def scattered(num=4000, seed=1, voxel_size_m=0.5, columns=()):
    """Return a map whose points lie in several tiles on both sides of the origin."""
    rng = np.random.default_rng(seed)
    surfel_map = SurfelMap(voxel_size_m, columns=columns)
    points = rng.normal(0.0, [150.0, 100.0, 5.0], (num, 3)) * voxel_size_m / 0.5
    points = np.concatenate([points, points + 0.01])
    intensity = rng.uniform(0.0, 255.0, len(points))
    surfel_map.add(points, origin=[0.0, 0.0, 3.0], columns={'intensity': intensity})
    return surfel_map


def dataset(directory, surfel_map):
    write_tiles(directory / 'map', surfel_map)
    return directory / 'map'


@pytest.fixture(scope='module')
def written(tmp_path_factory):
    """Return a scattered map and its dataset, not to be changed."""
    surfel_map = scattered()
    return surfel_map, dataset(tmp_path_factory.mktemp('tiles'), surfel_map)


@pytest.fixture(scope='module')
def with_intensity(tmp_path_factory):
    """Return the same with a column."""
    surfel_map = scattered(columns=('intensity',))
    return surfel_map, dataset(tmp_path_factory.mktemp('tiles'), surfel_map)


@pytest.mark.parametrize('which', ['written', 'with_intensity'])
def test_a_dataset_is_read_as_the_map_it_is(request, tmp_path, which):
    surfel_map, directory = request.getfixturevalue(which)

    assert dataset_in(tmp_path) is None
    assert dataset_in(directory.parent) == dataset_in(directory) == directory
    assert read_tiles(directory).digest() == surfel_map.digest()
    with pytest.raises(FileFormatError, match='voxel'):
        read_tiles(directory, voxel_size_m=0.2)


def test_the_tiles_of_a_map_are_squares_and_together_the_map(written):
    surfel_map, directory = written
    again, most = SurfelMap(0.5), 0

    for tile, path in tiles_in(directory).items():
        part = read_map(path)  # which checks the digest of the tile
        index = part.moments().voxel_index
        assert (index[:, :2] >> TILE_BITS == tile).all()
        again.merge(part)
        most = max(most, len(part))

    assert again == surfel_map
    assert most < len(surfel_map) / 2


def test_other_tools_read_a_dataset_by_tile(written):
    from pyarrow import dataset as arrow_dataset

    surfel_map, directory = written

    table = arrow_dataset.dataset(directory, partitioning='hive').to_table()
    index = np.stack([table.column(name).to_numpy() for name in 'ijk'], axis=1)
    order = np.argsort(pack_keys(index))
    moments = surfel_map.moments()
    np.testing.assert_array_equal(index[order], moments.voxel_index)
    np.testing.assert_array_equal(table.column('num_points').to_numpy()[order], moments.count)
    np.testing.assert_array_equal(table.column('tile_i').to_numpy(), index[:, 0] >> TILE_BITS)


def test_voxels_at_the_corners_of_space_have_tiles_too(tmp_path):
    far = 2**20 - 1
    index = np.array([[-far - 1, far, 0], [far, -far - 1, far], [0, -1, 0], [-1, 0, 0]])
    num = len(index)
    surfel_map = SurfelMap(0.5)
    surfel_map.insert(
        ScanMoments(
            voxel_size_m=0.5,
            key=np.sort(pack_keys(index)),
            count=np.ones(num, np.int64),
            total=np.zeros((num, 3), np.int64),
            product=np.zeros((num, 6), np.int64),
            view=np.zeros((num, 3), np.int64),
        )
    )
    directory = dataset(tmp_path, surfel_map)
    assert read_tiles(directory).digest() == surfel_map.digest()
    assert Tile(-1, 0) in tiles_in(directory)


def test_an_empty_map_has_no_tiles(tmp_path):
    assert not dataset(tmp_path, SurfelMap(0.5)).exists()


def test_a_directory_without_tiles_and_tiles_of_two_maps_are_refused(written, tmp_path):
    with pytest.raises(FileFormatError, match='no tiles of a map'):
        read_tiles(tmp_path)
    first = shutil.copytree(written[1], tmp_path / 'map')
    other = SurfelMap(0.2)
    other.add(np.full((3, 3), 900.0))
    path = first / Tile(99, 99).path
    path.parent.mkdir(parents=True)
    write_map(path, other)
    with pytest.raises(FileFormatError, match='voxel'):
        read_tiles(first)


def test_an_earlier_dataset_is_replaced_and_something_else_is_left_alone(tmp_path):
    for seed in (1, 2):
        surfel_map = scattered(seed=seed)
        directory = dataset(tmp_path, surfel_map)
    assert read_tiles(directory) == surfel_map
    assert [*tmp_path.iterdir()] == [directory]
    (directory / 'thesis.txt').write_text('mine')
    with pytest.raises(FileFormatError, match='holds something else'):
        write_tiles(directory, surfel_map)


@pytest.mark.parametrize('damage', ['empty', 'cut'])
def test_a_damaged_tile_is_refused_by_name(written, tmp_path, damage):
    path = next(iter(tiles_in(shutil.copytree(written[1], tmp_path / 'map')).values()))
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2 if damage == 'cut' else 0])
    with pytest.raises(FileFormatError, match=str(path)):
        read_tiles(tmp_path / 'map')
