# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Frame and kind of patches, and touching point sets, against numpy and analytic surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.patches import (
    bend_height,
    described,
    PatchPoints,
)


def bowl(radius_m, half_m=0.5, number=4000):
    """Return points on a paraboloid whose radius of curvature at its vertex is given."""
    xy = np.random.default_rng(1).uniform(-half_m, half_m, (number, 2))
    return np.column_stack([xy, 0.5 / radius_m * (xy**2).sum(axis=1)])


def test_bend_of_a_paraboloid_is_its_rise_and_that_of_a_plane_is_zero():
    points = bowl(1.0)
    bend = bend_height(points, 0.05)
    rise = np.percentile(points[:, 2], [5.0, 95.0])
    assert bend == pytest.approx(rise[1] - rise[0], rel=0.05)
    level = points * [1.0, 1.0, 0.0]
    assert bend_height(level, 0.05) == 0.0
    assert bend_height(level[:3], 0.5) == -1.0


def test_kind_and_moments_of_patches():
    flat = bowl(1.0) * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.0]
    points, starts = np.concatenate([flat, bowl(1.0)]), np.array([0, 4000, 8000])
    groups = PatchPoints(points, starts, np.tile([0.0, 0.0, 1.0], (2, 1)), np.full(2, 0.04))
    rules = groups.thickness, 0.05, True, True
    means, covariances, frames, curved = described(groups, np.array([0.0, 0.0, 9.0]), rules)
    assert curved.tolist() == [False, True]
    for k in range(2):
        own = points[starts[k] : starts[k + 1]]
        np.testing.assert_allclose(means[k], own.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(covariances[k], np.cov(own.T), atol=1e-12)
        np.testing.assert_allclose(frames[k] @ frames[k].T, np.eye(3), atol=1e-9)
        assert frames[k, 2, 2] > 0.999
