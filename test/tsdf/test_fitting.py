# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The fitted lidar model equals the known one that made the points."""

import numpy as np
import pytest

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.tsdf.fitting import fitted_lidar
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
    found = fitted_lidar(points, ring, **RANGES)
    assert (found.rows, found.columns) == (8, 256)
    assert np.abs(np.subtract(found.beam_elevations_deg, beams)).max() <= 1e-4
    assert (found.min_range_m, found.max_range_m) == (0.5, 40.0)


def test_without_rings_the_beams_are_evenly_spaced():
    points, _ = points_of(LidarModel(rows=16, columns=300, vertical_fov_deg=30.0))
    found = fitted_lidar(points, rows=16, **RANGES)
    assert (found.rows, found.columns) == (16, 300)
    assert np.abs(np.degrees(found.elevations_rad) - np.linspace(15.0, -15.0, 16)).max() <= 1e-4


def test_given_rows_and_columns_are_not_fitted():
    points, ring = points_of(LidarModel(rows=16, columns=300, vertical_fov_deg=30.0))
    found = fitted_lidar(points, ring, rows=32, columns=512, **RANGES)
    assert (found.rows, found.columns, found.beam_elevations_deg) == (32, 512, ())
    assert fitted_lidar(points, ring, columns=512, **RANGES).columns == 512
    assert fitted_lidar(points, **RANGES).rows == 64


def test_rings_of_one_elevation_are_one_beam():
    points, _ = points_of(LidarModel(rows=2, columns=64, vertical_fov_deg=10.0))
    found = fitted_lidar(points, np.arange(128) // 32, **RANGES)
    assert found.rows == 2
    assert fitted_lidar(points, np.zeros(128, int), **RANGES).rows == 64  # of one ring: no beams


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
        fitted_lidar(points, **RANGES)
