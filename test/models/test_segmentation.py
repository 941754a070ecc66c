# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Thinning, flat clusters, and merging of clusters, against slow twins."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models import fit
from surfel_mapper.models.segmentation import segment_cloud
from surfel_mapper.models.thinning import thin
from test.models.scenes import A, room, sheet, VIEW

OFF_GRID = (0.011, 0.004, 0.007)
"""A sheet through the edges of voxels crosses half as many as any other of its direction."""

ABOVE = np.array([0.0, 0.0, 5.0])


def clustered(points, viewpoint=ABOVE, **settings):
    config = ModelsConfig(**{'voxel_size_m': A, **settings})
    return segment_cloud(thin(points, config.voxel_size_m).means, config, viewpoint), config


def flat_share(clusters):
    return clusters.num_points[clusters.flat].sum() / max(clusters.num_points.sum(), 1)


@pytest.mark.parametrize(
    ('cloud', 'is_flat'),
    [
        (sheet(0.9, 0.6, A), True),
        (sheet(0.9, 0.6, A, sigma=A / 8), True),
        (sheet(0.9, 0.6, A, sigma=A / 2), False),  # thicker than a voxel
        (sheet(0.9, 0.6, 2.5 * A), False),  # sparse
        (sheet(0.9, A / 2, A / 2), False),  # a line
    ],
)
def test_cluster_is_flat_if_thin_dense_and_wide(cloud, is_flat):
    clusters = segment_cloud(cloud, ModelsConfig(voxel_size_m=A, min_points=100_000), ABOVE)
    assert clusters.flat.tolist() == [is_flat]


def test_outlier_share_is_allowed_but_not_in_strict_mode():
    cloud = np.concatenate([sheet(0.9, 0.9, A), [[0.0, 0.0, 0.05]] * 5])
    strict = ModelsConfig(voxel_size_m=A, min_points=100_000, outlier_share=0.0)
    allowed = ModelsConfig(voxel_size_m=A, min_points=100_000, outlier_share=0.02)
    assert not segment_cloud(cloud, strict, ABOVE).flat[0]
    assert segment_cloud(cloud, allowed, ABOVE).flat[0]


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(
    'cloud',
    [
        np.empty((0, 3)),
        np.full((7, 3), np.nan),
        np.zeros((1, 3)),
        np.zeros((500, 3)),
        np.arange(600.0)[:, None] * [0.013, 0.017, -0.011],
        sheet(1.0, 1.0, 0.02),
        sheet(1.0, 1.0, 0.02, normal=(1.0, 2.0, -3.0)),
        sheet(0.1, 0.1, 0.04) + 1e6,
        np.repeat(sheet(0.2, 0.2, 0.1), 300, axis=0),
    ],
)
@pytest.mark.parametrize('profile', ['robust', 'paper'])
def test_degenerate_clouds_give_a_result_that_holds_every_point_once(cloud, profile):
    model = fit(cloud, ModelsConfig(voxel_size_m=A, profile=profile))
    total = sum(p.num_points for p in model.patches) + model.gaussians.num_points.sum()
    assert total == model.num_thinned
    finite = np.isfinite(cloud).all(axis=1)
    assert ((model.labels >= 0) == finite).all()
    assert np.isfinite(model.resample()).all()


def test_clusters_partition_the_points_and_have_exact_moments():
    points, _ = room(160, 120)
    clusters, _ = clustered(points, VIEW)
    assert sorted(clusters.order) == list(range(len(clusters.points)))
    assert clusters.rows[0, 0] == 0
    assert clusters.rows[-1, 1] == len(clusters.points)
    assert (clusters.rows[1:, 0] == clusters.rows[:-1, 1]).all()
    covariances = clusters.covariances()
    for k in range(len(clusters)):
        own = clusters.points[slice(*clusters.rows[k])]
        np.testing.assert_allclose(clusters.mean[k], own.mean(axis=0), atol=1e-12)
        if len(own) > 1:
            np.testing.assert_allclose(covariances[k], np.cov(own.T), atol=1e-12)


def test_result_is_reproducible_and_independent_of_point_order():
    points, _ = room(160, 120)
    config = ModelsConfig(voxel_size_m=A)
    order = np.random.default_rng(5).permutation(len(points))
    once, again, other = (fit(p, config, VIEW) for p in (points, points, points[order]))
    assert (once.labels == again.labels).all()
    assert (once.labels[order] == other.labels).all()


@pytest.mark.parametrize('normal', [(0, 0, 1), (0, 1, 1), (1, 1, 1), (1, 0, 0), (1, 2, 5)])
def test_full_sheets_of_any_direction_are_flat(normal):
    clusters, _ = clustered(sheet(2.0, 1.5, A / 6, normal, OFF_GRID))
    assert flat_share(clusters) >= 0.97


def test_paper_profile_rejects_an_axis_aligned_floor():
    """The least density of 2 is just above that of an axis-aligned sheet, a point a voxel."""
    floor, diagonal = sheet(2.0, 1.5, A / 6), sheet(2.0, 1.5, A / 6, (1, 1, 1), OFF_GRID)
    assert flat_share(clustered(floor, profile='paper')[0]) < 0.6
    assert flat_share(clustered(diagonal, profile='paper')[0]) > 0.95


def test_noisy_room_is_mostly_flat_if_the_noise_is_known():
    points, _ = room(320, 240, noise_per_range_sq=1.425e-3)
    assert flat_share(clustered(points, VIEW, noise_per_range_sq=1.425e-3)[0]) >= 0.8


def test_parallel_planes_merge_within_an_offset_and_not_beyond():
    def num_planes(step):
        both = np.concatenate(
            [sheet(0.6, 0.6, A, centre=(-0.3, 0, 0.0)), sheet(0.6, 0.6, A, centre=(0.3, 0, step))]
        )
        return len(fit(both, ModelsConfig(voxel_size_m=A), ABOVE).planes)

    assert num_planes(0.5 * A) == 1
    assert num_planes(3.0 * A) == 2


@pytest.mark.parametrize('angle_deg', [30.0, 45.0, 90.0])
def test_two_sheets_that_meet_at_an_angle_are_two_planes(angle_deg):
    t = math.radians(angle_deg)
    flat = sheet(0.9, 0.9, A / 6, centre=(-0.45, 0, 0))
    normal = (-math.sin(t), 0.0, math.cos(t))
    other = sheet(0.9, 0.9, A / 6, normal, (0.45 * math.cos(t), 0, 0.45 * math.sin(t)))
    model = fit(np.concatenate([flat, other]) + OFF_GRID, ModelsConfig(voxel_size_m=A), ABOVE)
    assert not model.surfaces
    large = [p for p in model.planes if p.num_points > 300]
    assert len(large) == 2
    between = math.degrees(math.acos(abs(large[0].normal @ large[1].normal)))
    assert between == pytest.approx(angle_deg, abs=2.0)


def cloud(reach, dtype):
    """Return points near and far with repeated ones in a row, and some that are not finite."""
    rng = np.random.default_rng(2)
    near = np.repeat(rng.normal(scale=0.3, size=(700, 3)), rng.integers(1, 300, 700), axis=0)
    points = np.concatenate([near, rng.uniform(-reach, reach, (300, 3))]).astype(dtype)
    points[::97] = np.nan
    points[5], points[6, 1] = np.inf, -np.inf
    return points
