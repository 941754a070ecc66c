# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Lidar: directions, organised scans of a known world, noise, rolling columns, refusals."""

import numpy as np
import pytest

from surfel_mapper.errors import ConfigError
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.simulation import Lidar, Primitive, World

FLOOR_M = 2.0
FLOOR = World([Primitive(kind='rectangle', size_m=(1000.0, 1000.0), xyz=(0.0, 0.0, -FLOOR_M))])
SMALL = Lidar(beams=8, columns=32, elevation_deg=(-30.0, 5.0))
HERE = np.eye(4)


def test_directions_are_unit_vectors_beam_by_beam_clockwise_from_behind():
    unit = SMALL.directions()
    assert unit.shape == (8, 32, 3)
    np.testing.assert_allclose(np.linalg.norm(unit, axis=2), 1.0, rtol=1e-15)
    elevation = np.degrees(np.arcsin(unit[:, 0, 2]))
    np.testing.assert_allclose(elevation, np.linspace(-30.0, 5.0, 8), rtol=1e-12)
    azimuth = np.degrees(np.arctan2(unit[3, :, 1], unit[3, :, 0]))
    np.testing.assert_allclose(azimuth, 180.0 - (np.arange(32) + 0.5) * 11.25, atol=1e-12)


def test_a_scan_is_organised_and_each_point_lies_where_its_beam_meets_the_floor():
    scan = SMALL.scan(FLOOR, HERE, stamp_ns=12, frame_id='os')

    assert (scan.stamp_ns, scan.frame_id, len(scan)) == (12, 'os', 8 * 32)
    assert scan.points.dtype == np.float32
    points = scan.points.reshape(8, 32, 3)
    surface = scan.columns['surface'].reshape(8, 32)
    unit = SMALL.directions()
    down = unit[:, :, 2] < 0.0
    expected = unit[down] * (FLOOR_M / -unit[down][:, 2])[:, None]
    np.testing.assert_allclose(points[down], expected, rtol=2.0**-24)
    assert (surface[down] == 0).all()
    assert np.isnan(points[~down]).all()
    assert (surface[~down] == -1).all()


def test_the_columns_say_beam_time_and_how_bright_a_surface_is():
    scan = SMALL.scan(FLOOR, HERE)
    columns = {name: values.reshape(8, 32) for name, values in scan.columns.items()}
    assert {name: values.dtype for name, values in columns.items()} == {
        'intensity': np.float32,
        'ring': np.uint16,
        'time': np.float32,
        'surface': np.int64,
    }
    assert (columns['ring'] == np.arange(8)[:, None]).all()
    assert (columns['time'] == 0.0).all()
    # half of the light comes back, times the sine of the angle to the floor
    assert columns['intensity'][0] == pytest.approx(255.0 * 0.5 * 0.5, rel=1e-6)
    assert (columns['intensity'][7] == 0.0).all()


def test_the_pose_takes_the_points_to_the_world():
    T = pose_matrix((3.0, -4.0, 0.5), (0.1, -0.2, 0.3, np.sqrt(1.0 - 0.14)))
    points = SMALL.scan(FLOOR, T).points.astype(np.float64)
    height = points @ T[2, :3] + T[2, 3]
    hit = np.isfinite(height)
    assert hit.sum() > 50
    # float32 rounds each coordinate by half a unit in its last place
    allowed = np.abs(points[hit]).sum(axis=1) * 2.0**-24
    assert (np.abs(height[hit] + FLOOR_M) <= allowed).all()


def test_surfaces_nearer_or_farther_than_the_lidar_reaches_return_nothing():
    lidar = Lidar(
        beams=8, columns=4, elevation_deg=(-60.0, -5.0), min_range_m=3.0, max_range_m=10.0
    )
    range_m = FLOOR_M / -lidar.directions()[:, 0, 2]
    seen = (lidar.scan(FLOOR, HERE).columns['surface'] >= 0).reshape(8, 4)
    assert (seen == ((range_m >= 3.0) & (range_m <= 10.0))[:, None]).all()
    assert seen.any()
    assert not seen.all()


def test_noise_moves_points_along_their_beam_with_the_deviation_asked_for():
    quiet = Lidar(beams=16, columns=512, elevation_deg=(-30.0, -5.0))
    noisy = Lidar(beams=16, columns=512, elevation_deg=(-30.0, -5.0), range_noise_m=0.02, seed=1)
    exact, moved = (
        np.linalg.norm(lidar.scan(FLOOR, HERE).points.astype(np.float64), axis=1)
        for lidar in (quiet, noisy)
    )
    off = moved - exact
    # 8192 samples: the mean within 4 sigma / sqrt(n), the deviation within 4 sigma / sqrt(2 n)
    assert abs(off.mean()) < 4 * 0.02 / np.sqrt(8192)
    assert abs(off.std() - 0.02) < 4 * 0.02 / np.sqrt(2 * 8192)
    beams = noisy.scan(FLOOR, HERE).points / moved[:, None]
    np.testing.assert_allclose(beams, quiet.directions().reshape(-1, 3), atol=1e-6)


def test_with_a_pose_for_each_column_every_column_is_seen_from_its_own():
    poses = np.array([pose_matrix((0.1 * c, 0.0, 0.01 * c), (0, 0, 0, 1)) for c in range(32)])
    rolling = SMALL.scan(FLOOR, poses)
    points = rolling.points.reshape(8, 32, 3)
    for column in (0, 13, 31):
        alone = SMALL.scan(FLOOR, poses[column]).points.reshape(8, 32, 3)
        np.testing.assert_array_equal(points[:, column], alone[:, column])
    time = rolling.columns['time'].reshape(8, 32)
    np.testing.assert_allclose(time, np.arange(32)[None] * 0.1 / 32 * np.ones((8, 1)), rtol=1e-7)


@pytest.mark.parametrize(
    'setting',
    [
        dict(beams=0),
        dict(columns=10**6),
        dict(rate_hz=0.0),
        dict(rate_hz=np.nan),
        dict(range_noise_m=-0.1),
        dict(range_noise_m=np.inf),
        dict(min_range_m=200.0),
        dict(max_range_m=np.inf),
        dict(elevation_deg=(10.0, -10.0)),
        dict(elevation_deg=(-95.0, 0.0)),
        dict(seed=-1),
    ],
)
def test_an_invalid_lidar_is_refused_by_its_setting(setting):
    with pytest.raises(ConfigError) as refused:
        Lidar(**setting)
    text = str(refused.value)
    assert text.startswith(('min_range_m', 'max_range_m', *setting))
    assert 'expected' in text


def test_a_range_that_ends_before_it_begins_is_refused_by_its_end():
    with pytest.raises(ConfigError, match=r'max_range_m: 0\.1, expected over 0\.3, finite'):
        Lidar(max_range_m=0.1)


def test_poses_of_another_shape_are_refused():
    with pytest.raises(ValueError, match='T_world_sensor'):
        SMALL.scan(FLOOR, np.tile(HERE, (31, 1, 1)))
