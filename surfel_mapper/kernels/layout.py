# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Numbers that the kernels of the map share: the lattice, the voxel key, a row of the slab.

A voxel key packs the three indices, each of 21 bits and offset by 2^20, into 63 bits of an
int64, x highest. A map keeps one row of 16 int64 a voxel: 128 bytes, two neighbouring cache
lines, so that a voxel costs one miss (a separate array for each moment would cost thirteen).
"""

BITS = 16
"""A voxel is 2^BITS lattice units wide."""

HALF = 1 << (BITS - 1)
"""Half a voxel in lattice units."""

INDEX_BITS = 21
"""Bits of a voxel index along one axis."""

INDEX_OFFSET = 1 << (INDEX_BITS - 1)
"""Voxel indices lie in [-INDEX_OFFSET, INDEX_OFFSET)."""

INDEX_MASK = (1 << INDEX_BITS) - 1

MAX_SCAN_COUNT = 1 << 23
"""Points in one voxel of one scan: up to here float64 sums of the moments are exact."""

MAX_MAP_COUNT = 1 << 31
"""Points in one voxel of a map: up to here int64 sums of the moments do not overflow."""

VIEW_SCALE = 1 << 14
"""Length of the integer unit vectors that say from where a voxel was seen."""

# Columns of a row. A free row has COUNT 0 and the next free row in KEY.
KEY = 0
COUNT = 1
VERSION = 2
SUM = 3
PRODUCT = 6
VIEW = 12
ROW = 16
"""The last column is unused: it pads the row to two cache lines."""
