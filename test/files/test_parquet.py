# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A map comes back from Parquet exactly, pyarrow reads its rows, damage is refused."""

import json

import numpy as np
import pytest

from surfel_mapper import SurfelMap
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.parquet import METADATA, read_map, write_map
from test import extras

pa = extras.load('pyarrow')
pq = extras.load('pyarrow.parquet')


def some_map(columns=(), voxel_size_m=0.5):
    rng = np.random.default_rng(7)
    surfel_map = SurfelMap(voxel_size_m, columns=columns)
    points = rng.uniform(-6.0, 6.0, (4000, 3)) * [1.0, 1.0, 0.05] + [1e4, -2e4, 0.0]
    values = {'intensity': rng.uniform(0, 255, 4000), 'rgb': rng.integers(0, 256, (4000, 3))}
    surfel_map.add(points, origin=[1e4, -2e4, 3.0], columns=values)
    return surfel_map


@pytest.mark.parametrize('columns', [(), ('intensity',), ('intensity', 'rgb')])
def test_a_map_comes_back_with_the_same_digest(tmp_path, columns):
    surfel_map = some_map(columns)

    digest = write_map(tmp_path / 'map.parquet', surfel_map)
    found = read_map(tmp_path / 'map.parquet', voxel_size_m=0.5)

    assert digest == surfel_map.digest() == found.digest()
    assert found.columns == columns


def test_a_coarse_map_and_an_empty_one_come_back(tmp_path):
    for surfel_map in (some_map().coarsen(2), SurfelMap(0.3)):
        write_map(tmp_path / 'map.parquet', surfel_map)
        found = read_map(tmp_path / 'map.parquet')
        assert found.digest() == surfel_map.digest()
        assert (found.voxel_size_m, found.level) == (surfel_map.voxel_size_m, surfel_map.level)


def test_pyarrow_reads_the_surfels_as_the_map_has_them(tmp_path):
    surfel_map = some_map()
    write_map(tmp_path / 'map.parquet', surfel_map)

    rows = pq.read_table(tmp_path / 'map.parquet').to_pydict()

    surfels = surfel_map.surfels()
    by_voxel = {tuple(index): row for row, index in enumerate(surfels.voxel_index.tolist())}
    order = [by_voxel[index] for index in zip(rows['i'], rows['j'], rows['k'], strict=True)]
    assert sorted(order) == list(range(len(surfels)))
    for axis, name in enumerate('xyz'):
        np.testing.assert_array_equal(rows[name], surfels.position[order, axis])
        normal = surfels.normal[order, axis].astype(np.float32)
        np.testing.assert_array_equal(np.float32(rows[f'n{name}']), normal)
    np.testing.assert_array_equal(rows['num_points'], surfels.num_points[order])
    planarity = surfels.planarity[order].astype(np.float32)
    np.testing.assert_array_equal(np.float32(rows['planarity']), planarity)
    moments = surfel_map.moments()
    np.testing.assert_array_equal(rows['sum_xy'], moments.product[:, 1])
    np.testing.assert_array_equal(rows['view_z'], moments.view[:, 2])


def changed(path, change):
    """Write a file again with changed columns or attributes."""
    table = pq.read_table(path)
    columns, attributes = table.to_pydict(), json.loads(table.schema.metadata[METADATA])
    change(columns, attributes)
    types = {name: table.schema.field(name).type for name in columns}
    again = pa.table({name: pa.array(columns[name], type_) for name, type_ in types.items()})
    pq.write_table(again.replace_schema_metadata({METADATA: json.dumps(attributes)}), path)


CHANGES = {
    'a count': lambda columns, _: columns['num_points'].__setitem__(0, 10**6),
    'a sum': lambda columns, _: columns['sum_xx'].__setitem__(3, 5),
    'a missing value': lambda columns, _: columns['sum_x'].__setitem__(3, None),
    'a voxel twice': lambda columns, _: [columns[n].__setitem__(1, columns[n][0]) for n in 'ijk'],
    'a voxel beyond the map': lambda columns, _: columns['i'].__setitem__(1, 2**30),
    'no points': lambda columns, _: columns['num_points'].__setitem__(1, 0),
    'a column missing': lambda columns, _: columns.pop('view_x'),
    'a row missing': lambda columns, _: [values.pop() for values in columns.values()],
    'another digest': lambda _, attributes: attributes.update(digest='0'),
    'a later version': lambda _, attributes: attributes.update(version=2),
    'another kind': lambda _, attributes: attributes.update(kind='mesh'),
    'a voxel size of nothing': lambda _, attributes: attributes.update(voxel_size_m=0.0),
    'a voxel size of text': lambda _, attributes: attributes.update(voxel_size_m='a'),
    'unknown columns': lambda _, attributes: attributes.update(columns=['smell']),
    'nothing of itself': lambda _, attributes: attributes.clear(),
}


@pytest.mark.parametrize('change', CHANGES.values(), ids=CHANGES)
def test_a_file_that_was_changed_is_refused(tmp_path, change):
    write_map(tmp_path / 'map.parquet', some_map())
    changed(tmp_path / 'map.parquet', change)

    with pytest.raises(FileFormatError, match=r'map\.parquet: '):
        read_map(tmp_path / 'map.parquet')


def test_another_parquet_file_is_refused(tmp_path):
    pq.write_table(pa.table({'x': [1.0]}), tmp_path / 'map.parquet')

    with pytest.raises(FileFormatError, match='but not a map of surfel_mapper'):
        read_map(tmp_path / 'map.parquet')


def test_another_voxel_size_than_asked_for_is_refused(tmp_path):
    write_map(tmp_path / 'map.parquet', some_map())

    with pytest.raises(FileFormatError, match=r'voxel size 0.5 m, expected .* = 0.2 m'):
        read_map(tmp_path / 'map.parquet', voxel_size_m=0.2)


def test_quality_is_in_the_file_and_numbers_of_scans_come_back(tmp_path):
    path, surfel_map = tmp_path / 'map.parquet', some_map()
    surfel_map.add(surfel_map.surfels().position[:50])
    write_map(path, surfel_map)
    rows, surfels = pq.read_table(path), surfel_map.surfels(covariance=True)
    order = np.lexsort(surfels.voxel_index.T[::-1])

    assert set(rows['num_scans'].to_pylist()) == {1, 2}
    moments = surfel_map.moments()
    np.testing.assert_array_equal(read_map(path).moments().num_scans, moments.num_scans)
    for name, values in surfels.to_pandas().items():
        if name in ('thickness', 'normal_sigma', 'radius', 'size') or name.startswith('cov_'):
            np.testing.assert_array_equal(rows[name], values.to_numpy()[order].astype(np.float32))

    pq.write_table(rows.drop(['num_scans']), path)
    with pytest.raises(FileFormatError, match='num_scans'):
        read_map(path)
