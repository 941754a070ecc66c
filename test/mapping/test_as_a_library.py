# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Maps and surfels as Python objects: files, pickles, rows, tables; and mistakes by kind."""

from __future__ import annotations

import copy
import pickle
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfel_mapper import (
    Config,
    diff,
    estimate_normals,
    load_config,
    Mapper,
    replay,
    Scan,
    SlidingWindow,
    SurfelMap,
    Surfels,
    Trajectory,
)
from surfel_mapper.errors import ConfigError, DependencyError, FileFormatError, MapError
from test import extras

ORIGIN = [1.0, 1.0, 3.0]


def floor(number=5000, seed=1, height=0.1):
    rng = np.random.default_rng(seed)
    return rng.uniform([0.0, 0.0, height], [4.0, 4.0, height + 0.02], (number, 3))


@pytest.fixture
def surfel_map():
    found = SurfelMap(0.5, columns=('intensity',))
    points = floor()
    found.add(points, origin=ORIGIN, columns={'intensity': points[:, 0].astype(np.float32)})
    return found


@pytest.mark.parametrize('name', ['map.npz', 'map.parquet'])
def test_maps_are_saved_and_loaded_exactly(surfel_map, tmp_path, name):
    if name.endswith('parquet'):
        extras.load('pyarrow')
    assert surfel_map.save(str(tmp_path / name)) == surfel_map.digest()
    assert SurfelMap.load(str(tmp_path / name)) == surfel_map
    if name == 'map.npz':
        assert SurfelMap.load(tmp_path) == surfel_map


@pytest.mark.parametrize('name', ['map.ply', 'map.pcd'])
def test_surfels_are_saved_but_no_map_is_loaded_from_them(surfel_map, tmp_path, name):
    surfel_map.save(tmp_path / name)
    with pytest.raises(FileFormatError, match=r'surfels without their moments.*\.npz or'):
        SurfelMap.load(tmp_path / name)
    with pytest.raises(FileFormatError, match=r'map\.txt: expected a file ending in \.npz'):
        surfel_map.save(tmp_path / 'map.txt')


@pytest.mark.parametrize(
    'clone', [copy.copy, copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))]
)
@pytest.mark.parametrize('level', [0, 1])
def test_copies_and_pickles_are_equal_and_independent(surfel_map, clone, level):
    original = surfel_map.coarsen(level)
    original.origin_m = (512.0, 0.0, 1024.0)
    other = clone(original)
    assert other == original
    assert other.level == level
    assert other.columns == ('intensity',)
    other.clear()
    assert original.num_points == 5000


def test_surfels_are_pickled(surfel_map):
    surfels = surfel_map.surfels()
    other = pickle.loads(pickle.dumps(surfels))
    np.testing.assert_array_equal(other.to_numpy(), surfels.to_numpy())


def test_representations_are_short(surfel_map):
    assert repr(surfel_map) == 'SurfelMap(0.5 m: 5,000 points in 64 voxels)'
    assert repr(surfel_map.coarsen(1)) == 'SurfelMap(1 m, level 1: 5,000 points in 16 voxels)'
    assert repr(surfel_map.surfels()).startswith('Surfels(64, from [0.')
    assert repr(SurfelMap().surfels()) == 'Surfels(0)'


def test_surfels_are_a_sequence(surfel_map):
    surfels = surfel_map.surfels()
    each = list(surfels)
    assert len(each) == len(surfels) == 64
    for row in (0, 63, np.int64(5)):
        one = surfels[row]
        np.testing.assert_array_equal(one.position, surfels.position[row])
        assert one.num_points == surfels.num_points[row]
        assert one.voxel_index == tuple(surfels.voxel_index[row])
        assert one.planarity == each[row].planarity
    chosen = surfels[surfels.num_points > 70]
    assert isinstance(chosen, Surfels)
    assert len(chosen) == (surfels.num_points > 70).sum()
    np.testing.assert_array_equal(surfels[2:5].position, surfels.position[2:5])
    np.testing.assert_array_equal(surfels[[4, 1]].position, surfels.position[[4, 1]])
    assert len(surfels[[]]) == len(surfels.select(np.zeros(64, bool))) == 0
    np.testing.assert_array_equal(
        surfels[2:5].channels['intensity'], surfels.channels['intensity'][2:5]
    )


def test_rows_beyond_the_surfels_are_refused(surfel_map):
    surfels, index = surfel_map.surfels(), surfel_map.index()
    nowhere = index.at([[100.0, 0.0, 0.0]])
    for rows in (nowhere, int(nowhere[0]), [0, -1]):
        with pytest.raises(IndexError, match='at returns -1 for a voxel without surfel'):
            surfels[rows]
    with pytest.raises(IndexError):
        surfels[64]


def test_tables_have_every_column(surfel_map):
    surfels = surfel_map.surfels()
    table = surfels.to_numpy()
    assert table.shape == (64,)
    np.testing.assert_array_equal(table['x'], surfels.position[:, 0])
    np.testing.assert_array_equal(table['normal_z'], surfels.normal[:, 2])
    np.testing.assert_array_equal(table['e2'], surfels.eigenvalues[:, 2])
    np.testing.assert_array_equal(table['k'], surfels.voxel_index[:, 2])
    np.testing.assert_array_equal(table['intensity'], surfels.channels['intensity'])


def test_pandas_has_the_same_columns(surfel_map):
    extras.load('pandas')
    surfels = surfel_map.surfels()
    frame = surfels.to_pandas()
    assert tuple(frame.columns) == surfels.to_numpy().dtype.names
    np.testing.assert_array_equal(frame['num_points'], surfels.num_points)


def test_open3d_has_points_and_normals(surfel_map):
    pytest.importorskip('open3d')
    surfels = surfel_map.surfels()
    cloud = surfels.to_open3d()
    np.testing.assert_array_equal(np.asarray(cloud.points), surfels.position)
    np.testing.assert_array_equal(np.asarray(cloud.normals), surfels.normal)


@pytest.mark.parametrize('package', ['pandas', 'open3d'])
def test_missing_packages_are_named(surfel_map, monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(DependencyError, match=f'pip install {package}'):
        getattr(surfel_map.surfels(), f'to_{package}')()


def test_a_scan_is_added_at_a_pose():
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler('xyz', [0.1, -0.2, 0.7]).as_matrix()
    T[:3, 3] = [4.0, 5.0, 2.0]
    points = floor() - [2.0, 2.0, 1.0]
    posed, expected = SurfelMap(0.5), SurfelMap(0.5)
    expected.insert(expected.reduce(points, T, origin=T[:3, 3]))

    moments = posed.add(points, T_map_sensor=T.tolist())

    assert posed == expected
    posed.remove(moments)
    assert posed.num_points == 0


def test_diff_finds_new_lost_and_turned_surfels():
    rng = np.random.default_rng(2)
    before, after = SurfelMap(1.0), SurfelMap(1.0)
    same = rng.uniform([0.0, 0.0, 0.1], [1.0, 1.0, 0.12], (200, 3))
    level = rng.uniform([3.0, 0.0, 0.4], [4.0, 1.0, 0.42], (200, 3))
    upright = rng.uniform([3.4, 0.0, 0.0], [3.42, 1.0, 1.0], (200, 3))
    for each, parts in (
        (before, [same, level, same + np.array([0, 5, 0])]),
        (after, [same, upright, same + 9]),
    ):
        for part in parts:
            each.add(part)

    found = diff(before, after)

    assert found.came.voxel_index.tolist() == [[9, 9, 9]]
    assert found.went.voxel_index.tolist() == [[0, 5, 0]]
    assert found.turned.voxel_index.tolist() == [[3, 0, 0]]
    assert found.num_same == 2
    assert str(found) == '1 surfel came, 1 went, 1 turned; voxels with one in both: 2'
    assert str(diff(before, before.copy())) == 'equal to the bit'
    with pytest.raises(MapError, match='voxel size 1 m, level 0, and 2 m, level 1'):
        diff(before, before.coarsen(1))
    with pytest.raises(TypeError, match='a ndarray, expected two SurfelMaps'):
        diff(before, same)


@pytest.mark.parametrize('shift', [np.zeros(3), np.array([4e5, 5.4e6, 250.0])])
def test_normals_of_a_cloud_are_those_of_its_planes(shift):
    rng = np.random.default_rng(3)
    normal = np.array([0.6, 0.0, 0.8])
    across = np.array([[0.8, 0.0, -0.6], [0.0, 1.0, 0.0]])
    points = rng.uniform(-3.0, 3.0, (2000, 2)) @ across - 5.0 * normal + shift
    points[7], points[11] = np.nan, np.inf

    found = estimate_normals(points, viewpoint=shift)

    assert found.shape == (2000, 3)
    assert np.isnan(found[[7, 11]]).all()
    rest = np.delete(found, [7, 11], axis=0)
    np.testing.assert_allclose(rest, np.tile(normal, (1998, 1)), atol=1e-6)
    np.testing.assert_allclose(np.abs(estimate_normals(points, viewpoint=None)[0] @ normal), 1.0)
    assert estimate_normals(np.full((3, 3), np.nan)).shape == (3, 3)
    with pytest.raises(ValueError, match='viewpoint'):
        estimate_normals(points, viewpoint=[1.0, np.nan, 0.0])


POINTS = floor(10)

POSES = Trajectory.from_matrices(
    [[[1, 0, 0, i], [0, 1, 0, 2 * i], [0, 0, 1, 3], [0, 0, 0, 1]] for i in range(3)],
    np.arange(3) * 10**9,
)

MISTAKES = {
    'a word for points of an index': (
        lambda m: m.index().at('here'),
        ValueError,
        "points: 'here', expected numbers",
    ),
    'a list of bags': (lambda _: replay(['a', 'b']), TypeError, 'path: .*expected a str or Path'),
    'a dict for a file of settings': (
        lambda _: load_config({'map': 1}),
        ConfigError,
        'a dict, expected a str or Path of a YAML file; Config.from_mapping',
    ),
    'a matrix for a pose': (
        lambda _: Mapper().add_pose('odom', 'base_link', 1, np.eye(4)),
        TypeError,
        r'\(4, 4\) for the position and no orientation.*Trajectory.from_matrices',
    ),
    'a matrix for a frame': (
        lambda _: Mapper().add_pose(np.eye(4), 'base_link', 1, [0, 0, 0], [0, 0, 0, 1]),
        TypeError,
        'parent: a ndarray, expected the name of a frame',
    ),
    'a length for the settings of a window': (
        lambda m: SlidingWindow(m, 10),
        TypeError,
        'expected a WindowConfig',
    ),
    'an array to remove': (lambda m: m.remove(POINTS), TypeError, 'expected the ScanMoments that'),
    'moments to merge': (lambda m: m.merge(m.reduce(POINTS)), TypeError, 'another SurfelMap'),
    'text for a voxel size': (lambda _: SurfelMap('0.5'), TypeError, 'a number of metres'),
    'a transposed pose': (
        lambda m: m.add(POINTS, T_map_sensor=(np.eye(4) + 3.0 * np.eye(4, k=3)).T),
        ValueError,
        'expected a rigid transform',
    ),
    'settings to a mapper': (
        lambda _: Mapper({'map.voxel_size_m': 0.5}),
        ConfigError,
        r'a dict, expected a Config: Config\.from_mapping\(settings\)',
    ),
    'no number of points': (
        lambda m: m.surfels('5'),
        TypeError,
        r"min_points: '5', expected a whole number",
    ),
    'a frame as position': (lambda m: m.add(POINTS, 'lidar'), ValueError, "origin: 'lidar'"),
    'a column without name': (
        lambda _: SurfelMap(0.5, columns=('intensity',)).add(POINTS, columns=POINTS[:, 0]),
        TypeError,
        'columns: a ndarray, expected arrays by name',
    ),
    'points for voxels': (lambda m: m.moments(POINTS), ValueError, 'voxel_index: float64'),
    'the name of a field': (lambda m: m.surfels()['position'], IndexError, 'as surfels.position'),
    'a mask of others': (
        lambda m: m.surfels()[np.ones(3, bool)],
        IndexError,
        r'a mask of 3, expected one of \d+ surfels',
    ),
    'nothing to save to': (lambda m: m.save(None), TypeError, 'path: None'),
}


@pytest.mark.parametrize('kind', MISTAKES)
def test_mistakes_get_a_sentence(kind):
    act, error, message = MISTAKES[kind]
    surfel_map = SurfelMap(0.5)
    surfel_map.add(floor())
    before = surfel_map.digest()
    with pytest.raises(error, match=message):
        act(surfel_map)
    assert surfel_map.digest() == before


def test_a_trajectory_is_a_sequence_of_matrices():
    assert POSES[1].tolist() == [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    assert POSES[-1][:3, 3].tolist() == [2, 4, 3]
    last = POSES[1:]
    assert isinstance(last, Trajectory)
    assert last.stamp_ns.tolist() == [10**9, 2 * 10**9]
    assert [pose[0, 3] for pose in POSES] == [0, 1, 2]
    assert np.asarray(POSES).shape == (3, 4, 4)
    assert np.asarray(POSES, np.float32)[2, 1, 3] == 4.0


@pytest.mark.parametrize('per_metre', [1000.0, 100.0])
def test_other_units_are_warned_about_once(caplog, per_metre):
    rng = np.random.default_rng(5)
    room = per_metre * rng.uniform(-4.0, 4.0, (3000, 3))
    surfel_map = SurfelMap(0.5)
    for _ in range(2):
        surfel_map.add(room)
    assert caplog.text.count('are they millimetres or centimetres?') == 1

    caplog.clear()
    mapper = Mapper(Config.from_mapping({'pose.source': 'identity', 'input.max_range_m': 0.0}))
    for stamp_ns in (1, 2):
        mapper.add_scan(Scan(points=room, stamp_ns=stamp_ns, frame_id='lidar'))
        list(mapper.insert_ready())
    assert caplog.text.count('are they millimetres or centimetres?') == 1


def test_metres_far_from_the_origin_are_not_warned_about(caplog):
    rng = np.random.default_rng(6)
    SurfelMap(0.5).add(rng.uniform(-150.0, 150.0, (3000, 3)) + np.array([2e5, 3e5, 0]))
    assert not caplog.text
