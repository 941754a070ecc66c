# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The noise of depth cameras, white, in steps and correlated, against truth and a slow twin."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models import fit
from surfel_mapper.models.noise import estimate_noise, NoiseSamples
from surfel_mapper.models.thinning import thin
from test.bench import tabletop
from test.models import depth_frames
from test.models.depth_frames import SIGMA, STEP_SIGMA, wall

KINDS = {
    'white': ({'white': True}, SIGMA),
    'steps': ({'steps': True}, STEP_SIGMA),
    'white in steps': ({'white': True, 'steps': True}, np.hypot(SIGMA, STEP_SIGMA)),
    'matched': ({'matched': 9}, SIGMA),
    'matched in steps': ({'matched': 9, 'steps': True}, np.hypot(SIGMA, STEP_SIGMA)),
}
"""Arguments of a wall, and sigma of its depth by depth^2."""


def samples_of(thinned, view):
    return NoiseSamples(thinned.points, thinned.rows, thinned.starts, thinned.means, view=view)


def noise_of(cloud, size_m):
    """Return the estimate at the median point, m, and depth times range there, m^2."""
    thinned = thin(cloud.reshape(-1, 3), size_m)
    voxels = thinned.by_voxel()
    samples = samples_of(thinned, np.zeros(3))
    n0, n2 = estimate_noise(samples, size_m)
    range_sq = np.nanmedian((voxels.points**2).sum(axis=1))
    return n0 + n2 * range_sq, np.median(voxels.points[:, 2]) * np.sqrt(range_sq)


@pytest.mark.parametrize('slope', [0.0, 0.37], ids=['facing', 'slanted'])
@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('size_m', [0.02, 0.04])
def test_walls_of_depth_cameras_are_one_plane_with_their_noise(kind, slope, size_m):
    arguments, sigma = KINDS[kind]
    cloud = wall(slope, **arguments)
    if kind == 'steps' and slope == 0.0:
        cloud = wall(0.02, **arguments)  # at one depth there are no steps to see
    model = fit(cloud, ModelsConfig(voxel_size_m=size_m))
    assert len(model.planes) == 1
    assert not model.surfaces
    assert not len(model.gaussians)
    points = cloud.reshape(-1, 3)
    range_sq = np.median((points**2).sum(axis=1))
    along = sigma * np.median(points[:, 2]) * np.sqrt(range_sq)
    assert model.noise[0] + model.noise[1] * range_sq == pytest.approx(along, rel=0.25)


def test_an_unorganised_cloud_has_the_noise_of_the_organised_one():
    cloud = wall(0.37, matched=9, steps=True)
    shuffled = np.random.default_rng(0).permutation(cloud.reshape(-1, 3))
    one, other = (fit(points, ModelsConfig()) for points in (cloud, shuffled))
    assert other.noise == pytest.approx(one.noise, rel=0.1, abs=1e-3)
    assert len(other.planes) == 1


@pytest.mark.parametrize(
    ('name', 'number'),
    [
        *(('sevenscenes', n) for n in (0, 100, 300, 500, 800)),
        *(('slambook2', n) for n in (1, 3, 5)),
    ],
)
def test_noise_of_real_rooms_equals_the_twin(data_folder, name, number):
    cloud = depth_frames.real_frame(data_folder, name, number)
    expected = depth_frames.disparity_noise(cloud)
    sigma_m, scale = noise_of(cloud, 0.04)
    assert sigma_m == pytest.approx(expected * scale, rel=0.25)


@pytest.mark.parametrize('size_m', [0.01, 0.02, 0.03])
def test_noise_of_real_tables_equals_the_twin(data_folder, size_m):
    for file in sorted((data_folder / 'data' / 'osd').glob('*.pcd')):
        cloud = tabletop.frame(file)[0].reshape(480, 640, 3)
        sigma_m, scale = noise_of(cloud, size_m)
        assert sigma_m == pytest.approx(depth_frames.disparity_noise(cloud) * scale, rel=0.25)


def test_walls_of_real_rooms_are_few_planes(data_folder):
    """With neighbouring pixels alone the first frame was 207 planes in 34 kB."""
    model = fit(depth_frames.real_frame(data_folder, 'sevenscenes', 0), ModelsConfig())
    assert len(model.planes) <= 70
    assert model.size_bytes < 15_000


@pytest.mark.parametrize(('size_m', 'impure'), [(0.01, 0.03), (0.02, 0.04), (0.03, 0.05)])
def test_a_table_under_books_is_one_plane_without_them(size_m, impure):
    """Books were in the plane of the table, a tenth of the points, as layers of its clusters."""
    figures = []
    for seed in range(4):
        points, labels = depth_frames.table_of_books(seed)
        figures.append(tabletop.ours(points, labels, size_m))
    assert min(one['table'] for one in figures) >= 0.9
    assert np.mean([one['impure'] for one in figures]) <= impure


def test_noise_grows_with_the_square_of_the_range():
    rng, parts = np.random.default_rng(7), []
    for far in (1.0, 2.0, 3.0, 4.0):
        xy = rng.uniform(-0.6, 0.6, (40_000, 2))
        z = far + 1.5e-3 * far**2 * rng.standard_normal(len(xy))
        parts.append(np.column_stack([xy, z]))
    thinned = thin(np.concatenate(parts), 0.06)
    samples = samples_of(thinned, np.zeros(3))
    n0, n2 = estimate_noise(samples, 0.06)
    for far in (1.0, 2.0, 3.0, 4.0):
        assert n0 + n2 * far**2 == pytest.approx(1.5e-3 * far**2, rel=0.25)


@pytest.mark.parametrize('number', [0, 1, 40])
def test_too_few_points_have_no_noise(number):
    points = np.zeros((number, 3)) + np.arange(number)[:, None] * [0.1, 0.0, 0.0]
    thinned = thin(points, 0.04)
    samples = samples_of(thinned, np.ones(3))
    assert estimate_noise(samples, 0.04) == (0.0, 0.0)
