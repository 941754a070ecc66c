# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Add the moments of a scan to a map, subtract them again, and sum them into coarser voxels.

All are integer sums by voxel, so that a subtraction undoes an addition to the bit, in any order.
Rows of the slab are visited in the order of the scan; hash bucket and row of later voxels are
prefetched, which hides most of the cache misses.

The stamps of rows are written in a loop of their own: among the accesses to rows they made adding
1.2 times as long at 10^6 voxels, 4 MB of stamps.

A voxel of level L consists of 2^L finer voxels an axis and keeps their lattice unit. A point at q
about the centre of its fine voxel lies at q + d about the coarse centre, d an integer vector: the
sum becomes S + n d, the second moment M + d S^T + S d^T + n d d^T.

"""

from numba import njit
import numpy as np

from surfel_mapper.kernels.compiling import inlined, kernel, U
from surfel_mapper.kernels.grouping import hash_shift, home
from surfel_mapper.kernels.hashing import (
    DEPTH,
    find_row,
    first_bucket,
    FREE_ROW,
    hash_key,
    insert_entry,
    is_full,
    likely_row,
    LOW,
    makes_room,
    NEXT_ROW,
    POINTS,
    remove_entry,
    SEGMENT,
    VOXELS,
)
from surfel_mapper.kernels.layout import (
    BITS,
    EMPTIED,
    HIGH_BITS,
    INDEX_BITS,
    INDEX_OFFSET,
    KEY,
    PRODUCT,
    ROW,
    SCANS,
    STAMP,
    STAMP_ROW,
    STAMPS,
    SUM,
    VIEW,
)
from surfel_mapper.kernels.prefetch import prefetch, prefetch_early
from surfel_mapper.kernels.quantisation import unpack
from surfel_mapper.mapping.kernels.rows import (
    add_to_row,
    count_of,
    first_word,
    prefetch_row,
    prefetch_row_early,
    sum_of,
    view_of,
)

AHEAD = 16
"""Number of voxels between the prefetch of a row and its use."""

EARLY = 64
"""Number of voxels between the early prefetch of a row and its use."""

HASHED, EARLIER, NEARER, FOUND = 64, 48, 32, 16
"""Number of voxels between the steps of a look-up and the use of its row: hash, with a prefetch of
its entry in the directory; early and later prefetch of the bucket; search of the row. One voxel at
a time: blocks of 32 asked for more lines at once than the processor waits for, and took up to 1.4
times as long."""

RING = 2 * HASHED
"""Number of voxels whose hashes and rows are kept, a power of two."""

LAST = RING - 1
"""Mask of a place in the ring; the remainder of a signed integer would take half of a look-up."""

FREE = SUM
"""Column of a free row: in the lower half 1 + the next free row, in the upper one 1 + the row that
is taken AHEAD new voxels later, to be prefetched; in the cache line of key and count."""


@njit(cache=True, nogil=True, inline='always')
def look_ahead(index, last, keys, flat, directory, buckets, depth, hashes, likely):
    """
    Hash the voxel HASHED places ahead; find and prefetch the row of the one FOUND places ahead.

    index   int64, from HASHED before the first voxel on
    last    int64, the last voxel
    keys    (K,) int64, at least one
    flat    (R * 12,) int64, the rows
    hashes  (RING,) int64, in and out: hash of voxel i at i & LAST
    likely  (RING,) int64, out: a row with this hash, to be confirmed by its key; -1 if not found
    """
    hashed = hash_key(keys[U(min(index + HASHED, last))])
    hashes[U((index + HASHED) & LAST)] = hashed
    prefetch(directory, hashed >> (32 - depth))
    earlier, nearer = hashes[U((index + EARLIER) & LAST)], hashes[U((index + NEARER) & LAST)]
    prefetch_early(buckets, first_bucket(earlier, directory, depth))
    prefetch(buckets, first_bucket(nearer, directory, depth))
    row = likely_row(hashes[U((index + FOUND) & LAST)], directory, buckets, depth)
    likely[U((index + FOUND) & LAST)] = row
    prefetch_row(flat, max(row, 0))  # an address before the slab may cost a walk of page tables


@kernel()
def find_rows(keys, rows, table, state, row_of):
    """
    Look up the row of every voxel.

    keys    (K,) int64
    row_of  (K,) int32, out: row, -1 if not found
    """
    directory, buckets, _, _ = table
    flat = rows.ravel()
    depth = state[DEPTH]
    hashes, likely = np.zeros(RING, np.int64), np.empty(RING, np.int64)
    for index in range(-HASHED if len(keys) else 0, len(keys)):
        look_ahead(index, len(keys) - 1, keys, flat, directory, buckets, depth, hashes, likely)
        if index >= 0:
            row, key = likely[U(index & LAST)], keys[U(index)]
            if row >= 0 and flat[first_word(row) + U(KEY)] != key:
                row = find_row(key, rows, table, depth)
            row_of[U(index)] = row


@kernel()
def add_moments(moments, rows, stamps, table, state, stamp, start, row_of):
    """
    Add the moments of the voxels of a scan from start on; return the first that was not added.

    moments  keys (K,) int64, count (K,) uint32, total (K, 3) int32, product (K, 6) int64, view
             (K, 3) int16 of every point of the voxel, and num_scans (K,) uint32
    stamps   (R * 2,) uint32, in and out: the last change of each row and its number of scans
    stamp    uint32, of this change; see kernels/layout.py
    start    int64, the first voxel to add
    row_of   (K,) int32, out: row of each voxel

    Returns K if all were added. Otherwise slab, segments or directory have no room for a voxel:
    make room and continue from there.
    """
    keys, count, _, _, _, scans = moments
    words = words_of(moments)
    directory, buckets, counts, _ = table
    flat = rows.ravel()
    depth, stop = state[DEPTH], len(keys)
    hashes, likely = np.zeros(RING, np.int64), np.empty(RING, np.int64)
    entries = np.empty(SEGMENT, np.int64)  # here: what fails later would leave the counts wrong
    num_points, num_new, done = np.int64(0), 0, stop
    for index in range(start - HASHED if start < stop else stop, stop):
        look_ahead(index, stop - 1, keys, flat, directory, buckets, depth, hashes, likely)
        if index < start:
            continue
        voxel, slot = U(index), U(index & LAST)
        key, hashed, row = keys[voxel], hashes[slot], likely[slot]
        if row >= 0 and flat[first_word(row) + U(KEY)] != key:
            row = find_row(key, rows, table, depth)
        if row < 0:
            full = is_full(hashed, directory, counts, depth)
            if not full or makes_room(hashed, table, state, entries):
                row = take_row(flat, state)
            if row < 0:
                done = index
                break
            insert_entry(hashed, row, directory, buckets, counts, depth)
            num_new += 1
            clear_row(flat, first_word(row), key)
        num_points += np.int64(count[voxel])
        change_row(words, flat, first_word(row), voxel, 1)
        row_of[voxel] = row
    state[POINTS] += num_points
    state[VOXELS] += num_new
    set_stamps(stamps, row_of[start:done], stamp, scans[start:done], 1)
    return done


@njit(cache=True, nogil=True, inline='always')
def set_stamps(stamps, rows, stamp, scans, sign):
    """Stamp the rows (K,) int32, and add their numbers of scans; subtract them with sign -1."""
    num = U(len(rows))
    for index in range(num):
        if index + U(EARLY) < num:
            prefetch_early(stamps, np.int64(rows[index + U(EARLY)]) * STAMP_ROW)
        at = U(rows[index]) * U(STAMP_ROW)
        stamps[at + U(STAMP)] = stamp
        stamps[at + U(SCANS)] += np.uint32(sign * np.int64(scans[index]))


@njit(cache=True, nogil=True, inline='always')
def take_row(flat, state):
    """Return a free row and prefetch a later one; -1 if there is none."""
    row = state[FREE_ROW]
    if row >= 0:
        links = flat[first_word(row) + U(FREE)]
        state[FREE_ROW] = (links & LOW) - 1
        prefetch_row(flat, max((links >> HIGH_BITS) - 1, 0))
    elif state[NEXT_ROW] * ROW < len(flat):
        row = state[NEXT_ROW]
        state[NEXT_ROW] = row + 1
    return row


@njit(cache=True, nogil=True, inline='always')
def free_row(flat, at, following, later):
    """Make the row that begins at a word a free one; see FREE."""
    flat[at + U(KEY)] = -1
    flat[at + U(VIEW)] = flat[at + U(VIEW + 1)] = 0  # and with them the count
    flat[at + U(FREE)] = ((later + 1) << HIGH_BITS) | (following + 1)


@kernel()
def remove_moments(moments, rows, stamps, table, state, stamp, row_of, min_points, fallen):
    """
    Subtract moments, or nothing if a voxel does not hold its own; free the rows that get empty.

    moments     as of add_moments
    stamps      as of add_moments
    stamp       uint32, of this change; see kernels/layout.py
    row_of      (K,) int32, in: row of each voxel, or a hint of it; out: the row
    min_points  smallest number of points of a surfel, at least 1
    fallen      (K, 3) int32, out: indices of the voxels that held min_points before and hold
                fewer

    Returns the first voxel that does not hold its moments, or -1, and the number of fallen voxels.

    A row keeps its voxel as long as that holds points, so a hint is right unless the voxel was
    emptied since; a wrong one is replaced by a look-up. A voxel must hold at least as many points
    as are subtracted; if it holds no others, its sums must be equal. One pass that is undone on
    failure: a pass of checks before it would read every row from memory twice.
    """
    keys, count, _, _, _, scans = moments
    words = words_of(moments)
    directory, buckets, counts, _ = table
    depth, num = state[DEPTH], U(len(keys))
    flat = rows.ravel()
    emptied, hashes = np.empty(num, np.int32), np.empty(num, np.int64)
    num_emptied, num_fallen = 0, 0
    num_points, missing = np.int64(0), np.int64(-1)
    for voxel in range(num):
        if voxel + U(EARLY) < num:
            prefetch_row_early(flat, np.int64(row_of[voxel + U(EARLY)]))
            prefetch_row(flat, np.int64(row_of[voxel + U(AHEAD)]))
        key, n = keys[voxel], np.int64(count[voxel])
        row = np.int64(row_of[voxel])
        if not (0 <= row < len(rows) and is_voxel(flat, first_word(row), key)):
            row = find_row(key, rows, table, depth)
            row_of[voxel] = row
        at = first_word(max(row, 0))
        stored = count_of(flat, at) if row >= 0 else np.int64(-1)
        if stored < n or (stored == n and not holds_exactly(words, flat, at, voxel)):
            missing = np.int64(voxel)
            break
        if stored >= min_points > stored - n:
            fallen[num_fallen, 0], fallen[num_fallen, 1], fallen[num_fallen, 2] = unpack(key)
            num_fallen += 1
        if stored == n:
            later = np.int64(-1)
            if num_emptied >= AHEAD:
                later = np.int64(row_of[U(emptied[U(num_emptied - AHEAD)])])
            free_row(flat, at, state[FREE_ROW], later)
            state[FREE_ROW] = row
            emptied[U(num_emptied)], hashes[U(num_emptied)] = voxel, hash_key(key)
            num_emptied += 1
        else:
            change_row(words, flat, at, voxel, -1)
        num_points += n
    if missing >= 0:
        for i in range(num_emptied - 1, -1, -1):
            links = flat[first_word(row_of[U(emptied[i])]) + U(FREE)]
            state[FREE_ROW] = (links & LOW) - 1
        put_back(keys, words, flat, row_of, missing)
        return missing, 0
    state[POINTS] -= num_points
    state[VOXELS] -= num_emptied
    set_stamps(stamps, row_of, stamp, scans, -1)
    for i in range(U(num_emptied)):
        if i + U(HASHED) < U(num_emptied):
            prefetch(directory, hashes[i + U(HASHED)] >> (32 - depth))
            earlier, nearer = hashes[i + U(EARLIER)], hashes[i + U(NEARER)]
            prefetch_early(buckets, first_bucket(earlier, directory, depth))
            prefetch(buckets, first_bucket(nearer, directory, depth))
        row = np.int64(row_of[U(emptied[i])])
        remove_entry(hashes[i], row, directory, buckets, counts, depth)
        stamps[U(row) * U(STAMP_ROW) + U(STAMP)] = stamp | EMPTIED
        stamps[U(row) * U(STAMP_ROW) + U(SCANS)] = 0
    return missing, num_fallen


@njit(cache=True, nogil=True, inline='always')
def is_voxel(flat, at, key):
    """Return whether the row that begins at a word holds points of the voxel with a key."""
    return (flat[at + U(KEY)] == key) & (count_of(flat, at) > 0)


@inlined()
def put_back(keys, words, flat, row_of, stop):
    """Add the moments of the first voxels to their rows again, also to emptied ones."""
    for voxel in range(U(stop)):
        at = first_word(row_of[voxel])
        if count_of(flat, at) == 0:
            clear_row(flat, at, keys[voxel])
        change_row(words, flat, at, voxel, 1)


@njit(cache=True, nogil=True, inline='always')
def clear_row(flat, at, key):
    """Set a row to a key and zeros."""
    for column in range(U(ROW)):
        flat[at + column] = 0
    flat[at + U(KEY)] = key


@njit(cache=True, nogil=True, inline='always')
def words_of(moments):
    """Return count to view of the moments of a scan, tables as their words one after another."""
    _, count, total, product, view, _ = moments
    return count, total.ravel(), product.ravel(), view.ravel()


@njit(cache=True, nogil=True, inline='always')
def change_row(words, flat, at, voxel, sign):
    """Add the moments of a voxel, as words_of returns them, to its row; subtract with sign -1."""
    count, total, product, view = words
    n = np.int64(count[voxel])
    weight = sign * n
    x, y, z = U(3) * voxel, U(3) * voxel + U(1), U(3) * voxel + U(2)
    sums = sign * np.int64(total[x]), sign * np.int64(total[y]), sign * np.int64(total[z])
    views = weight * np.int64(view[x]), weight * np.int64(view[y]), weight * np.int64(view[z])
    add_to_row(flat, at, sign * n, sums, views)
    for pair in range(U(6)):
        flat[at + U(PRODUCT) + pair] += sign * product[U(6) * voxel + pair]


@kernel()
def add_sums(rows, chosen, sign, total, view):
    """
    Add sums of positions and views to rows; subtract them with sign -1.

    chosen  (K,) int32, rows; -1 is skipped
    total   (K, 3) int64, sums of positions
    view    (K, 3) int64, sums of views
    """
    flat = rows.ravel()
    for i in range(len(chosen)):
        if chosen[i] >= 0:
            sums = sign * total[i, 0], sign * total[i, 1], sign * total[i, 2]
            views = sign * view[i, 0], sign * view[i, 1], sign * view[i, 2]
            add_to_row(flat, first_word(chosen[i]), 0, sums, views)


@inlined()
def holds_exactly(words, flat, at, voxel):
    """Return whether the sums of a row are the moments of a voxel, as words_of returns them."""
    count, total, product, view = words
    weight = np.int64(count[voxel])
    x, y, z = view_of(flat, at)
    first = U(3) * voxel
    equal = x == weight * view[first]
    equal &= y == weight * view[first + U(1)]
    equal &= z == weight * view[first + U(2)]
    for axis in range(3):
        equal &= sum_of(flat, at, axis) == total[first + U(axis)]
    for pair in range(U(6)):
        equal &= flat[at + U(PRODUCT) + pair] == product[U(6) * voxel + pair]
    return equal


@kernel()
def rows_changed_at(rows, stamps, changed, stamp, min_points):
    """
    Return the rows of at least min_points points whose last change has a stamp.

    rows        (R, 12) int64, the slab
    stamps      (R * 2,) uint32, see kernels/layout.py
    changed     (K,) int32, the rows in question
    stamp       uint32
    min_points  0: emptied rows too

    Stamps tell which rows are empty, so rows themselves are read only for a higher min_points.
    """
    kept = np.empty(len(changed), np.int32)
    ignored = EMPTIED if min_points < 1 else 0
    num, num_changed = U(0), U(len(changed))
    for index in range(num_changed):
        if index + U(EARLY) < num_changed:
            prefetch_early(stamps, np.int64(changed[index + U(EARLY)]) * STAMP_ROW)
        row = changed[index]
        kept[num] = row  # a branch would be mispredicted half of the time
        num += U((stamps[U(row) * U(STAMP_ROW) + U(STAMP)] ^ stamp) <= ignored)
    return kept[:num] if min_points <= 1 else kept[: keep_full(rows, kept, num, min_points)]


@njit(cache=True, nogil=True, inline='always')
def keep_full(rows, kept, num, min_points):
    """Move the rows of at least min_points points to the front; return their number."""
    flat = rows.ravel()
    num_full = 0
    for index in range(num):
        if index + AHEAD < num:
            prefetch(flat, np.int64(kept[index + AHEAD]) * ROW)
        row = kept[index]
        kept[num_full] = row
        num_full += count_of(flat, first_word(row)) >= min_points
    return num_full


@kernel()
def rows_changed_after(rows, stamps, used, stamp, changes, min_points):
    """
    Return the rows of at least min_points points that the latest changes changed.

    rows        (R, 12) int64, the slab
    stamps      (R * 2,) uint32, see kernels/layout.py
    used        number of rows ever used
    stamp       uint32, of the latest change
    changes     int64, number of changes
    min_points  0: emptied rows too
    """
    kept = np.empty(used, np.int32)
    ignored = EMPTIED if min_points < 1 else 0
    num = 0
    for row in range(used):
        last = np.int64(stamps[row * STAMP_ROW + STAMP])
        age = (((stamp | EMPTIED) - last) & STAMPS) >> 1
        kept[num] = row
        num += (age < changes) & (last & EMPTIED <= ignored)
    if min_points > 1:
        num = keep_full(rows, kept, num, min_points)
    return kept[:num].copy()


@kernel()
def coarse_rows(fine_keys, level, table, keys, rows):
    """
    Find the voxels 2^level times larger; return their number.

    fine_keys  (K,) int64
    table      (B,) int32, B a power of two and at least 2 K, all -1
    keys       (K,) int64, out: keys of the coarse voxels in the order of first appearance
    rows       (K,) int32, out: row of the coarse voxel of each fine voxel
    """
    shift = hash_shift(len(table))
    mask = len(table) - 1
    num = 0
    for i in range(len(fine_keys)):
        key = fine_keys[i]
        x, y, z = unpack(key)
        coarse = ((x >> level) + INDEX_OFFSET) << (2 * INDEX_BITS)
        coarse |= (((y >> level) + INDEX_OFFSET) << INDEX_BITS) | ((z >> level) + INDEX_OFFSET)
        entry = home(coarse, shift)
        row = np.int64(table[entry])
        while row >= 0 and keys[row] != coarse:
            entry = (entry + 1) & mask
            row = np.int64(table[entry])
        if row < 0:
            row = np.int64(num)
            num += 1
            table[entry] = row
            keys[row] = coarse
        rows[i] = row
    return num


@kernel()
def sum_coarse(moments, chosen, rows, fine_level, level, coarse):
    """
    Sum the moments of voxels in rows of voxels 2^level times larger.

    moments     keys (N,) int64, count (N,), total (N, 3), product (N, 6), view (N, 3),
                num_scans (N,)
    chosen      (K,) int64, the voxels to sum, of the N
    rows        (K,) int32, row of the coarse voxel of each, as coarse_rows finds it
    fine_level  level of the given moments
    coarse      count (C,) int64, total (C, 3), product (C, 6), view (C, 3), num_scans (C,) int64,
                zeros, out: num_scans is the largest of the voxels
    """
    fine_keys, count, total, product, view, num_scans = moments
    counts, sums, products, views, most_scans = coarse
    fine = np.int64(1) << (BITS + fine_level)
    half_gap = fine // 2 - (fine << level) // 2
    below = (np.int64(1) << level) - 1
    for k in range(len(chosen)):
        i, row = chosen[k], np.int64(rows[k])
        key = fine_keys[i]
        x, y, z = unpack(key)
        # d: from the coarse centre to the fine centre
        n = np.int64(count[i])
        dx = (x & below) * fine + half_gap
        dy = (y & below) * fine + half_gap
        dz = (z & below) * fine + half_gap
        sx, sy, sz = np.int64(total[i, 0]), np.int64(total[i, 1]), np.int64(total[i, 2])
        counts[row] += n
        most_scans[row] = max(most_scans[row], np.int64(num_scans[i]))
        sums[row, 0] += sx + n * dx
        sums[row, 1] += sy + n * dy
        sums[row, 2] += sz + n * dz
        for axis in range(3):
            views[row, axis] += np.int64(view[i, axis])
        products[row, 0] += product[i, 0] + dx * sx + dx * sx + n * dx * dx
        products[row, 1] += product[i, 1] + dx * sy + dy * sx + n * dx * dy
        products[row, 2] += product[i, 2] + dx * sz + dz * sx + n * dx * dz
        products[row, 3] += product[i, 3] + dy * sy + dy * sy + n * dy * dy
        products[row, 4] += product[i, 4] + dy * sz + dz * sy + n * dy * dz
        products[row, 5] += product[i, 5] + dz * sz + dz * sz + n * dz * dz
