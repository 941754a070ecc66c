# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the pairs of an edge say about the motions of its two scans, at given poses.

For a pair a (of the source) and b (of the target), both in the map, let c = (a + b) / 2 and
z = a - b. The edge asks for X = X_source - X_target, a translation t and a rotation vector w,
with t + w x c = z for all pairs: least squares gives D = (sum M^T M)^-1 sum M^T z, and what is
left, ss, gives its weight: information = sum M^T M / ss. Taken about the mean of c, M^T M falls
into num times I for t and the matrix of inertia of c for w. About the origin, as PCL does, the
two are mixed, and at 1 km nothing is left of either in float32.

All sums follow from the moments of the pairs (alignment/kernels/edges.py) and the two poses.

Source: Lu and Milios 1997; the weight is that of pcl::registration::LUM.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.kernels.edges import (
    COUNT,
    CROSS_SCATTER,
    NUM_MOMENTS,
    SOURCE_MEAN,
    SOURCE_SCATTER,
    TARGET_MEAN,
    TARGET_SCATTER,
)

Floats = npt.NDArray[np.float64]

MIN_PAIRS = 3
"""Fewer pairs do not determine the six unknowns."""

EXACT = 1e-12
"""Exact fits: the residual counts as at least this part of the spread of the pairs, that is 1e-6
of their extent, or 0.01 mm in 10 m. Below it is only the rounding of float32."""

PCL_EXACT = 1e-12
"""PCL drops an edge with less residual, m^2."""

PCL_SINGULAR = 1e-12
"""From this ratio of the moments of inertia on no digit of a rotation about the line is left."""

THIN = 1e-2
"""Pairs lie on a line if one of their moments of inertia is less than this part of the largest."""

NOISE = 10.0
"""Of such pairs, a moment of inertia of at most so many times that of the noise says nothing."""

WEAK = 1e-6
"""What counts as information on a rotation that nothing is known of, as part of the largest."""

FEW_PAIRS = 'fewer than 3 pairs with finite coordinates'
ONE_POINT = 'all its pairs lie in one point'
PCL_DROPS_EXACT = 'its pairs fit exactly, which PCL cannot weigh'
PCL_DROPS_SINGULAR = 'its pairs lie on a line, of which PCL has no inverse'

_SYMMETRIC = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EdgeSums:
    """
    Sums over the pairs of E edges, in the frame of the map.

    Attributes
    ----------
    num : (E,) float64
        Pairs.
    center : (E, 3) float64, m
        Mean of c.
    gap : (E, 3) float64, m
        Mean of z.
    inertia : (E, 3, 3) float64, m^2
        Sum of |c|^2 I - c c^T about the mean.
    turn : (E, 3) float64, m^2
        Sum of c x z about the means.
    gap_sq : (E,) float64, m^2
        Sum of |z|^2 about the mean.

    """

    num: Floats
    center: Floats
    gap: Floats
    inertia: Floats
    turn: Floats
    gap_sq: Floats

    @property
    def spread(self) -> Floats:
        """Sum of |c|^2 about the mean, m^2."""
        return np.asarray(0.5 * np.trace(self.inertia, axis1=1, axis2=2))

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
        Zero for edges that are dropped.
    dropped : mapping of int to str
        Row of an edge, and why it does not count.
    weak : mapping of int to (K, 6) float64
        Row of an edge, and the motions of which its pairs say nothing: these get none.

    """

    center: Floats
    motion: Floats
    information: Floats
    dropped: dict[int, str]
    weak: dict[int, Floats]

    def joined(self, other: EdgeTerms, order: npt.NDArray[np.int64]) -> EdgeTerms:
        """Return these terms and those of other edges, then put into an order."""
        num, place = len(self.center), np.argsort(order).tolist()
        return EdgeTerms(
            center=np.concatenate([self.center, other.center])[order],
            motion=np.concatenate([self.motion, other.motion])[order],
            information=np.concatenate([self.information, other.information])[order],
            dropped={place[e]: why for e, why in self.dropped.items()}
            | {place[num + e]: why for e, why in other.dropped.items()},
            weak={place[e]: axes for e, axes in self.weak.items()}
            | {place[num + e]: axes for e, axes in other.weak.items()},
        )


def edge_sums(moments: Floats, T_map_source: Floats, T_map_target: Floats) -> EdgeSums:
    """
    Return the sums over the pairs of edges at given poses.

    Parameters
    ----------
    moments : (E, 28) float64
        As pair_moments gives them.
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
    cc = 0.25 * (aa + bb + ab + ab.swapaxes(1, 2))
    return EdgeSums(
        num=moments[:, COUNT],
        center=0.5 * (mean_a + mean_b),
        gap=mean_a - mean_b,
        inertia=_trace(cc)[:, None, None] * np.eye(3) - cc,
        turn=np.stack(  # c x z = b x a
            [
                ab[:, 2, 1] - ab[:, 1, 2],
                ab[:, 0, 2] - ab[:, 2, 0],
                ab[:, 1, 0] - ab[:, 0, 1],
            ],
            axis=1,
        ),
        gap_sq=_trace(aa) + _trace(bb) - 2.0 * _trace(ab),
    )


def exact_terms(sums: EdgeSums) -> EdgeTerms:
    """
    Return the terms with which every edge counts that has three pairs in more than one point.

    An exact fit counts with a residual of 1e-12 of the spread. Where the pairs lie on a line but
    for their noise, the rotation about it is taken to be right as it is: it gets no motion and
    little information, so that it is left to other edges, and without any stays as it is.
    """
    inertia, axes = np.linalg.eigh(sums.inertia)
    turn = np.einsum('eji,ej->ei', axes, sums.turn)
    largest = inertia[:, 2:]
    known = inertia > EXACT * largest
    rotation = np.divide(turn, inertia, out=np.zeros_like(turn), where=known)
    spread = sums.spread
    ss = _floored(sums.gap_sq - (turn * rotation).sum(axis=1), spread)
    of_noise = (ss / 6.0)[:, None]  # a moment of inertia of c alone, if z is noise of a and b
    weak = (inertia < THIN * largest) & (inertia <= NOISE * of_noise)
    rotation[weak] = 0.0
    ss = _floored(sums.gap_sq - (turn * rotation).sum(axis=1), spread)
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
        },
    )


def pcl_terms(sums: EdgeSums, residual: Callable[[Floats, Floats], Floats]) -> EdgeTerms:
    """
    Return the terms as PCL has them, which drops exact fits and pairs on a line.

    Parameters
    ----------
    sums : EdgeSums
        At the present poses.
    residual : callable
        Of centers and motions of the edges: the sum of |z - M D|^2 over the pairs of each, to
        the last digit. The sums have it to 1e-16 of the spread only, and PCL's limit is below.

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


def _moved(T: Floats, points: Floats) -> Floats:
    """Return points (E, 3), each moved by the transform of its row."""
    return np.asarray(np.einsum('eij,ej->ei', T[:, :3, :3], points) + T[:, :3, 3])


def _turned(R: Floats, scatter: Floats, Q: Floats) -> Floats:
    """Return R scatter Q^T of every row."""
    return np.asarray(R @ scatter @ Q.swapaxes(1, 2))


def _trace(matrices: Floats) -> Floats:
    return np.asarray(np.trace(matrices, axis1=1, axis2=2))
