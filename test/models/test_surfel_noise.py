# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The noise of the sensor, from maps of planes with known noise, and live models with it."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config import ModelsLayerConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.models.live import LEAST_ESTIMATED, LiveModels
from surfel_mapper.models.surfel_noise import map_noise, MOST_M
from test.models.depth_frames import posed_frames


def square(sigma, number=90_000, seed=0):
    """Return points on a slanted square of 2 x 2 m."""
    rng = np.random.default_rng(seed)
    flat = np.c_[rng.uniform(-1.0, 1.0, (number, 2)), sigma * rng.standard_normal(number)]
    return flat @ np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0].T


def map_of(points, size_m):
    surfel_map = SurfelMap(size_m)
    surfel_map.add(points)
    return surfel_map


@pytest.mark.parametrize('size_m', [0.02, 0.03, 0.06, 0.1])
@pytest.mark.parametrize('sigma', [0.003, 0.005, 0.007, 0.015])
def test_the_noise_of_a_plane_is_found(size_m, sigma):
    assert map_noise(map_of(square(sigma), size_m)) == pytest.approx(sigma, rel=0.15)


def test_a_plane_without_noise_has_none():
    assert map_noise(map_of(square(0.0), 0.03)) < 1e-4


def test_large_noise_is_bounded():
    assert map_noise(map_of(square(0.05), 0.2)) == MOST_M


@pytest.mark.parametrize('points', [np.empty((0, 3)), square(0.005, 50)])
def test_too_few_points_tell_nothing(points):
    assert map_noise(map_of(points, 0.03)) == 0.0


@pytest.mark.parametrize('size_m', [0.03, 0.1])
@pytest.mark.parametrize('sigma', [0.003, 0.007, 0.015])
def test_live_models_find_a_noisy_plane_with_the_default_settings(size_m, sigma):
    models = LiveModels(ModelsLayerConfig(), map_of(square(sigma), size_m))
    models.update()
    assert models.noise_m == pytest.approx(sigma, rel=0.15)
    counts = models.surfels.num_points
    largest = max(counts[models.model.labels == plane.id].sum() for plane in models.model.planes)
    assert largest > 0.95 * counts.sum()


@pytest.mark.parametrize('updates_each', [False, True])
def test_frames_of_a_kinect_have_few_gaussians(data_folder, updates_each):
    """2,748 by the thickness of voxels of 5 cm; 669 with a stated noise of 10 mm."""
    surfel_map = SurfelMap(0.05)
    models = LiveModels(ModelsLayerConfig(), surfel_map)
    for points, origin in posed_frames(data_folder, 10):
        surfel_map.add(points, origin=origin)
        if updates_each:
            models.update()
    models.update()
    assert len(models.model.gaussians) <= 700


def test_a_configured_noise_is_taken_as_it_is():
    models = LiveModels(ModelsLayerConfig(noise_m=0.002), map_of(square(0.007), 0.03))
    models.update()
    assert models.noise_m == 0.002


def test_ids_stay_when_the_noise_is_found():
    """A few voxels are a plane before enough of them tell the noise."""
    points, surfel_map = square(0.004), SurfelMap(0.1)
    models = LiveModels(ModelsLayerConfig(), surfel_map)
    surfel_map.add(points[np.abs(points).max(axis=1) < 0.4])
    models.update()
    assert surfel_map.num_voxels < LEAST_ESTIMATED
    assert models.noise_m == 0.0
    (before,) = models.model.planes
    surfel_map.add(points)
    update = models.update()
    assert models.noise_m == pytest.approx(0.004, rel=0.15)
    assert before.id in update.updated
    (after,) = models.model.planes
    assert after.id == before.id
