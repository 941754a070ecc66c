# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Slow twins of the package in plain numpy: independent, and exact if possible."""

from fractions import Fraction
import hashlib
import itertools
import math
import struct

import numpy as np


def exact_moments(points):
    """
    Return count, sum and scatter of (N, 3) points in rational arithmetic.

    The sum is 3 fractions, the scatter about the mean 6: xx xy xz yy yz zz.
    """
    rows = [[Fraction(float(value)) for value in point] for point in np.asarray(points)]
    count = len(rows)
    total = [sum(row[axis] for row in rows) for axis in range(3)]
    scatter = [
        sum(row[i] * row[j] for row in rows) - total[i] * total[j] / count
        for i in range(3)
        for j in range(i, 3)
    ]
    return count, total, scatter


# The map. Moments of a voxel are a list of 13 ints: count; sum x y z; products xx xy xz yy yz zz;
# view x y z. Moments of a scan or a map are a dict from voxel index (i, j, k) to such a list.

PAIRS = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]


def quantise(point, voxel_size_m, pose=None):
    """
    Return voxel index and place in the voxel of one point, 3 ints each.

    None for a point that is not finite or lies beyond the voxel indices. The pose, (3, 4) or
    (4, 4), takes the point to the map first.
    """
    place = [float(value) for value in point]
    if not all(math.isfinite(value) for value in place):
        return None
    if pose is not None:
        x, y, z = place
        rows = np.asarray(pose)[:3].tolist()
        place = [((r0 * x + r1 * y) + r2 * z) + t for r0, r1, r2, t in rows]
    scaled = [value * (65536.0 / voxel_size_m) for value in place]
    if not all(abs(value) < 2.0**40 for value in scaled):
        return None
    lattice = [math.floor(value) for value in scaled]
    voxel = tuple(value >> 16 for value in lattice)
    if not all(-(2**20) <= value < 2**20 for value in voxel):
        return None
    return voxel, tuple((value & 65535) - 32768 for value in lattice)


def view_of(voxel, origin, voxel_size_m):
    """Return the integer vector from a voxel's centre towards the sensor, rounded exactly."""
    if origin is None:
        return [0, 0, 0]
    half = Fraction(1, 2)
    towards = [
        Fraction(float(o)) - (index + half) * Fraction(voxel_size_m)
        for o, index in zip(origin, voxel, strict=True)
    ]
    length_sq = sum(value * value for value in towards)
    if length_sq == 0:
        return [0, 0, 0]
    # floor(r + 1/2) of r = sqrt(s) is (floor(sqrt(4 s)) + 1) // 2
    sizes = [(math.isqrt(int(4 * 2**28 * v * v / length_sq)) + 1) // 2 for v in towards]
    return [size if v >= 0 else -size for v, size in zip(towards, sizes, strict=True)]


def scan_moments(points, voxel_size_m, origin=None, pose=None):
    """Return the moments of points; those that cannot enter are left out."""
    moments = {}
    for point in np.asarray(points).reshape(-1, 3).tolist():
        quantised = quantise(point, voxel_size_m, pose)
        if quantised is not None:
            voxel, q = quantised
            row = moments.setdefault(voxel, [0] * 13)
            for column, value in enumerate([1, *q, *(q[i] * q[j] for i, j in PAIRS)]):
                row[column] += value
    for voxel, row in moments.items():
        row[10:] = [row[0] * value for value in view_of(voxel, origin, voxel_size_m)]
    return moments


def as_twin(moments):
    """Return a ScanMoments of the package in the form of the twins."""
    weight = np.ones_like(moments.count) if moments.view_is_sum else moments.count
    view = moments.view.astype(np.int64) * weight.astype(np.int64)[:, None]
    columns = [moments.count[:, None], moments.total, moments.product, view]
    rows = np.concatenate([np.asarray(column, np.int64) for column in columns], axis=1)
    return dict(zip(map(tuple, moments.voxel_index.tolist()), rows.tolist(), strict=True))


def add_moments(moments, more, sign=1):
    """Add moments to others in place, or subtract them; voxels without points leave."""
    for voxel, row in more.items():
        held = moments.get(voxel, [0] * 13)
        result = [a + sign * b for a, b in zip(held, row, strict=True)]
        if result[0]:
            moments[voxel] = result
        else:
            assert not any(result), (voxel, result)
            moments.pop(voxel, None)


def digest(moments, voxel_size_m, level=0):
    """Return the digest of a map that holds some moments."""
    state = b'surfel map 1' + struct.pack('<dqq', voxel_size_m, level, len(moments))
    voxels = sorted(moments)
    for i, j, k in voxels:
        state += struct.pack('<q', ((i + 2**20) * 2**21 + (j + 2**20)) * 2**21 + (k + 2**20))
    for columns in (slice(0, 1), slice(1, 4), slice(4, 10), slice(10, 13)):
        numbers = [value for voxel in voxels for value in moments[voxel][columns]]
        state += struct.pack(f'<{len(numbers)}q', *numbers)
    return hashlib.sha256(state).hexdigest()


def surfel(voxel, row, voxel_size_m):
    """
    Return position, exact scatter (3, 3), covariance, eigenvalues, normal of a voxel's moments.

    The normal is that of numpy.linalg.eigh, turned by the rules; the scatter is in fractions
    of a squared lattice unit.
    """
    count, total, product, view = row[0], row[1:4], row[4:10], row[10:]
    size = Fraction(voxel_size_m)
    unit = size / 65536
    centre = 32768 + Fraction(1, 2)
    position = [
        float(index * size + (Fraction(s, count) + centre) * unit)
        for index, s in zip(voxel, total, strict=True)
    ]
    scatter = [[Fraction(0)] * 3 for _ in range(3)]
    for (i, j), value in zip(PAIRS, product, strict=True):
        scatter[i][j] = scatter[j][i] = value - Fraction(total[i] * total[j], count)
    covariance = np.array(
        [[float(value * unit * unit / max(count - 1, 1)) for value in line] for line in scatter]
    )
    eigenvalues, vectors = np.linalg.eigh(covariance)
    eigenvalues = np.maximum(eigenvalues, 0.0)
    normal = vectors[:, 0]
    if not any(scatter[i][i] for i in range(3)):
        normal = np.full(3, np.nan)
    towards = float(normal @ np.array(view, float))
    if towards < 0.0 or (not any(view) and normal[np.argmax(np.abs(normal))] < 0.0):
        normal = -normal
    return {
        'position': np.array(position),
        'scatter': scatter,
        'eigenvalues': eigenvalues,
        'normal': normal,
        'num_points': count,
        'towards': abs(towards) / max(np.linalg.norm(view), 1.0),
    }


def window(scans, limits):
    """
    Return the numbers of the scans left of a sequence: the longest end of it within limits.

    A scan is a tuple of stamp in s, position, bytes, and its voxels as a set; the newest stays.
    """

    def within(part):
        steps = [math.dist(a[1], b[1]) for a, b in itertools.pairwise(part)]
        values = {
            'max_scans': len(part),
            'max_age_s': part[-1][0] - part[0][0],
            'max_distance_m': math.fsum(steps),
            'max_bytes': sum(scan[2] for scan in part),
            'max_voxels': len(set().union(*(scan[3] for scan in part))),
        }
        return all(values[name] <= limit for name, limit in limits.items() if limit)

    first = 0
    while first < len(scans) - 1 and not within(scans[first:]):
        first += 1
    return list(range(first, len(scans)))
