# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Analytic surfaces: tables of primitives, normals, nearest surface to a position.

A primitive is a kind, a pose and half its extent along its own axes. Its faces are numbered, and
a surface is ``primitive * FACES + face``: a box has six planes, which distinguishes points on one
plane from points on one box. The primitives are the leaves of a tree of axis-parallel bounding
boxes in depth-first order, each with the node that follows a miss: traversal needs no stack.

The tables, for P primitives and M nodes:

    kind            (P,) int64, RECTANGLE to SPHERE
    pose            (P, 3, 4) float64, upper rows of T_world_primitive
    half            (P, 3) float64 m, half the extent along the primitive's own x, y, z
    node_box        (M, 6) float64 m, lowest x y z and highest x y z in the world
    node_next       (M,) int64, first node after the branch
    node_primitive  (M,) int64, primitive of a leaf, else -1
"""

import math

from numba import njit
import numpy as np

RECTANGLE, BOX, CYLINDER, TUBE, SPHERE = range(5)
"""Faces: a rectangle has 0 (+z); a box +x -x +y -y +z -z; a cylinder side, +z, -z; else 0."""

FACES = 6
"""Face numbers reserved for each primitive."""


@njit(cache=True, nogil=True)
def nearest_surface(
    positions, kind, pose, half, node_box, node_next, node_primitive, distance_m, surface
):
    """
    Find the surface nearest to each position, in place.

    positions   (N, 3) float64 m, in the world
    distance_m  (N,) float64 m, out
    surface     (N,) int64, out; -1 without primitives and for non-finite positions
    """
    position, local = np.zeros(6), np.zeros(6)
    last = 0
    for row in range(len(positions)):
        nearest, surface_id = np.inf, -1
        finite = True
        for axis in range(3):
            position[axis] = positions[row, axis]
            finite = finite and np.isfinite(position[axis])
        if finite and len(kind) > 0:
            # Neighbours often share their surface; its distance prunes most of the tree at once.
            into_primitive(position, pose[last], local)
            nearest = np.nextafter(gap(local, kind[last], half[last])[0], np.inf)
        node = 0
        while finite and node < len(node_next):
            if not distance_to_box(position, node_box[node]) < nearest:
                node = node_next[node]
                continue
            primitive = node_primitive[node]
            if primitive >= 0:
                into_primitive(position, pose[primitive], local)
                distance, face = gap(local, kind[primitive], half[primitive])
                if distance < nearest:
                    nearest, surface_id, last = distance, primitive * FACES + face, primitive
            node += 1
        distance_m[row], surface[row] = nearest, surface_id


@njit(cache=True, nogil=True)
def outward_normals(positions, surface, kind, pose, normals):
    """
    Compute the outward unit normal of each position's surface, in place.

    positions  (N, 3) float64 m, in the world
    surface    (N,) int64, -1 for none
    normals    (N, 3) float64, out; nan without a surface, on the axis of a cylinder and at the
               centre of a sphere
    """
    position, local, normal = np.zeros(6), np.zeros(6), np.zeros(3)
    for row in range(len(positions)):
        if surface[row] < 0:
            normals[row] = np.nan
            continue
        primitive, face = surface[row] // FACES, surface[row] % FACES
        position[:3] = positions[row]
        into_primitive(position, pose[primitive], local)
        local_normal(local, kind[primitive], face, normal)
        for axis in range(3):
            normals[row, axis] = (
                pose[primitive, axis, 0] * normal[0]
                + pose[primitive, axis, 1] * normal[1]
                + pose[primitive, axis, 2] * normal[2]
            )


@njit(cache=True, nogil=True)
def local_normal(local, kind, face, normal):
    """Write the outward normal (3,) of a face at a position, both in the primitive's frame."""
    normal[:] = 0.0
    if kind == RECTANGLE:
        normal[2] = 1.0
    elif kind == BOX:
        normal[face // 2] = 1.0 - 2.0 * (face % 2)
    elif face > 0:
        normal[2] = 3.0 - 2.0 * face
    else:
        z = local[2] if kind == SPHERE else 0.0
        length = math.sqrt(local[0] * local[0] + local[1] * local[1] + z * z)
        if length == 0.0:
            normal[:] = np.nan
        else:
            normal[0], normal[1], normal[2] = local[0] / length, local[1] / length, z / length


@njit(cache=True, nogil=True)
def into_primitive(ray, pose, local):
    """Transform a position (0 to 2) and a direction (3 to 5) from the world to a primitive."""
    x, y, z = ray[0] - pose[0, 3], ray[1] - pose[1, 3], ray[2] - pose[2, 3]
    for axis in range(3):
        a, b, c = pose[0, axis], pose[1, axis], pose[2, axis]
        local[axis] = a * x + b * y + c * z
        local[3 + axis] = a * ray[3] + b * ray[4] + c * ray[5]


@njit(cache=True, nogil=True)
def distance_to_box(position, box):
    """Return the distance of a position from a box, 0 inside it."""
    total = 0.0
    for axis in range(3):
        outside = max(box[axis] - position[axis], position[axis] - box[3 + axis], 0.0)
        total += outside * outside
    return math.sqrt(total)


@njit(cache=True, nogil=True)
def gap(local, kind, half):
    """Return the distance of a position from a primitive's surface, and the face it is nearest."""
    x, y, z = local[0], local[1], local[2]
    if kind == SPHERE:
        return abs(math.sqrt(x * x + y * y + z * z) - half[0]), 0
    if kind == RECTANGLE:
        across, along = max(abs(x) - half[0], 0.0), max(abs(y) - half[1], 0.0)
        return math.sqrt(across * across + along * along + z * z), 0
    if kind == TUBE:
        wall = math.sqrt(x * x + y * y) - half[0]
        beyond = max(abs(z) - half[2], 0.0)
        return math.sqrt(wall * wall + beyond * beyond), 0
    if kind == CYLINDER:
        wall, end = math.sqrt(x * x + y * y) - half[0], abs(z) - half[2]
        face = 0 if wall >= end else (1 if z >= 0.0 else 2)
        return solid_gap(wall, end, -np.inf), face
    gaps = abs(x) - half[0], abs(y) - half[1], abs(z) - half[2]
    axis = 0
    for candidate in (1, 2):
        if gaps[candidate] > gaps[axis]:
            axis = candidate
    return solid_gap(*gaps), 2 * axis + (0 if local[axis] >= 0.0 else 1)


@njit(cache=True, nogil=True)
def solid_gap(a, b, c):
    """Return the distance from a solid's surface, from the signed distances to its walls."""
    if max(a, b, c) <= 0.0:
        return -max(a, b, c)
    a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
    return math.sqrt(a * a + b * b + c * c)
