# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Motion and information of an edge, from the pairs of points of its two scans at given poses.

Edges of plain pairs (``exact_terms``, ``pcl_terms``) and of weighted pairs (``weighted_terms``)
share one module because the solver takes both as EdgeTerms.

*Plain pairs.* For a pair a (of the source) and b (of the target), both in the map, let c = (a + b)
/ 2 and z = a - b. The edge asks for X = X_source - X_target, a translation t and a rotation vector
w, with t + w x c = z for all pairs: least squares gives D = (sum M^T M)^-1 sum M^T z, and the
residual ss gives the weight: information = sum M^T M / ss. Taken about the mean of c, M^T M
separates into num times I for t and the matrix of inertia of c for w. About the origin, as in PCL,
the two are mixed, and at 1 km float32 loses both. All sums follow from the moments of the pairs
(alignment/kernels/edges.py) and the two poses.

*Weighted pairs.* A weight is a matrix W (3, 3); the gap z of a pair costs z^T W z. W is the
inverse of the covariance of the gap, so that two surfels of one wall hold each other across the
wall and not along it. The cost of all gaps is a quadratic form in the entries of the pose of the
source in the target; its coefficients are summed once for any number of iterations. Information is
sum M^T W M, divided by the variance of a weighted gap if that is more than 1. So an edge of many
pairs weighs more than an edge of few, and further knowledge, such as odometry, can be added as an
edge.

A motion that the pairs hardly determine, as the one along a tunnel, stays open: the pairs carry
only noise of the normals about it, and would pull scans to where their voxels coincide. Of the
total information of scans in a street the least known motion has 0.4 %, in a tunnel 0.001 %.

Source: Lu and Milios 1997; the weight of plain pairs is that of pcl::registration::LUM; Segal,
Haehnel and Thrun 2009 for weighted pairs; Zhang, Kaess and Singh 2016 for degenerate directions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.angles import skew
from surfel_mapper.alignment.kernels.edges import (
    COUNT,
    CROSS_SCATTER,
    FIRST_PAIR,
    GAP_SQ,
    LINEAR,
    NUM_MOMENTS,
    NUM_WEIGHTED,
    QUADRATIC,
    SOURCE_MEAN,
    SOURCE_SCATTER,
    TARGET_MEAN,
    TARGET_SCATTER,
)

Floats = npt.NDArray[np.float64]

MIN_PAIRS = 3
"""Minimum number of pairs that determine the six unknowns."""

EXACT = 1e-12
"""Lower bound of the residual as a share of the spread of the pairs, that is 1e-6 of their extent,
or 0.01 mm in 10 m. Smaller residuals are the rounding of float32."""

PCL_EXACT = 1e-12
"""Residual, m^2, below which PCL drops an edge."""

PCL_SINGULAR = 1e-12
"""Ratio of the moments of inertia below which float64 cannot resolve a rotation about the line."""

THIN = 1e-2
"""Pairs may lie on a line if a moment of inertia is less than this share of the largest."""

NOISE = 10.0
"""Multiple of the moment of inertia of noise up to which such a moment is ignored."""

WEAK = 1e-6
"""Information assigned to an undetermined motion, as a share of the largest."""

OPPOSED_RAD = math.radians(170.0)
"""Angle between two scans above which they are opposed. With 178 deg, 2 of 32 graphs of two scans
end at a wrong pose; below 150 deg large loops need more steps."""

APART = 1e-3
"""Squared gaps about their mean, as a share of the scatter of the pairs, below which scans are not
opposed: half a turn leaves more unless the pairs lie on a line."""

FEW_PAIRS = 'fewer than 3 pairs with finite coordinates'
ONE_POINT = 'all its pairs lie in one point'
PCL_DROPS_EXACT = 'its pairs fit exactly, which PCL cannot weigh'
PCL_DROPS_SINGULAR = 'its pairs lie on a line, which makes the system of PCL singular'

OPEN = 1e-4
"""A motion is open if it has less than this share of the information; rotations are scaled by the
distance by which they move the pairs."""

NO_WEIGHT = 'all its weights are zero'

NUM_UNKNOWNS = 6

_ALONG, _ABOUT = slice(0, 3), slice(3, 6)
_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_SYMMETRIC_4 = np.array([[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EdgeSums:
    """
    Sums over the pairs of E edges, in the frame of the map.

    Attributes
    ----------
    num : (E,) float64
        Number of pairs.
    center : (E, 3) float64, m
        Mean of c.
    gap : (E, 3) float64, m
        Mean of z.
    source, target : (E, 3, 3) float64, m^2
        Scatter of a, of b.
    cross : (E, 3, 3) float64, m^2
        Sum of a b^T about the means.

    """

    num: Floats
    center: Floats
    gap: Floats
    source: Floats
    target: Floats
    cross: Floats

    @property
    def inertia(self) -> Floats:
        """Sum of |c|^2 I - c c^T about the mean, (E, 3, 3) m^2."""
        cc = 0.25 * (self.source + self.target + self.cross + self.cross.swapaxes(1, 2))
        return np.asarray(_trace(cc)[:, None, None] * np.eye(3) - cc)

    @property
    def turn(self) -> Floats:
        """Sum of c x z about the means, (E, 3) m^2."""
        ab = self.cross  # c x z = b x a
        columns = (ab[:, 2, 1] - ab[:, 1, 2], ab[:, 0, 2] - ab[:, 2, 0], ab[:, 1, 0] - ab[:, 0, 1])
        return np.stack(columns, axis=1)

    @property
    def gap_sq(self) -> Floats:
        """Sum of |z|^2 about the mean, m^2."""
        return np.asarray(_trace(self.source) + _trace(self.target) - 2.0 * _trace(self.cross))

    @property
    def spread(self) -> Floats:
        """Sum of |c|^2 about the mean, m^2."""
        return np.asarray(0.5 * _trace(self.inertia))

    @property
    def rms(self) -> Floats:
        """Root of the mean of |z|^2 over the pairs, m; nan without pairs."""
        with np.errstate(invalid='ignore', divide='ignore'):
            mean_sq = np.maximum(self.gap_sq, 0.0) / self.num + (self.gap**2).sum(axis=1)
        return np.asarray(np.sqrt(np.where(self.num > 0, mean_sq, np.nan)))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EdgeTerms:
    """
    Observation and information of E edges about their centers.

    Attributes
    ----------
    center : (E, 3) float64, m
    motion : (E, 6) float64
        D: translation of the center in m, then rotation vector in rad.
    information : (E, 6, 6) float64
        Zero for dropped edges.
    dropped : mapping of int to str
        Row of a dropped edge and the reason.
    weak : mapping of int to (K, 6) float64
        Row of an edge that is not dropped, and the motions that its pairs do not determine: these
        are set to 0.

    """

    center: Floats
    motion: Floats
    information: Floats
    dropped: dict[int, str]
    weak: dict[int, Floats]

    def joined(self, added: EdgeTerms, order: npt.NDArray[np.int64]) -> EdgeTerms:
        """Return the terms of these and of added edges, reordered."""
        num, row_of = len(self.center), np.argsort(order).tolist()
        return EdgeTerms(
            center=np.concatenate([self.center, added.center])[order],
            motion=np.concatenate([self.motion, added.motion])[order],
            information=np.concatenate([self.information, added.information])[order],
            dropped={row_of[e]: why for e, why in self.dropped.items()}
            | {row_of[num + e]: why for e, why in added.dropped.items()},
            weak={row_of[e]: axes for e, axes in self.weak.items()}
            | {row_of[num + e]: axes for e, axes in added.weak.items()},
        )


def edge_sums(moments: Floats, T_map_source: Floats, T_map_target: Floats) -> EdgeSums:
    """
    Return the sums over the pairs of edges at given poses.

    Parameters
    ----------
    moments : (E, 28) float64
        Moments from pair_moments.
    T_map_source, T_map_target : (E, 4, 4) float64
        Poses of the scans that each edge connects.

    """
    if moments.shape[1] != NUM_MOMENTS:
        raise ValueError(f'moments: {moments.shape[1]} of each edge, expected {NUM_MOMENTS}')
    R, Q = T_map_source[:, :3, :3], T_map_target[:, :3, :3]
    mean_a = _moved(T_map_source, moments[:, SOURCE_MEAN:TARGET_MEAN])
    mean_b = _moved(T_map_target, moments[:, TARGET_MEAN:SOURCE_SCATTER])
    aa = _turned(R, moments[:, SOURCE_SCATTER + _SYMMETRIC], R)
    bb = _turned(Q, moments[:, TARGET_SCATTER + _SYMMETRIC], Q)
    ab = _turned(R, moments[:, CROSS_SCATTER:].reshape(-1, 3, 3), Q)
    return EdgeSums(
        num=moments[:, COUNT],
        center=0.5 * (mean_a + mean_b),
        gap=mean_a - mean_b,
        source=aa,
        target=bb,
        cross=ab,
    )


def without_opposition(sums: EdgeSums) -> EdgeSums:
    """
    Return the sums of edges whose scans are opposed as if they differed by 170 deg.

    Opposed scans leave c without extent, so that noise decides about the motion. The best rotation
    of the pairs is known in closed form for any angle; the source is turned by the part of it that
    exceeds 170 deg. Pairs on a line do not determine it and stay unchanged.

    Source: Kabsch 1976.
    """
    scatter = 0.5 * (_trace(sums.source) + _trace(sums.target))
    apart = np.flatnonzero(sums.gap_sq > APART * scatter)
    if not len(apart):
        return sums
    U, size, Vt = np.linalg.svd(sums.cross[apart])
    Vt[:, 2] *= np.linalg.det(U @ Vt)[:, None]
    Q = (U @ Vt).swapaxes(1, 2)  # takes a to b
    cosine = np.clip(0.5 * (_trace(Q) - 1.0), -1.0, 1.0)
    rows = (cosine < math.cos(OPPOSED_RAD)) & (size[:, 1] > THIN * size[:, 0])
    if not rows.any():
        return sums
    apart, P = apart[rows], _rotations_beyond(Q[rows], OPPOSED_RAD)
    source, cross = sums.source.copy(), sums.cross.copy()
    source[apart] = _turned(P, sums.source[apart], P)
    cross[apart] = P @ sums.cross[apart]
    return replace(sums, source=source, cross=cross)


def _rotations_beyond(Q: Floats, limit_rad: float) -> Floats:
    """Return rotations about the axes of Q (E, 3, 3) by their angles less a limit."""
    cosine = np.clip(0.5 * (_trace(Q) - 1.0), -1.0, 1.0)
    outer = Q + Q.swapaxes(1, 2) - 2.0 * cosine[:, None, None] * np.eye(3)  # along axis axis^T
    longest = np.argmax(np.diagonal(outer, axis1=1, axis2=2), axis=1)
    axis = np.take_along_axis(outer, longest[:, None, None], axis=2)[:, :, 0]
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    turn = np.stack([Q[:, 2, 1] - Q[:, 1, 2], Q[:, 0, 2] - Q[:, 2, 0], Q[:, 1, 0] - Q[:, 0, 1]])
    axis *= np.where((axis * turn.T).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    angle = (np.arccos(cosine) - limit_rad)[:, None, None]
    K = skew(axis)
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * (K @ K))


def exact_terms(sums: EdgeSums) -> EdgeTerms:
    """
    Return the terms of edges, dropping those of fewer than three pairs or of a single point.

    An exact fit gets a residual of 1e-12 of the spread. If the pairs lie on a line up to their
    noise, the rotation about it is undetermined: it gets no motion and little information, so that
    other edges determine it, and without any it keeps its value. Of a rotation of more
    than 170 deg the edge asks for 170 deg.
    """
    sums = without_opposition(sums)
    inertia, axes = np.linalg.eigh(sums.inertia)
    turn = np.einsum('eji,ej->ei', axes, sums.turn)
    largest = inertia[:, 2:]
    determined = inertia > EXACT * largest
    rotation = np.divide(turn, inertia, out=np.zeros_like(turn), where=determined)
    spread, gap_sq = sums.spread, sums.gap_sq
    ss = _floored(gap_sq - (turn * rotation).sum(axis=1), spread)
    of_noise = (ss / 6.0)[:, None]  # the moment of inertia of c if z is the noise of a and b
    weak = (inertia < THIN * largest) & (inertia <= NOISE * of_noise)
    rotation[weak] = 0.0
    ss = _floored(gap_sq - (turn * rotation).sum(axis=1), spread)
    inertia = np.where(weak, WEAK * largest, inertia)
    dropped = {int(e): ONE_POINT for e in np.flatnonzero(~(spread > 0.0))}
    dropped |= {int(e): FEW_PAIRS for e in np.flatnonzero(sums.num < MIN_PAIRS)}
    return EdgeTerms(
        center=sums.center,
        motion=np.concatenate([sums.gap, np.einsum('eij,ej->ei', axes, rotation)], axis=1),
        information=_information(
            sums.num, np.einsum('eij,ej,ekj->eik', axes, inertia, axes), ss, dropped
        ),
        dropped=dropped,
        weak={
            int(e): np.hstack([np.zeros((weak[e].sum(), 3)), axes[e].T[weak[e]]])
            for e in np.flatnonzero(weak.any(axis=1))
            if e not in dropped
        },
    )


def pcl_terms(sums: EdgeSums, residual: Callable[[Floats, Floats], Floats]) -> EdgeTerms:
    """
    Return the terms as PCL computes them, which drops exact fits and pairs on a line.

    Parameters
    ----------
    sums : EdgeSums
        Sums at the current poses.
    residual : callable
        Returns, for centers and motions of the edges, the sum of |z - M D|^2 over the pairs of
        each, at full precision. EdgeSums determine it only to 1e-16 of the spread, which is above
        PCL's limit.

    """
    inertia, axes = np.linalg.eigh(sums.inertia)
    singular = ~(inertia[:, 0] > PCL_SINGULAR * inertia[:, 2])
    turn = np.einsum('eji,ej->ei', axes, sums.turn)
    rotation = np.divide(turn, inertia, out=np.zeros_like(turn), where=~singular[:, None])
    motion = np.concatenate([sums.gap, np.einsum('eij,ej->ei', axes, rotation)], axis=1)
    ss = residual(sums.center, motion)
    dropped = {int(e): PCL_DROPS_EXACT for e in np.flatnonzero(~(ss >= PCL_EXACT))}
    dropped |= {int(e): PCL_DROPS_SINGULAR for e in np.flatnonzero(singular)}
    dropped |= {int(e): FEW_PAIRS for e in np.flatnonzero(sums.num < MIN_PAIRS)}
    return EdgeTerms(
        center=sums.center,
        motion=motion,
        information=_information(sums.num, sums.inertia, ss, dropped),
        dropped=dropped,
        weak={},
    )


def weighted_terms(
    moments: Floats, T_map_source: Floats, T_map_target: Floats
) -> tuple[EdgeTerms, Floats]:
    """
    Return the terms of edges of weighted pairs, and their current gaps.

    Parameters
    ----------
    moments : (E, 80) float64
        Moments from weighted_moments.
    T_map_source, T_map_target : (E, 4, 4) float64
        Poses of the scans that each edge connects.

    Returns
    -------
    terms : EdgeTerms
    rms : (E,) float64, m
        Root of the weighted mean of the squared gaps; nan without pairs.

    """
    first = moments[:, FIRST_PAIR:NUM_WEIGHTED].reshape(-1, 2, 3)
    T_map_source, T_map_target = (
        _counted_from(T, first[:, end]) for end, T in enumerate((T_map_source, T_map_target))
    )
    A = (np.linalg.inv(T_map_target) @ T_map_source)[:, :3]
    linear = moments[:, LINEAR:QUADRATIC].reshape(-1, 3, 4)
    sums = moments[:, QUADRATIC:FIRST_PAIR].reshape(-1, 6, 10)
    quadratic = sums[:, _SYMMETRIC][..., _SYMMETRIC_4]
    total = np.trace(quadratic[..., 3, 3], axis1=1, axis2=2)
    center = _center(A, quadratic, total)
    B = _directions(A, center)
    pulled = np.einsum('eijab,ejb->eia', quadratic, A)
    gap_sq = moments[:, GAP_SQ] + (A * (pulled - 2.0 * linear)).sum(axis=(1, 2))
    right = np.einsum('emia,eia->em', B, pulled - linear)
    matrix = np.einsum('emia,eijab,enjb->emn', B, quadratic, B, optimize=True)
    dropped = {int(e): NO_WEIGHT for e in np.flatnonzero(~(total > 0.0))}
    dropped |= {int(e): FEW_PAIRS for e in np.flatnonzero(moments[:, COUNT] < MIN_PAIRS)}
    matrix, motion, weak = _determined(matrix, right)
    ss = gap_sq - (right * motion).sum(axis=1)
    variance = np.maximum(ss / np.maximum(moments[:, COUNT] - NUM_UNKNOWNS, 1.0), 1.0)
    variance[list(dropped)] = np.inf
    turn = np.zeros_like(matrix)
    turn[:, :3, :3] = turn[:, 3:, 3:] = R = T_map_target[:, :3, :3]
    terms = EdgeTerms(
        center=(R @ center[:, :, None])[:, :, 0] + T_map_target[:, :3, 3],
        motion=(turn @ motion[:, :, None])[:, :, 0],
        information=turn @ (matrix / variance[:, None, None]) @ turn.swapaxes(1, 2),
        dropped=dropped,
        weak={e: motions @ turn[e].T for e, motions in weak.items() if e not in dropped},
    )
    with np.errstate(invalid='ignore', divide='ignore'):
        rms = np.sqrt(np.maximum(gap_sq, 0.0) / total)
    return terms, rms


def _information(num: Floats, inertia: Floats, ss: Floats, dropped: dict[int, str]) -> Floats:
    """Return the information matrices (E, 6, 6), zero where an edge is dropped."""
    counts = np.ones(len(num), bool)
    counts[list(dropped)] = False
    weight = np.divide(1.0, ss, out=np.zeros_like(ss), where=counts)
    result = np.zeros((len(num), 6, 6))
    result[:, :3, :3] = (num * weight)[:, None, None] * np.eye(3)
    result[:, 3:, 3:] = weight[:, None, None] * inertia
    return result


def _floored(ss: Floats, spread: Floats) -> Floats:
    return np.maximum(ss, EXACT * spread)


def _counted_from(T: Floats, origins: Floats) -> Floats:
    """Return the transforms (E, 4, 4) of points that are counted from origins (E, 3) instead."""
    result = T.copy()
    result[:, :3, 3] = _moved(T, origins)
    return result


def _moved(T: Floats, points: Floats) -> Floats:
    """Return points (E, 3) moved by the transforms of their rows."""
    return np.asarray(np.einsum('eij,ej->ei', T[:, :3, :3], points) + T[:, :3, 3])


def _turned(R: Floats, scatter: Floats, Q: Floats) -> Floats:
    """Return R scatter Q^T for every row."""
    return np.asarray(R @ scatter @ Q.swapaxes(1, 2))


def _trace(matrices: Floats) -> Floats:
    return np.asarray(np.trace(matrices, axis1=1, axis2=2))


def _center(A: Floats, quadratic: Floats, total: Floats) -> Floats:
    """Return the weighted means (E, 3) of the moved sources."""
    weighted = np.trace(quadratic[..., 3], axis1=1, axis2=2)
    of_source = weighted / np.where(total > 0.0, total, 1.0)[:, None]
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


def _determined(matrix: Floats, right: Floats) -> tuple[Floats, Floats, dict[int, Floats]]:
    """
    Return information, motions and open directions.

    An open direction gets no motion and a millionth of the total information.
    """
    along, about = (np.trace(matrix[:, p, p], axis1=1, axis2=2) for p in (_ALONG, _ABOUT))
    arm = np.sqrt(np.divide(about, along, out=np.ones_like(about), where=(about * along) > 0.0))
    unit = np.ones_like(right)
    unit[:, 3:] = 1.0 / arm[:, None]  # turns in m, at the arm
    values, vectors = np.linalg.eigh(unit[:, :, None] * matrix * unit[:, None])
    total = values.sum(axis=1, keepdims=True)
    is_open = values <= OPEN * total
    values = np.where(is_open, WEAK * total, values)
    pull = np.einsum('emk,em->ek', vectors, unit * right)
    length = np.divide(pull, values, out=np.zeros_like(pull), where=~is_open)
    motion = unit * np.einsum('emk,ek->em', vectors, length)
    kept = np.einsum('emk,ek,enk->emn', vectors, values, vectors)
    weak = {
        int(e): unit[e] * vectors[e].T[is_open[e]] for e in np.flatnonzero(is_open.any(axis=1))
    }
    return kept / (unit[:, :, None] * unit[:, None]), motion, weak
