# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Points of scans in a temporary file come back with the same bits."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.scan_spool import ScanSpool


def scans():
    rng = np.random.default_rng(0)
    for number, dtype in enumerate((np.float32, np.float64, np.float32, np.float64)):
        points = rng.normal(size=(10 * number, 3)).astype(dtype)  # the first one is empty
        order = np.asfortranarray if number % 2 else np.ascontiguousarray
        yield order(points), {'intensity': rng.integers(0, 255, len(points)).astype(np.uint16)}


def test_points_and_columns_come_back_to_the_bit(tmp_path):
    spool, kept = ScanSpool(tmp_path), list(scans())
    for points, columns in kept:
        spool.append(points, columns)

    for number in (2, 0, 3, 1, 2):
        points, columns = kept[number]
        found = spool.points(number)
        np.testing.assert_array_equal(found, points)
        assert found.dtype == points.dtype
        assert found.flags.f_contiguous
        assert found.flags.writeable
        np.testing.assert_array_equal(spool.columns(number)['intensity'], columns['intensity'])
    assert len(spool) == len(kept)


def test_no_file_is_left_in_the_directory(tmp_path):
    spool = ScanSpool(tmp_path)
    spool.append(np.zeros((5, 3)), {})

    assert not list(tmp_path.iterdir())


def test_an_empty_spool_starts_again(tmp_path):
    spool = ScanSpool(tmp_path)
    spool.append(np.zeros((5, 3)), {})
    spool.clear()
    spool.append(np.ones((2, 3)), {})

    assert len(spool) == 1
    np.testing.assert_array_equal(spool.points(0), np.ones((2, 3)))


def test_a_missing_directory_is_named(tmp_path):
    with pytest.raises(
        FileFormatError, match=r'nowhere: no file for the points of scans: No such'
    ):
        ScanSpool(tmp_path / 'nowhere')
