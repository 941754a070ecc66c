# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Tensor voting: the kernels against slow twins, labels and densities on known shapes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from surfel_mapper.filters.kernels.tensor_voting import closed_form_votes, first_votes
from surfel_mapper.filters.shapes import as_matrices, PAIRS
from surfel_mapper.filters.tensor_voting import mean_decay
from test.filters.examples import filter_of, scan_of

SALIENCY, SPECTRAL = 'saliency', 'spectral_decomposition'

CURVE, SURFACE = 2, 3

EYE = np.eye(3)


def slow_first(points, ids, sigma, to_neighbours):
    """Return the first votes as matrices."""
    found = np.tile(EYE, (len(ids), 1, 1))
    for row, near in enumerate(ids):
        for other in near[1:]:
            if other == len(points):
                continue
            votes = found[other if to_neighbours else row]
            v = points[other] - points[near[0]]
            far = np.linalg.norm(v) / sigma
            if 0.0 < far < 3.0:
                r = v / np.linalg.norm(v)
                votes += far**2 * (far - 3.0) ** 4 / 16.0 * (EYE - np.outer(r, r))
    return found


def slow_closed_form(points, ids, tensors, sigma, symmetric):
    """Return the votes in closed form as matrices, from equation 11."""
    found = np.zeros((len(ids), 3, 3))
    for votes, near in zip(found, ids, strict=True):
        for other in near[1:]:
            if other == len(points):
                continue
            v = points[near[0]] - points[other]
            distance = np.linalg.norm(v)
            if 0.0 < distance < 3.0 * sigma:
                r = np.outer(v, v) / distance**2
                turn = EYE - 2.0 * r
                vote = turn @ tensors[other] @ (EYE - 0.5 * r) @ turn
                lower = np.tril(vote) + np.tril(vote, -1).T
                taken = 0.5 * (vote + vote.T) if symmetric else lower
                votes += math.exp(-(distance**2) / sigma) * taken
    return found


@pytest.mark.parametrize('sigma', [0.05, 0.3, 5.0, math.inf, 0.0])
@pytest.mark.parametrize('compiled', [True, False])
@pytest.mark.parametrize('symmetric', [True, False])
def test_the_kernels_cast_the_votes_that_their_slow_twins_cast(sigma, compiled, symmetric):
    rng = np.random.default_rng(1)
    points = rng.uniform(-1.0, 1.0, (40, 3))
    points[7] = points[6]  # at one place: no direction, no vote
    ids = np.array([np.argsort(((points - p) ** 2).sum(axis=1))[:9] for p in points], np.int32)
    ids[3, 5:] = 40
    factors = rng.normal(size=(40, 3, 3))
    tensors = factors @ factors.transpose(0, 2, 1)
    rows = np.stack([tensors[:, i, j] for i, j in PAIRS], axis=1)
    votes = np.empty((6, 40))
    first, again = (k if compiled else k.py_func for k in (first_votes, closed_form_votes))

    with np.errstate(divide='ignore', invalid='ignore'):
        first(points, ids, np.float64(sigma), not symmetric, votes)
        expected = slow_first(points, ids, np.float64(sigma), not symmetric)
        np.testing.assert_allclose(as_matrices(votes), expected, atol=1e-12)
        again(points, ids, rows, np.float64(sigma), symmetric, votes)
        expected = slow_closed_form(points, ids, tensors, np.float64(sigma), symmetric)
        np.testing.assert_allclose(as_matrices(votes), expected, atol=1e-11)


def grid(*axes):
    """Return the points of a grid."""
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3).astype(np.float64)


LINE = np.linspace(-1.0, 1.0, 41)
PLANE = grid(LINE + 50.0, LINE, 0.0)
CURVE_X = grid(LINE, 0.0, 0.0)
BALL = grid(LINE[::4] * 0.5, LINE[::4] * 0.5 + 50.0, LINE[::4] * 0.5)


def middle(points, centre, size=0.25):
    return (np.abs(points - centre) <= size).all(axis=1)


def test_planes_lines_and_clouds_are_told_apart():
    found = filter_of(SALIENCY, k=26).apply(scan_of(np.concatenate([PLANE, CURVE_X, BALL])))
    columns = found.columns
    plane, line, ball = (
        middle(found.points, centre) for centre in ([50.0, 0, 0], [0.0, 0, 0], [0.0, 50.0, 0])
    )
    assert (columns['labels'][plane] == SURFACE).all()
    assert (columns['labels'][line] == CURVE).all()
    # within an even cloud no direction is preferred
    assert columns['surfaceness'][ball].max() < 0.01 * columns['surfaceness'][plane].min()
    assert columns['curveness'][ball].max() < 0.01 * columns['curveness'][line].min()
    inside = middle(found.points, [50.0, 0, 0])
    normals = np.abs(columns['normals'][inside])
    np.testing.assert_allclose(normals, np.tile([0.0, 0, 1], (inside.sum(), 1)), atol=1e-6)
    inside = middle(found.points, [0.0, 0, 0])
    tangents = np.abs(columns['tangents'][inside])
    np.testing.assert_allclose(tangents, np.tile([1.0, 0, 0], (inside.sum(), 1)), atol=1e-6)


@pytest.mark.parametrize('name', [SALIENCY, SPECTRAL])
def test_sticks_plates_and_balls_add_up(name):
    rng = np.random.default_rng(2)
    found = filter_of(name, k=20, sigma=1.0).apply(scan_of(rng.uniform(-1, 1, (300, 3)))).columns
    assert (found['sticks'].shape[1], found['plates'].shape[1]) == (4, 7)
    for stick, plate in ((found['sticks'][:, 1:], found['plates'][:, 1:4]),):
        np.testing.assert_array_equal(stick, plate)
    np.testing.assert_allclose(found['sticks'][:, 0] / 20, found['surfaceness'])
    np.testing.assert_allclose(found['plates'][:, 0] / 20, found['curveness'])
    np.testing.assert_allclose(found['balls'] / 20, found['pointness'])
    across = (found['plates'][:, 4:] * found['tangents']).sum(axis=1)
    np.testing.assert_allclose(across, 0.0, atol=1e-12)


def test_columns_are_left_out_where_not_wanted():
    scan = scan_of(np.random.default_rng(3).uniform(-1, 1, (60, 3)))
    flags = dict.fromkeys(('keepNormals', 'keepLabels', 'keepTensors'), 0)
    bare = {'surfaceness', 'curveness', 'pointness'}
    assert set(filter_of(SALIENCY, **flags).apply(scan).columns) == bare
    assert set(filter_of(SPECTRAL, **flags, keepLambdas=0).apply(scan).columns) == bare


def test_a_point_without_votes_has_no_normal():
    found = filter_of(SALIENCY).apply(scan_of([[0.0, 0, 0], [9.0, 0, 0]])).columns
    assert np.isnan(found['normals']).all()
    assert found['surfaceness'].tolist() == [0.0, 0.0]


@pytest.mark.parametrize('dimension', [1, 2, 3])
@pytest.mark.parametrize(('sigma', 'radius'), [(0.2, 0.4), (1.0, 0.05), (0.05, 2.0), (9.0, 1e-4)])
def test_the_mean_decay_is_the_mean_over_the_ball(dimension, sigma, radius):
    r = (np.arange(200_000) + 0.5) / 200_000 * radius
    weight = r ** (dimension - 1)
    expected = (np.exp(-(r**2) / sigma) * weight).sum() / weight.sum()
    assert mean_decay(dimension, sigma, radius) == pytest.approx(expected, rel=1e-6)


def test_the_mean_decay_at_its_limits():
    found = [mean_decay(2, *each) for each in ((0.2, 0.0), (0.2, math.inf), (0.0, 1.0))]
    assert found == [1.0, 0.0, 0.0]


# ---- SpectralDecomposition


def dense_and_sparse(seed=5):
    """Return a plane of 2 m a side with 4000 points, and 20 m away one with 100."""
    rng = np.random.default_rng(seed)
    dense = rng.uniform([-1, -1, 0], [1, 1, 0], (4000, 3))
    sparse = rng.uniform([19, -1, 0], [21, 1, 0], (100, 3))
    return np.concatenate([dense, sparse])


def test_density_becomes_even_and_what_is_sparse_stays():
    scan = scan_of(dense_and_sparse(), row=range(4100))
    found = filter_of(SPECTRAL, k=20).apply(scan)
    rows = found.columns['row']
    assert (np.diff(rows) > 0).all()
    assert np.count_nonzero(rows >= 4000) == 100
    # 20 neighbours within 0.4 m are 40 points on a square metre; the last round halves
    assert 20.0 * 4.0 < np.count_nonzero(rows < 4000) < 50.0 * 4.0
    np.testing.assert_array_equal(found.points, scan.points[rows])


def test_points_far_from_all_others_are_dropped():
    scan = scan_of(np.concatenate([PLANE[:400], [[0.0, 0.0, 30.0]]]), row=range(401))
    found = filter_of(SPECTRAL, radius=0).apply(scan)
    assert found.columns['row'].tolist() == list(range(400))
