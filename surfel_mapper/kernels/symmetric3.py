# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Eigenvalues and eigenvectors of symmetric 3 by 3 matrices, of many at once or of one.

``decompose`` finds the eigenvalues and the eigenvector of the smallest one, ``eigenvectors`` the
other two eigenvectors. No trigonometry, no iteration of unknown length and no branches, so that
the compiler vectorises the loops.

The deviator scaled to B (trace 0, |B|^2 = 6) has eigenvalues t with t^3 - 3 t = det B. The one
farthest from the other two is a well-conditioned root, at least 3^(1/2) away from both; its
eigenvector is the longest cross product of two rows of B - t I. The other two eigenvalues come
from the 2 by 2 matrix in the plane across that eigenvector, which is accurate even if they
coincide. Only multiplication, addition, division and square roots are used, so every machine
gives the same bits.

Every step is a loop of its own. In a single loop divisions and roots wait for each other, and it
is too long for the processor to overlap iterations (25 against 16.5 ns a matrix; 100 to 200 ns
with acos and cos).

Source: Smith 1961 for the scaled cubic; Eberly 2014 (A robust eigensolver for 3 x 3 symmetric
matrices) for deflation; Duff et al. 2017 for the basis across a unit vector.
"""

import math

from numba import njit

from surfel_mapper.kernels.compiling import inlined, kernel

NOISE = 1e-15
"""Eigenvalues below this share of the trace are rounding errors, and become 0."""

SIXTH = 1.0 / 6.0

CHUNK = 128
"""Matrices decomposed together: their intermediate results stay in the first-level cache."""


@kernel(error_model='numpy')
def decompose(scatter, num, eigenvalues, normals):
    """
    Decompose the first num matrices.

    scatter      (6, C) float64, xx xy xz yy yz zz, positive semidefinite
    num          <= C
    eigenvalues  (3, C) float64, out: ascending, none negative
    normals      (3, C) float64, out: unit eigenvectors of the smallest; sign arbitrary. If the
                 two smallest coincide: orthogonal to the third eigenvector; if all coincide: z
    """
    for i in range(num):
        values, normal = decompose_one(
            scatter[0, i],
            scatter[1, i],
            scatter[2, i],
            scatter[3, i],
            scatter[4, i],
            scatter[5, i],
        )
        for axis in range(3):
            eigenvalues[axis, i] = values[axis]
            normals[axis, i] = normal[axis]


@inlined(error_model='numpy')
def decompose_one(axx, axy, axz, ayy, ayz, azz):
    """
    Return eigenvalues and normal of a matrix, as ``decompose`` does, three float64 each.

    No branches, so that a loop over matrices is vectorised.
    """
    size = (axx + ayy) + azz
    # squares and cubes of tiny and huge matrices would leave float64
    into = 2.0**700 if size < 2.0**-400 else (2.0**-600 if size > 2.0**400 else 1.0)
    back = 2.0**-700 if size < 2.0**-400 else (2.0**600 if size > 2.0**400 else 1.0)
    axx, axy, axz = axx * into, axy * into, axz * into
    ayy, ayz, azz = ayy * into, ayz * into, azz * into
    # the deviator scaled to B, of trace 0 and |B|^2 = 6; of a multiple of the identity: normal z
    trace = (axx + ayy) + azz
    mean = trace / 3.0
    bxx, byy, bzz = axx - mean, ayy - mean, azz - mean
    off = (axy * axy + axz * axz) + ayz * ayz
    spread = math.sqrt((((bxx * bxx + byy * byy) + bzz * bzz) + 2.0 * off) * SIXTH)
    ball = spread <= NOISE * trace
    inverse = 0.0 if ball else 1.0 / spread
    spread = 0.0 if ball else spread
    bxy, bxz, byz = axy * inverse, axz * inverse, ayz * inverse
    bxx = 1.0 if ball else bxx * inverse
    byy = 1.0 if ball else byy * inverse
    bzz = -2.0 if ball else bzz * inverse
    t = isolated_root(
        bxx * (byy * bzz - byz * byz)
        - bxy * (bxy * bzz - byz * bxz)
        + bxz * (bxy * byz - byy * bxz)
    )
    # its unit eigenvector v, the longest cross product of two rows of B - t I
    cxx, cyy, czz = bxx - t, byy - t, bzz - t
    ux, uy, uz = bxy * byz - bxz * cyy, bxz * bxy - cxx * byz, cxx * cyy - bxy * bxy
    wx, wy, wz = bxy * czz - bxz * byz, bxz * bxz - cxx * czz, cxx * byz - bxy * bxz
    vx, vy, vz = cyy * czz - byz * byz, byz * bxz - bxy * czz, bxy * byz - cyy * bxz
    u_sq = (ux * ux + uy * uy) + uz * uz
    w_sq = (wx * wx + wy * wy) + wz * wz
    v_sq = (vx * vx + vy * vy) + vz * vz
    better = w_sq > v_sq
    vx, vy, vz = (wx if better else vx), (wy if better else vy), (wz if better else vz)
    v_sq = w_sq if better else v_sq
    better = u_sq > v_sq
    vx, vy, vz = (ux if better else vx), (uy if better else vy), (uz if better else vz)
    v_sq = u_sq if better else v_sq
    scale = 1.0 / math.sqrt(v_sq)
    vx, vy, vz = vx * scale, vy * scale, vz * scale
    # u, w: a basis of the plane across v
    sign = 1.0 if vz >= 0.0 else -1.0
    a = -1.0 / (sign + vz)
    b = vx * vy * a
    ux, uy, uz = 1.0 + sign * vx * vx * a, sign * b, -sign * vx
    wx, wy, wz = b, sign + vy * vy * a, -vy
    # B in it: the 2 by 2 matrix [[uu, uw], [uw, ww]], where uu + ww = -t
    pux, puy = (bxx * ux + bxy * uy) + bxz * uz, (bxy * ux + byy * uy) + byz * uz
    puz = (bxz * ux + byz * uy) + bzz * uz
    uu, uw = (ux * pux + uy * puy) + uz * puz, (wx * pux + wy * puy) + wz * puz
    d = uu + 0.5 * t
    radius = math.sqrt(d * d + uw * uw)
    first, second = (-uw if d >= 0.0 else radius - d), (d + radius if d >= 0.0 else -uw)
    first = first if radius > 0.0 else 1.0
    px, py, pz = first * ux + second * wx, first * uy + second * wy, first * uz + second * wz
    scale = 1.0 / math.sqrt((px * px + py * py) + pz * pz)
    is_lowest = t < 0.0
    normal = (
        vx if is_lowest else px * scale,
        vy if is_lowest else py * scale,
        vz if is_lowest else pz * scale,
    )
    noise = 3.0 * NOISE * mean
    low, high = -0.5 * t - radius, -0.5 * t + radius
    e0 = mean + spread * (t if is_lowest else low)
    e1 = mean + spread * (low if is_lowest else high)
    e2 = mean + spread * (high if is_lowest else t)
    e0 = 0.0 if e0 < noise else e0
    e1 = 0.0 if e1 < noise else e1
    e1 = e0 if e1 < e0 else e1
    e2 = e1 if e2 < e1 else e2
    return (e0 * back, e1 * back, e2 * back), normal


@inlined(error_model='numpy')
def isolated_root(determinant):
    """Return the eigenvalue t of B farthest from the other two, in [-2, 2]."""
    side = 1.0 if determinant >= 0.0 else -1.0
    half = min(abs(determinant) * 0.5, 1.0)
    t = 0.0186393677949610 * half - 0.0813823948457717
    t = (t * half + 0.3306607004416897) * half + 1.7321326590663837  # to 1e-4
    t -= ((t * t - 3.0) * t - 2.0 * half) / (3.0 * (t * t - 1.0))  # to 1e-8
    t -= ((t * t - 3.0) * t - 2.0 * half) / (3.0 * (t * t - 1.0))
    return t * side


@kernel(error_model='numpy')
def eigenvectors(matrices, values, smallest, vectors):
    """
    Find all eigenvectors, given those of the smallest eigenvalues.

    matrices  (6, M) float64, symmetric, xx xy xz yy yz zz
    values    (3, M) float64, their eigenvalues, ascending
    smallest  (3, M) float64, unit eigenvectors of values[0]
    vectors   (M, 3, 3) float64, out: vectors[:, k] belong to values[k], are of unit length, and
              their component of largest magnitude is positive; nan where all values are 0
    """
    for i in range(matrices.shape[1]):
        if values[2, i] > 0.0:
            write_frame(matrices[:, i], smallest[:, i], vectors[i])
        else:
            vectors[i, :, :] = math.nan


@inlined(error_model='numpy')
def write_frame(matrix, smallest, vectors):
    """
    Write the three eigenvectors of a matrix, given the one of its smallest eigenvalue.

    In the plane across the smallest, the matrix is 2 by 2; its larger eigenvector follows from a
    square root. The third is the cross product of both.
    """
    xx, xy, xz, yy, yz, zz = matrix[0], matrix[1], matrix[2], matrix[3], matrix[4], matrix[5]
    nx, ny, nz = smallest[0], smallest[1], smallest[2]
    # u and w: a basis across n (Duff et al. 2017)
    sign = 1.0 if nz >= 0.0 else -1.0
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    ux, uy, uz = 1.0 + sign * nx * nx * a, sign * b, -sign * nx
    wx, wy, wz = b, sign + ny * ny * a, -ny
    pux, puy = (xx * ux + xy * uy) + xz * uz, (xy * ux + yy * uy) + yz * uz
    puz = (xz * ux + yz * uy) + zz * uz
    pwx, pwy = (xx * wx + xy * wy) + xz * wz, (xy * wx + yy * wy) + yz * wz
    pwz = (xz * wx + yz * wy) + zz * wz
    uu, uw = (ux * pux + uy * puy) + uz * puz, (wx * pux + wy * puy) + wz * puz
    ww = (wx * pwx + wy * pwy) + wz * pwz
    half = 0.5 * (uu - ww)
    scale = max(abs(half), abs(uw))  # the squares of tiny values underflow
    equal = scale == 0.0  # any direction will do
    half, uw = (1.0, 0.0) if equal else (half / scale, uw / scale)
    spread = math.sqrt(half * half + uw * uw)
    cosine, sine = half / spread, uw / spread
    # cosine and sine of half of the angle, scaled
    first = 1.0 + cosine if cosine >= 0.0 else sine
    second = sine if cosine >= 0.0 else 1.0 - cosine
    length = math.sqrt(first * first + second * second)
    first, second = first / length, second / length
    lx, ly, lz = first * ux + second * wx, first * uy + second * wy, first * uz + second * wz
    store(vectors[0], nx, ny, nz)
    store(vectors[1], ny * lz - nz * ly, nz * lx - nx * lz, nx * ly - ny * lx)
    store(vectors[2], lx, ly, lz)


@kernel()
def smallest_vectors(values, smallest, vectors):
    """
    Write the eigenvectors of the smallest eigenvalues alone, as ``eigenvectors`` does.

    values, smallest  as of eigenvectors
    vectors           (M, 1, 3) float64, out
    """
    for i in range(len(vectors)):
        if values[2, i] > 0.0:
            store(vectors[i, 0], smallest[0, i], smallest[1, i], smallest[2, i])
        else:
            vectors[i, :, :] = math.nan


@njit(cache=True, nogil=True, inline='always')
def store(vector, x, y, z):
    """Store a vector with its component of largest magnitude, the first of equal ones, > 0."""
    leading = x
    if abs(y) > abs(leading):
        leading = y
    if abs(z) > abs(leading):
        leading = z
    side = -1.0 if leading < 0.0 else 1.0
    vector[0], vector[1], vector[2] = side * x, side * y, side * z
