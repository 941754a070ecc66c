# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The kernels that derive surfels from rows, against exact fractions.

Rows are filled by hand here. Surfels of whole maps are in test/mapping/test_surfels.py.
"""

from fractions import Fraction

import numpy as np
import pytest

from surfel_mapper.mapping.kernels.surfels import CHUNK, derive_surfels, side_of
from surfel_mapper.mapping.moments import pack_keys
from test import reference
from test.kernels.modes import both
from test.mapping.kernels.packed_rows import packed, unpacked

NAMES = ['position', 'normal', 'planarity', 'curvature', 'eigenvalues']


def row_of(places, voxel=(0, 0, 0), times=1, view=(0, 0, 0)):
    """Return the row of a voxel with repeated lattice places."""
    q = [[int(value) for value in place] for place in places]
    total = [times * sum(p[i] for p in q) for i in range(3)]
    product = [times * sum(p[i] * p[j] for p in q) for i, j in reference.PAIRS]
    key = pack_keys(np.array([voxel]))[0]
    return packed(key, [times * len(q), *total, *product, *view])


def twin_of(row, voxel, voxel_size_m):
    return reference.surfel(voxel, unpacked(row), voxel_size_m)


def outputs_for(num):
    return (
        np.full((num, 3), -7.0),
        np.full((num, 3), -7.0),
        np.full(num, -7.0),
        np.full(num, -7.0),
        np.full((num, 3), -7.0),
        np.full(num, -7, np.int64),
        np.full((num, 3), -7, np.int32),
    )


def random_rows(num, seed):
    rng = np.random.default_rng(seed)
    rows, voxels = [], []
    for _ in range(num):
        voxels.append(tuple(rng.integers(-(2**20), 2**20, 3).tolist()))
        middle, spread = rng.integers(-20000, 20000, 3), 10.0 ** rng.uniform(0, 4, 3)
        places = np.rint(middle + rng.uniform(-spread, spread, (rng.integers(1, 30), 3)))
        view = rng.integers(-(2**14), 2**14, 3) * len(places)
        rows.append(row_of(places, voxels[-1], int(rng.integers(1, 50)), view.tolist()))
    return rows, voxels


@both
@pytest.mark.parametrize('num', [0, 1, CHUNK - 1, CHUNK, CHUNK + 1, 3 * CHUNK])
def test_chosen_rows_are_derived_in_their_order(call, num):
    rows, voxels = random_rows(40, seed=1)
    chosen = np.random.default_rng(2).integers(0, 40, num).astype(np.int32)
    outputs = outputs_for(num)
    call(derive_surfels, np.array(rows), chosen, 0.25, 16, outputs)
    *quantities, num_points, voxel_index = outputs
    found = dict(zip(NAMES, quantities, strict=True))
    twins = [twin_of(row, voxel, 0.25) for row, voxel in zip(rows, voxels, strict=True)]
    assert [tuple(voxel) for voxel in voxel_index.tolist()] == [voxels[c] for c in chosen]
    assert num_points.tolist() == [twins[c]['num_points'] for c in chosen]
    for place, c in enumerate(chosen):
        twin = twins[c]
        assert np.abs(found['position'][place] - twin['position']).max() <= 1e-10
        error = np.abs(found['eigenvalues'][place] - twin['eigenvalues']).max()
        assert error <= 1e-12 * twin['eigenvalues'][2]
        if twin['eigenvalues'][2] == 0.0:
            assert np.isnan(found['normal'][place]).all()
        elif twin['eigenvalues'][1] - twin['eigenvalues'][0] > 1e-4 * twin['eigenvalues'][2]:
            assert np.linalg.norm(found['normal'][place] - twin['normal']) <= 1e-6


@both
@pytest.mark.parametrize('times', [1, 7, 49, 98, 10**6 + 3, 2**22, 2**31])
@pytest.mark.parametrize('place', [(0, 0, 0), (1, -1, 3), (-32768, 32767, 12345)])
def test_equal_points_spread_by_exactly_0(call, times, place):
    outputs = outputs_for(1)
    rows = np.array([row_of([place], times=times)])
    call(derive_surfels, rows, np.zeros(1, np.int32), 0.5, 16, outputs)
    assert outputs[4].tolist() == [[0.0] * 3]
    assert np.isnan(outputs[1]).all()


@both
@pytest.mark.parametrize('bits', [16, 20])
@pytest.mark.parametrize('times', [1, 3, 10**5, 2**21 - 1, 2**21, 2**30])
def test_eigenvalues_are_exact_to_rounding_for_any_number_of_points(call, times, bits):
    rng = np.random.default_rng(3)
    if times > (1 << 30) >> (2 * (bits - 16)):
        pytest.skip('a map of this level refuses more points')
    for spread in (1, 3, 100, 32767):
        places = rng.integers(-spread, spread + 1, (3, 3)) << (bits - 16)
        row = row_of(places, times=times)
        outputs = outputs_for(1)
        chosen = np.zeros(1, np.int32)
        call(derive_surfels, np.array([row]), chosen, 0.5, bits, outputs)
        exact = twin_of(row, (0, 0, 0), 1.0)['scatter']
        trace = sum(exact[i][i] for i in range(3))
        norm_sq = sum(exact[i][j] ** 2 for i in range(3) for j in range(3))
        unit = Fraction(0.5 / 2**bits) ** 2 / max(unpacked(row)[0] - 1, 1)
        values = [Fraction(value) / unit for value in outputs[4][0].tolist()]
        # trace and sum of squares are those of the matrix, and of its eigenvalues
        assert abs(sum(values) - trace) <= trace * Fraction(1, 10**14)
        assert abs(sum(v**2 for v in values) - norm_sq) <= norm_sq * Fraction(1, 10**14)


@both
@pytest.mark.parametrize('bits', [16, 17, 20])
def test_means_are_placed_for_voxels_of_any_level(call, bits):
    reach = 2 ** (bits - 1)
    places = [(-reach, 0, reach - 1), (-reach, 1, reach - 1)]
    outputs = outputs_for(1)
    rows = np.array([row_of(places, (2, -3, 0))])
    call(derive_surfels, rows, np.zeros(1, np.int32), 2.0, bits, outputs)
    cell = 2.0 / 2**bits
    # half a cell from the faces along x and z, a whole one above the middle along y
    expected = [4.0 + cell / 2, -5.0 + cell, 2.0 - cell / 2]
    assert np.abs(outputs[0][0] - expected).max() <= 1e-15


@both
@pytest.mark.parametrize(
    ('normal', 'view', 'away'),
    [
        ((0, 0, 1), (0, 0, 5), False),
        ((0, 0, 1), (0, 0, -5), True),
        ((0, 0, -1), (3, 2, 0), True),  # seen from the side: as if the sensor were unknown
        ((0, 0, 1), (3, 2, 0), False),
        ((0, 0, -1), (0, 0, 0), True),
        ((0.6, -0.8, 0), (0, 0, 0), True),
        ((0.8, -0.6, 0), (0, 0, 0), False),
        ((-0.5, 0.5, 0.70), (0, 0, 0), False),
        ((0.5, 0.5, -0.70), (0, 0, 0), True),
        ((-0.5, 0.5, 0.5), (0, 0, 0), True),  # the first of equal ones
        ((0.5, -0.5, -0.5), (0, 0, 0), False),
        ((0.1, -0.5, 0.5), (0, 0, 0), True),
    ],
)
def test_normals_turn_towards_the_sensor(call, normal, view, away):
    components = [float(value) for value in (*normal, *view)]
    assert call(side_of, *components) == (-1.0 if away else 1.0)
