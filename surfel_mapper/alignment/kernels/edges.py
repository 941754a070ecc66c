# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Moments of the pairs of an edge: means and second moments of both ends.

Every sum over the pairs of two clouds that the alignment needs is a polynomial in the two poses.
Its coefficients are 28 numbers, or 80 if each pair has its own weight. So the pairs are read only
once, and an iteration costs the same for 10 pairs as for 10^6: 100 edges of 5000 pairs take 6 ms
once instead of in each iteration. The 28 are taken about the means, because about the origin
float64 cancellation would swallow millimetres at 1 km.
"""

import math

from numba import njit

# Entries of the moments of an edge.
COUNT = 0
SOURCE_MEAN = 1
TARGET_MEAN = 4
SOURCE_SCATTER = 7
TARGET_SCATTER = 13
CROSS_SCATTER = 19
NUM_MOMENTS = 28

# Entries of the moments of an edge of weighted pairs.
GAP_SQ = 1
LINEAR = 2
QUADRATIC = 14
FIRST_PAIR = 74
NUM_WEIGHTED = 80


@njit(cache=True, nogil=True)
def pair_moments(source, target, pairs, moments):
    """
    Sum the moments of pairs of points; pairs with a coordinate that is not finite are skipped.

    source   (N, 3) float32 or float64, m
    target   (M, 3) float32 or float64, m
    pairs    (K, 2) int32, rows of source and target; the caller has checked their range
    moments  (28,) float64, out: number of pairs; mean of source (3) and target (3); sums of
             products of the deviations from these: source (6: xx xy xz yy yz zz), target (6),
             source by target (9: xx xy xz yx yy yz zx zy zz); 0 without pairs

    Summed about the first pair and then moved to the mean.
    """
    num = 0
    ax = ay = az = bx = by = bz = 0.0
    sx = sy = sz = tx = ty = tz = 0.0
    sxx = sxy = sxz = syy = syz = szz = 0.0
    txx = txy = txz = tyy = tyz = tzz = 0.0
    cxx = cxy = cxz = cyx = cyy = cyz = czx = czy = czz = 0.0
    for k in range(len(pairs)):
        i, j = pairs[k, 0], pairs[k, 1]
        px, py, pz = float(source[i, 0]), float(source[i, 1]), float(source[i, 2])
        qx, qy, qz = float(target[j, 0]), float(target[j, 1]), float(target[j, 2])
        if not (math.isfinite(px + py + pz) and math.isfinite(qx + qy + qz)):
            continue
        if num == 0:
            ax, ay, az, bx, by, bz = px, py, pz, qx, qy, qz
        num += 1
        px, py, pz, qx, qy, qz = px - ax, py - ay, pz - az, qx - bx, qy - by, qz - bz
        sx, sy, sz = sx + px, sy + py, sz + pz
        tx, ty, tz = tx + qx, ty + qy, tz + qz
        sxx, sxy, sxz = sxx + px * px, sxy + px * py, sxz + px * pz
        syy, syz, szz = syy + py * py, syz + py * pz, szz + pz * pz
        txx, txy, txz = txx + qx * qx, txy + qx * qy, txz + qx * qz
        tyy, tyz, tzz = tyy + qy * qy, tyz + qy * qz, tzz + qz * qz
        cxx, cxy, cxz = cxx + px * qx, cxy + px * qy, cxz + px * qz
        cyx, cyy, cyz = cyx + py * qx, cyy + py * qy, cyz + py * qz
        czx, czy, czz = czx + pz * qx, czy + pz * qy, czz + pz * qz
    share = 1.0 / max(num, 1)
    ux, uy, uz, vx, vy, vz = sx * share, sy * share, sz * share, tx * share, ty * share, tz * share
    sums = (
        float(num),
        ax + ux,
        ay + uy,
        az + uz,
        bx + vx,
        by + vy,
        bz + vz,
        sxx - sx * ux,
        sxy - sx * uy,
        sxz - sx * uz,
        syy - sy * uy,
        syz - sy * uz,
        szz - sz * uz,
        txx - tx * vx,
        txy - tx * vy,
        txz - tx * vz,
        tyy - ty * vy,
        tyz - ty * vz,
        tzz - tz * vz,
        cxx - sx * vx,
        cxy - sx * vy,
        cxz - sx * vz,
        cyx - sy * vx,
        cyy - sy * vy,
        cyz - sy * vz,
        czx - sz * vx,
        czy - sz * vy,
        czz - sz * vz,
    )
    for entry in range(NUM_MOMENTS):
        moments[entry] = sums[entry]


@njit(cache=True, nogil=True)
def weighted_moments(source, target, pairs, weights, moments):
    """
    Sum the moments of weighted pairs of points; see ``pair_moments``.

    source   (N, 3) float32 or float64, m
    target   (M, 3) float32 or float64, m
    pairs    (K, 2) int32, rows of source and target; the caller has checked their range
    weights  (K, 3, 3) float64, symmetric, in the frame of the target
    moments  (80,) float64, out: number of pairs; sum of target^T W target; sums of W target by
             (source, 1) (12: x by source x y z 1, then y, z); sums of W by (source, 1) by
             (source, 1) (60: W xx xy xz yy yz zz, each by xx xy xz x yy yz y zz z 1); the points
             of the first pair, source and target, from which all others are counted

    These are the coefficients of the squared gap as a quadratic form in the entries of the
    transform T that moves the source. About a far origin the gap would be the small difference of
    large sums: at 5000 km, as in UTM, 200 pairs without a gap would have one of up to 0.13 m.
    """
    moments[:] = 0.0
    ax = ay = az = bx = by = bz = 0.0
    for k in range(len(pairs)):
        i, j = pairs[k, 0], pairs[k, 1]
        px, py, pz = float(source[i, 0]), float(source[i, 1]), float(source[i, 2])
        qx, qy, qz = float(target[j, 0]), float(target[j, 1]), float(target[j, 2])
        if not (math.isfinite(px + py + pz) and math.isfinite(qx + qy + qz)):
            continue
        if moments[COUNT] == 0.0:
            ax, ay, az, bx, by, bz = px, py, pz, qx, qy, qz
        px, py, pz, qx, qy, qz = px - ax, py - ay, pz - az, qx - bx, qy - by, qz - bz
        h = (px, py, pz, 1.0)
        w = weights[k]
        upper = (w[0, 0], w[0, 1], w[0, 2], w[1, 1], w[1, 2], w[2, 2])
        wq = (
            w[0, 0] * qx + w[0, 1] * qy + w[0, 2] * qz,
            w[1, 0] * qx + w[1, 1] * qy + w[1, 2] * qz,
            w[2, 0] * qx + w[2, 1] * qy + w[2, 2] * qz,
        )
        moments[COUNT] += 1.0
        moments[GAP_SQ] += wq[0] * qx + wq[1] * qy + wq[2] * qz
        index = LINEAR
        for axis in range(3):
            for a in range(4):
                moments[index] += wq[axis] * h[a]
                index += 1
        for entry in range(6):
            for a in range(4):
                scaled = upper[entry] * h[a]
                for b in range(a, 4):
                    moments[index] += scaled * h[b]
                    index += 1
    for entry, value in enumerate((ax, ay, az, bx, by, bz)):
        moments[FIRST_PAIR + entry] = value
