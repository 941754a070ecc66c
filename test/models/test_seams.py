# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Surfaces that continue each other: position and normal at their seams, creases, thin walls."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models import fit
from surfel_mapper.models.seams import continuation

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


def seams(model, points, size_m):
    """Return distances, m, and angles, deg, of neighbours at the points beside their seams."""
    gaps, angles = [np.empty(0)], [np.empty(0)]
    for one in model.surfaces:
        for other in model.surfaces[: model.surfaces.index(one)]:
            own, others = points[model.labels == one.id], points[model.labels == other.id]
            own = own[np.isfinite(cKDTree(others).query(own, distance_upper_bound=size_m)[0])]
            here, there = one.to_local(own), other.to_local(own)
            a, b = one.normals(here[:, :2]), other.normals(there[:, :2])
            cosine = np.einsum('ij,ij->i', a, b)
            above = (here[:, 2] - one.heights(here[:, :2])) * (a @ one.normal)
            beside = (there[:, 2] - other.heights(there[:, :2])) * (b @ other.normal)
            gaps.append(np.abs(above - np.sign(cosine) * beside))
            angles.append(np.degrees(np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))))
    return np.concatenate(gaps), np.concatenate(angles)


@pytest.mark.parametrize(
    ('points', 'most_deg'), [(cylinder(0.3, NOISE_M), 3.0), (ball(0.3, NOISE_M), 6.0)]
)
def test_surfaces_meet_within_the_noise(points, most_deg):
    model = fit(points, ModelsConfig(voxel_size_m=0.03), (0.0, 0.0, 5.0))
    assert len(model.surfaces) >= 4
    gap_m, angle_deg = seams(model, points, 0.03)
    assert len(gap_m) > 2000
    assert np.median(gap_m) < 0.5 * NOISE_M
    assert np.quantile(gap_m, 0.9) < NOISE_M
    assert np.median(angle_deg) < most_deg
    assert np.mean([surface.rms_m for surface in model.surfaces]) < 1.5 * NOISE_M


def test_coverage_is_that_of_own_points():
    points = cylinder(0.3, 0.0)
    model = fit(points, ModelsConfig(voxel_size_m=0.03), (0.0, 0.0, 5.0))
    for surface in model.surfaces:
        local = surface.to_local(points[model.labels == surface.id])[:, :2]
        assert surface.grid.contains(local).mean() > 0.95
        assert (local.min(axis=0) - surface.grid.origin < surface.grid.pitch_m).all()


def sheet(normal, start, num=2000):
    """Return points of a half plane that starts at x = 0 or 0.01, and their normals."""
    rng = np.random.default_rng(2)
    x_axis = np.cross([0.0, 1.0, 0.0], normal)
    along = rng.uniform(0.0, 0.5, (num, 1)) * x_axis + start
    return along + rng.uniform(0.0, 0.5, (num, 1)) * [0.0, 1.0, 0.0], np.tile(normal, (num, 1))


@pytest.mark.parametrize(
    ('tilt_deg', 'start', 'expected'),
    [
        (180.0, [0.0, 0.0, 0.0], True),  # flat: on to negative x
        (160.0, [0.0, 0.0, 0.0], True),
        (120.0, [0.0, 0.0, 0.0], False),  # a crease
        (0.0, [0.0, 0.0, -0.06], False),  # the other side of a thin wall
    ],
)
def test_points_beyond_a_smooth_seam_continue_a_surface(tilt_deg, start, expected):
    tilt = np.radians(tilt_deg)
    own, normal = sheet(np.array([0.0, 0.0, 1.0]), np.zeros(3))
    other, others = sheet(np.array([np.sin(tilt), 0.0, np.cos(tilt)]), np.array(start))
    found = continuation(0, [own, other], [normal, others], 0.09)
    assert bool(len(found)) == expected
    if expected:
        reach = np.linalg.norm(found - own[:, None], axis=2).min(axis=0) if len(found) < 500 else 0
        assert np.max(reach) <= 0.09
        assert len(found) > 0.5 * (np.abs(other[:, 0]) < 0.08).sum()
