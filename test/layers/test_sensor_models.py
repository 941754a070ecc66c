# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Models of lidars are fitted, checked on every scan, fitted again, or refused with a warning."""

import logging

import numpy as np
import pytest

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import ConfigError
from surfel_mapper.layers.sensor_models import FIRST_RETRY, SensorModels
from surfel_mapper.scan import Scan
from surfel_mapper.tsdf.sensors import LidarModel
from test.tsdf.test_fitting import wall_around

FIRST = LidarModel(rows=64, columns=1024, vertical_fov_deg=40.0, max_range_m=40.0)
SECOND = LidarModel(rows=32, columns=512, vertical_fov_deg=40.0, max_range_m=40.0)


def config(**settings):
    return TsdfConfig(voxel_size_m=0.2, truncation_m=0.6, max_range_m=40.0, **settings)


def scan_of(points, stamp_ns=0):
    return Scan(points=np.asarray(points, np.float32), stamp_ns=stamp_ns, frame_id='lidar')


def scattered(seed=1):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(9000, 3)) * rng.uniform(2.0, 9.0, (9000, 1))


def test_another_lidar_in_the_same_frame_is_fitted_again(caplog):
    sensors = SensorModels(config())
    first = sensors.of(scan_of(wall_around(FIRST)))
    assert (first.rows, first.columns) == (64, 1024)
    assert sensors.of(scan_of(wall_around(FIRST, 6.0))) is first
    with caplog.at_level(logging.WARNING):
        second = sensors.of(scan_of(wall_around(SECOND)))
    assert (second.rows, second.columns) == (32, 512)
    assert 'fitted again' in caplog.text
    assert sensors.summary()['sensor_refits'] == 1
    assert sensors.summary()['sensors'] == {'lidar': '32 x 512'}
    assert sensors.summary()['sensor_fit']['lidar'] > 0.9


def test_frame_without_a_model_is_tried_again_and_warned_of_once(caplog):
    sensors = SensorModels(config())
    with caplog.at_level(logging.WARNING):
        for seed in range(4):
            assert sensors.of(scan_of(scattered(seed))) is None
    assert caplog.text.count('fused point by point') == 1
    found = [sensors.of(scan_of(wall_around(FIRST))) for _ in range(4 * FIRST_RETRY)]
    assert found[-1] is not None


def test_layers_that_share_a_scan_share_its_check():
    sensors, scan = SensorModels(config()), scan_of(scattered())
    sensors.of(scan)
    due = sensors.frames['lidar'].due
    sensors.of(scan)
    assert sensors.frames['lidar'].due == due


def test_layers_that_share_a_scan_about_another_origin_share_its_check():
    center_m = (1.0, 0.4, 1.8)
    sensors = SensorModels(config(sensor_center_m=center_m))
    scan = scan_of(wall_around(FIRST) + np.array(center_m))
    poses = np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])
    (first, T_first), (second, T_second) = (sensors.centered(scan, T) for T in poses)
    assert first is second
    assert sensors.of(first).rows == 64
    np.testing.assert_allclose(first.points, wall_around(FIRST), atol=1e-5)
    assert T_first[:3, 3].tolist() == [1.0, 0.4, 1.8]
    assert T_second[:3, 3].tolist() == [-1.0, -0.4, 1.8]


def test_configured_angles_are_used_and_checked(caplog):
    fov = SensorModels(config(sensor_rows=64, sensor_fov_deg=(-20.0, 20.0)))
    model = fov.of(scan_of(wall_around(FIRST)))
    np.testing.assert_allclose(model.elevations_rad, FIRST.elevations_rad, atol=1e-9)
    beams = tuple(np.degrees(SECOND.elevations_rad).tolist())
    table = SensorModels(config(sensor_beams_deg=beams))
    model = table.of(scan_of(wall_around(SECOND)))
    assert model.beam_elevations_deg == pytest.approx(beams)
    assert model.columns == 512
    assert caplog.text == ''
    front = SensorModels(config(sensor_rows=64, sensor_azimuth_deg=(-90.0, 90.0)))
    points = wall_around(FIRST)
    model = front.of(scan_of(points[points[:, 0] > 0.0]))
    assert (model.first_azimuth_deg, model.horizontal_fov_deg, model.columns) == (90.0, 180.0, 512)
    wrong = SensorModels(config(sensor_rows=16, sensor_fov_deg=(-10.0, 0.0)))
    assert wrong.of(scan_of(wall_around(FIRST))).rows == 16
    assert 'fit this sensor' in caplog.text


@pytest.mark.parametrize(
    'settings',
    [
        {'sensor_fov_deg': (-10.0, 10.0)},
        {'sensor_azimuth_deg': (-90.0, 90.0)},
        {'sensor_rows': 16, 'sensor_azimuth_deg': (90.0, -90.0)},
        {'sensor_rows': 16, 'sensor_fov_deg': (10.0, -10.0)},
        {'sensor_rows': 16, 'sensor_fov_deg': (10.0,)},
        {'sensor_beams_deg': (1.0,)},
        {'sensor_beams_deg': (1.0, 1.0)},
        {'sensor_rows': 3, 'sensor_beams_deg': (1.0, 2.0)},
        {'sensor_beams_deg': (1.0, 95.0)},
    ],
)
def test_impossible_angles_are_refused(settings):
    with pytest.raises(ConfigError, match='sensor_'):
        config(**settings)
