# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The hash table of a map: voxel key to row of the slab.

The table is a directory of segments (extendible hashing). A single large table would have to be
rehashed as a whole when it grows; here each full segment of 64 buckets splits separately. The
directory is indexed by the highest bits of a 32-bit hash, the bucket within a segment by the
lowest.

A bucket is a line of the cache: eight entries, filled from the first on. Of a full one, entries go
to the next, cyclically within the segment, and come back when a removal makes room, so no
tombstones remain. All entries of a bucket are compared, without branches: the end of a search by
steps is random, and mispredicting it made look-ups 1.3 times as long.

An entry is one int64: the hash in the upper 32 bits and row + 1 in the lower, 0 if empty.
Splitting and removing need only the hash, never the rows; a look-up that finds an equal hash
confirms it by the key in the row, which the caller is about to use.

The kernels take the table as one tuple: directory (2^depth,) int32, the segment of each prefix of
the hash; buckets (S * 512,) int64, the entries; held (S,) int32, rows in each segment; local_depth
(S,) int8, number of hash bits that all rows of a segment share. Its depth is in the state.

Source: Fagin et al. 1979, Extendible hashing; deletion after algorithm R of Knuth, vol. 3, 6.4.
"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.compiling import inlined, U
from surfel_mapper.kernels.lanes import highest_match, num_used, place_of_half, WORDS
from surfel_mapper.kernels.layout import KEY

SEGMENT = 512
"""Entries of a segment: 4 KiB."""

BUCKET = WORDS
"""Entries of a bucket."""

FULLEST = SEGMENT * 3 // 4
"""Maximum number of rows in a segment; see is_full."""

# Entries of the state of a table, an int64 array that kernels write.
DEPTH = 0
"""The directory has 2^DEPTH entries."""
FREE_ROW = 1
"""First row of the chain of free rows, -1 if the chain is empty."""
NEXT_ROW = 2
"""The row that is used next if the chain is empty: this and later ones were never used."""
NEXT_SEGMENT = 3
"""The segment that is used next: this and later ones were never used."""
VOXELS = 4
POINTS = 5
STATE = 6
"""Length of the state."""

LOW = np.int64(0xFFFFFFFF)


@njit(cache=True, nogil=True, inline='always')
def hash_key(key):
    """Return the 32-bit hash of a voxel key, an int64 in [0, 2^32)."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= mixed >> np.uint64(32)
    mixed *= np.uint64(0xD6E8FEB86659FD93)
    return np.int64(mixed >> np.uint64(32))


@njit(cache=True, nogil=True, inline='always')
def first_bucket(hashed, directory, depth):
    """Return the first entry of the bucket where the search for a hash starts."""
    segment = np.int64(directory[U(hashed >> (32 - depth))])
    return segment * SEGMENT + home_of(hashed)


@njit(cache=True, nogil=True, inline='always')
def home_of(hashed):
    """Return the first entry, within its segment, of the bucket of a hash."""
    return hashed & (SEGMENT - BUCKET)


@njit(cache=True, nogil=True, inline='always')
def next_bucket(bucket):
    """Return the first entry of the next bucket, cyclically within the segment."""
    return (bucket & ~(SEGMENT - 1)) | ((bucket + BUCKET) & (SEGMENT - 1))


@njit(cache=True, nogil=True, inline='always')
def likely_row(hashed, directory, buckets, depth):
    """
    Return a row with a hash, or -1 if not found.

    Two voxels of one segment may have the same hash: compare the key in the row.
    """
    bucket = first_bucket(hashed, directory, depth)
    row = row_of(hashed, bucket, buckets)
    while row < 0 and buckets[U(bucket + BUCKET - 1)] != 0:
        bucket = next_bucket(bucket)
        row = row_of(hashed, bucket, buckets)
    return row


@njit(cache=True, nogil=True, inline='always')
def row_of(hashed, bucket, buckets):
    """Return the highest row with a hash in a bucket, -1 if not found."""
    return highest_match(buckets, bucket, hashed) - 1


@njit(cache=True, nogil=True, inline='always')
def is_full(hashed, directory, counts, depth):
    """
    Return whether the segment of a hash has to split before the next insertion.

    Segments are full at 1/2 to 3/4 of their entries, the share spread by multiples of the golden
    ratio. With an equal share all segments would split at the same time, since hashes are uniform,
    and look-ups would take twice as long before that moment as after it.
    """
    segment = np.int64(directory[U(hashed >> (32 - depth))])
    return counts[U(segment)] >= FULLEST - (segment * 79) % (SEGMENT // 4)


@inlined()
def find_row(key, rows, table, depth):
    """
    Return the row of a voxel, or -1 if not found.

    rows  (R, 12) int64, the slab
    """
    directory, buckets, _, _ = table
    hashed = hash_key(key)
    bucket = first_bucket(hashed, directory, depth)
    while True:
        for index in range(bucket, bucket + BUCKET):
            entry = buckets[index]
            row = (entry & LOW) - 1
            if row >= 0 and (entry >> 32) & LOW == hashed and rows[row, KEY] == key:
                return row
        if buckets[bucket + BUCKET - 1] == 0:
            return np.int64(-1)
        bucket = next_bucket(bucket)


@njit(cache=True, nogil=True, inline='always')
def insert_entry(hashed, row, directory, buckets, counts, depth):
    """
    Insert the row of a voxel that is not in the table.

    It takes the arrays of the table one by one: unpacking the table for each voxel counts
    references to four arrays, a quarter of an insertion.
    """
    bucket = first_bucket(hashed, directory, depth)
    counts[U(bucket) // U(SEGMENT)] += 1
    offset = num_used(buckets, bucket)
    while offset == BUCKET:
        bucket = next_bucket(bucket)
        offset = num_used(buckets, bucket)
    buckets[U(bucket + offset)] = (hashed << 32) | (row + 1)


@njit(cache=True, nogil=True, inline='always')
def remove_entry(hashed, row, directory, buckets, counts, depth):
    """Remove the row of a voxel by its hash; see ``insert_entry``."""
    bucket = first_bucket(hashed, directory, depth)
    counts[U(bucket) // U(SEGMENT)] -= 1
    offset = place_of_half(buckets, bucket, row + 1)
    while offset == BUCKET:
        bucket = next_bucket(bucket)
        offset = place_of_half(buckets, bucket, row + 1)
    last = num_used(buckets, bucket) - 1
    buckets[U(bucket + offset)] = buckets[U(bucket + last)]
    buckets[U(bucket + last)] = 0
    if last == BUCKET - 1:
        take_back(bucket, buckets)


@inlined()
def take_back(bucket, buckets):
    """
    Fill the last place of a bucket that was full, if a later bucket holds an entry for it.

    An entry may move unless its search starts after the bucket. If it leaves a full bucket, the
    last place of that one is filled in the same way.
    """
    num = np.int64(BUCKET)
    later = bucket
    while num == BUCKET:
        later = next_bucket(later)
        num = num_used(buckets, later)
        for index in range(later, later + num):
            home = home_of((buckets[index] >> 32) & LOW)
            if (later - home) & (SEGMENT - 1) >= (later - bucket) & (SEGMENT - 1):
                buckets[bucket + BUCKET - 1] = buckets[index]
                buckets[index] = buckets[later + num - 1]
                buckets[later + num - 1] = 0
                bucket = later
                break


@inlined()
def split_segment(hashed, table, state, entries):
    """
    Split the segment of a hash by the next bit of the hashes; return whether there was room.

    hashed   int64, any hash of the segment
    state    (STATE,) int64
    entries  (SEGMENT,) int64, overwritten

    Without room for another segment, or if the directory would have to double, nothing changes
    and the result is False.
    """
    directory, buckets, counts, local_depth = table
    depth = state[DEPTH]
    old = np.int64(directory[hashed >> (32 - depth)])
    bits = np.int64(local_depth[old])
    new = state[NEXT_SEGMENT]
    if bits == depth or new == len(counts):
        return False
    state[NEXT_SEGMENT] = new + 1
    local_depth[old] = local_depth[new] = bits + 1
    for index in range(SEGMENT):
        entries[index] = buckets[old * SEGMENT + index]
        buckets[old * SEGMENT + index] = buckets[new * SEGMENT + index] = 0
    # the upper half of the directory entries with the old prefix gets the new segment
    span = 1 << (depth - bits)
    first = (hashed >> (32 - bits)) << (depth - bits) if bits > 0 else 0
    for prefix in range(first + span // 2, first + span):
        directory[prefix] = new
    counts[old] = counts[new] = 0
    for index in range(SEGMENT):
        entry = entries[index]
        if entry != 0:
            insert_entry((entry >> 32) & LOW, (entry & LOW) - 1, directory, buckets, counts, depth)
    return True


@inlined()
def makes_room(hashed, table, state, entries):
    """Split the segment of a hash until it has room for a row; return False if it cannot split."""
    directory, _, counts, _ = table
    depth = state[DEPTH]
    while is_full(hashed, directory, counts, depth):
        if not split_segment(hashed, table, state, entries):
            return False
    return True
