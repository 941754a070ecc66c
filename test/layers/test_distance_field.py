# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The distance field of a mapper: scans fused, when and where, and its figures.

A lidar stands in a sphere; the mesh has to be that sphere, wherever the poses put it.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfel_mapper.errors import ConfigError
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from surfel_mapper.tsdf.queries import labels_of
from surfel_mapper.tsdf.sensors import CameraModel
from test.fields import config_of
from test.tsdf.scenes import lidar_rays

S = 10**9
RADIUS_M = 5.0
RAYS = lidar_rays(64, 360, 60.0)
SETTINGS = {
    'pose.source': 'odometry',
    'frames.base': 'lidar',
    'map.min_points': 1,
    'layers.tsdf.enabled': True,
    'layers.tsdf.voxel_size_m': 0.2,
    'layers.tsdf.truncation_m': 0.6,
    'layers.tsdf.carve_m': 0.0,
}


def sphere(**columns):
    points = (RADIUS_M * RAYS).reshape(-1, 3)
    return Scan(points=points, stamp_ns=0, frame_id='lidar', columns=columns)


RING = np.repeat(np.arange(64), 360)


def mapper_with(**settings):
    return Mapper(config_of({**SETTINGS, **settings}))


def insert(mapper, number, xyz=(0.0, 0.0, 0.0), **columns):
    """Map the sphere about a place; return the mapper and the updates."""
    mapper.add_pose('odom', 'lidar', number * S, xyz, (0.0, 0.0, 0.0, 1.0))
    mapper.add_scan(replace(sphere(ring=RING, **columns), stamp_ns=number * S))
    return list(mapper.insert_ready())


def radii(mesh, middle=(0.0, 0.0, 0.0)):
    return np.linalg.norm(mesh.vertices - middle, axis=1)


def test_the_mesh_is_what_the_scan_saw_where_it_was_taken():
    mapper = mapper_with()
    (update,) = insert(mapper, 1, (10.0, -3.0, 2.0))
    mesh = mapper.tsdf.mesh()
    assert len(mesh) > 1000
    assert np.abs(radii(mesh, (10.0, -3.0, 2.0)) - RADIUS_M).max() <= 0.05
    assert update.milliseconds['tsdf'] > 0.0
    summary = mapper.summary()['tsdf']
    assert (summary['scans'], summary['waiting']) == (1, 0)
    assert summary['blocks'] == mapper.tsdf.blocks.num_blocks > 0


def test_with_when_final_scans_are_fused_as_they_leave_the_window():
    mapper = mapper_with(**{'layers.tsdf.when_final': True, 'window.max_scans': 2})
    for number in range(1, 4):
        insert(mapper, number, (20.0 * number, 0.0, 0.0))
    assert (mapper.tsdf.summary()['scans'], mapper.tsdf.summary()['waiting']) == (1, 2)
    assert np.abs(radii(mapper.tsdf.mesh(), (20.0, 0.0, 0.0)) - RADIUS_M).max() <= 0.05
    mapper.finish_layers()
    assert (mapper.tsdf.summary()['scans'], mapper.tsdf.summary()['waiting']) == (3, 0)
    assert mapper.tsdf.mesh().vertices[:, 0].max() > 64.0


def test_with_when_final_and_no_window_scans_are_fused_at_once():
    mapper = mapper_with(**{'layers.tsdf.when_final': True, 'window.max_scans': 0})
    for number in range(1, 4):
        insert(mapper, number, (20.0 * number, 0.0, 0.0))
        assert mapper.tsdf.summary()['scans'] == number
        assert mapper.tsdf.summary()['waiting'] == 0
    assert mapper.tsdf.mesh().vertices[:, 0].max() > 64.0


def test_with_when_final_scans_of_two_lidars_at_one_time_keep_their_poses():
    mapper = mapper_with(**{'layers.tsdf.when_final': True, 'window.max_scans': 2})
    mapper.add_pose('lidar', 'rear', 0, (-40.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), static=True)
    for number in (1, 2):
        mapper.add_pose('odom', 'lidar', number * S, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        for frame_id, height_m in (('lidar', 0.0), ('rear', 2.0)):
            shift = np.float32([0.0, 0.0, height_m])
            points = sphere().points + shift
            scan = Scan(points=points, stamp_ns=number * S, frame_id=frame_id)
            mapper.add_scan(replace(scan, columns={'ring': RING}))
        assert len(list(mapper.insert_ready())) == 2
    mapper.finish_layers()
    assert (mapper.tsdf.summary()['scans'], mapper.tsdf.summary()['waiting']) == (4, 0)
    mesh = mapper.tsdf.mesh()
    from_front, from_rear = radii(mesh), radii(mesh, (-40.0, 0.0, 2.0))
    assert np.abs(np.minimum(from_front, from_rear) - RADIUS_M).max() <= 0.1
    assert (from_front < 6.0).any()
    assert (from_rear < 6.0).any()


@pytest.mark.parametrize('ends', [False, True], ids=['evicted', 'at the end'])
def test_a_scan_that_cannot_be_fused_does_not_keep_back_the_others(ends, caplog):
    settings = {'layers.tsdf.when_final': True, 'layers.tsdf.semantics': 'single'}
    mapper = mapper_with(**settings, **{'window.max_age_s': 10.0, 'window.max_scans': 0})
    for number, label in ((1, 1 << 25), (2, 7), (3, 7)):
        column = np.full(len(RING), label, np.int32)
        insert(mapper, number, (20.0 * number, 0.0, 0.0), label=column)
    if ends:
        mapper.finish_layers()
    else:
        insert(mapper, 100)
    assert 'label' in caplog.text
    assert mapper.tsdf.summary()['scans'] == 2
    assert mapper.tsdf.summary()['waiting'] == (0 if ends else 1)
    assert len(mapper.tsdf.mesh()) > 2000


def test_clearing_the_map_clears_the_field():
    mapper = mapper_with()
    insert(mapper, 1)
    mapper.clear()
    assert mapper.tsdf.blocks.num_blocks == len(mapper.tsdf.mesh()) == 0
    insert(mapper, 2)
    assert len(mapper.tsdf.mesh())


def test_blocks_out_of_reach_leave():
    mapper = mapper_with(**{'layers.tsdf.max_radius_m': 12.0})
    insert(mapper, 1)
    insert(mapper, 2, (100.0, 0.0, 0.0))
    mesh = mapper.tsdf.mesh()
    assert np.abs(radii(mesh, (100.0, 0.0, 0.0)) - RADIUS_M).max() <= 0.05


def test_the_memory_of_a_drive_is_bounded_and_the_surroundings_are_right(caplog):
    small = {'map.max_bytes': 24 << 20, 'layers.tsdf.carve_m': 20.0, 'window.max_scans': 2}
    mapper = mapper_with(**small, **{'layers.tsdf.voxel_size_m': 0.1})
    for number in range(1, 12):
        insert(mapper, number, (10.0 * number, 0.0, 0.0))
    summary = mapper.tsdf.summary()
    assert summary['bytes'] <= 24 << 20
    assert summary['blocks_evicted'] > 0
    assert 'map.max_bytes' in caplog.text
    near = [v for v in mapper.tsdf.mesh().vertices if v[0] > 107.0]
    assert len(near) > 1000
    assert (
        np.abs(np.linalg.norm(near - np.array([110.0, 0.0, 0.0]), axis=1) - RADIUS_M).max() < 0.1
    )


def test_colours_and_labels_of_points_enter():
    rgb = np.full(len(RING), (200 << 16) | (100 << 8) | 50, np.uint32)
    label = np.full(len(RING), 7, np.int32)
    mapper = mapper_with(**{'layers.tsdf.color': True, 'layers.tsdf.semantics': 'single'})
    insert(mapper, 1, rgb=rgb, label=label)
    mesh = mapper.tsdf.mesh()
    assert set(map(tuple, mesh.colors.tolist())) == {(200, 100, 50)}
    blocks = mapper.tsdf.blocks
    labels, _ = labels_of(blocks.votes[blocks.rows()].swapaxes(0, 1), 1)
    assert set(np.unique(labels)) == {-1, 7}


@pytest.mark.parametrize('dtype', [np.uint8, np.uint32, np.int32])
def test_labels_of_any_whole_type_enter_with_rays_without_a_return(dtype):
    layer = mapper_with(**{'layers.tsdf.semantics': 'single'}).tsdf
    scan = sphere(label=np.full(len(RING), 7, dtype))
    layer.insert(replace(scan, free=np.array([[0.0, 0.0, 1.0]])), np.eye(4))
    assert set(layer.field.labels_at(scan.points)[0]) == {7}


def test_a_cloud_of_two_points_is_fused():
    mapper = mapper_with()
    mapper.add_pose('odom', 'lidar', S, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    flat = np.array([[1.0, 0.0, 0.0], [2.0, 1.0, 0.0]])
    mapper.add_scan(Scan(points=flat, stamp_ns=S, frame_id='lidar'))
    assert len(list(mapper.insert_ready())) == 1
    assert mapper.tsdf.summary()['scans'] == 1
    assert mapper.counters.messages_ignored == {}


def test_the_optical_centre_of_a_cloud_in_base_link_comes_from_its_frame():
    turn, T = Rotation.from_euler('zy', [90.0, 12.0], degrees=True), np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), (0.5, 0.0, 1.8)
    mapper = mapper_with(**{'layers.tsdf.sensor_frame': 'top', 'layers.tsdf.carve_m': 20.0})
    mapper.add_pose('odom', 'lidar', S, (3.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    mapper.add_pose('lidar', 'top', 0, T[:3, 3], turn.as_quat(), static=True)
    scan = sphere()
    points = scan.points @ T[:3, :3].T + T[:3, 3]
    mapper.add_scan(replace(scan, points=points.astype(np.float32), stamp_ns=S))
    assert len(list(mapper.insert_ready())) == 1
    assert mapper.tsdf.summary()['scans'] == 1
    mesh = mapper.tsdf.mesh()
    assert len(mesh) > 1000
    assert np.abs(radii(mesh, T[:3, 3] + (3.0, 0.0, 0.0)) - RADIUS_M).max() < 0.02


def test_an_unknown_frame_of_the_sensor_is_named(caplog):
    mapper = mapper_with(**{'layers.tsdf.sensor_frame': 'nowhere'})
    insert(mapper, 1)
    assert 'layers.tsdf.sensor_frame: ' in caplog.text
    assert 'nowhere' in caplog.text
    assert mapper.tsdf.summary()['scans'] == 0


def test_a_depth_image_is_fused_as_its_camera_saw_it():
    camera = CameraModel(columns=80, rows=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
    depth_m = 2.0
    points = (camera.directions / camera.directions[..., 2:] * depth_m).reshape(-1, 3)
    mapper = mapper_with(**{'layers.tsdf.voxel_size_m': 0.05, 'layers.tsdf.truncation_m': 0.15})
    mapper.add_pose('odom', 'lidar', S, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    seen_by = (80, 60, 70.0, 70.0, 39.5, 29.5)
    mapper.add_scan(Scan(points=points, stamp_ns=S, frame_id='lidar', camera=seen_by))
    list(mapper.insert_ready())
    mesh = mapper.tsdf.mesh()
    assert len(mesh) > 1000
    assert np.abs(mesh.vertices[:, 2] - depth_m).max() <= 0.1 * 0.05


@pytest.mark.parametrize('name', ['max_range_m', 'min_range_m'])
def test_ranges_that_leave_nothing_are_refused(name):
    values = {'max_range_m': 0.1, 'min_range_m': 60.0}
    with pytest.raises(ConfigError, match=r'layers\.tsdf\.max_range_m: .* expected more than'):
        mapper_with(**{f'layers.tsdf.{name}': values[name]})
