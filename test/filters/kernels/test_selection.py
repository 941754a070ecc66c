# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Copies of selected points, against numpy; the mask is tested in test/filters/kernels."""

import numpy as np
import pytest

from surfel_mapper.filters.kernels.selection import compact
from test.kernels.modes import both


@both
@pytest.mark.parametrize('share', [0.0, 0.02, 0.5, 0.98, 1.0])
@pytest.mark.parametrize('run', [1, 50, 130])
@pytest.mark.parametrize('num', [1, 63, 64, 65, 500])
def test_a_mask_keeps_the_order_of_every_row_whether_points_go_alone_or_in_runs(
    call, num, run, share
):
    rng = np.random.default_rng(num * run)
    values, keep = rng.normal(size=(3, num)), np.repeat(rng.random(num) < share, run)[:num]
    memory = np.full((3, keep.sum() + 70), np.nan)
    call(compact, values, keep, memory[:, : keep.sum()])
    np.testing.assert_array_equal(memory[:, : keep.sum()], values[:, keep])
    assert np.isnan(memory[:, keep.sum() :]).all()  # nothing is written past the end
