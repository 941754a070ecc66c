# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfaces that continue each other: position and normal at their seams, creases, thin walls.

Bounds of live models are those of fit: medians of half the noise, in position.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from surfel_mapper.config import ModelsConfig, ModelsLayerConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.models import fit
from surfel_mapper.models.live import LiveModels
from surfel_mapper.models.seams import with_smooth_seams

NOISE_M = 0.005


def cylinder(radius_m, noise_m, num=60_000):
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0.0, 2.0 * np.pi, num), rng.uniform(0.0, 0.8, num)
    reach = radius_m + noise_m * rng.standard_normal(num)
    return np.stack([reach * np.cos(angle), reach * np.sin(angle), height], axis=1)


def ball(radius_m, noise_m, num=60_000):
    rng = np.random.default_rng(1)
    way = rng.standard_normal((num, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return way * (radius_m + noise_m * rng.standard_normal((num, 1)))


def seams(surfaces, labels, points, size_m):
    """Return distances, m, and angles, deg, of neighbours at the points beside their seams."""
    gaps, angles = [np.empty(0)], [np.empty(0)]
    for number, one in enumerate(surfaces):
        for other in surfaces[:number]:
            own, others = points[labels == one.id], points[labels == other.id]
            own = own[np.isfinite(cKDTree(others).query(own, distance_upper_bound=size_m)[0])]
            here, there = one.to_local(own), other.to_local(own)
            a, b = one.normals(here[:, :2]), other.normals(there[:, :2])
            cosine = np.einsum('ij,ij->i', a, b)
            above = (here[:, 2] - one.heights(here[:, :2])) * (a @ one.normal)
            beside = (there[:, 2] - other.heights(there[:, :2])) * (b @ other.normal)
            gaps.append(np.abs(above - np.sign(cosine) * beside))
            angles.append(np.degrees(np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))))
    return np.concatenate(gaps), np.concatenate(angles)


def distances(surface, points):
    """Return the signed distances of points from a surface along its normals, m."""
    local = surface.to_local(points)
    height = local[:, 2] - surface.heights(local[:, :2])
    return height * (surface.normals(local[:, :2]) @ surface.normal)


@pytest.mark.parametrize(
    ('points', 'most_deg'), [(cylinder(0.3, NOISE_M), 3.0), (ball(0.3, NOISE_M), 6.0)]
)
def test_surfaces_meet_within_the_noise(points, most_deg):
    model = fit(points, ModelsConfig(voxel_size_m=0.03), (0.0, 0.0, 5.0))
    assert len(model.surfaces) >= 3
    gap_m, angle_deg = seams(model.surfaces, model.labels, points, 0.03)
    assert len(gap_m) > 2000
    assert np.median(gap_m) < 0.5 * NOISE_M
    assert np.quantile(gap_m, 0.9) < 1.3 * NOISE_M
    assert np.median(angle_deg) < most_deg
    owned = [(surface, points[model.labels == surface.id]) for surface in model.surfaces]
    away_m = np.concatenate([distances(surface, own) for surface, own in owned])
    assert np.sqrt(np.mean(away_m**2)) == pytest.approx(NOISE_M, rel=0.1)


def live_labels(models, points):
    """Return the label of the voxel of each point."""
    voxels, size_m = models.surfels.voxel_index, models.map.voxel_size_m
    label = dict(zip(map(tuple, voxels.tolist()), models.model.labels.tolist(), strict=True))
    index = np.floor(points / size_m).astype(np.int64)
    return np.array([label[tuple(voxel)] for voxel in index.tolist()])


@pytest.mark.parametrize(
    ('points', 'size_m', 'most_deg'),
    [
        (cylinder(0.3, NOISE_M), 0.03, 4.0),
        (ball(0.3, NOISE_M), 0.03, 4.0),
        (cylinder(0.3, NOISE_M), 0.06, 6.0),
        (ball(0.3, NOISE_M), 0.06, 6.0),
    ],
)
def test_live_surfaces_meet_within_the_noise(points, size_m, most_deg):
    surfel_map = SurfelMap(size_m)
    surfel_map.add(points, origin=(0.0, 0.0, 5.0))
    models = LiveModels(ModelsLayerConfig(noise_m=NOISE_M), surfel_map)
    models.update()
    surfaces = models.model.surfaces
    assert len(surfaces) >= 4
    gap_m, angle_deg = seams(surfaces, live_labels(models, points), points, size_m)
    assert len(gap_m) > 2000
    assert np.median(gap_m) < 0.5 * NOISE_M
    assert np.quantile(gap_m, 0.9) < max(NOISE_M, 0.1 * size_m)
    assert np.median(angle_deg) < most_deg
    assert np.mean([surface.rms_m for surface in surfaces]) < 1.5 * NOISE_M


def test_surfaces_of_more_noise_than_half_a_voxel_stay_as_they_are():
    model = fit(cylinder(0.3, NOISE_M), ModelsConfig(voxel_size_m=0.03), (0.0, 0.0, 5.0))
    points = [cylinder(0.3, NOISE_M)[model.labels == surface.id] for surface in model.surfaces]
    rough = [replace(surface, rms_m=0.016) for surface in model.surfaces]
    config = ModelsConfig(voxel_size_m=0.03)
    assert with_smooth_seams(rough, points, config) == rough
    refitted = with_smooth_seams([rough[0], *model.surfaces[1:]], points, config)
    assert refitted[0] is rough[0]
    assert any(a is not b for a, b in zip(refitted[1:], model.surfaces[1:], strict=True))


def test_coverage_is_that_of_own_points():
    points = cylinder(0.3, 0.0)
    model = fit(points, ModelsConfig(voxel_size_m=0.03), (0.0, 0.0, 5.0))
    for surface in model.surfaces:
        local = surface.to_local(points[model.labels == surface.id])[:, :2]
        assert surface.grid.contains(local).mean() > 0.95
        assert (local.min(axis=0) - surface.grid.origin < surface.grid.pitch_m).all()
