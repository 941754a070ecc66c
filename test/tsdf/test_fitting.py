# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The fitted lidar model equals the known one that made the points."""

import numpy as np
import pytest

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.tsdf.fitting import best_fit, candidates, fit_share, LEAST_FIT
from surfel_mapper.tsdf.sensors import LidarModel

RANGES = {'min_range_m': 0.5, 'max_range_m': 40.0}


def points_of(lidar, seed=0, keep=0.8):
    """Return points and rings of a turn, some nan and some at 0."""
    rng = np.random.default_rng(seed)
    points = lidar.directions * rng.uniform(2.0, 30.0, (lidar.rows, lidar.columns, 1))
    points[rng.random((lidar.rows, lidar.columns)) > keep] = np.nan
    points[rng.random((lidar.rows, lidar.columns)) > 0.95] = 0.0
    ring = np.repeat(np.arange(lidar.rows)[::-1], lidar.columns)  # counted from below
    return points.reshape(-1, 3).astype(np.float32), ring


def test_with_rings_every_beam_gets_its_elevation():
    beams = (12.0, 7.5, 4.0, 1.0, -0.5, -3.0, -9.0, -20.0)
    points, ring = points_of(LidarModel(rows=8, columns=256, beam_elevations_deg=beams))
    found = candidates(points, ring, **RANGES)[0]
    assert (found.rows, found.columns) == (8, 256)
    assert np.abs(np.subtract(found.beam_elevations_deg, beams)).max() <= 1e-4
    assert (found.min_range_m, found.max_range_m) == (0.5, 40.0)


def test_rings_of_one_elevation_are_one_beam():
    points, _ = points_of(LidarModel(rows=2, columns=64, vertical_fov_deg=10.0))
    found = candidates(points, np.arange(128) // 32, **RANGES)[0]
    assert found.rows == 2
    # without usable rings the clusters of elevations are the beams
    assert candidates(points, np.zeros(128, int), **RANGES)[0].rows == 2


@pytest.mark.parametrize(
    'points',
    [
        np.empty((0, 3), np.float32),
        np.full((9, 3), np.nan, np.float32),
        np.zeros((9, 3), np.float32),
        np.array([[1.0, 0, 0], [0, 2.0, 0], [3.0, 1.0, 0]], np.float32),
        np.array([[1.0, 0, 0.2]]),
    ],
)
def test_points_without_two_beams_are_refused(points):
    with pytest.raises(CloudFormatError, match='expected those of a lidar with two beams'):
        candidates(points, **RANGES)[0]


def test_points_overhead_and_of_any_size_do_not_count():
    lidar = LidarModel(rows=16, columns=360, vertical_fov_deg=30.0)
    points = 5.0 * lidar.directions.reshape(-1, 3)
    odd = [[0.0, 0.0, 3.0], [0.0, 0.0, -3.0], [1e-9, 0.0, 3.0], [1e200, 1e200, -1e300]]
    odd += [[np.nan, 1.0, 1.0], [np.inf, -np.inf, 1.0]]
    limits = {'min_range_m': 0.5, 'max_range_m': 20.0}

    assert candidates(np.vstack([points, odd]), **limits)[0] == candidates(points, **limits)[0]
    with pytest.raises(CloudFormatError, match='two beams or more'):
        candidates(np.array(odd), **limits)[0]


def test_beams_without_rings_are_the_clusters_of_elevations():
    beams = (12.0, 7.5, 4.0, 1.0, -0.5, -3.0, -9.0, -20.0)
    points, _ = points_of(LidarModel(rows=8, columns=256, beam_elevations_deg=beams))
    found = candidates(points, **RANGES)[0]
    assert (found.rows, found.columns) == (8, 256)
    assert np.abs(np.subtract(found.beam_elevations_deg, beams)).max() <= 1e-4


@pytest.mark.parametrize('share', [-0.4, 0.0, 0.3])
def test_columns_go_through_the_points(share):
    step = 360.0 / 1024
    first = 180.0 + share * step
    true = LidarModel(
        rows=16, columns=1024, vertical_fov_deg=30.0, first_azimuth_deg=first, max_range_m=40.0
    )
    points, ring = points_of(true)
    found = candidates(points, ring, **RANGES)[0]
    assert found.columns == 1024
    assert found.first_azimuth_deg == pytest.approx(first, abs=1e-3 * step)
    part = np.arctan2(points[:, 1], points[:, 0]) > 2.0
    found = candidates(points[part], ring[part], **RANGES)[0]
    assert found.first_azimuth_deg == pytest.approx(first, abs=1e-3 * step)


def wall_around(lidar, radius_m=8.0):
    """Return the points of a lidar in the middle of a round room with a floor."""
    directions = lidar.directions.reshape(-1, 3).astype(np.float64)
    level = np.hypot(directions[:, 0], directions[:, 1])
    distance = radius_m / level
    down = directions[:, 2] < 0.0
    distance[down] = np.minimum(distance[down], -1.5 / directions[down, 2])
    return directions * distance[:, None]


def test_a_lidar_fits_its_model_and_no_other_cloud_does():
    lidar = LidarModel(rows=64, columns=1024, vertical_fov_deg=40.0, max_range_m=40.0)
    points = wall_around(lidar)
    model, share = best_fit(points, None, 0.2, **RANGES)
    assert model is not None
    assert (model.rows, model.columns) == (64, 1024)
    assert share > 0.9

    mounted = points + np.array([1.2, 0.3, 1.8])
    offset = np.array([1.5, 0.0, 0.3])
    merged = np.concatenate([points + offset, points[:, [1, 0, 2]] - offset])
    rng = np.random.default_rng(1)
    scattered = rng.normal(size=(9000, 3)) * rng.uniform(2.0, 9.0, (9000, 1))
    for cloud in (mounted, merged, scattered):
        model, share = best_fit(cloud, None, 0.2, **RANGES)
        assert model is None
        assert share < LEAST_FIT


def test_share_of_fitting_points_falls_with_wrong_columns():
    lidar = LidarModel(rows=64, columns=1024, vertical_fov_deg=40.0, max_range_m=40.0)
    points = wall_around(lidar)
    assert fit_share(lidar, points, 0.2) > 0.99
    twice = LidarModel(rows=64, columns=2048, vertical_fov_deg=40.0, max_range_m=40.0)
    assert fit_share(twice, points, 0.2) < 0.1
    assert fit_share(lidar, np.full((4, 3), np.nan), 0.2) == 0.0
