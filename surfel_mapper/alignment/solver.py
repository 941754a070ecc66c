# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
One step of the alignment: from the terms of all edges to a correction of every pose.

Block row i of the linear system balances the edges at vertex i. The system is sparse; SuperLU with
a minimum degree ordering solves it in time linear in the edges for chains with loops (200 vertices
and 10 loops: 3 ms; dense QR, as in PCL: 288 ms). The motion of a vertex is taken about the mean of
the centers of its edges, not about the origin of the map, so that nothing cancels far from the
origin.

``exact_step`` is correct to second order in the angle: an edge measures halfway between its two
ends, c = (a + b) / 2, so that its rotation vector is Cayley's, tan(angle / 2), and a pair of scans
with exact correspondences converges in a single step for any angle.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.angles import pcl_incidence, poses_of, skew, transforms
from surfel_mapper.alignment.edge_terms import EdgeTerms
from surfel_mapper.errors import AlignmentError

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


HUGE = 1e12
"""Motions beyond this, m or rad, mean that the system is singular."""


class Entries(NamedTuple):
    """
    Contributions of edges to the rows of vertices, one a line.

    Attributes
    ----------
    edges : (C,) int64
        Row of the edge.
    ij : (C, 2) int64
        Vertex of the row, and the other end of the edge.
    sign : (C,) float64
        1 in the row of the source, -1 in the row of the target.

    """

    edges: Ints
    ij: Ints
    sign: Floats

    def chosen(self, lines: npt.NDArray[np.bool_]) -> Entries:
        """Return selected lines."""
        return Entries(self.edges[lines], self.ij[lines], self.sign[lines])


def components(num_vertices: int, ends: Ints) -> Ints:
    """Return the connected component of each vertex, (V,), in the graph of edges (E, 2)."""
    from scipy.sparse import coo_array  # 0.4 s, only alignment pays
    from scipy.sparse.csgraph import connected_components

    ones = np.ones(len(ends), np.int8)
    adjacency = coo_array((ones, (ends[:, 0], ends[:, 1])), shape=(num_vertices, num_vertices))
    return np.asarray(connected_components(adjacency, directed=False)[1], np.int64)


def exact_step(poses: Floats, ends: Ints, terms: EdgeTerms) -> Floats:
    """
    Return the poses after a step in which every edge acts on both of its vertices.

    Parameters
    ----------
    poses : (V, 6) float64
        Vertex 0 and vertices that no used edge connects to it do not move.
    ends : (E, 2) int64
        Source and target of every edge.
    terms : EdgeTerms
        Terms at these poses.

    Raises
    ------
    AlignmentError
        If the system has no finite solution.

    """
    used = _used(ends, terms)
    component = components(len(poses), ends[used])
    free = component == component[0]
    free[0] = False
    entries = Entries(
        edges=np.concatenate([used, used]),
        ij=np.concatenate([ends[used], ends[used][:, ::-1]]),
        sign=np.repeat([1.0, -1.0], len(used)),
    )
    pivots = _pivots(len(poses), ends[used], terms.center[used])
    motion = _solve(free, entries, pivots, terms, symmetric=True)
    moved = poses_of(_cayley(transforms(poses), pivots, motion), near=poses)
    return np.where(free[:, None], moved, poses)


def pcl_step(poses: Floats, ends: Ints, terms: EdgeTerms) -> Floats:
    """
    Return the poses after a step as PCL computes it, for comparison.

    If two vertices have edges in both directions, the row of a vertex uses only the edge that
    leaves it; the pose is corrected by the Jacobian of another order of rotations. In a component
    without vertex 0 the last vertex stays fixed.

    Raises
    ------
    AlignmentError
        If the system, or the Jacobian of a pose, is singular.

    """
    counts = np.zeros(len(ends), bool)
    counts[_used(ends, terms)] = True
    edges = np.arange(len(ends))
    leaving = {tuple(pair) for pair in ends.tolist()}
    answered = np.array([(t, s) in leaving for s, t in ends.tolist()], bool)
    entries = Entries(
        edges=np.concatenate([edges, edges[~answered]]),
        ij=np.concatenate([ends, ends[~answered][:, ::-1]]),
        sign=np.repeat([1.0, -1.0], [len(edges), int((~answered).sum())]),
    )
    entries = entries.chosen(counts[entries.edges])
    free = np.zeros(len(poses), bool)
    free[entries.ij[:, 0]] = True
    component = components(len(poses), entries.ij)
    last = {int(number): vertex for vertex, number in enumerate(component)}
    free[[0 if number == component[0] else vertex for number, vertex in last.items()]] = False
    pivots = _pivots(len(poses), entries.ij, terms.center[entries.edges])
    motion = _solve(free, entries, pivots, terms, symmetric=False)
    motion[:, :3] -= np.cross(motion[:, 3:], pivots)  # about the origin of the map
    try:
        change = np.linalg.solve(pcl_incidence(poses), motion[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        raise AlignmentError(
            "a pose has a pitch of 90 deg, where PCL's Jacobian is singular; use jacobian='exact'"
        ) from None
    moved: npt.NDArray[np.float64] = poses - np.where(free[:, None], change, 0.0)
    return moved


def pose_covariances(poses: Floats, ends: Ints, terms: EdgeTerms, freedom: Floats) -> Floats:
    """
    Return the covariances of the poses, (V, 6, 6); see LUM.pose_covariances.

    Parameters
    ----------
    poses : (V, 6) float64
        The solution.
    ends : (E, 2) int64
        Source and target of every edge.
    terms : EdgeTerms
        Terms at these poses.
    freedom : (E,) float64
        Inverse covariance of an edge over its information.

    Notes
    -----
    With the system G x = sum A^T W m of the edges, where A = (A_source, -A_target) takes motions
    of the vertices to that of an edge, and m has the covariance (freedom W)^-1, the covariance of
    x is G^-1 (sum A^T W A / freedom) G^-1.

    """
    used = _used(ends, terms)
    component = components(len(poses), ends[used])
    free = component == component[0]
    result = np.where(free[:, None, None], 0.0, np.full((6, 6), np.nan))
    free[0] = False
    used = used[np.isin(ends[used][:, 0], np.flatnonzero(component == component[0]))]
    row_of = np.cumsum(free) - 1
    size = 6 * int(free.sum())
    origins = transforms(poses)[:, :3, 3]
    system, noise = np.zeros((2, size, size))
    for edge in used:
        rows = np.zeros((6, size))
        for end, sign in zip(ends[edge], (1.0, -1.0), strict=True):
            if free[end]:
                arm = _arms((terms.center[edge] - origins[end])[None])[0]
                rows[:, 6 * row_of[end] : 6 * row_of[end] + 6] += sign * arm
        share = rows.T @ terms.information[edge] @ rows
        system += share
        noise += share / freedom[edge]
    try:
        half = np.linalg.solve(system, noise)
        covariance = np.linalg.solve(system, half.T)
    except np.linalg.LinAlgError as error:
        raise AlignmentError(f'the edges do not determine the poses: {error}') from error
    blocks = covariance.reshape(size // 6, 6, size // 6, 6)
    at = np.arange(size // 6)
    result[free] = blocks[at, :, at]
    return result


def _used(ends: Ints, terms: EdgeTerms) -> Ints:
    """Return the rows of the edges that are not dropped."""
    counts = np.ones(len(ends), bool)
    counts[list(terms.dropped)] = False
    return np.flatnonzero(counts)


def _pivots(num_vertices: int, ends: Ints, centers: Floats) -> Floats:
    """Return the mean (V, 3) of the edge centers at every vertex."""
    total, number = np.zeros((num_vertices, 3)), np.zeros(num_vertices)
    for column in (0, 1):
        np.add.at(total, ends[:, column], centers)
        np.add.at(number, ends[:, column], 1.0)
    return np.asarray(total / np.maximum(number, 1.0)[:, None])


def _solve(
    free: npt.NDArray[np.bool_],
    entries: Entries,
    pivots: Floats,
    terms: EdgeTerms,
    *,
    symmetric: bool,
) -> Floats:
    """Return the motions (V, 6) of all vertices about their pivots, zero if not free."""
    motion = np.zeros((len(free), 6))
    edges, ij, sign = entries.chosen(free[entries.ij[:, 0]])
    if not len(edges):
        return motion
    row_of = np.cumsum(free) - 1
    near = _arms(terms.center[edges] - pivots[ij[:, 0]])
    weighed = near.swapaxes(1, 2) @ terms.information[edges]
    right = np.zeros((int(free.sum()), 6))
    observed = weighed @ (sign[:, None] * terms.motion[edges])[:, :, None]
    np.add.at(right, row_of[ij[:, 0]], observed[:, :, 0])
    coupled = free[ij[:, 1]]
    far = _arms(terms.center[edges[coupled]] - pivots[ij[coupled, 1]])
    blocks = np.concatenate([weighed @ near, -(weighed[coupled] @ far)])
    rows = row_of[np.concatenate([ij[:, 0], ij[coupled, 0]])]
    columns = row_of[np.concatenate([ij[:, 0], ij[coupled, 1]])]
    motion[free] = _solve_blocks(blocks, rows, columns, right, symmetric=symmetric)
    return motion


def _solve_blocks(
    blocks: Floats, rows: Ints, columns: Ints, right: Floats, *, symmetric: bool
) -> Floats:
    """Solve the system of blocks (B, 6, 6), summed by row and column, for right (F, 6)."""
    from scipy.sparse import coo_array
    from scipy.sparse.linalg import splu

    within = np.arange(6)
    i = np.broadcast_to(6 * rows[:, None, None] + within[:, None], blocks.shape)
    j = np.broadcast_to(6 * columns[:, None, None] + within, blocks.shape)
    size = right.size
    system = coo_array((blocks.ravel(), (i.ravel(), j.ravel())), shape=(size, size)).tocsc()
    try:
        if symmetric:
            # positive definite: pivoting on the diagonal is stable and keeps the fill small
            factors = splu(
                system,
                permc_spec='MMD_AT_PLUS_A',
                diag_pivot_thresh=0.0,
                options={'SymmetricMode': True},
            )
        else:
            factors = splu(system)
        solution = np.asarray(factors.solve(right.ravel()))
    except RuntimeError as error:
        raise AlignmentError(f'the edges do not determine the poses: {error}') from error
    if not (np.abs(solution) < HUGE).all():
        raise AlignmentError('the edges do not determine the poses: no finite solution')
    return solution.reshape(-1, 6)


def _arms(lengths: Floats) -> Floats:
    """Return the matrices (B, 6, 6) from motions about a pivot to motions about a center."""
    result = np.zeros((len(lengths), 6, 6))
    result[:] = np.eye(6)
    result[:, :3, 3:] = -skew(lengths)
    return result


def _cayley(T: Floats, pivots: Floats, motion: Floats) -> Floats:
    """
    Return transforms (V, 4, 4) after reverting motions about pivots.

    A point u about the pivot moves to v with v - u = -(t + w x (u + v) / 2).
    """
    half = 0.5 * motion[:, 3:]
    # the inverse of 1 + [half]x in closed form: never singular
    inverse = np.eye(3) + half[:, :, None] * half[:, None] - skew(half)
    inverse /= 1.0 + (half * half).sum(axis=1)[:, None, None]
    R = inverse @ (np.eye(3) - skew(half))
    moved = T.copy()
    moved[:, :3, :3] = R @ T[:, :3, :3]
    arm = R @ (T[:, :3, 3] - pivots)[:, :, None] - inverse @ motion[:, :3, None]
    moved[:, :3, 3] = pivots + arm[:, :, 0]
    return np.asarray(moved)
