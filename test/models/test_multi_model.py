# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Samples of Gaussians: bounded by volume, and with the expected values of one for each point."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models import fit
from surfel_mapper.models.multi_model import Gaussians, MultiModel
from test.models.live_scenes import of_points
from test.models.scenes import A, room, VIEW

SIZE_M = 0.1
MOST = 343
"""Samples in a voxel whose points are all in its corners."""


def gaussians(num_points, seed=3):
    """Return Gaussians as large as voxels, with the given numbers of points."""
    rng, number = np.random.default_rng(seed), len(num_points)
    factor = rng.uniform(-1.0, 1.0, (number, 3, 3)) * SIZE_M / 6.0
    return Gaussians(
        id=np.arange(number),
        num_points=np.array(num_points, np.int64),
        mean=rng.uniform(0.0, 1.0, (number, 3)),
        covariance=factor @ np.swapaxes(factor, 1, 2),
    )


def model_of(found):
    return MultiModel([], [], found, np.empty(0, np.int32), SIZE_M, 0)


def drawn_one_by_one(mean, covariance, number, rng):
    """Return a sample for each point, (number, 3): a Gaussian within three sigma."""
    factor, points = np.linalg.cholesky(covariance), []
    while len(points) < number:
        away = rng.normal(size=3)
        if away @ away <= 9.0:
            points.append(mean + factor @ away)
    return np.array(points)


def test_number_of_samples_does_not_grow_with_the_points_of_a_voxel():
    few, many = gaussians([3] * 20), gaussians([10**12] * 20)
    np.testing.assert_array_equal(few.sample_counts(SIZE_M), 3)
    counts = many.sample_counts(SIZE_M)
    assert counts.min() > 3
    assert counts.max() <= MOST
    assert len(model_of(many).resample()) == counts.sum()
    even = Gaussians(np.zeros(1, int), np.array([500]), np.zeros((1, 3)), np.eye(3)[None] / 12)
    assert even.sample_counts(1.0).tolist() == [88]


def test_points_that_are_equal_have_one_sample():
    points = Gaussians(np.zeros(1, int), np.array([500]), np.ones((1, 3)), np.zeros((1, 3, 3)))
    np.testing.assert_array_equal(model_of(points).resample(), np.ones((1, 3)))


def test_samples_of_a_live_map_are_bounded_after_many_scans():
    rng = np.random.default_rng(4)
    scan = rng.uniform(0.0, 0.6, (2000, 3))
    for times in (20, 200):
        _, models = of_points(np.repeat(scan, times, axis=0))
        assert models.model.gaussians.num_points.sum() > 0.9 * 2000 * times
        assert len(models.model.resample()) <= 100 * len(models.model.gaussians)


def test_a_thinned_cloud_has_a_sample_for_each_point():
    points, _ = room(320, 240, noise_per_range_sq=1e-3)
    for kinds in ('all', 'gaussians'):
        found = fit(points, ModelsConfig(voxel_size_m=A, kinds=kinds), VIEW).gaussians
        np.testing.assert_array_equal(found.sample_counts(A), found.num_points)


def test_bounded_samples_of_a_gaussian_have_the_moments_of_all_its_points():
    one = gaussians([4000], seed=9)
    every = drawn_one_by_one(one.mean[0], one.covariance[0], 4000, np.random.default_rng(1))
    counts = one.sample_counts(SIZE_M)
    assert counts[0] < 150
    found = np.concatenate([one.samples(seed, counts) for seed in range(200)])
    sigma = np.sqrt(np.diag(one.covariance[0]))
    # four standard errors of 4000 points
    assert (np.abs(found.mean(axis=0) - every.mean(axis=0)) < 4.0 * sigma / 4000**0.5).all()
    scale = np.outer(sigma, sigma)
    assert (np.abs(np.cov(found.T) - np.cov(every.T)) < 4.0 * (2.0 / 4000) ** 0.5 * scale).all()


def test_precision_is_that_of_a_sample_for_each_point():
    rng = np.random.default_rng(2)
    found = gaussians(rng.integers(1, 3000, 30))
    reference = rng.uniform(0.0, 1.0, (60, 3))
    rows = zip(found.mean, found.covariance, found.num_points, strict=True)
    every = np.concatenate([drawn_one_by_one(*row, rng) for row in rows])
    distance = cdist(every, reference).min(axis=1)
    figures = [model_of(found).evaluate(reference, seed) for seed in range(20)]
    precision = np.mean([figure.precision_rms_m**2 for figure in figures]) ** 0.5
    assert precision == pytest.approx(np.mean(distance**2) ** 0.5, rel=0.01)
    far = np.mean([figure.precision_p95_m for figure in figures])
    assert far == pytest.approx(np.percentile(distance, 95.0), rel=0.02)
