# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Models of lidars are fitted, checked on every scan, fitted again, or refused with a warning."""

import logging

import numpy as np

from surfel_mapper.config import TsdfConfig
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
    assert sensors.frames['lidar'].share > 0.9


def test_frame_without_a_model_is_tried_again_and_warned_of_once(caplog):
    sensors = SensorModels(config())
    with caplog.at_level(logging.WARNING):
        for seed in range(4):
            assert sensors.of(scan_of(scattered(seed))) is None
    assert caplog.text.count('no model of a lidar fits') == 1
    found = [sensors.of(scan_of(wall_around(FIRST))) for _ in range(4 * FIRST_RETRY)]
    assert found[-1] is not None


def test_layers_that_share_a_scan_share_its_check():
    sensors, scan = SensorModels(config()), scan_of(scattered())
    sensors.of(scan)
    due = sensors.frames['lidar'].due
    sensors.of(scan)
    assert sensors.frames['lidar'].due == due
