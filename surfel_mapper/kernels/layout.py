# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Constants that all kernels of the map share: the lattice, the voxel key, a row of the slab.

A voxel key packs the three indices, each of 21 bits and offset by 2^20, into 63 bits of an
int64, x highest. A map keeps one row of 12 int64 for each voxel. Its 96 bytes lie in two
neighbouring cache lines, so that a voxel costs one cache miss (separate arrays of each moment
would cost thirteen); half of the rows of 13 or 14 words would lie in three.

Sums of positions and of views need at most 47 bits. They are kept in the upper 48 bits of a word,
and the lower 16 bits hold pieces of two other numbers; mapping/kernels/rows.py reads and writes
them.
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

COUNT_BITS, HIGH_BITS = 40, 32
"""Sums of the places of points in their voxel take two words: count << COUNT_BITS | sum of x, and
sum of z << HIGH_BITS | sum of y."""

VIEW_SCALE = 1 << 14
"""Length of the integer vectors that point from a voxel to the sensor."""

# Columns of a row. A free row has a key of -1 and a count of 0.
KEY = 0
VIEW = 1
"""Sums of the views along x and y; the lower 16 bits are the count, its lower half first."""
SUM = 3
"""Sums of x, y, z; the lower 16 bits are the sum of the views along z, its lowest third first."""
PRODUCT = 6
"""Sums of products, order xx xy xz yy yz zz."""
ROW = 12

PIECE = 16
"""Bits of a word of VIEW or SUM that belong to another number."""

# Two words for each row, uint32, in a slab of their own.
STAMP = 0
"""The last change of the voxel: bit 0 says that the change emptied it, the 31 upper bits are the
lower ones of the version of the map."""
SCANS = 1
"""Number of scans with points in the voxel, 0 for an empty row; sums wrap around at 2^32."""
STAMP_ROW = 2

EMPTIED = 1
STAMPS = (1 << 32) - 1
"""Mask of a stamp. Versions repeat after 2^31 changes, 1.7 years of a window at 20 scans/s. A row
that stayed the same for as long counts as changed in a request for changes that old."""
