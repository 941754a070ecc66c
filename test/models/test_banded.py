# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Small banded systems: held against numpy's solution of the full matrix."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.models.kernels.banded import solve_band


@pytest.mark.parametrize(('number', 'width'), [(1, 1), (3, 8), (40, 1), (40, 7), (40, 40)])
def test_a_band_is_solved_as_the_full_matrix_is(number, width):
    rng = np.random.default_rng(number + width)
    band, right = rng.uniform(-1.0, 1.0, (number, width)), rng.normal(size=number)
    band[:, 0] = 2.0 * width + 1.0  # more than the rest of its row and column together
    full = np.zeros((number, number))
    for i in range(number):
        for k in range(min(width, number - i)):
            full[i, i + k] = full[i + k, i] = band[i, k]
    expected = np.linalg.solve(full, right)
    solve_band(band, right)
    np.testing.assert_allclose(right, expected, rtol=1e-12, atol=1e-12)
