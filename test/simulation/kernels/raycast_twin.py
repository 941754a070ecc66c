# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Twins of the kernels of rays and nearest surfaces, one ray and one place at a time.

They try every surface of every primitive. A box is six rectangles here and a cylinder a side and
two discs; a ray meets a plane where a linear system of three unknowns is solved, and a side or a
sphere at the roots of a polynomial that numpy finds.
"""

import numpy as np

from surfel_mapper.geometry import pose_matrix
from surfel_mapper.simulation.kernels.surfaces import FACES


def patches(primitive):
    """
    Yield (face, centre, axes, half extents) of the flat faces; discs have a radius.

    Columns of axes: two in the face, then its outward normal; all in the world.
    """
    T = pose_matrix(primitive.xyz, primitive.q_xyzw)
    R, t, size = T[:3, :3], T[:3, 3], primitive.size_m
    if primitive.kind == 'rectangle':
        yield 0, t, R, (size[0] / 2, size[1] / 2)
    elif primitive.kind == 'box':
        for axis in range(3):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            for side, sign in enumerate((1.0, -1.0)):
                axes = np.column_stack([R[:, a], R[:, b], sign * R[:, axis]])
                centre = t + sign * R[:, axis] * size[axis] / 2
                yield 2 * axis + side, centre, axes, (size[a] / 2, size[b] / 2)
    elif primitive.kind == 'cylinder':
        for face, sign in ((1, 1.0), (2, -1.0)):
            axes = np.column_stack([R[:, 0], R[:, 1], sign * R[:, 2]])
            yield face, t + sign * R[:, 2] * size[1] / 2, axes, size[0]


def inside(u, v, extent):
    if np.isscalar(extent):
        return np.hypot(u, v) <= extent
    return abs(u) <= extent[0] and abs(v) <= extent[1]


def round_hits(primitive, origin, direction):
    """Yield the ranges at which a ray meets a sphere or the side of a cylinder."""
    T = pose_matrix(primitive.xyz, primitive.q_xyzw)
    o, d = T[:3, :3].T @ (origin - T[:3, 3]), T[:3, :3].T @ direction
    dims = 3 if primitive.kind == 'sphere' else 2
    a, b = d[:dims], o[:dims]
    for root in np.roots([a @ a, 2.0 * (a @ b), b @ b - primitive.size_m[0] ** 2]):
        within = dims == 3 or abs(o[2] + root.real * d[2]) <= primitive.size_m[1] / 2
        if abs(root.imag) == 0.0 and within:
            yield float(root.real)


def cast_twin(world, origin, direction):
    """Return range and surface of the first hit, trying everything."""
    hits = [(np.inf, -1)]
    for index, primitive in enumerate(world.primitives):
        for face, centre, axes, extent in patches(primitive):
            system = np.column_stack([direction, -axes[:, 0], -axes[:, 1]])
            distance, u, v = np.linalg.solve(system, centre - origin)
            if distance > 0.0 and inside(u, v, extent):
                hits.append((distance, index * FACES + face))
        if primitive.kind in ('cylinder', 'tube', 'sphere'):
            ranges = round_hits(primitive, origin, direction)
            hits.extend((distance, index * FACES) for distance in ranges if distance > 0.0)
    return min(hits)


def distances_twin(world, place):
    """Return the distance of every surface."""
    found = {}
    for index, primitive in enumerate(world.primitives):
        for face, centre, axes, extent in patches(primitive):
            u, v, w = axes.T @ (place - centre)
            if np.isscalar(extent):
                beside = max(np.hypot(u, v) - extent, 0.0)
            else:
                beside = np.linalg.norm(np.maximum(np.abs([u, v]) - extent, 0.0))
            found[index * FACES + face] = np.hypot(beside, w)
        T = pose_matrix(primitive.xyz, primitive.q_xyzw)
        x, y, z = T[:3, :3].T @ (place - T[:3, 3])
        if primitive.kind == 'sphere':
            found[index * FACES] = abs(np.sqrt(x**2 + y**2 + z**2) - primitive.size_m[0])
        elif primitive.kind in ('cylinder', 'tube'):
            over = max(abs(z) - primitive.size_m[1] / 2, 0.0)
            found[index * FACES] = np.hypot(np.hypot(x, y) - primitive.size_m[0], over)
    return found
