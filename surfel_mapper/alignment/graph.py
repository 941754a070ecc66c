# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Graph: clouds with poses, and edges with the correspondences between their points.

Vertex 0 is the reference, fixed at the origin. There is at most one edge from a vertex to another,
and one back. All input is checked and copied, so that a graph is consistent at any time and the
sums over the pairs of an edge are computed only once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.correspondences import moved
from surfel_mapper.alignment.kernels.edges import (
    NUM_MOMENTS,
    NUM_WEIGHTED,
    pair_moments,
    weighted_moments,
)
from surfel_mapper.errors import AlignmentError

Floats = npt.NDArray[np.float64]
Pairs = npt.NDArray[np.int32]
Points = npt.NDArray[np.float32] | npt.NDArray[np.float64]

ROUNDING = 1e-9
"""Rounding of a weight matrix as a share of the largest weight of its edge."""


@dataclass(slots=True)
class Edge:
    """Pairs of points of two vertices, optional weights, and the cached sums over them."""

    pairs: Pairs
    weights: Floats | None = None
    moments: Floats | None = None


class Graph:
    """Vertices with clouds and poses, edges with pairs of points; see LUM."""

    def __init__(self) -> None:
        self._points: list[Points] = []
        self._poses: list[Floats] = []
        self._edges: dict[tuple[int, int], Edge] = {}

    @property
    def num_vertices(self) -> int:
        """Number of vertices."""
        return len(self._points)

    @property
    def ends(self) -> npt.NDArray[np.int64]:
        """Source and target of every edge, (E, 2), in the order of insertion."""
        return np.array(list(self._edges), np.int64).reshape(-1, 2)

    @property
    def is_weighted(self) -> npt.NDArray[np.bool_]:
        """Whether the pairs of each edge have weights, (E,)."""
        return np.array([edge.weights is not None for edge in self._edges.values()], bool)

    @property
    def poses(self) -> Floats:
        """Poses of all vertices, (V, 6); a copy."""
        return np.array(self._poses).reshape(-1, 6)

    def add_vertex(self, points: npt.ArrayLike, pose: npt.ArrayLike | None) -> int:
        """Add a cloud at a pose, by default the origin; return its vertex number."""
        number = self.num_vertices
        checked_points, checked = _points(number, points), _pose(number, pose)
        self._points.append(checked_points)
        self._poses.append(checked)
        return number

    def points(self, vertex: int) -> Points:
        """Return the points of a vertex; they cannot be written to."""
        return self._points[self._vertex(vertex)]

    def set_points(self, vertex: int, points: npt.ArrayLike) -> None:
        """Replace the points of a vertex; its pairs stay and must refer to existing points."""
        checked = _points(self._vertex(vertex), points)
        for ends, edge in self._edges.items():
            for column, end in enumerate(ends):
                if end == vertex:
                    _check_rows(ends, vertex, edge.pairs[:, column], len(checked))
        self._points[vertex] = checked
        for ends, edge in self._edges.items():
            if vertex in ends:
                edge.moments = None

    def pose(self, vertex: int) -> Floats:
        """Return the pose of a vertex, (6,); a copy."""
        return np.array(self._poses[self._vertex(vertex)])

    def set_pose(self, vertex: int, pose: npt.ArrayLike) -> None:
        """Move a vertex other than the reference."""
        if self._vertex(vertex) == 0:
            raise AlignmentError('vertex 0 is the reference: its pose is fixed at the origin')
        self._poses[vertex] = _pose(vertex, pose)

    def set_poses(self, poses: Floats) -> None:
        """Set the poses of all vertices, (V, 6), unchecked."""
        self._poses = list(np.array(poses))

    def edge(self, source: int, target: int) -> Edge:
        """Return an edge."""
        ends = (self._vertex(source), self._vertex(target))
        if ends not in self._edges:
            raise AlignmentError(f'there is no edge {source} -> {target}')
        return self._edges[ends]

    def set_edge(
        self, source: int, target: int, pairs: npt.ArrayLike, weights: npt.ArrayLike | None
    ) -> None:
        """Add or replace an edge."""
        ends = (self._vertex(source), self._vertex(target))
        if source == target:
            raise AlignmentError(f'edge {source} -> {target}: from a vertex to itself')
        rows = np.asarray(pairs)
        if rows.size == 0:
            rows = np.empty((0, 2), np.int32)
        if rows.ndim != 2 or rows.shape[1] != 2 or rows.dtype.kind not in 'iu':
            raise AlignmentError(
                f'edge {source} -> {target}: pairs of shape {rows.shape} and type {rows.dtype}, '
                'expected (K, 2) integers'
            )
        for column, end in enumerate(ends):
            _check_rows(ends, end, rows[:, column], len(self._points[end]))
        self._edges[ends] = Edge(
            np.array(rows, np.int32, order='C'), _weights(ends, weights, len(rows))
        )

    def moments(self, weighted: bool) -> Floats:
        """Return the sums over the pairs of all weighted edges, or of all others."""
        rows = [
            self._sum(ends, edge)
            for ends, edge in self._edges.items()
            if (edge.weights is not None) == weighted
        ]
        return np.array(rows).reshape(-1, NUM_WEIGHTED if weighted else NUM_MOMENTS)

    def residual(
        self, T_source: Floats, T_target: Floats, center: Floats, motion: Floats
    ) -> Floats:
        """Return the squared residual gaps after motions (E, 6) about centers, (E,) m^2."""
        result = np.zeros(len(self._edges))
        for row, ((s, t), edge) in enumerate(self._edges.items()):
            a = moved(self._points[s][edge.pairs[:, 0]], T_source[row])
            b = moved(self._points[t][edge.pairs[:, 1]], T_target[row])
            arms = 0.5 * (a + b) - center[row]
            gaps = a - b - motion[row, :3] - np.cross(motion[row, 3:], arms)
            squares = (gaps * gaps).sum(axis=1)
            result[row] = squares[np.isfinite(squares)].sum()
        return result

    def _sum(self, ends: tuple[int, int], edge: Edge) -> Floats:
        if edge.moments is None:
            source, target = (self._points[end] for end in ends)
            if edge.weights is None:
                edge.moments = np.empty(NUM_MOMENTS)
                pair_moments(source, target, edge.pairs, edge.moments)
            else:
                edge.moments = np.empty(NUM_WEIGHTED)
                weighted_moments(source, target, edge.pairs, edge.weights, edge.moments)
        return edge.moments

    def _vertex(self, vertex: int) -> int:
        """Return a vertex number; AlignmentError if there is no such vertex."""
        if not 0 <= vertex < self.num_vertices:
            raise AlignmentError(f'there is no vertex {vertex} among {self.num_vertices}')
        return vertex


def _points(vertex: int, points: npt.ArrayLike) -> Points:
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in 'fiu':
        raise AlignmentError(
            f'vertex {vertex}: points of shape {array.shape} and type {array.dtype}, '
            'expected (N, 3) numbers'
        )
    if not len(array):
        raise AlignmentError(f'vertex {vertex}: no points')
    dtype: Any = np.float32 if array.dtype == np.float32 else np.float64
    copy: Points = np.array(array, dtype, order='C')
    copy.setflags(write=False)
    return copy


def _pose(vertex: int, pose: npt.ArrayLike | None) -> Floats:
    array = np.zeros(6) if pose is None else np.array(pose, np.float64)
    if array.shape != (6,) or not np.isfinite(array).all():
        raise AlignmentError(
            f'vertex {vertex}: pose {array.tolist()}, expected 6 finite numbers '
            '(x y z in m, roll pitch yaw in rad)'
        )
    return array


def _weights(ends: tuple[int, int], weights: npt.ArrayLike | None, num: int) -> Floats | None:
    if weights is None:
        return None
    array = np.array(weights, np.float64, order='C')
    if array.shape != (num, 3, 3) or not np.isfinite(array).all():
        raise AlignmentError(
            f'edge {ends[0]} -> {ends[1]}: weights of shape {array.shape}, '
            f'expected ({num}, 3, 3), all finite'
        )
    _check_definite(ends, array)
    return array


def _check_definite(ends: tuple[int, int], weights: Floats) -> None:
    """Raise AlignmentError if a weight matrix is not symmetric or has a negative eigenvalue."""
    if not len(weights):
        return
    name = f'edge {ends[0]} -> {ends[1]}: weight'
    scale = float(np.abs(weights).max())
    apart = np.abs(weights - weights.swapaxes(1, 2)).max(axis=(1, 2))
    if (apart > ROUNDING * scale).any():
        row = int(apart.argmax())
        raise AlignmentError(f'{name} {row} is not symmetric: {weights[row].tolist()}')
    xx, yy, zz = weights[:, 0, 0], weights[:, 1, 1], weights[:, 2, 2]
    xy, xz, yz = weights[:, 0, 1], weights[:, 0, 2], weights[:, 1, 2]
    minors = (yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy)
    determinant = xx * minors[0] - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    for size, values in ((1, (xx, yy, zz)), (2, minors), (3, (determinant,))):
        for minor in values:
            if (minor < -ROUNDING * scale**size).any():
                row = int(minor.argmin())
                raise AlignmentError(
                    f'{name} {row} has a negative eigenvalue: {weights[row].tolist()}'
                )


def _check_rows(
    ends: tuple[int, int], vertex: int, rows: npt.NDArray[np.integer], num_points: int
) -> None:
    """Raise AlignmentError if pairs refer to points that a vertex does not have."""
    beyond = np.flatnonzero((rows < 0) | (rows >= num_points))
    if len(beyond):
        raise AlignmentError(
            f'edge {ends[0]} -> {ends[1]}: pair {beyond[0]} names point {rows[beyond[0]]} of '
            f'vertex {vertex}, which has {num_points}'
        )
