# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The kernels that derive surfels from rows, against exact fractions.

Rows are filled by hand here. Surfels of whole maps are in test/mapping/test_surfels.py.
"""

from fractions import Fraction

import numpy as np
import pytest

from surfel_mapper.kernels.layout import STAMP_ROW
from surfel_mapper.mapping.kernels.surfels import derive_surfels
from surfel_mapper.mapping.moments import pack_keys
from test import reference
from test.kernels.modes import both
from test.mapping.kernels.packed_rows import packed, unpacked


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
        np.full(num, -7, np.int64),
        np.full((num, 6), -7.0),
    )


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
        stamps = np.ones((1, STAMP_ROW), np.uint32)
        call(derive_surfels, np.array([row]), stamps, chosen, 0.5, bits, outputs)
        exact = twin_of(row, (0, 0, 0), 1.0)['scatter']
        trace = sum(exact[i][i] for i in range(3))
        norm_sq = sum(exact[i][j] ** 2 for i in range(3) for j in range(3))
        unit = Fraction(0.5 / 2**bits) ** 2 / max(unpacked(row)[0] - 1, 1)
        values = [Fraction(value) / unit for value in outputs[4][0].tolist()]
        # trace and sum of squares are those of the matrix, and of its eigenvalues
        assert abs(sum(values) - trace) <= trace * Fraction(1, 10**14)
        assert abs(sum(v**2 for v in values) - norm_sq) <= norm_sq * Fraction(1, 10**14)
