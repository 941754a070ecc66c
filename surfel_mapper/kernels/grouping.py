# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Group points by voxel: runs of consecutive points of one voxel, and a hash table of the voxels.

Points are taken in chunks whose keys stay in the first-level cache. A chunk is cut into runs of
one voxel key, and each run costs one look-up, without a branch that depends on the data. The table
holds rows of other arrays, probes linearly, and is used by reductions to moments, by VoxelGrid and
for look-ups by key.

Source: Fibonacci hashing, Knuth, The Art of Computer Programming, vol. 3, 6.4.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel, U
from surfel_mapper.kernels.prefetch import prefetch

CHUNK = 1024
"""Points processed at once: their keys and places stay in the first-level cache."""

AHEAD = 32
"""Number of runs between the prefetch of a table entry and its use."""


_MIX = np.uint64(0x9E3779B97F4A7C15)


@njit(cache=True, nogil=True, inline='always')
def hash_shift(size):
    """Return the shift of a 64-bit hash for a table of size entries, a power of two."""
    shift = np.uint64(64)
    while size > 1:
        size >>= 1
        shift -= np.uint64(1)
    return shift


@njit(cache=True, nogil=True, inline='always')
def home(key, shift):
    """Return the table entry where the search for a key starts."""
    return np.int64((np.uint64(key) * _MIX) >> shift)


@inlined()
def find_runs(keys, num, starts):
    """
    Find the runs of consecutive points of one voxel; return their number.

    keys    (CHUNK,) int64, of which num count
    starts  (CHUNK + 1,) int32, out: first point of each run, and num after the last
    """
    num_runs = np.int64(0)  # an int here would compile kernels that take it for a literal 0 too
    previous = np.int64(-2)
    for i in range(num):
        starts[num_runs] = i
        num_runs += keys[i] != previous
        previous = keys[i]
        # only the first point of a run stays: the entry of a later one is overwritten
    starts[num_runs] = num
    return num_runs


@inlined()
def number_runs(chunk_keys, starts, num_runs, table, keys, num_rows, run_rows):
    """
    Look up the row of each run's voxel, adding rows for new voxels; return their number.

    chunk_keys  (CHUNK + 1,) int64, voxel key of each point of the chunk
    starts      (CHUNK + AHEAD,) int32, first point of each run
    table       (B,) int32, B a power of two: row of the voxel hashed there, -1 if empty
    keys        (E,) int64, in and out: keys[row + 1] is that of a voxel; E > num_rows + num_runs
    run_rows    (CHUNK,) int32, out

    On a real lidar every third to eighth point opens a voxel, at random, and mispredicted branches
    took a quarter of the time of a reduction. So keys[0] is set to the key looked for: an empty
    entry, -1, ends the search as a found one does. Row num_rows is written every time; it counts
    only if the voxel is new. The first step past a foreign entry is taken without a branch: one
    voxel in ten needs it.
    """
    shift = hash_shift(len(table))
    mask = U(len(table) - 1)
    number = U(num_rows)
    for run in range(U(num_runs)):
        # past the last run these are runs of an earlier chunk: no harm
        ahead = U(np.uint32(starts[run + U(AHEAD)]))
        prefetch(table, home(chunk_keys[ahead], shift))
        key = chunk_keys[U(np.uint32(starts[run]))]
        keys[U(0)] = key
        entry = U(home(key, shift))
        entry = (entry + U(keys[U(table[entry] + 1)] != key)) & mask
        row = np.int64(table[entry])
        while keys[U(row + 1)] != key:
            entry = (entry + U(1)) & mask
            row = np.int64(table[entry])
        is_new = row < 0
        row = np.int64(number) if is_new else row
        table[entry] = row
        keys[number + U(1)] = key
        number += U(is_new)
        run_rows[run] = row
    return np.int64(number)


@kernel()
def enlarged_table(table, keys, num_rows):
    """Return a table (4 B,) int32 that holds the same rows; see ``number_runs``."""
    larger = np.full(4 * len(table), -1, np.int32)
    shift = hash_shift(len(larger))
    mask = len(larger) - 1
    for row in range(num_rows):
        entry = home(keys[row], shift)
        while larger[entry] >= 0:
            entry = (entry + 1) & mask
        larger[entry] = row
    return larger


@kernel()
def build_table(keys, table):
    """
    Build the hash table of unique voxel keys.

    keys   (M,) int64
    table  (B,) int32, out: row of each key, -1 if empty; B a power of two, at least 2 M
    """
    table[:] = -1
    shift = hash_shift(len(table))
    mask = len(table) - 1
    for row in range(len(keys)):
        entry = home(keys[row], shift)
        while table[entry] >= 0:
            entry = (entry + 1) & mask
        table[entry] = row


@kernel()
def find_key(key, keys, table, shift):
    """Return the row of a voxel key in a table of build_table, -1 if not found."""
    mask = len(table) - 1
    entry = home(key, shift)
    row = np.int64(table[entry])
    while row >= 0 and keys[row] != key:
        entry = (entry + 1) & mask
        row = np.int64(table[entry])
    return row
