# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Rays that met nothing: found by rows and columns, and free up to the range of the sensor.

Points that are nan are unknown: space without rays stays unknown.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfel_mapper.config import Config
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from surfel_mapper.sensors.free_rays import free_directions
from surfel_mapper.tsdf.queries import FREE, states, UNKNOWN
from test.tsdf.scenes import lidar_rays

RAYS = lidar_rays(32, 360, 40.0)
S = 10**9


def organised(nothing, where, staggered_deg=0.0, order=slice(None), transpose=False):
    """Return a scan of a sphere, the content of some pixels, and their true directions."""
    turn = np.radians(staggered_deg) * np.arange(len(RAYS))[:, None]
    d = RAYS.astype(float)
    rays = np.stack(
        [
            np.cos(turn) * d[..., 0] - np.sin(turn) * d[..., 1],
            np.sin(turn) * d[..., 0] + np.cos(turn) * d[..., 1],
            d[..., 2],
        ],
        axis=-1,
    )[order]
    points = (10.0 * rays).astype(np.float32)
    points[where] = nothing
    if transpose:
        points = points.swapaxes(0, 1)
    msg = SimpleNamespace(height=points.shape[0], width=points.shape[1])
    scan = Scan(points=points.reshape(-1, 3), stamp_ns=S, frame_id='lidar', msg=msg)
    return scan, rays[where]


PATCH = np.zeros((32, 360), bool)
PATCH[5:15, 100:140] = True


@pytest.mark.parametrize(
    'layout',
    [{}, {'staggered_deg': 0.7}, {'order': slice(None, None, -1)}, {'transpose': True}],
    ids=['plain', 'staggered', 'from below', 'a row for each azimuth'],
)
def test_the_directions_of_points_at_infinity_are_those_of_their_beams(layout):
    scan, expected = organised(np.inf, PATCH, **layout)
    found = free_directions(scan)
    if 'transpose' in layout:
        expected = expected.reshape(10, 40, 3).swapaxes(0, 1).reshape(-1, 3)
        found = found.reshape(10, 40, 3).swapaxes(0, 1).reshape(-1, 3)
    assert len(found) == 400
    off = np.degrees(np.arccos(np.clip((found * expected).sum(axis=1), -1.0, 1.0)))
    assert off.max() < 0.1


def test_without_points_at_infinity_or_without_rows_there_are_none():
    assert free_directions(organised(np.nan, PATCH)[0]) is None
    scan, _ = organised(np.inf, PATCH)
    assert free_directions(scan.select(np.arange(len(scan)))) is None


def test_rows_that_are_no_beams_give_no_directions():
    scan, _ = organised(np.inf, PATCH)
    mixed = np.random.default_rng(3).permutation(len(scan))
    shuffled = Scan(points=scan.points[mixed], stamp_ns=S, frame_id='lidar', msg=scan.msg)
    assert free_directions(shuffled) is None


def test_a_beam_without_points_gives_no_directions():
    where = np.zeros((32, 360), bool)
    where[3], where[:, 50] = True, True
    found = free_directions(organised(np.inf, where)[0])
    assert found is None or not len(found)


@pytest.mark.parametrize(('nothing', 'state'), [(np.inf, FREE), (np.nan, UNKNOWN)])
def test_infinite_points_free_the_space_before_them_and_missing_ones_do_not(nothing, state):
    mapper = Mapper(
        Config.from_mapping(
            {
                'pose.source': 'identity',
                'layers.tsdf.enabled': True,
                'map.min_points': 1,
                'layers.tsdf.voxel_size_m': 0.2,
                'layers.tsdf.truncation_m': 0.6,
                'layers.tsdf.max_range_m': 20.0,
                'layers.tsdf.carve_m': 20.0,
            }
        )
    )
    scan, rays = organised(nothing, PATCH)
    mapper.add_scan(scan)
    assert len(list(mapper.insert_ready())) == 1
    ray = rays[np.argmax(rays @ rays.mean(axis=0))]
    points = np.outer([4.0, 8.0, 12.0, 16.0], ray / np.linalg.norm(ray))
    assert set(states(mapper.tsdf.blocks, points)) == {state}


@pytest.mark.parametrize(
    'transpose',
    [False, True],
    ids=['a column for each azimuth', 'a row for each azimuth'],
)
def test_rays_without_a_return_are_deskewed_by_the_time_of_their_column(transpose):
    turning = np.array([0.3, -0.4, 1.5])  # rad/s
    settings = {
        'pose.source': 'odometry',
        'frames.base': 'lidar',
        'deskew.enabled': True,
        'map.min_points': 1,
        'layers.tsdf.enabled': True,
        'layers.tsdf.voxel_size_m': 0.2,
        'layers.tsdf.truncation_m': 0.6,
        'layers.tsdf.max_range_m': 20.0,
        'layers.tsdf.carve_m': 20.0,
    }
    mapper = Mapper(Config.from_mapping(settings))
    scan, rays = organised(np.inf, PATCH, transpose=transpose)
    seconds = np.tile(np.float32(0.1 / 360) * np.arange(360, dtype=np.float32), (32, 1))
    expected = Rotation.from_rotvec(np.outer(seconds[PATCH], turning)).apply(rays)
    seconds[PATCH] = 0.0  # undefined without a return
    for hundredths in range(12):
        xyz, turn = (0.05 * hundredths, 0.0, 0.0), turning * hundredths / 100
        q_xyzw = Rotation.from_rotvec(turn).as_quat()
        mapper.add_pose('odom', 'lidar', S + hundredths * S // 100, xyz, q_xyzw)
    column = (seconds.T if transpose else seconds).reshape(-1)
    for shift_ns in (0, 1):
        mapper.add_scan(replace(scan, stamp_ns=S + shift_ns, columns={'t': column}))
    updates = list(mapper.insert_ready())
    assert len(updates) == 2
    for found in (update.filtered.free for update in updates):
        off = np.degrees(np.linalg.norm(found - expected, axis=1))
        assert off.max() < 0.1  # of directions fitted to columns; the sweep turns these by 3 deg
    middle = expected.mean(axis=0)
    points = np.outer([4.0, 8.0, 12.0, 16.0], middle / np.linalg.norm(middle))
    assert set(states(mapper.tsdf.blocks, points)) == {FREE}
