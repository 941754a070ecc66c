# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Bisection of a cluster: moments, 2-means and the mixture against slow twins."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.kernels.bisection import (
    MEANS_ITERATIONS,
    MEANS_SAMPLE,
    SETTLED_SHARE,
    split_two_means,
)
from surfel_mapper.models.kernels.gaussian_mixture import (
    ITERATIONS,
    SETTLED,
    split_mixture,
    TERMS,
)


def two_sheets(number, seed):
    """Return points (3, n) on two sheets that meet at an angle, far from the origin."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-0.5, 0.5, (2, number))
    bent = np.where(u > 0.1, 0.7 * (u - 0.1), 0.0)
    points = np.stack([u, 0.6 * v, bent + 0.004 * rng.standard_normal(number)])
    return points + np.array([[40.0], [-7.0], [3.0]])


def frame_of(points):
    values, vectors = np.linalg.eigh(np.cov(points))
    return points.mean(axis=1), values, np.ascontiguousarray(vectors.T[::-1])


@pytest.mark.parametrize('number', [40, 700, 5 * MEANS_SAMPLE + 3])
def test_two_means_equal_lloyd_from_the_principal_axis(number):
    points = two_sheets(number, 3)
    mean, values, frame = frame_of(points)
    share, plane, sums = np.empty(number), np.append(frame[0], 0.0), np.empty(8)
    split_two_means(*points, mean, plane, share, sums)

    sample = (points - mean[:, None])[:, :: 1 + number // MEANS_SAMPLE]
    reach = np.sqrt(2.0 * values[2] / np.pi) * frame[0]
    centres, before = np.stack([-reach, reach]), None
    for _ in range(MEANS_ITERATIONS):
        side = nearer_second(sample, centres)
        if before is not None and (side != before).sum() < SETTLED_SHARE * sample.shape[1]:
            break
        centres = np.stack([sample[:, ~side].mean(axis=1), sample[:, side].mean(axis=1)])
        before = side
    np.testing.assert_array_equal(share, nearer_second(points - mean[:, None], centres))
    assert sums[3] == share.sum()


def nearer_second(points, centres):
    first, second = (((points - c[:, None]) ** 2).sum(axis=0) for c in centres)
    return second < first


def test_mixture_equals_textbook_expectation_maximisation():
    from scipy.stats import multivariate_normal  # seconds to import

    points = two_sheets(180, 4)
    mean = points.mean(axis=1)
    away = (points - mean[:, None]).T
    middle = np.median(away[:, 0])
    expected = (away[:, 0] > middle).astype(np.float64)
    products = (away.T @ away)[np.triu_indices(3)]
    total, plane = np.concatenate([[180.0], np.zeros(3), products]), np.array([1.0, 0, 0, middle])
    share = expected.copy()
    split_mixture(*points, mean, plane, total, np.empty(TERMS), np.empty(TERMS), share)

    for _ in range(ITERATIONS):
        densities = []
        for weights in (1.0 - expected, expected):
            total = weights.sum()
            centre = weights @ away / total
            covariance = np.cov(away.T, aweights=weights, bias=True)
            covariance += np.eye(3) * (1e-8 + 1e-4 * np.trace(covariance) / 3.0)
            densities.append(total * multivariate_normal.pdf(away, centre, covariance))
        new = densities[1] / (densities[0] + densities[1])
        change, expected = np.abs(new - expected).max(), new
        if change < SETTLED:
            break
    np.testing.assert_allclose(share, expected, atol=1e-7)
