# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Slab: rows stay and new ones are zero when it grows, also if memory cannot be moved."""

import numpy as np
import pytest

from surfel_mapper.mapping.storage import Slab


@pytest.mark.parametrize('width', [16, 512])
def test_a_new_slab_has_the_rows_asked_for_all_zero(width):
    for num_rows in (1, 3, 1000):
        array = Slab(num_rows, width).array
        assert array.dtype == np.int64
        assert array.shape[0] >= num_rows
        assert array.shape[1] == width
        assert array.flags.c_contiguous
        assert array.flags.writeable
        assert not array.any()


def grown(slab, expected):
    """Double a slab several times, fill new rows, and check all rows."""
    num_rows = len(expected)
    for _ in range(6):
        slab.grow(2 * num_rows)
        assert len(slab.array) >= 2 * num_rows
        assert (slab.array[:num_rows] == expected).all()
        assert not slab.array[num_rows:].any()
        slab.array[num_rows : 2 * num_rows] = np.arange(num_rows)[:, None] + num_rows
        num_rows *= 2
        expected = slab.array[:num_rows].copy()
    return slab


@pytest.mark.parametrize('width', [16, 512])
def test_growing_keeps_the_rows_and_adds_zeros(width):
    slab = Slab(256, width)  # 32 KiB or 1 MiB, which ends as 2 or 64 MiB
    slab.array[:] = -np.arange(len(slab.array))[:, None]
    grown(slab, slab.array.copy())


def test_a_slab_grows_while_a_view_of_its_rows_exists():
    slab = Slab(64, 16)
    slab.array[:] = 7
    held = slab.array
    slab.grow(128)
    slab.array[:] = 9
    assert (held == 7).all()
    assert len(slab.array) == 128


def test_rows_written_are_rows_read():
    slab = Slab(32, 16)
    slab.array[3, 5] = -(2**63)
    slab.array[31, 15] = 2**63 - 1
    slab.grow(4096)
    assert slab.array[3, 5] == -(2**63)
    assert slab.array[31, 15] == 2**63 - 1
    assert np.count_nonzero(slab.array) == 2
