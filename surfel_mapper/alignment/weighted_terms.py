# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What pairs with weights say about the motions of the two scans of an edge, at given poses.

A weight is a matrix W (3, 3) by which the gap z of a pair counts, z^T W z: the inverse of the
covariance of the gap, so that two surfels of one wall hold each other across the wall and not
along it. With all weights equal it is the least squares of edge_terms.py. The square of all gaps
is a quadratic form in the entries of the pose of the source in the target, whose coefficients
(kernels/edges.py) are summed up once for any number of iterations.

Information is sum M^T W M over the variance of a weighted gap, so that only the ratios of weights
matter and an edge of many pairs weighs more than one of few. What the pairs leave open, as a
translation along a corridor, is held by a millionth of what they know elsewhere.

Source: Segal, Haehnel and Thrun 2009 for the weights of pairs of surfaces.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.angles import skew
from surfel_mapper.alignment.edge_terms import EdgeTerms, EXACT, FEW_PAIRS, MIN_PAIRS, WEAK
from surfel_mapper.kernels.edges import COUNT, GAP_SQ, LINEAR, NUM_WEIGHTED, QUADRATIC

Floats = npt.NDArray[np.float64]

NO_WEIGHT = 'all its weights are zero'

NUM_UNKNOWNS = 6

_SYMMETRIC_3 = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_SYMMETRIC_4 = np.array([[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]])


def weighted_terms(
    moments: Floats, T_map_source: Floats, T_map_target: Floats
) -> tuple[EdgeTerms, Floats]:
    """
    Return the terms of edges whose pairs have weights, and the gaps that are there now.

    Parameters
    ----------
    moments : (E, 74) float64
        As weighted_moments gives them.
    T_map_source, T_map_target : (E, 4, 4) float64
        Poses of the scans that each edge connects.

    Returns
    -------
    terms : EdgeTerms
    rms : (E,) float64, m
        Root of the weighted mean of the squared gaps; nan without pairs.

    """
    A = (np.linalg.inv(T_map_target) @ T_map_source)[:, :3]
    linear = moments[:, LINEAR:QUADRATIC].reshape(-1, 3, 4)
    sums = moments[:, QUADRATIC:NUM_WEIGHTED].reshape(-1, 6, 10)
    quadratic = sums[:, _SYMMETRIC_3][..., _SYMMETRIC_4]
    total = np.trace(quadratic[..., 3, 3], axis1=1, axis2=2)
    center = _center(A, quadratic, total)
    B = _directions(A, center)
    pulled = np.einsum('eijab,ejb->eia', quadratic, A)
    gap_sq = moments[:, GAP_SQ] + (A * (pulled - 2.0 * linear)).sum(axis=(1, 2))
    right = np.einsum('emia,eia->em', B, pulled - linear)
    matrix = _held(np.einsum('emia,eijab,enjb->emn', B, quadratic, B, optimize=True))
    counts = (moments[:, COUNT] >= MIN_PAIRS) & (total > 0.0)
    matrix[~counts] = np.eye(6)
    motion = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
    spread = np.trace(matrix[:, 3:, 3:], axis1=1, axis2=2)
    ss = np.maximum(gap_sq - (right * motion).sum(axis=1), EXACT * spread)
    variance = ss / np.maximum(moments[:, COUNT] - NUM_UNKNOWNS, 1.0)
    matrix = np.where(counts[:, None, None], matrix / variance[:, None, None], 0.0)
    dropped = {int(e): NO_WEIGHT for e in np.flatnonzero(~(total > 0.0))}
    dropped |= {int(e): FEW_PAIRS for e in np.flatnonzero(moments[:, COUNT] < MIN_PAIRS)}
    turn = np.zeros_like(matrix)
    turn[:, :3, :3] = turn[:, 3:, 3:] = T_map_target[:, :3, :3]
    terms = EdgeTerms(
        center=(T_map_target[:, :3, :3] @ center[:, :, None])[:, :, 0] + T_map_target[:, :3, 3],
        motion=(turn @ motion[:, :, None])[:, :, 0],
        information=turn @ matrix @ turn.swapaxes(1, 2),
        dropped=dropped,
        weak={},
    )
    with np.errstate(invalid='ignore', divide='ignore'):
        rms = np.sqrt(np.maximum(gap_sq, 0.0) / total)
    return terms, rms


def _center(A: Floats, quadratic: Floats, total: Floats) -> Floats:
    """Return the weighted means (E, 3) of the moved sources."""
    of_source = (
        np.trace(quadratic[..., 3], axis1=1, axis2=2) / np.where(total > 0, total, 1.0)[:, None]
    )
    of_source[:, 3] = 1.0
    return np.asarray((A @ of_source[:, :, None])[:, :, 0])


def _directions(A: Floats, center: Floats) -> Floats:
    """Return how A changes with a motion about a center: (E, 6, 3, 4)."""
    result = np.zeros((len(A), 6, 3, 4))
    result[:, [0, 1, 2], [0, 1, 2], 3] = 1.0
    arms = A.copy()
    arms[:, :, 3] -= center
    result[:, 3:] = skew(np.eye(3)) @ arms[:, None]
    return result


def _held(matrix: Floats) -> Floats:
    """Return matrices (E, 6, 6) with a little on the diagonal, so that none is singular."""
    for part in (slice(0, 3), slice(3, 6)):
        mean = np.trace(matrix[:, part, part], axis1=1, axis2=2) / 3.0
        matrix[:, part, part] += (WEAK * mean)[:, None, None] * np.eye(3)
    return matrix
