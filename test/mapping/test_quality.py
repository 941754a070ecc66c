# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Columns that tell how good a surfel is, against exact fractions; numbers of scans, kept exactly.

Points come in pairs about the centre of a voxel, along its axes, so that the eigenvalues are
rational.
"""

import copy
from dataclasses import replace
from fractions import Fraction
import math
import pickle

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from surfel_mapper import SurfelMap
from surfel_mapper.errors import MapError
from surfel_mapper.mapping.surfels import concatenated

pytestmark = pytest.mark.filterwarnings('error')

NOISE_SQ = Fraction(0.01) ** 2


def crosses(steps, times, voxel_size_m=0.5):
    """Return points ``times`` at both ends of a step along each axis about a voxel's centre."""
    unit_m = voxel_size_m / 65536
    ends = np.array(
        [sign * step * np.eye(3)[i] for i, step in enumerate(steps) for sign in (1, -1)]
    )
    return np.repeat((ends + 32768.5) * unit_m, times, axis=0)


def expected_quality(steps, times, voxel_size_m=0.5):
    """Return the squares of thickness, normal_sigma and radius as fractions."""
    n = 6 * times
    unit_sq = (Fraction(voxel_size_m) / 65536) ** 2
    e0, e1, e2 = sorted(2 * times * Fraction(step) ** 2 * unit_sq / (n - 1) for step in steps)
    variance = e0 * (n - 1) / (n - 3)
    s = max(variance, NOISE_SQ)
    sigma_sq = 3 * s * sum(e / (e - s) ** 2 for e in (e1, e2)) / (n - 1) if e1 > s else math.inf
    return variance, sigma_sq, 2 * (e1 + e2)


@pytest.mark.parametrize('voxel_size_m', [0.5, 0.2])
@given(
    steps=st.permutations([st.integers(0, 9000), *[st.integers(15000, 32767)] * 2]).flatmap(
        lambda ranges: st.tuples(*ranges)
    ),
    times=st.integers(1, 500),
)
def test_quality_is_that_of_exact_fractions(voxel_size_m, steps, times):
    surfel_map = SurfelMap(voxel_size_m)
    surfel_map.add(crosses(steps, times, voxel_size_m))
    (surfel,) = surfel_map.surfels()

    variance, sigma_sq, radius_sq = expected_quality(steps, times, voxel_size_m)
    assert surfel.thickness == pytest.approx(math.sqrt(variance), rel=1e-12, abs=1e-12)
    expected = min(math.sqrt(sigma_sq), math.pi / 2)
    assert surfel.normal_sigma == pytest.approx(expected, rel=1e-9)
    assert surfel.radius == pytest.approx(math.sqrt(radius_sq), rel=1e-13)
    assert (surfel.size, surfel.num_scans) == (voxel_size_m, 1)


@pytest.mark.parametrize('number', [1, 2, 3])
def test_up_to_three_points_have_no_thickness_and_no_sigma(number):
    surfel_map = SurfelMap(0.5)
    surfel_map.add([[0.1, 0.1, 0.1], [0.4, 0.1, 0.1], [0.1, 0.4, 0.1]][:number])
    (surfel,) = surfel_map.surfels()

    assert np.isnan([surfel.thickness, surfel.normal_sigma]).all()
    assert (surfel.radius == 0.0) == (number == 1)


def test_a_line_has_an_undetermined_normal_and_equal_points_have_none():
    surfel_map = SurfelMap(1.0)
    surfel_map.add(np.linspace([0.1, 0.5, 0.5], [0.9, 0.5, 0.5], 9))
    surfel_map.add(np.tile([5.5, 0.5, 0.5], (9, 1)))
    surfels = surfel_map.surfels()
    line, spot = surfels.select(np.argsort(surfels.voxel_index[:, 0]))

    assert (line.thickness, line.normal_sigma) == (0.0, math.pi / 2)
    assert (spot.thickness, spot.radius) == (0.0, 0.0)
    assert math.isnan(spot.normal_sigma)


@pytest.mark.parametrize('level', [0, 2])
def test_covariances_have_the_eigenvalues_of_their_surfels(level):
    rng = np.random.default_rng(4)
    surfel_map = SurfelMap(0.5)
    surfel_map.add(rng.normal(scale=[2.0, 2.0, 0.05], size=(5000, 3)) + 100.0)
    coarse = surfel_map.coarsen(level)
    assert coarse.surfels().covariance is None
    since = coarse.version - 1
    for surfels in (
        coarse.surfels(5, covariance=True),
        coarse.surfels(5, 100, covariance=True),
        coarse.surfels_changed(since, 5, covariance=True),
        coarse.surfels_of(coarse.find(coarse.keys(5)), covariance=True),
    ):
        xx, xy, xz, yy, yz, zz = surfels.covariance.T
        rows = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
        np.testing.assert_allclose(np.linalg.eigvalsh(rows), surfels.eigenvalues, atol=1e-14)
        table = surfels.to_numpy()
        np.testing.assert_array_equal(table['cov_yz'], yz)
        both = concatenated([surfels[:3], surfels[3:]])
        np.testing.assert_array_equal(both.covariance, surfels.covariance)
        assert concatenated([surfels, coarse.surfels()]).covariance is None


def scans_and_voxels(num=7):
    """Return scans, and the number of them in each voxel of 0.5 m."""
    rng = np.random.default_rng(8)
    scans = [rng.uniform(-2.0, 2.0, (60, 3)) for _ in range(num)]
    hit = [np.unique(np.floor(points / 0.5), axis=0) for points in scans]
    voxels, numbers = np.unique(np.concatenate(hit), axis=0, return_counts=True)
    return scans, dict(zip(map(tuple, voxels.astype(int).tolist()), numbers.tolist(), strict=True))


def num_scans_of(surfel_map):
    surfels = surfel_map.surfels()
    voxels = map(tuple, surfels.voxel_index.tolist())
    return dict(zip(voxels, surfels.num_scans.tolist(), strict=True))


def test_copies_pickles_merges_and_moves_keep_the_numbers_of_scans():
    scans, expected = scans_and_voxels()
    first, second = SurfelMap(0.5), SurfelMap(0.5)
    for number, points in enumerate(scans):
        (first, second)[number % 2].add(points)
    before = num_scans_of(first)
    first.merge(second)

    assert num_scans_of(first) == expected
    assert num_scans_of(first.copy()) == num_scans_of(copy.deepcopy(first)) == expected
    assert num_scans_of(pickle.loads(pickle.dumps(first))) == expected
    assert num_scans_of(first.at_origin([5.0, 0.0, 0.0]).at_origin([0.0] * 3)) == expected
    moments = first.moments()
    rebuilt = SurfelMap(0.5)
    for rows in (slice(0, 9), slice(9, None)):
        rebuilt.insert(moments.select(rows))
    assert num_scans_of(rebuilt) == expected
    first.subtract(second)
    assert num_scans_of(first) == before


def test_a_coarse_cell_has_the_scans_of_its_most_hit_voxel():
    scans, expected = scans_and_voxels()
    surfel_map = SurfelMap(0.5)
    for points in scans:
        surfel_map.add(points)
    most = {}
    for (i, j, k), number in expected.items():
        cell = i >> 1, j >> 1, k >> 1
        most[cell] = max(most.get(cell, 0), number)

    coarse = surfel_map.coarsen(1)

    assert num_scans_of(coarse) == most
    assert set(coarse.surfels().size) == {1.0}


def test_a_voxel_has_at_least_one_scan_and_at_most_its_points():
    """Also if scans are removed in other pieces than they were added in."""
    surfel_map = SurfelMap(0.5)
    points = np.full((3, 3), 0.1)
    surfel_map.add(points)
    surfel_map.remove(surfel_map.reduce(points[:1]))
    surfel_map.remove(surfel_map.reduce(points[:1]))
    assert surfel_map.surfels().num_scans.tolist() == [1]
    surfel_map.remove(surfel_map.reduce(points[:1]))
    for point in points:
        surfel_map.add(point[None])
    surfel_map.remove(surfel_map.reduce(points[:2]))
    assert surfel_map.moments().num_scans.tolist() == [1]


@pytest.mark.parametrize('numbers', [[0], [4], [-1], [1, 1], [1.0]])
def test_impossible_numbers_of_scans_are_refused(numbers):
    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.full((3, 3), 0.1))
    moments = surfel_map.moments()
    wrong = np.array(numbers)
    object.__setattr__(moments, 'num_scans', wrong)
    with pytest.raises(MapError, match='scans'):
        surfel_map.insert(moments)
    assert surfel_map.num_points == 3


def test_a_surfel_is_good_by_thickness_sigma_and_scans():
    surfel_map = SurfelMap(0.5)
    rng = np.random.default_rng(2)
    flat = rng.uniform(0.0, 0.5, (3, 100, 3)) * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.25]
    kinds = {
        'plane': flat,
        'thick': flat + rng.normal(0.0, 0.04, flat.shape) * [0.0, 0.0, 1.0],
        'line': flat * [1.0, 0.0, 1.0] + [0.0, 0.25, 0.0],
        'two scans': flat[:2],
        'two points': flat[:, :1],
    }
    for place, scans in enumerate(kinds.values()):
        for points in scans:
            surfel_map.add(points + np.array([2.0 * place, 0.0, 0.0]))
    surfels = surfel_map.surfels()

    good = surfels.select(surfels.is_good)

    assert good.voxel_index[:, 0].tolist() == [0]
    assert len(surfels) == len(kinds)


def test_copies_keep_the_quality():
    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.random.default_rng(1).uniform(0.0, 2.0, (900, 3)))
    surfels, fresh = surfel_map.surfels(), surfel_map.surfels()
    thickness = surfels.thickness
    copies = copy.deepcopy(fresh), pickle.loads(pickle.dumps(fresh)), replace(fresh, channels={})
    for other in (*copies, fresh[:], concatenated([fresh])):
        np.testing.assert_array_equal(other.thickness, thickness)
        np.testing.assert_array_equal(other.radius, surfels.radius)
