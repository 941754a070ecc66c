# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Marching cubes over blocks of voxels.

The table of cases is computed: on each face of a cube a line separates every run of inside
corners, the lines of the six faces form loops, and every loop becomes a fan of triangles. The
lines of a face depend on its four corners only, so neighbouring cubes agree and the surface has no
cracks, ambiguous cases included. Corner c of a cube lies at (c & 1, c >> 1 & 1, c >> 2). Edge
e = 3 c + axis begins at corner c and is identified by the voxel there, so that cubes share
vertices.

Torn cubes can be skipped: an edge from free space to deep behind a surface crosses no surface but
the boundary of an object's shadow.

Source: Lorensen and Cline 1987; the rule for ambiguous faces keeps inside corners apart.
"""

from numba import njit
import numpy as np

FACES = (
    (0, 4, 6, 2),
    (1, 3, 7, 5),
    (0, 1, 5, 4),
    (2, 6, 7, 3),
    (0, 2, 3, 1),
    (4, 5, 7, 6),
)
"""Corners of each face, counter-clockwise as seen from outside of the cube."""


def edge_between(first, second):
    """Return the edge between two neighbouring corners."""
    return 3 * min(first, second) + (first ^ second).bit_length() - 1


def lines_of(face, inside):
    """Yield lines from edge to edge around every run of inside corners of a face."""
    for place in range(4):
        corner, before = face[place], face[place - 1]
        if not inside[corner] or inside[before]:
            continue
        last = place
        while inside[face[(last + 1) % 4]]:
            last += 1
        after = face[(last + 1) % 4]
        yield edge_between(before, corner), edge_between(face[last % 4], after)


def triangles_of(case):
    """Return the triangles of a case, three edges each, their normals pointing outside."""
    inside = [bool(case >> corner & 1) for corner in range(8)]
    following = dict(line for face in FACES for line in lines_of(face, inside))
    triangles = []
    while following:
        first, at = following.popitem()
        loop = [first]
        while at != first:
            loop.append(at)
            at = following.pop(at)
        fans = (fan_of(loop[start:] + loop[:start]) for start in range(len(loop)))
        triangles += min(fans, key=num_on_faces)
    return triangles


def fan_of(loop):
    """Return the triangles of a loop that all have its first edge."""
    return [(loop[0], *loop[i : i + 2]) for i in range(1, len(loop) - 1)]


def num_on_faces(fan):
    """Return the number of diagonals of a fan that lie on a face of the cube."""
    apex, diagonals = fan[0][0], [triangle[1] for triangle in fan[1:]]
    return sum(
        {apex, end} <= {edge_between(face[place], face[place - 1]) for place in range(4)}
        for end in diagonals
        for face in FACES
    )


CASES = [triangles_of(case) for case in range(256)]
MOST = max(len(triangles) for triangles in CASES)
TRIANGLES = np.full((256, MOST, 3), -1, np.int8)
"""Edges of the triangles of every case, padded with -1."""
NUM_TRIANGLES = np.array([len(triangles) for triangles in CASES])
for _case, _triangles in enumerate(CASES):
    if _triangles:
        TRIANGLES[_case, : len(_triangles)] = _triangles

FLAT = 1e-6
"""For distances that differ by at most this, the vertex is the midpoint of the edge."""


@njit(cache=True, nogil=True)
def pad(neighbours, side, values, missing, padded):
    """
    Copy a channel of a block, with the first layer of the blocks above.

    neighbours  (8,) int64, rows of the block and of those above; -1 if missing
    values      (R, N) float32, the channel; N = side^3
    missing     value for missing blocks
    padded      (side + 1, side + 1, side + 1) float32, out, z first
    """
    for k in range(side + 1):
        for j in range(side + 1):
            for i in range(side + 1):
                above = i // side + 2 * (j // side) + 4 * (k // side)
                row = neighbours[above]
                inner = i % side + side * (j % side + side * (k % side))
                padded[k, j, i] = values[row, inner] if row >= 0 else missing


@njit(cache=True, nogil=True)
def cube_case(distance, weight, i, j, k, limits):
    """
    Return the case of a cube; -1 if the weight of a corner is too small or the cube is torn.

    limits  (smallest weight of a corner, largest step along an edge across the surface, m)
    """
    min_weight, max_step_m = limits
    case = 0
    for corner in range(8):
        x, y, z = i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)
        if weight[z, y, x] <= 0.0 or weight[z, y, x] < min_weight:
            return -1
        if distance[z, y, x] < 0.0:
            case |= 1 << corner
    if 0 < case < 255 and max_step_m < np.inf:
        for corner in range(8):
            x, y, z = i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)
            for axis in range(3):
                other = corner | 1 << axis
                if other == corner or (case >> corner & 1) == (case >> other & 1):
                    continue
                end = distance[z + (axis == 2), y + (axis == 1), x + (axis == 0)]
                if abs(end - distance[z, y, x]) > max_step_m:
                    return -1
    return case


@njit(cache=True, nogil=True)
def count_triangles(neighbours, side, field, limits, counts):
    """
    Count the triangles of every block.

    neighbours  (K, 8) int64
    field       (R, 2, N) float32, distance and weight
    limits      of cubes, see cube_case
    counts      (K,) int64, out
    """
    distance = np.empty((side + 1, side + 1, side + 1), np.float32)
    weight = np.empty((side + 1, side + 1, side + 1), np.float32)
    for block in range(len(neighbours)):
        pad(neighbours[block], side, field[:, 0], 0.0, distance)
        pad(neighbours[block], side, field[:, 1], 0.0, weight)
        counts[block] = 0
        for k in range(side):
            for j in range(side):
                for i in range(side):
                    case = cube_case(distance, weight, i, j, k, limits)
                    if case > 0:
                        counts[block] += NUM_TRIANGLES[case]


@njit(cache=True, nogil=True)
def march(neighbours, index, side, field, limits, starts, edges, places):
    """
    Write the triangles of every block; a corner is an edge and a position along it.

    neighbours  (K, 8) int64
    index       (K, 3) int64, of the blocks
    starts      (K,) int64, number of the first triangle of each block
    edges       (T, 3, 4) int64, out: voxel index at the start of the edge (3), and its axis
    places      (T, 3) float64, out: position along the edge, in [0, 1]
    """
    distance = np.empty((side + 1, side + 1, side + 1), np.float32)
    weight = np.empty((side + 1, side + 1, side + 1), np.float32)
    for block in range(len(neighbours)):
        pad(neighbours[block], side, field[:, 0], 0.0, distance)
        pad(neighbours[block], side, field[:, 1], 0.0, weight)
        out = starts[block]
        for k in range(side):
            for j in range(side):
                for i in range(side):
                    case = cube_case(distance, weight, i, j, k, limits)
                    if case <= 0:
                        continue
                    for triangle in range(NUM_TRIANGLES[case]):
                        for corner in range(3):
                            edge = np.int64(TRIANGLES[case, triangle, corner])
                            begin, axis = edge // 3, edge % 3
                            x, y, z = i + (begin & 1), j + (begin >> 1 & 1), k + (begin >> 2)
                            edges[out, corner, 0] = index[block, 0] * side + x
                            edges[out, corner, 1] = index[block, 1] * side + y
                            edges[out, corner, 2] = index[block, 2] * side + z
                            edges[out, corner, 3] = axis
                            d0 = np.float64(distance[z, y, x])
                            d1 = np.float64(
                                distance[z + (axis == 2), y + (axis == 1), x + (axis == 0)]
                            )
                            flat = abs(d0 - d1) <= FLAT
                            places[out, corner] = 0.5 if flat else d0 / (d0 - d1)
                        out += 1
