# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Mark the blocks that the rays of a range image touch.

Every ray is traversed exactly, block by block, through the band about the surface. Blocks are
marked in a bit cube about the sensor, so that a block on many rays costs little and is listed
once, in the order of its index.

Near the sensor rays are denser than blocks. In the band, rays are subsampled to a spacing of half
a voxel or more. When carving, a ray is traversed only from the range at which its coarser
neighbours (columns and rows divisible by larger powers of two) are an eighth of a block away or
end: a lidar with a range of 100 m traverses 6 blocks a ray instead of 40. Blocks missed that way
are touched at their corners only, less than a quarter of a block deep, in free space.

Blocks in the band about a surface are marked in a cube of their own: all others can only become
free. That costs one comparison a block and ray.

Source: Amanatides and Woo 1987 for the traversal; the number of steps along each axis is computed
beforehand, so rounding can neither lose the last block nor run past it.
"""

from numba import njit
import numpy as np

# What rays reach, float64 m.
BAND = 0
"""Distance before a surface at which the band begins, and behind it at which it ends, m."""
NEAR = 1
MAX_RANGE = 2
CARVE = 3
"""Not 0: rays are traversed from the sensor on."""
ROW_FREE = 4
"""Range up to which neighbouring rows are within an eighth of a block, m."""
COLUMN_FREE = 5
ROW_BAND = 6
"""Range up to which rows are denser than the spacing of rays in the band, m."""
COLUMN_BAND = 7
NUM_REACH = 8


@njit(cache=True, nogil=True)
def lowest_bits(count):
    """Return the largest power of two that divides each number below count; 1e12 for 0."""
    bits = np.empty(count, np.float64)
    for number in range(count):
        bits[number] = number & -number
    bits[0] = 1e12
    return bits


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def covered(image, row, column, down, across, reach):
    """Return the range up to which coarser neighbours cover a ray, m."""
    beside = above = 0.0
    if column > 0:
        coarser = np.float64(image[row, column - np.int64(across)])
        beside = min(reach[COLUMN_FREE] / across, coarser)
    if row > 0:
        coarser = np.float64(image[row - np.int64(down), column])
        above = min(reach[ROW_FREE] / down, coarser)
    return max(beside, above)


@njit(cache=True, nogil=True, error_model='numpy')
def mark_rays(image, directions, pose, reach, side, marks, near):
    """
    Mark the blocks that rays touch, and those in the band about a surface.

    image       (rows, columns) float32 m
    directions  (rows, columns, 3) float32, unit vectors in the frame of the sensor
    pose        (3, 4) float64, from m in the sensor frame to blocks from the cube's corner
    reach       (NUM_REACH,) float64
    side        side of the cube in blocks; all rays stay inside
    marks       (side^3 / 64,) int64, one bit a block, z fastest
    near        same shape, marks of the band; or no rows
    """
    rows, columns = directions.shape[0], directions.shape[1]
    down, across = lowest_bits(rows), lowest_bits(columns)
    least_column = (reach[COLUMN_BAND] / 2.0 / across).astype(np.float32)
    least_m, max_range = reach[NEAR], reach[MAX_RANGE]
    carve, separate = reach[CARVE] != 0.0, near.shape[0] > 0
    for row in range(rows):
        least_row = np.float32(reach[ROW_BAND] / 2.0 / down[row])
        for column in range(columns):
            measured = image[row, column]
            in_band = measured > max(least_row, least_column[column])
            if measured <= 0.0 or not (in_band or carve):
                continue
            range_m = np.float64(measured)
            clears = range_m > max_range
            start = range_m - reach[BAND]
            end = range_m + reach[BAND] if in_band else start
            if clears:
                start, end = max_range, max_range
            surface = start if separate and in_band and not clears else np.inf
            if carve:
                free = covered(image, row, column, down[row], across[column], reach)
                start = min(free, start) if in_band else free
            start = max(start, least_m)
            if end < start or (clears and not carve):
                continue
            x = np.float64(directions[row, column, 0])
            y = np.float64(directions[row, column, 1])
            z = np.float64(directions[row, column, 2])
            dx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z
            dy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z
            dz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z
            cell, tx, ix, sx, nx = walk(pose[0, 3], dx, start, end, side * side)
            offset, ty, iy, sy, ny = walk(pose[1, 3], dy, start, end, side)
            cell += offset
            offset, tz, iz, sz, nz = walk(pose[2, 3], dz, start, end, 1)
            cell += offset
            marks[cell >> 6] |= np.int64(1) << (cell & 63)
            for _ in range(nx + ny + nz):
                previous, leaves = cell, min(tx, ty, tz)
                if tx <= ty and tx <= tz:
                    cell += sx
                    nx -= 1
                    tx = tx + ix if nx > 0 else np.inf
                elif ty <= tz:
                    cell += sy
                    ny -= 1
                    ty = ty + iy if ny > 0 else np.inf
                else:
                    cell += sz
                    nz -= 1
                    tz = tz + iz if nz > 0 else np.inf
                marks[cell >> 6] |= np.int64(1) << (cell & 63)
                if leaves >= surface:
                    near[previous >> 6] |= np.int64(1) << (previous & 63)
            if surface < np.inf:
                near[cell >> 6] |= np.int64(1) << (cell & 63)


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def walk(origin, along, start, end, stride):
    """
    Prepare the traversal along one axis.

    Returns the number of the first block, the range at which the next one begins (inf if none),
    the range from block to block, the step of the number, and the number of steps.
    """
    first = np.floor(origin + along * start)
    last = np.floor(origin + along * end)
    steps = np.int64(abs(last - first))
    inverse = 1.0 / along
    border = first + 1.0 if along > 0.0 else first
    reached = (border - origin) * inverse if steps > 0 else np.inf
    step = stride if along > 0.0 else -stride
    return np.int64(first) * stride, reached, abs(inverse), step, steps


@njit(cache=True, nogil=True)
def count_marks(marks):
    """Return the number of set bits."""
    count = 0
    for word in marks:
        while word != 0:
            word &= word - 1
            count += 1
    return count


@njit(cache=True, nogil=True)
def list_marks(marks, side, low, index):
    """
    List the marked blocks and clear the marks.

    low    (3,) int64, block at the lower corner of the cube
    index  (K, 3) int64, out: ascending
    """
    row = 0
    for number in range(len(marks)):
        word = marks[number]
        if word == 0:
            continue
        marks[number] = 0
        for bit in range(64):
            if word >> bit & 1:
                cell = number * 64 + bit
                index[row, 0] = low[0] + cell // (side * side)
                index[row, 1] = low[1] + cell // side % side
                index[row, 2] = low[2] + cell % side
                row += 1


@njit(cache=True, nogil=True)
def look_up_marks(marks, side, low, index, marked):
    """
    Look up whether blocks are marked.

    low     (3,) int64, block at the lower corner of the cube
    index   (K, 3) int64; blocks beyond the cube are not marked
    marked  (K,) bool, out
    """
    for n in range(len(index)):
        i, j, k = index[n, 0] - low[0], index[n, 1] - low[1], index[n, 2] - low[2]
        cell = (i * side + j) * side + k
        within = min(i, j, k) >= 0 and max(i, j, k) < side
        marked[n] = within and (marks[cell >> 6] >> (cell & 63)) & 1 == 1
