# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Constants that all kernels of the map share: the lattice, the voxel key, a row of the slab.

A voxel key packs the three indices, each of 21 bits and offset by 2^20, into 63 bits of an
int64, x highest. A map keeps one row of 16 int64 for each voxel: 128 bytes, two neighbouring cache
lines, so that a voxel costs one cache miss (separate arrays of each moment would cost thirteen).

Stands alone because files and messages read it too, which need no kernel.
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
"""Maximum number of points of one scan in a voxel: float64 sums of their moments are exact."""

MAX_MAP_COUNT = 1 << 31
"""Maximum number of points of a map in a voxel: int64 sums of their moments do not overflow."""

VIEW_SCALE = 1 << 14
"""Length of the integer vectors that point from a voxel to the sensor."""

# Columns of a row. A free row has COUNT 0 and the next free row in KEY.
KEY = 0
COUNT = 1
VERSION = 2
SUM = 3
PRODUCT = 6
VIEW = 12
ROW = 16
"""The last column is unused: it pads the row to two cache lines."""
