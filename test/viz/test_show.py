# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper view`` shows what files hold, read back from the recording that it writes."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial import cKDTree

from surfel_mapper import SurfelMap, Trajectory
from surfel_mapper.cli.main import main
from surfel_mapper.files.map_state import save_map
from surfel_mapper.files.mesh_ply import write_mesh
from surfel_mapper.files.parquet_tiles import write_tiles
from surfel_mapper.files.ply import write_points
from surfel_mapper.mapping.window import WindowedScan
from surfel_mapper.viz.discs import CORNERS, OUTER, SPREAD
from test import extras
from test.bags.recorded import drive, write_rosbag2
from test.viz.test_mesh import sphere

pytestmark = extras.needs('pyarrow')

UTM = np.array([400_384.0, 5_400_576.0, 256.0])

START_NS = 1_700_000_000_000_000_000


@pytest.fixture(autouse=True)
def _rerun():
    extras.load('rerun.chunk')


def ground(number=20_000, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-20.0, -10.0, 0.1], [20.0, 10.0, 0.14], (number, 3))
    return points


def ground_map(origin_m=(0.0, 0.0, 0.0), columns=()):
    surfel_map = SurfelMap(0.5, columns=columns, origin_m=origin_m)
    points = ground()
    extra = {'intensity': np.abs(points[:, 0]).astype(np.float32)} if columns else None
    surfel_map.add(points, origin=[0.0, 0.0, 3.0], columns=extra)
    return surfel_map


def shown(tmp_path, *arguments):
    """Return the last row of each component in the recording of a view, by entity and name."""
    from rerun import chunk as reader

    file = tmp_path / 'shown.rrd'
    assert main(['view', *map(str, arguments), '--rrd', str(file), '--overwrite']) == 0
    found = {}
    for chunk in reader.RrdReader(str(file)).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name != 'rerun.controls.RowId' and batch.num_rows:
                found.setdefault(chunk.entity_path, {})[name] = batch.column(name)[-1].as_py()
    return found


def together(found, prefix, name):
    """Return one component of all entities below a prefix."""
    parts = [
        np.array(each[name])
        for path, each in found.items()
        if path.startswith(prefix) and name in each
    ]
    return np.concatenate(parts)


def in_order(rows):
    return rows[np.lexsort(rows.T)]


@pytest.mark.parametrize('name', ['map.npz', 'map.parquet', 'tiles'])
def test_exact_maps_are_shown_by_their_adaptive_surfels(tmp_path, name):
    surfel_map = ground_map()
    if name == 'tiles':
        path = tmp_path / 'out'
        write_tiles(path / 'map', surfel_map)
    else:
        path = tmp_path / name
        surfel_map.save(path)
    found = shown(tmp_path, path)

    surfels = surfel_map.adaptive(5)
    assert len(surfels) < surfel_map.num_surfels(5)
    places = together(found, '/map/', 'Points3D:positions')
    np.testing.assert_allclose(
        in_order(places), in_order(surfels.position.astype(np.float32)), atol=1e-6
    )
    counts = together(found, '/map/', 'num_points')
    np.testing.assert_array_equal(np.sort(counts), np.sort(surfels.num_points))
    assert len(together(found, '/map/', 'Mesh3D:vertex_positions')) == CORNERS * len(surfels)


def test_a_large_map_is_shown_as_exact_coarser_maps(tmp_path):
    surfel_map = ground_map()
    surfel_map.save(tmp_path / 'map.npz')
    found = shown(tmp_path, tmp_path / 'map.npz', '--discs', 600, '--at', -20, -10, 0)

    places = together(found, '/map/', 'Points3D:positions')
    assert len(places) <= 600
    level = together(found, '/map/', 'level')
    assert level.min() < level.max()
    for each in np.unique(level):
        coarser = surfel_map.coarsen(int(each)).surfels(5).position.astype(np.float32)
        rows = {tuple(row) for row in coarser.tolist()}
        assert rows.issuperset(map(tuple, places[level == each].tolist()))
    distance = np.linalg.norm(places[:, :2] - [-20.0, -10.0], axis=1)
    assert distance[level == level.min()].mean() < distance[level == level.max()].mean()


def test_files_of_a_replay_share_the_frame_of_the_map_far_from_zero(tmp_path):
    out = tmp_path / 'out'
    out.mkdir()
    surfel_map = ground_map(UTM)
    surfel_map.save(out / 'map.npz')
    write_mesh(out / 'mesh.ply', sphere(8, 3.0, (5.0, 5.0, 5.0)), UTM)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = UTM + np.arange(3.0)[:, None] * [1.0, 0.5, 0.0]
    stamps = START_NS + np.arange(3) * 10**8
    Trajectory.from_matrices(poses, stamps).save(out / 'trajectory.tum')
    found = shown(tmp_path, out)

    places = together(found, '/map/surfels', 'Points3D:positions')
    assert np.abs(places).max() < 25.0
    fixed = np.stack(
        [together(found, '/map/surfels', f'fixed_{axis}_m') for axis in 'xyz'], axis=1
    )
    expected = surfel_map.adaptive(5).position + UTM
    np.testing.assert_allclose(in_order(fixed), in_order(expected), atol=1e-9, rtol=0)
    np.testing.assert_array_equal(found['/map']['origin_m'], UTM)
    corners = np.array(found['/map/mesh']['Mesh3D:vertex_positions'])
    np.testing.assert_allclose(np.linalg.norm(corners - 5.0, axis=1), 3.0, atol=0.01)
    line = np.array(found['/map/trajectory']['LineStrips3D:strips'])
    np.testing.assert_allclose(line[0], np.arange(3.0)[:, None] * [1.0, 0.5, 0.0], atol=1e-6)
    sensor = found['/map/trajectory/sensor']
    np.testing.assert_allclose(np.ravel(sensor['Transform3D:translation']), [2.0, 1.0, 0.0])
    assert max(sensor['Points3D:radii']) < 0.0  # pixels, whatever the size of the scene


def test_discs_have_no_dot_and_are_seen_from_their_front(tmp_path):
    ground_map().save(tmp_path / 'map.npz')
    found = shown(tmp_path, tmp_path / 'map.npz')
    assert together(found, '/map/', 'Points3D:radii').max() < 0.0  # pixels
    front = together(found, '/map/', 'Mesh3D:face_rendering')
    assert set(front.tolist()) == {2}


def hidden(tmp_path):
    """Return the paths that the blueprint of the recording of a view hides, below its view."""
    from rerun import chunk as reader

    file = reader.RrdReader(str(tmp_path / 'shown.rrd'))
    (store,) = file.blueprints()
    return {
        re.search(r'/overrides(/.*)/visualizers$', chunk.entity_path)[1]
        for chunk in file.stream(store=store).to_chunks()
        if 'EntityBehavior:visible' in chunk.to_record_batch().schema.names
    }


def look_of(tmp_path):
    """Return position, target and up of the eye in the blueprint of the recording of a view."""
    from rerun import chunk as reader

    file = reader.RrdReader(str(tmp_path / 'shown.rrd'))
    (store,) = file.blueprints()
    values = {}
    for chunk in file.stream(store=store).to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.startswith('EyeControls3D:'):
                values[name.split(':')[1]] = np.array(batch.column(name)[-1].as_py()[0])
    return values


def test_a_map_in_the_frame_of_a_camera_is_looked_at_upright(tmp_path):
    surfel_map = SurfelMap(0.5)
    x, z, y = ground().T  # y of a camera is down
    surfel_map.add(np.column_stack([x, 3.0 - y, z]), origin=[0.0, 0.0, 0.0])
    surfel_map.save(tmp_path / 'map.npz')
    shown(tmp_path, tmp_path / 'map.npz')

    eye = look_of(tmp_path)
    np.testing.assert_allclose(eye['eye_up'], [0.0, -1.0, 0.0], atol=0.05)
    assert (eye['position'] - eye['look_target'])[1] < -1.0


def test_surfels_of_ply_are_discs_with_their_values(tmp_path, capsys):
    surfel_map = ground_map(UTM)
    surfel_map.save(tmp_path / 'map.ply')
    found = shown(tmp_path, tmp_path / 'map.ply', '--color', 'thickness')

    places = together(found, '/map/map', 'Points3D:positions')
    origin_m = np.array(found['/map']['origin_m'])
    surfels = surfel_map.surfels()
    surfels = surfels.select(np.isfinite(surfels.planarity))
    expected = surfels.position + (UTM - origin_m)
    away, _ = cKDTree(expected).query(places)
    assert len(places) == len(expected)
    assert away.max() < 1e-4
    assert np.sort(together(found, '/map/map', 'num_points')).tolist() == sorted(
        surfels.num_points
    )
    corners = together(found, '/map/map', 'Mesh3D:vertex_positions').reshape(-1, CORNERS, 3)
    radii = np.sort(np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2)[:, 0])
    expected = np.sort(SPREAD * OUTER * surfels.radius)
    # corners are float32, up to 1 km from the origin; the largest discs end at their cells
    np.testing.assert_allclose(radii[:-10], expected[:-10], atol=1e-3)
    assert (radii[-10:] < expected[-10:] + 1e-3).all()
    assert 'without their moments' in capsys.readouterr().out


def test_a_cloud_without_normals_is_points(tmp_path):
    points = ground(500)
    columns = dict(zip('xyz', points.astype(np.float32).T, strict=True))
    write_points(tmp_path / 'cloud.ply', columns)
    found = shown(tmp_path, tmp_path / 'cloud.ply')

    np.testing.assert_array_equal(
        found['/map/cloud']['Points3D:positions'], points.astype(np.float32)
    )
    assert '/map/cloud/discs' not in found


def test_models_of_obj_are_a_mesh(tmp_path):
    (tmp_path / 'models.obj').write_text(
        'o plane_1\nv 0 0 0\nv 4 0 0\nv 4 2 0\nv 0 2 0\nf 1 2 3 4\n'
        'v 0 0 5\nv 1 0 5\nv 0 1 5\nf -3/1/1 -2 -1\n'
    )
    found = shown(tmp_path, tmp_path / 'models.obj')['/map/models']
    assert found['Mesh3D:triangle_indices'] == [[0, 1, 2], [2, 3, 0], [4, 5, 6]]


def test_ages_count_back_from_the_newest_scan(tmp_path):
    surfel_map, scans = SurfelMap(0.5), []
    for number, x in enumerate((0.0, 10.0, 20.0)):
        moments = surfel_map.add(ground(4000, number) * [0.1, 0.1, 1.0] + [x, 0.0, 0.0])
        pose = np.eye(4)
        scans.append(
            WindowedScan(moments=moments, stamp_ns=START_NS + number * 10**9, T_map_sensor=pose)
        )
    save_map(tmp_path / 'map.npz', surfel_map, scans)
    found = shown(tmp_path, tmp_path / 'map.npz', '--color', 'age')

    places = together(found, '/map/', 'Points3D:positions')
    age = together(found, '/map/', 'age')
    np.testing.assert_allclose(age, 2.0 - np.rint(places[:, 0] / 10.0))


def test_several_maps_are_shown_by_the_names_of_their_directories(tmp_path):
    for name in ('monday', 'tuesday'):
        (tmp_path / name).mkdir()
        ground_map(columns=('intensity',)).save(tmp_path / name / 'map.npz')
    found = shown(tmp_path, tmp_path / 'monday', tmp_path / 'tuesday', '--color', 'intensity')
    for name in ('monday', 'tuesday'):
        assert len(together(found, f'/map/{name}/surfels', 'intensity')) == len(
            ground_map().adaptive(5)
        )


def test_a_bag_is_mapped_while_it_is_shown(tmp_path):
    bag = write_rosbag2(tmp_path / 'drive', drive())
    found = shown(tmp_path, bag)
    assert {'/map/surfels', '/map/changed', '/map/window', '/map/sensor/scan'} <= set(found)
    assert sorted(tmp_path.iterdir()) == [bag, tmp_path / 'shown.rrd']


@pytest.mark.parametrize(
    ('name', 'content', 'message'),
    [
        ('map.npz', b'PK', r'map\.npz'),
        ('a.obj', b'v 0 0 0\nf 1 2 3\n', r'a\.obj: damaged, .*index 1 is out of bounds'),
        ('a.obj', b'v 0 x 0\nf 1 1 1\n', r'a\.obj: damaged, .*could not (convert|be read)'),
        ('poses.tum', b'1 2 3\n', r'poses\.tum'),
    ],
)
def test_damaged_files_are_refused_by_name(tmp_path, capsys, name, content, message):
    (tmp_path / name).write_bytes(content)
    assert main(['view', str(tmp_path / name), '--rrd', str(tmp_path / 'a.rrd')]) == 1
    assert re.search(message, capsys.readouterr().err)
    assert not (tmp_path / 'a.rrd').exists()


def test_a_colour_that_nothing_has_is_refused(tmp_path, capsys):
    ground_map().save(tmp_path / 'map.npz')
    arguments = [
        'view',
        str(tmp_path / 'map.npz'),
        '--color',
        'rgb',
        '--rrd',
        str(tmp_path / 'a.rrd'),
    ]
    assert main(arguments) == 1
    expected = 'nothing shown has it; its values: curvature, normal_sigma'
    assert f"colouring 'rgb': {expected}" in capsys.readouterr().err
