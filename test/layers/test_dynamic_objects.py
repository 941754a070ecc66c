# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A box moves through a room: its former places are cleared, the room stays, nothing drifts.

The room and the box are simulated for every scan, so that the truth is known.
"""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from surfel_mapper.layers import Surroundings
from surfel_mapper.layers.dynamic_objects import DynamicObjectsLayer
from surfel_mapper.layers.sensor_models import SensorModels
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SlidingWindow
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from surfel_mapper.tsdf.sensors import CameraModel
from test.fields import config_of
from test.tsdf.scenes import lidar_rays

S = 10**9
RAYS = lidar_rays(64, 512, 60.0).reshape(-1, 3).astype(np.float64)
RING = np.repeat(np.arange(64), 512)
ROOM_M = np.array([8.0, 6.0, 2.0])
BOX_M = np.array([0.5, 0.5, 1.0])
SIZE_M = 0.25
SCANS = 40


def ranges_to_box(origin, directions, middle, half):
    """Return the ranges at which rays enter a box, inf if they miss it, and leave it."""
    with np.errstate(divide='ignore'):
        first = (middle - half - origin) / directions
        second = (middle + half - origin) / directions
    enters = np.minimum(first, second).max(axis=-1)
    leaves = np.maximum(first, second).min(axis=-1)
    return np.where((enters < leaves) & (enters > 0.0), enters, np.inf), leaves


@cache
def scan_of(number, has_box=True, missing_wall=None):
    """
    Return the scan of a lidar in the middle, its origin, and the position of the box.

    Points of the wall behind the box have the value of ``missing_wall``, if given. Not to be
    changed: five drives see the same scans.
    """
    origin = np.array([0.02 * number, 0.0, 0.0])
    box = np.array([-5.0 + 10.0 * number / SCANS, 3.0, -1.0])
    directions = RAYS
    _, walls = ranges_to_box(origin, directions, np.zeros(3), ROOM_M)
    nearest, _ = ranges_to_box(origin, directions, box, BOX_M)
    ranges = np.minimum(walls, nearest) if has_box else walls
    rng = np.random.default_rng(number)
    points = directions * (ranges + rng.normal(scale=0.01, size=len(ranges)))[:, None]
    if missing_wall is not None:
        behind = (origin + directions * walls[:, None])[:, 1] > ROOM_M[1] - 1e-6
        points[behind & (ranges == walls)] = missing_wall
    scan = Scan(
        points=points.astype(np.float32),
        stamp_ns=(number + 1) * S,
        frame_id='lidar',
        columns={'ring': RING},
        msg=SimpleNamespace(height=64, width=512),
    )
    return scan, origin, box


def driven(missing_wall=None, center_m=(0.0, 0.0, 0.0), **settings):
    """Return a mapper that has seen the box pass, in clouds with the lidar at a place."""
    mapper = Mapper(
        config_of(
            {
                'pose.source': 'odometry',
                'frames.base': 'lidar',
                'map.voxel_size_m': SIZE_M,
                'map.min_points': 1,
                'window.max_scans': 0,
                **settings,
            }
        )
    )
    mapper.add_pose('lidar', 'top', 0, center_m, (0.0, 0.0, 0.0, 1.0), static=True)
    updates = []
    for number in range(SCANS):
        scan, origin, _ = scan_of(number, missing_wall=missing_wall)
        mapper.add_pose('odom', 'lidar', scan.stamp_ns, origin - center_m, (0.0, 0.0, 0.0, 1.0))
        mapper.add_scan(replace(scan, points=scan.points + np.float32(center_m)))
        updates += mapper.insert_ready()
    assert len(updates) == SCANS
    return mapper, updates


def ghosts(mapper, scans=SCANS - 10):
    """Return the voxels well within the room where the box was up to a scan; keys."""
    index = mapper.map.moments().voxel_index
    centers = (index + 0.5) * SIZE_M
    inner = (np.abs(centers) < ROOM_M - 2 * SIZE_M).all(axis=1)
    _, _, box = scan_of(scans)
    return pack_keys(index[inner & (centers[:, 0] < box[0])])


def walls(mapper):
    """Return the voxels of the walls, as a set of keys."""
    index = mapper.map.moments().voxel_index
    centers = (index + 0.5) * SIZE_M
    return set(pack_keys(index[(np.abs(centers) >= ROOM_M - SIZE_M).any(axis=1)]).tolist())


@pytest.fixture(scope='module')
def with_clearing():
    return driven(**{'dynamic.clear': True})


def test_voxels_of_a_box_that_moved_are_cleared_and_the_room_stays(with_clearing):
    mapper, updates = with_clearing
    without, _ = driven()
    assert len(ghosts(without)) > 200
    assert len(ghosts(mapper)) <= 0.02 * len(ghosts(without))
    assert len(walls(mapper)) >= 0.995 * len(walls(without))
    assert mapper.summary()['voxels_cleared']['dynamic'] > 200
    assert not without.counters.voxels_cleared
    assert updates[-1].milliseconds['dynamic'] > 0.0


CENTER_M = (1.0, 0.5, 1.5)


@pytest.mark.parametrize(
    'settings',
    [
        {'sensor_frame': 'top', 'enabled': True, 'carve_m': 0.0},
        {'sensor_frame': 'top'},
    ],
    ids=['with a field', 'without'],
)
def test_voxels_are_seen_from_the_place_of_the_sensor_in_the_cloud(settings, with_clearing):
    settings = {f'layers.tsdf.{name}': value for name, value in settings.items()}
    mapper, _ = driven(center_m=CENTER_M, **settings, **{'dynamic.clear': True})
    central, _ = with_clearing
    assert len(ghosts(mapper)) <= len(ghosts(central)) + 2
    assert len(walls(mapper)) >= 0.995 * len(walls(central))


TSDF = {'enabled': True, 'carve_m': 0.0, 'voxel_size_m': 0.1}


def test_the_distance_field_forgets_what_is_cleared():
    settings = {f'layers.tsdf.{name}': value for name, value in TSDF.items()}
    where_box_was, on_walls = [], []
    for clears in (False, True):
        mapper, _ = driven(**settings, **{'dynamic.clear': clears})
        vertices = mapper.tsdf.mesh().vertices
        _, _, box = scan_of(SCANS - 10)
        inner = (np.abs(vertices) < ROOM_M - 2 * SIZE_M).all(axis=1)
        where_box_was.append(int((inner & (vertices[:, 0] < box[0])).sum()))
        on_walls.append(int((np.abs(np.abs(vertices) - ROOM_M) < 0.05).any(axis=1).sum()))
    assert where_box_was[0] > 200
    assert where_box_was[1] < 0.1 * where_box_was[0]
    assert on_walls[1] == on_walls[0]  # beside the ghost, which stands on the floor


def test_rays_that_met_nothing_clear_and_missing_ones_do_not():
    without, _ = driven(np.inf)
    clearing, _ = driven(np.inf, **{'dynamic.clear': True})
    silent, _ = driven(np.nan, **{'dynamic.clear': True})
    assert len(ghosts(without)) > 200
    assert len(ghosts(clearing)) <= 0.02 * len(ghosts(without))
    assert len(ghosts(silent)) >= 0.3 * len(ghosts(without))
    assert len(walls(clearing)) >= 0.995 * len(walls(without))


def test_voxels_beyond_the_range_of_the_sensor_stay():
    count = counting(min_scans=1, max_range_m=2.0)
    near, far = (6, 2, 0), INSIDE  # 1.7 and 3.3 m away; the walls are at 6 m and more
    assert voxels_cleared_by(count, EMPTY_ROOM, [near, far]) == []
    count = counting(min_scans=1, margin_m=0.1, max_range_m=2.0)
    assert voxels_cleared_by(count, EMPTY_ROOM, [near, far]) == [near]


def test_cleared_voxels_are_in_the_updates(with_clearing):
    _, updates = with_clearing
    there = set()
    for update in updates:
        there |= set(map(tuple, update.changed.voxel_index.tolist()))
        removed = set(map(tuple, update.removed_voxel_index.tolist()))
        assert removed <= there
        there -= removed
    mapper, _ = with_clearing
    assert there == set(map(tuple, mapper.map.surfels().voxel_index.tolist()))


def test_scans_leave_exactly_after_voxels_were_cleared():
    mapper, _ = driven(**{'dynamic.clear': True, 'window.max_scans': 30})
    alone = SurfelMap(SIZE_M)
    for scan in mapper.window:
        alone.insert(scan.moments)
    assert alone.digest() == mapper.map.digest()
    mapper.clear()
    assert mapper.map.num_voxels == 0


def voxels_cleared_by(count, scan, keys, hit=()):
    """Return which of some voxels are empty after a scan from the origin, as a list."""
    keys, hit = pack_keys(np.array(keys)), pack_keys(np.reshape(hit, (-1, 3)).astype(int))
    found = count.count(scan, np.eye(4), np.sort(keys), hit)
    return sorted(map(tuple, found.tolist()))


def counting(max_range_m=None, **settings):
    """Return the layer of a map that stays empty, without a pipeline."""
    ranges = {} if max_range_m is None else {'layers.tsdf.max_range_m': max_range_m}
    stage = {f'dynamic.{name}': value for name, value in settings.items()}
    config = config_of({'dynamic.clear': True, **stage, **ranges})
    surfel_map = SurfelMap(SIZE_M)
    around = Surroundings(
        surfel_map=surfel_map,
        window=SlidingWindow(surfel_map),
        sensors=SensorModels(config.tsdf),
    )
    return DynamicObjectsLayer(config, around)


EMPTY_ROOM = replace(scan_of(0, has_box=False)[0])
INSIDE, ON_WALL, OUTSIDE = (12, 4, 1), (31, 0, 0), (60, 0, 0)


def test_a_voxel_is_empty_once_enough_scans_in_a_row_saw_through_it():
    count = counting(min_scans=3)
    voxels = [INSIDE, ON_WALL, OUTSIDE]
    assert [voxels_cleared_by(count, EMPTY_ROOM, voxels) for _ in range(3)] == [[], [], [INSIDE]]


def test_voxels_without_rays_stay():
    count = counting(min_scans=1)
    nothing = replace(EMPTY_ROOM, points=np.full_like(EMPTY_ROOM.points, np.nan))
    voxels_cleared_by(count, EMPTY_ROOM, [ON_WALL])  # shows the lidar
    assert voxels_cleared_by(count, nothing, [INSIDE]) == []
    above = (0, 1, 30)  # out of view
    assert voxels_cleared_by(count, EMPTY_ROOM, [above]) == []


def test_rays_that_end_within_the_margin_clear_nothing():
    assert voxels_cleared_by(counting(min_scans=1, margin_m=20.0), EMPTY_ROOM, [INSIDE]) == []
    assert voxels_cleared_by(counting(min_scans=1, margin_m=0.5), EMPTY_ROOM, [INSIDE]) == [INSIDE]


def test_a_cloud_of_two_points_clears_nothing_and_is_mapped():
    mapper = Mapper(config_of({'pose.source': 'identity', 'dynamic.clear': True}))
    flat = np.array([[1.0, 0.0, 0.0], [2.0, 1.0, 0.0]])
    mapper.add_scan(Scan(points=flat, stamp_ns=S, frame_id='lidar'))
    assert len(list(mapper.insert_ready())) == 1
    assert mapper.map.num_voxels > 0


def test_a_camera_clears_along_its_optical_axis():
    camera = CameraModel(columns=80, rows=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
    points = (camera.directions / camera.directions[..., 2:] * 4.0).reshape(-1, 3)
    by_camera = (80, 60, 70.0, 70.0, 39.5, 29.5)
    scan = Scan(points=points, stamp_ns=S, frame_id='camera', camera=by_camera)
    ahead, aside = (0, 0, 8), (12, 0, 0)  # 2 m ahead, and 3 m to the right, out of view
    assert voxels_cleared_by(counting(min_scans=1), scan, [ahead, aside]) == [ahead]
