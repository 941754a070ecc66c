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
    for index in range(4):
        corner, previous = face[index], face[index - 1]
        if not inside[corner] or inside[previous]:
            continue
        last = index
        while inside[face[(last + 1) % 4]]:
            last += 1
        following = face[(last + 1) % 4]
        yield edge_between(previous, corner), edge_between(face[last % 4], following)


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
        {apex, end} <= {edge_between(face[index], face[index - 1]) for index in range(4)}
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


INSIDE, KNOWN = 1, 2
"""Bits of a voxel: behind a surface; of sufficient weight."""


@njit(cache=True, nogil=True)
def pad(neighbours, side, values, padded):
    """
    Copy a channel of a block, with the first layer of the blocks above.

    neighbours  (8,) int64, rows of the block and of those above; -1 if missing: 0 is copied
    values      (R, N), the channel; N = side^3
    padded      (side + 1, side + 1, side + 1), out, z first
    """
    for k in range(side + 1):
        for j in range(side + 1):
            above = (2 if j == side else 0) + (4 if k == side else 0)
            first = side * ((j if j < side else 0) + side * (k if k < side else 0))
            row, beside = neighbours[above], neighbours[above + 1]
            for i in range(side):
                padded[k, j, i] = values[row, first + i] if row >= 0 else 0
            padded[k, j, side] = values[beside, first] if beside >= 0 else 0


@njit(cache=True, nogil=True)
def describe(field, min_weight, bits):
    """
    Find the bits of every voxel.

    field  (R, 2, N) float32, distance and weight
    bits   (R, N) uint8, out
    """
    least = np.float32(max(min_weight, 1e-30))
    for row in range(len(field)):
        distance, weight = field[row, 0], field[row, 1]
        for n in range(distance.shape[0]):
            observed = np.uint8(KNOWN) if weight[n] >= least else np.uint8(0)
            bits[row, n] = observed | (np.uint8(INSIDE) if distance[n] < 0 else np.uint8(0))


@njit(cache=True, nogil=True)
def find_cases(neighbours, side, field, bits, max_step_m, cases, counts):
    """
    Find the case of every cube; 0 if a corner is not known or the cube is torn.

    neighbours  (K, 8) int64
    field       (R, 2, N) float32, distance and weight
    bits        (R, N) uint8, see describe
    max_step_m  largest step along an edge across the surface, m
    cases       (K, N) uint8, out
    counts      (K,) int64, out: number of triangles
    """
    whole = np.empty((side + 1, side + 1, side + 1), np.uint8)
    distance = np.empty((side + 1, side + 1, side + 1), np.float32)
    for block in range(len(neighbours)):
        pad(neighbours[block], side, bits, whole)
        counts[block] = 0
        has_distance = max_step_m == np.inf
        for k in range(side):
            for j in range(side):
                observed = inside = np.uint8(0)
                for i in range(side + 1):
                    a, b = whole[k, j, i], whole[k, j + 1, i]
                    c, d = whole[k + 1, j, i], whole[k + 1, j + 1, i]
                    previous, behind = observed, inside
                    observed = a & b & c & d & KNOWN
                    inside = (a & 1) | (b & 1) << 2 | (c & 1) << 4 | (d & 1) << 6
                    if i == 0:
                        continue
                    case = behind | inside << 1
                    if observed & previous == 0 or case == 255:
                        case = np.uint8(0)
                    if case > 0:
                        if not has_distance:
                            pad(neighbours[block], side, field[:, 0], distance)
                            has_distance = True
                        if max_step_m < np.inf and is_torn(
                            distance, i - 1, j, k, case, max_step_m
                        ):
                            case = np.uint8(0)
                    cases[block, i - 1 + side * (j + side * k)] = case
                    counts[block] += NUM_TRIANGLES[case]


@njit(cache=True, nogil=True)
def is_torn(distance, i, j, k, case, max_step_m):
    """Return whether a step along an edge of a cube across the surface is too large."""
    for corner in range(8):
        for axis in range(3):
            neighbour = corner | 1 << axis
            if neighbour == corner or (case >> corner & 1) == (case >> neighbour & 1):
                continue
            x, y, z = i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2)
            end = distance[z + (axis == 2), y + (axis == 1), x + (axis == 0)]
            if abs(end - distance[z, y, x]) > max_step_m:
                return True
    return False


@njit(cache=True, nogil=True)
def march(neighbours, index, side, field, cases, starts, triangles, edges, along, num_vertices):
    """
    Write the triangles of every block, and their vertices, each once a block.

    neighbours    (K, 8) int64
    index         (K, 3) int64, of the blocks
    field         (R, 2, N) float32, distance and weight
    cases         (K, N) uint8, see find_cases
    starts        (K + 1,) int64, number of the first triangle of each block
    triangles     (T, 3) int32, out: vertices, counted from the first of the block
    edges         (V, 4) int32, out: voxel index at the start of the edge (3), and its axis
    along         (V,) float64, out: position along the edge, in [0, 1]
    num_vertices  (K,) int64, out: vertices of each block; those of all blocks lie one by one
    """
    distance = np.empty((side + 1, side + 1, side + 1), np.float32)
    numbers = np.empty((side + 1, side + 1, side + 1, 3), np.int32)
    vertex = 0
    for block in range(len(neighbours)):
        first, out = vertex, starts[block]
        num_vertices[block] = 0
        if starts[block + 1] == out:
            continue
        pad(neighbours[block], side, field[:, 0], distance)
        numbers[:] = -1
        for cube in range(cases.shape[1]):
            case = cases[block, cube]
            if case == 0:
                continue
            i, j, k = cube % side, cube // side % side, cube // (side * side)
            for triangle in range(NUM_TRIANGLES[case]):
                for corner in range(3):
                    edge = np.int64(TRIANGLES[case, triangle, corner])
                    begin, axis = edge // 3, edge % 3
                    x, y, z = i + (begin & 1), j + (begin >> 1 & 1), k + (begin >> 2)
                    if numbers[z, y, x, axis] < 0:
                        numbers[z, y, x, axis] = vertex - first
                        edges[vertex, 0] = index[block, 0] * side + x
                        edges[vertex, 1] = index[block, 1] * side + y
                        edges[vertex, 2] = index[block, 2] * side + z
                        edges[vertex, 3] = axis
                        d0 = np.float64(distance[z, y, x])
                        end = distance[z + (axis == 2), y + (axis == 1), x + (axis == 0)]
                        d1 = np.float64(end)
                        along[vertex] = 0.5 if abs(d0 - d1) <= FLAT else d0 / (d0 - d1)
                        vertex += 1
                    triangles[out, corner] = numbers[z, y, x, axis]
                out += 1
        num_vertices[block] = vertex - first
