# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Coarser maps from finer ones, against the points regrouped; copies, subtraction and equality.

The expected moments of a coarse voxel are summed from the lattice coordinates of all points.
"""

import numpy as np
import pytest

from surfel_mapper.errors import MapError, MapLimitError, NotInMapError
from surfel_mapper.mapping.surfel_map import SurfelMap
from test import reference

pytestmark = pytest.mark.filterwarnings('error')


def scans_at(offset_m, num=4):
    rng = np.random.default_rng(5)
    return [
        (rng.normal(scale=3.0, size=(300, 3)) + offset_m, rng.normal(size=3) + offset_m)
        for _ in range(num)
    ]


def map_of(scans):
    surfel_map = SurfelMap(0.5)
    for points, origin in scans:
        surfel_map.add(points, origin)
    return surfel_map


def regrouped(scans, level):
    """Return the moments of voxels 2^level times larger, from the points; views are summed."""
    moments = {}
    for points, origin in scans:
        for point in points:
            fine, _ = reference.quantise(point, 0.5)
            lattice = [int(np.floor(value * (65536 / 0.5))) for value in point]
            voxel = tuple(value >> (16 + level) for value in lattice)
            q = [(x & (2 ** (16 + level) - 1)) - 2 ** (15 + level) for x in lattice]
            view = reference.view_of(fine, origin, 0.5)
            products = [q[i] * q[j] for i, j in reference.PAIRS]
            row = moments.setdefault(voxel, [0] * 13)
            row[:] = [a + b for a, b in zip(row, [1, *q, *products, *view], strict=True)]
    return moments


@pytest.mark.parametrize('offset_m', [0.0, -1e4])
@pytest.mark.parametrize('level', [0, 1, 2, 5, 9])
def test_a_coarser_map_holds_the_points_regrouped(level, offset_m):
    scans = scans_at(offset_m)
    coarse, expected = map_of(scans).coarsen(level), regrouped(scans, level)
    assert (coarse.voxel_size_m, coarse.level) == (0.5 * 2**level, level)
    assert reference.as_twin(coarse.moments()) == expected
    assert coarse.digest() == reference.digest(expected, 0.5 * 2**level, level)


def test_coarsening_twice_is_coarsening_at_once():
    fine = map_of(scans_at(0.0))
    assert fine.coarsen(2).coarsen(3).digest() == fine.coarsen(5).digest()


@pytest.mark.parametrize('level', [1, 4])
def test_surfels_of_a_coarser_map_are_those_of_its_points(level):
    scans = scans_at(100.0)
    unit_m = 0.5 / 65536
    coarse = map_of(scans).coarsen(level).surfels(min_points=10)
    points = np.concatenate([points for points, _ in scans])
    voxels = np.floor(points / (0.5 * 2**level)).astype(int)
    quantised = (np.floor(points * (65536 / 0.5)) + 0.5) * unit_m
    for row, voxel in enumerate(coarse.voxel_index):
        inside = quantised[(voxels == voxel).all(axis=1)]
        assert np.abs(coarse.position[row] - inside.mean(axis=0)).max() <= 1e-12
        e0, e1, e2 = np.linalg.eigvalsh(np.cov(inside.T))
        assert np.abs(coarse.eigenvalues[row] - [e0, e1, e2]).max() <= 1e-12 * e2
        assert coarse.planarity[row] == pytest.approx(2 * (e1 - e0) / (e0 + e1 + e2), abs=1e-11)


def test_a_coarser_map_takes_no_scan():
    coarse = map_of(scans_at(0.0)).coarsen(1)
    with pytest.raises(MapError, match='this map has 1 m, level 1'):
        coarse.add([[0.0, 0.0, 0.0]])


@pytest.mark.parametrize('level', [-1, 21, 100])
def test_a_level_out_of_bounds_is_refused(level):
    with pytest.raises(ValueError, match='level'):
        map_of([]).coarsen(level)


def test_too_many_points_for_a_level_are_refused():
    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.random.default_rng(1).uniform(0.0, 0.5, (8, 3)))
    assert surfel_map.coarsen(14).num_points == 8  # 2^31 / 4^14 is 8; one more level: 2
    with pytest.raises(MapLimitError, match='at most 2'):
        surfel_map.coarsen(15)


def test_a_box_of_a_map_is_coarsened_alone():
    surfel_map = map_of(scans_at(0.0))
    low, high = np.array([-4, -4, -2]), np.array([3, 5, 3])
    index = surfel_map.moments().voxel_index
    inside = index[((index >= low) & (index <= high)).all(axis=1)]
    part = SurfelMap(surfel_map.voxel_size_m)
    part.insert(surfel_map.moments(inside))

    coarse = surfel_map.coarsen(1, within=(low, high))

    assert 0 < part.num_voxels < surfel_map.num_voxels
    assert coarse == part.coarsen(1)


def test_maps_of_other_voxels_or_levels_are_not_equal():
    assert SurfelMap(0.5) == SurfelMap(0.5)
    assert SurfelMap(0.5) != SurfelMap(0.25)
    assert SurfelMap(0.5) != SurfelMap(0.5, level=1)


def test_subtracting_undoes_merging():
    scans = scans_at(0.0)
    whole, part = map_of(scans), map_of(scans[2:])
    whole.subtract(part)
    assert whole == map_of(scans[:2])
    before = whole.digest()
    with pytest.raises(NotInMapError):
        whole.subtract(part)
    assert whole.digest() == before
