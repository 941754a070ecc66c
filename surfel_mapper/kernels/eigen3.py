# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Eigenvalues of many symmetric 3 by 3 matrices, with the eigenvector of the smallest.

No trigonometry, no iteration of unknown length and no branches, so that the compiler works on
several matrices at once. The deviator scaled to B (trace 0, |B|^2 = 6) has eigenvalues t with
t^3 - 3 t = det B. The one farthest from the other two is a well-conditioned root, at least
3^(1/2) away from both; its eigenvector is the longest cross product of two rows of B - t I. The
remaining two come from the 2 by 2 matrix across that eigenvector, which stays accurate where
they coincide. Only multiplication, addition, division and square roots are used, so every
machine gives the same bits.

Every step is a loop of its own: as one loop its divisions and roots wait for each other, and
it is too long for a processor to begin with the next matrices meanwhile (25 against 16.5 ns a
matrix; 100 to 200 for acos and cos).

Source: Smith 1961 for the scaled cubic; Eberly 2014 (A robust eigensolver for 3 x 3 symmetric
matrices) for deflation; Duff et al. 2017 for the basis across a unit vector.
"""

import math

from numba import njit
import numpy as np

NOISE = 1e-15
"""Eigenvalues below this share of the trace are rounding, and count as 0."""

SIXTH = 1.0 / 6.0


@njit(cache=True, nogil=True, error_model='numpy')
def decompose(scatter, num, eigenvalues, normals):
    """
    Decompose the first num matrices.

    scatter      (6, C) float64, xx xy xz yy yz zz, positive semidefinite
    num          <= C
    eigenvalues  (3, C) float64, out: ascending, none negative
    normals      (3, C) float64, out: unit eigenvectors of the smallest; sign arbitrary.
                 Where the two smallest coincide: a unit vector across the third; all three: z
    """
    deviators, sizes = np.empty((6, num)), np.empty((3, num))
    roots, vectors, planes = np.empty(num), np.empty((3, num)), np.empty((4, num))
    normalise(scatter, num, deviators, sizes)
    isolate(deviators, num, roots)
    cross(deviators, roots, num, vectors)
    deflate(deviators, roots, vectors, num, planes)
    write_eigenvalues(sizes, roots, planes, num, eigenvalues)
    write_normals(roots, vectors, planes, num, normals)


@njit(cache=True, nogil=True, error_model='numpy')
def normalise(scatter, num, deviators, sizes):
    """
    Take the mean of the eigenvalues away and scale what is left.

    deviators  (6, num), out: B of trace 0 and |B|^2 = 6; for a ball, or nothing, of all that
               could be there the one with the normal z
    sizes      (3, num), out: trace, spread (B is times that), and what brings both back where
               squares and cubes of tiny or of huge entries would be no float64
    """
    for i in range(num):
        axx, axy, axz = scatter[0, i], scatter[1, i], scatter[2, i]
        ayy, ayz, azz = scatter[3, i], scatter[4, i], scatter[5, i]
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
        sizes[0, i], sizes[1, i], sizes[2, i] = trace, (0.0 if ball else spread), back


@njit(cache=True, nogil=True, error_model='numpy')
def isolate(deviators, num, roots):
    """Find the eigenvalue of each deviator that is farthest from the other two, in [-2, 2]."""
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


@njit(cache=True, nogil=True, error_model='numpy')
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


@njit(cache=True, nogil=True, error_model='numpy')
def deflate(deviators, roots, vectors, num, planes):
    """
    Solve for the other two eigenvalues, in the plane across the isolated eigenvector.

    planes  (4, num), out: half of their difference, and an eigenvector of the lower one, of any
            length but 0
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


@njit(cache=True, nogil=True, error_model='numpy')
def write_eigenvalues(sizes, roots, planes, num, eigenvalues):
    """Scale the three eigenvalues back, in ascending order."""
    for i in range(num):
        trace, spread, back = sizes[0, i], sizes[1, i], sizes[2, i]
        t, radius = roots[i], planes[0, i]
        mean, noise = trace / 3.0, NOISE * trace
        low, high = -0.5 * t - radius, -0.5 * t + radius
        e0 = mean + spread * (t if t < 0.0 else low)
        e1 = mean + spread * (low if t < 0.0 else high)
        e2 = mean + spread * (high if t < 0.0 else t)
        e0 = 0.0 if e0 < noise else e0
        e1 = 0.0 if e1 < noise else e1
        e1 = e0 if e1 < e0 else e1
        e2 = e1 if e2 < e1 else e2
        eigenvalues[0, i], eigenvalues[1, i], eigenvalues[2, i] = e0 * back, e1 * back, e2 * back


@njit(cache=True, nogil=True, error_model='numpy')
def write_normals(roots, vectors, planes, num, normals):
    """Write the unit eigenvectors of the lowest eigenvalues: of the isolated one or another."""
    for i in range(num):
        px, py, pz = planes[1, i], planes[2, i], planes[3, i]
        scale = 1.0 / math.sqrt((px * px + py * py) + pz * pz)
        isolated = roots[i] < 0.0
        normals[0, i] = vectors[0, i] if isolated else px * scale
        normals[1, i] = vectors[1, i] if isolated else py * scale
        normals[2, i] = vectors[2, i] if isolated else pz * scale
