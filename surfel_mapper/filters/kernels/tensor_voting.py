# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Tensor votes: evidence of the neighbours of a point for a surface, curve or junction at it.

A vote is a symmetric matrix, and six million of them are cast among the points of a scan with 50
neighbours each: one loop needs no memory for them, numpy needs 48 bytes each and a dozen passes.

Source: Wu et al. 2012, A closed-form solution to tensor voting, equation 11, made symmetric:
c R K (1 - r r^T / 2) R for a neighbour with tensor K in the direction r, R = 1 - 2 r r^T, and
decay c = exp(-distance^2 / sigma). For the first round, without tensors of the neighbours,
Guy and Medioni 1997: the plane orthogonal to r, 1 - r r^T.
"""

import math

from numba import njit

REACH = 3.0
"""Range of the votes over sigma."""


@njit(cache=True, nogil=True, error_model='numpy')
def direction(points, own, neighbour):
    """Return the unit vector to a point from another, and their squared distance, m^2."""
    x = points[own, 0] - points[neighbour, 0]
    y = points[own, 1] - points[neighbour, 1]
    z = points[own, 2] - points[neighbour, 2]
    length_sq = (x * x + y * y) + z * z
    length = math.sqrt(length_sq)
    if length > 0.0:
        x, y, z = x / length, y / length, z / length
    return x, y, z, length_sq


@njit(cache=True, nogil=True, error_model='numpy')
def first_votes(points, ids, sigma, to_neighbours, votes):
    """
    Sum the votes of neighbours without tensors and the ball of the point itself.

    points  (N, 3) float64, m
    ids     (P, K) int32, neighbours of P points, the point itself first; padded by N
    sigma   scale of the votes
    to_neighbours  whether each point votes for its neighbours, or they for it
    votes   (6, P) float64, out: their sum, xx xy xz yy yz zz

    The weight is z^2 (z - 3)^4 / 16, z the distance over sigma; largest at z = 1. Votes to
    neighbours differ if a point is no neighbour of its neighbour; P is N then.
    """
    for i in range(len(ids)):
        votes[:, i] = 0.0
        votes[0, i] = votes[3, i] = votes[5, i] = 1.0
    for i in range(len(ids)):
        own = ids[i, 0]
        for k in range(1, ids.shape[1]):
            neighbour = ids[i, k]
            if neighbour == len(points):
                break
            x, y, z, length_sq = direction(points, own, neighbour)
            far = math.sqrt(length_sq) / sigma
            if not (length_sq > 0.0 and far < REACH):
                continue
            end = (far - REACH) * (far - REACH)
            weight = far * far * (end * end) / 16.0
            to = neighbour if to_neighbours else i
            votes[0, to] += weight * (1.0 - x * x)
            votes[1, to] -= weight * x * y
            votes[2, to] -= weight * x * z
            votes[3, to] += weight * (1.0 - y * y)
            votes[4, to] -= weight * y * z
            votes[5, to] += weight * (1.0 - z * z)


@njit(cache=True, nogil=True, error_model='numpy')
def closed_form_votes(points, ids, tensors, sigma, symmetric, votes):
    """
    Sum the votes of neighbours with tensors.

    points   (N, 3) float64, m
    ids      (P, K) int32, neighbours of P points, the point itself first; padded by N
    tensors  (N, 6) float64, of the neighbours, xx xy xz yy yz zz
    sigma    scale of the votes
    symmetric  whether to take the symmetric part of a vote, or its lower triangle
    votes    (6, P) float64, out: their sum
    """
    # the vote is K - 2 r u' - 3/2 u r' + 3 s r r', with u = K r, s = r u
    first, second = (1.75, 1.75) if symmetric else (2.0, 1.5)
    for i in range(len(ids)):
        own = ids[i, 0]
        xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(1, ids.shape[1]):
            neighbour = ids[i, k]
            if neighbour == len(points):
                break
            x, y, z, length_sq = direction(points, own, neighbour)
            if not (length_sq > 0.0 and math.sqrt(length_sq) / sigma < REACH):
                continue
            txx, txy, txz = tensors[neighbour, 0], tensors[neighbour, 1], tensors[neighbour, 2]
            tyy, tyz, tzz = tensors[neighbour, 3], tensors[neighbour, 4], tensors[neighbour, 5]
            ux = (txx * x + txy * y) + txz * z
            uy = (txy * x + tyy * y) + tyz * z
            uz = (txz * x + tyz * y) + tzz * z
            s = (ux * x + uy * y) + uz * z
            weight = math.exp(-length_sq / sigma)
            xx += weight * (txx - 3.5 * ux * x + 3.0 * s * x * x)
            xy += weight * (txy - first * y * ux - second * uy * x + 3.0 * s * x * y)
            xz += weight * (txz - first * z * ux - second * uz * x + 3.0 * s * x * z)
            yy += weight * (tyy - 3.5 * uy * y + 3.0 * s * y * y)
            yz += weight * (tyz - first * z * uy - second * uz * y + 3.0 * s * y * z)
            zz += weight * (tzz - 3.5 * uz * z + 3.0 * s * z * z)
        votes[0, i], votes[1, i], votes[2, i] = xx, xy, xz
        votes[3, i], votes[4, i], votes[5, i] = yy, yz, zz
