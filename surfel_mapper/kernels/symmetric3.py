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
import numpy as np

from surfel_mapper.kernels.compiling import kernel, part

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
    work = make_work(min(num, CHUNK))
    for start in range(0, num, CHUNK):
        decompose_chunk(scatter, start, min(CHUNK, num - start), work, eigenvalues, normals)


@njit(cache=True, nogil=True, inline='always')
def make_work(size):
    """
    Return arrays for the intermediate results of ``size`` matrices, float64.

    Deviators (6, size), sizes (3, size), roots (size,), vectors (3, size), planes (4, size).
    """
    deviators, sizes = np.empty((6, size)), np.empty((3, size))
    return deviators, sizes, np.empty(size), np.empty((3, size)), np.empty((4, size))


@part(error_model='numpy')
def decompose_chunk(scatter, start, num, work, eigenvalues, normals):
    """Decompose num matrices from start on, as ``decompose`` does, with work for as many."""
    deviators, sizes, roots, vectors, planes = work
    normalise(scatter, start, num, deviators, sizes)
    isolate(deviators, num, roots)
    cross(deviators, roots, num, vectors)
    deflate(deviators, roots, vectors, num, planes)
    write_eigenvalues(sizes, roots, planes, start, num, eigenvalues)
    write_normals(roots, vectors, planes, start, num, normals)


@part(error_model='numpy')
def normalise(scatter, start, num, deviators, sizes):
    """
    Subtract the mean eigenvalue and scale the deviator.

    deviators  (6, num), out: B of trace 0 and |B|^2 = 6; for a multiple of the identity, the one
               with the normal z
    sizes      (3, num), out: mean eigenvalue, spread (the factor taken out of B), and the factor
               that undoes the scaling of tiny or huge matrices, whose squares and cubes would
               leave float64
    """
    for i in range(num):
        at = start + i
        axx, axy, axz = scatter[0, at], scatter[1, at], scatter[2, at]
        ayy, ayz, azz = scatter[3, at], scatter[4, at], scatter[5, at]
        size = (axx + ayy) + azz
        into = 2.0**700 if size < 2.0**-400 else (2.0**-600 if size > 2.0**400 else 1.0)
        back = 2.0**-700 if size < 2.0**-400 else (2.0**600 if size > 2.0**400 else 1.0)
        axx, axy, axz = axx * into, axy * into, axz * into
        ayy, ayz, azz = ayy * into, ayz * into, azz * into
        trace = (axx + ayy) + azz
        mean = trace / 3.0
        bxx, byy, bzz = axx - mean, ayy - mean, azz - mean
        off = (axy * axy + axz * axz) + ayz * ayz
        spread = math.sqrt((((bxx * bxx + byy * byy) + bzz * bzz) + 2.0 * off) * SIXTH)
        ball = spread <= NOISE * trace
        inverse = 0.0 if ball else 1.0 / spread
        deviators[0, i] = 1.0 if ball else bxx * inverse
        deviators[1, i] = axy * inverse
        deviators[2, i] = axz * inverse
        deviators[3, i] = 1.0 if ball else byy * inverse
        deviators[4, i] = ayz * inverse
        deviators[5, i] = -2.0 if ball else bzz * inverse
        sizes[0, i], sizes[1, i], sizes[2, i] = mean, (0.0 if ball else spread), back


@part(error_model='numpy')
def isolate(deviators, num, roots):
    """Find the eigenvalue of each deviator farthest from the other two, in [-2, 2]."""
    for i in range(num):
        bxx, bxy, bxz = deviators[0, i], deviators[1, i], deviators[2, i]
        byy, byz, bzz = deviators[3, i], deviators[4, i], deviators[5, i]
        determinant = (
            bxx * (byy * bzz - byz * byz)
            - bxy * (bxy * bzz - byz * bxz)
            + bxz * (bxy * byz - byy * bxz)
        )
        side = 1.0 if determinant >= 0.0 else -1.0
        half = min(abs(determinant) * 0.5, 1.0)
        t = 0.0186393677949610 * half - 0.0813823948457717
        t = (t * half + 0.3306607004416897) * half + 1.7321326590663837  # to 1e-4
        t -= ((t * t - 3.0) * t - 2.0 * half) / (3.0 * (t * t - 1.0))  # to 1e-8
        t -= ((t * t - 3.0) * t - 2.0 * half) / (3.0 * (t * t - 1.0))
        roots[i] = t * side


@part(error_model='numpy')
def cross(deviators, roots, num, vectors):
    """Find the unit eigenvectors (3, num) of the isolated eigenvalues."""
    for i in range(num):
        bxx, bxy, bxz = deviators[0, i], deviators[1, i], deviators[2, i]
        byy, byz, bzz = deviators[3, i], deviators[4, i], deviators[5, i]
        t = roots[i]
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
        vectors[0, i], vectors[1, i], vectors[2, i] = vx * scale, vy * scale, vz * scale


@part(error_model='numpy')
def deflate(deviators, roots, vectors, num, planes):
    """
    Solve for the other two eigenvalues, in the plane across the isolated eigenvector.

    planes  (4, num), out: half of their difference, and an eigenvector of the lower one, not
            normalised, never 0
    """
    for i in range(num):
        bxx, bxy, bxz = deviators[0, i], deviators[1, i], deviators[2, i]
        byy, byz, bzz = deviators[3, i], deviators[4, i], deviators[5, i]
        t, vx, vy, vz = roots[i], vectors[0, i], vectors[1, i], vectors[2, i]
        # u, w: a basis of the plane
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
        planes[0, i] = radius
        planes[1, i] = first * ux + second * wx
        planes[2, i] = first * uy + second * wy
        planes[3, i] = first * uz + second * wz


@part(error_model='numpy')
def write_eigenvalues(sizes, roots, planes, start, num, eigenvalues):
    """Scale the three eigenvalues back, in ascending order."""
    for i in range(num):
        mean, spread, back = sizes[0, i], sizes[1, i], sizes[2, i]
        t, radius = roots[i], planes[0, i]
        noise = 3.0 * NOISE * mean
        low, high = -0.5 * t - radius, -0.5 * t + radius
        e0 = mean + spread * (t if t < 0.0 else low)
        e1 = mean + spread * (low if t < 0.0 else high)
        e2 = mean + spread * (high if t < 0.0 else t)
        e0 = 0.0 if e0 < noise else e0
        e1 = 0.0 if e1 < noise else e1
        e1 = e0 if e1 < e0 else e1
        e2 = e1 if e2 < e1 else e2
        at = start + i
        eigenvalues[0, at], eigenvalues[1, at] = e0 * back, e1 * back
        eigenvalues[2, at] = e2 * back


@part(error_model='numpy')
def write_normals(roots, vectors, planes, start, num, normals):
    """Write the unit eigenvectors of the lowest eigenvalues, isolated or not."""
    for i in range(num):
        px, py, pz = planes[1, i], planes[2, i], planes[3, i]
        scale = 1.0 / math.sqrt((px * px + py * py) + pz * pz)
        isolated = roots[i] < 0.0
        at = start + i
        normals[0, at] = vectors[0, i] if isolated else px * scale
        normals[1, at] = vectors[1, i] if isolated else py * scale
        normals[2, at] = vectors[2, i] if isolated else pz * scale


@kernel(error_model='numpy')
def eigenvectors(matrices, values, smallest, vectors):
    """
    Find all eigenvectors, given those of the smallest eigenvalues.

    matrices  (6, M) float64, symmetric, xx xy xz yy yz zz
    values    (3, M) float64, their eigenvalues, ascending
    smallest  (3, M) float64, unit eigenvectors of values[0]
    vectors   (M, 3, 3) float64, out: vectors[:, k] belong to values[k], are of unit length, and
              their component of largest magnitude is positive; nan where all values are 0

    In the plane across the smallest, the matrix is 2 by 2; its larger eigenvector follows from a
    square root. The third is the cross product of both.
    """
    for i in range(matrices.shape[1]):
        if not values[2, i] > 0.0:
            vectors[i, :, :] = math.nan
            continue
        xx, xy, xz = matrices[0, i], matrices[1, i], matrices[2, i]
        yy, yz, zz = matrices[3, i], matrices[4, i], matrices[5, i]
        nx, ny, nz = smallest[0, i], smallest[1, i], smallest[2, i]
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
        store(vectors, i, 0, nx, ny, nz)
        store(vectors, i, 1, ny * lz - nz * ly, nz * lx - nx * lz, nx * ly - ny * lx)
        store(vectors, i, 2, lx, ly, lz)


@kernel()
def smallest_vectors(values, smallest, vectors):
    """
    Write the eigenvectors of the smallest eigenvalues alone, as ``eigenvectors`` does.

    values, smallest  as of eigenvectors
    vectors           (M, 1, 3) float64, out
    """
    for i in range(len(vectors)):
        if values[2, i] > 0.0:
            store(vectors, i, 0, smallest[0, i], smallest[1, i], smallest[2, i])
        else:
            vectors[i, :, :] = math.nan


@njit(cache=True, nogil=True, inline='always')
def store(vectors, i, k, x, y, z):
    """Store a vector with its component of largest magnitude, the first of equal ones, > 0."""
    leading = x
    if abs(y) > abs(leading):
        leading = y
    if abs(z) > abs(leading):
        leading = z
    side = -1.0 if leading < 0.0 else 1.0
    vectors[i, k, 0], vectors[i, k, 1], vectors[i, k, 2] = side * x, side * y, side * z
