# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Rows of voxels in the layout of kernels/layout.py, packed with Python's integers."""

import numpy as np


def packed(key, moments):
    """Return the row, 12 integers, of count, total (3), product (6) and view (3) of a voxel."""
    count, *sums = (int(value) for value in moments)
    total, product, view = sums[:3], sums[3:9], sums[9:]
    halves = [count % 2**16, count // 2**16]
    thirds = [view[2] % 2**48 // 2 ** (16 * place) % 2**16 for place in range(3)]
    views = [2**16 * value + half for value, half in zip(view[:2], halves, strict=True)]
    totals = [2**16 * value + third for value, third in zip(total, thirds, strict=True)]
    return [int(key), *views, *totals, *product]


def unpacked(row):
    """Return the 13 moments of a row."""
    _, *words = (int(word) for word in row)
    count = words[0] % 2**16 + 2**16 * (words[1] % 2**16)
    z = sum(words[2 + place] % 2**16 * 2 ** (16 * place) for place in range(3))
    view = [words[0] // 2**16, words[1] // 2**16, z - 2**48 if z >= 2**47 else z]
    return [count, *(word // 2**16 for word in words[2:5]), *words[5:], *view]


def slab_of(keys, moments):
    """Return the rows (R, 12) int64 of voxels."""
    rows = [packed(*voxel) for voxel in zip(keys, moments, strict=True)]
    return np.array(rows, np.int64).reshape(-1, 12)
