# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LUM: globally consistent poses of many scans by the method of Lu and Milios.

The interface is that of pcl::registration::LUM, whose results ``jacobian='pcl'`` reproduces. The
default differs where PCL fails: it uses the Jacobian of its own pose parameters and so converges
at any yaw and after full turns, weighs exact pairs instead of dropping them, lets the edges of
both directions act on both scans, and works in float64 with a sparse solver, so that graphs 1 km
from the origin or of a thousand scans are solved equally well.

Source: Lu and Milios 1997.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
import logging
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.angles import transforms
from surfel_mapper.alignment.edge_terms import (
    edge_sums,
    EdgeTerms,
    exact_terms,
    pcl_terms,
    weighted_terms,
)
from surfel_mapper.alignment.graph import Graph, Points
from surfel_mapper.alignment.kernels.edges import COUNT
from surfel_mapper.alignment.solver import components, exact_step, pcl_step, pose_covariances
from surfel_mapper.arguments import Record
from surfel_mapper.errors import AlignmentError

_log = logging.getLogger(__name__)

Floats = npt.NDArray[np.float64]
Ends = tuple[int, int]

JACOBIANS = ('exact', 'pcl')


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class EdgeEstimate(Record):
    """
    Estimate of an edge from its pairs at the final poses, in the frame of vertex 0.

    Attributes
    ----------
    center : (3,) float64, m
        Mean of the middles of the pairs; motion and information are about it.
    motion : (6,) float64
        Motion of the source against the target that its pairs alone would still correct:
        translation, m, then rotation vector, rad.
    information : (6, 6) float64
        Weight of the motion in the solution, translation first.

    """

    center: Floats
    motion: Floats
    information: Floats


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class LumResult(Record):
    """
    Result of an alignment.

    Attributes
    ----------
    converged : bool
        Whether the last step was below the threshold; False if all edges were ignored.
    iterations : int
        Number of steps.
    residuals : mapping of (source, target) to float, m
        Root mean square distance of the pairs of every edge at the final poses; nan without
        pairs.
    dropped : mapping of (source, target) to str
        Edges that were ignored in the last step, and the reason.
    unconnected : tuple of int
        Vertices that no used edge connects to vertex 0: their poses are unchanged.
    edges : mapping of (source, target) to EdgeEstimate
        Estimates of all edges that were not ignored.
    open_motions : mapping of (source, target) to (K, 6) float64
        Edges whose pairs do not determine all motions, and the undetermined motions, translation
        first, about the center of the pairs. Pairs on a line leave the rotation about it open,
        weights across the walls of a tunnel the translation along it.

    """

    converged: bool
    iterations: int
    residuals: Mapping[Ends, float]
    dropped: Mapping[Ends, str]
    unconnected: tuple[int, ...]
    edges: Mapping[Ends, EdgeEstimate] = field(default_factory=dict)
    open_motions: Mapping[Ends, Floats] = field(default_factory=dict)


class LUM:
    """
    Aligns the clouds of a graph, given the correspondences between their points.

    Poses are x y z in m, roll pitch yaw in rad, T = translation Rz(yaw) Ry(pitch) Rx(roll), of
    the cloud in the frame of vertex 0. A call that raises changes nothing.

    Parameters
    ----------
    max_iterations : int
        Maximum number of steps, at least one.
    convergence_threshold : float
        Iteration ends when the change of the poses is at most this. The change is its length (m
        and rad together), averaged over the vertices other than 0.
    jacobian : str
        ``exact``, or ``pcl`` for the steps that PCL takes.

    Raises
    ------
    AlignmentError
        If an argument is out of bounds.

    """

    def __init__(
        self,
        *,
        max_iterations: int = 5,
        convergence_threshold: float = 0.0,
        jacobian: str = 'exact',
    ) -> None:
        self.graph = Graph()
        self.jacobian = jacobian
        self.max_iterations = max_iterations
        self.convergence_threshold = convergence_threshold
        self._check_settings()

    def _check_settings(self) -> None:
        """Raise AlignmentError if a setting, which may have been changed, is out of bounds."""
        number, threshold = self.max_iterations, self.convergence_threshold
        if self.jacobian not in JACOBIANS:
            expected = ', '.join(JACOBIANS)
            raise AlignmentError(f'jacobian {self.jacobian!r}, expected one of {expected}')
        if isinstance(number, bool) or not isinstance(number, (int, np.integer)) or number < 1:
            raise AlignmentError(f'max_iterations {number!r}, expected an integer, one or more')
        if not 0.0 <= threshold < math.inf:
            raise AlignmentError(
                f'convergence_threshold {threshold}, expected zero or more, finite'
            )

    @property
    def num_vertices(self) -> int:
        """Number of clouds in the graph."""
        return self.graph.num_vertices

    def add_point_cloud(self, points: npt.ArrayLike, pose: npt.ArrayLike | None = None) -> int:
        """
        Add a cloud (N, 3), m, at a pose (6,) or at the origin; return its vertex.

        The first cloud is the reference at the origin; its pose is ignored with a warning. Points
        may contain nan; pairs of such points are ignored.
        """
        if pose is not None and not self.num_vertices:
            _log.warning('the pose of vertex 0 is ignored: it is the reference, at the origin')
            pose = None
        return self.graph.add_vertex(points, pose)

    def point_cloud(self, vertex: int) -> Points:
        """Return the points of a vertex in its own frame, read-only."""
        return self.graph.points(vertex)

    def set_point_cloud(self, vertex: int, points: npt.ArrayLike) -> None:
        """Replace the points of a vertex; correspondences stay unchanged."""
        self.graph.set_points(vertex, points)

    def pose(self, vertex: int) -> Floats:
        """Return the pose of a vertex, (6,)."""
        return self.graph.pose(vertex)

    def set_pose(self, vertex: int, pose: npt.ArrayLike) -> None:
        """Set the pose (6,) of a vertex other than 0."""
        self.graph.set_pose(vertex, pose)

    def transformation(self, vertex: int) -> Floats:
        """Return the pose of a vertex as T_0_vertex, (4, 4)."""
        return np.asarray(transforms(self.pose(vertex)[None])[0])

    def transformed_cloud(self, vertex: int) -> Floats:
        """Return the points of a vertex in the frame of vertex 0, (N, 3)."""
        T = self.transformation(vertex)
        return np.asarray(self.point_cloud(vertex) @ T[:3, :3].T + T[:3, 3])

    def concatenated_cloud(self) -> Floats:
        """Return the points of all vertices in the frame of vertex 0, (N, 3)."""
        clouds = [self.transformed_cloud(vertex) for vertex in range(self.num_vertices)]
        return np.concatenate([np.empty((0, 3)), *clouds])

    def set_correspondences(
        self,
        source: int,
        target: int,
        pairs: npt.ArrayLike,
        weights: npt.ArrayLike | None = None,
    ) -> None:
        """
        Set the correspondences between two clouds, replacing previous ones.

        Parameters
        ----------
        source, target : int
            Vertices.
        pairs : (K, 2) int
            Row of a point of the source, row of a point of the target.
        weights : (K, 3, 3) float, optional
            Symmetric, positive semidefinite weight matrix of the gap of each pair, in the frame of
            the target: the inverse of its covariance. If the gaps are larger than that, the whole
            edge is weighted down.

        """
        self.graph.set_edge(source, target, pairs, weights)

    @property
    def edges(self) -> tuple[Ends, ...]:
        """Source and target of every edge, in the order in which they were set."""
        return tuple((s, t) for s, t in self.graph.ends.tolist())

    def correspondences(self, source: int, target: int) -> npt.NDArray[np.int32]:
        """Return the pairs (K, 2) of an edge; a copy."""
        return np.array(self.graph.edge(source, target).pairs)

    def compute(self) -> LumResult:
        """
        Compute the poses and store them in the graph.

        Raises
        ------
        AlignmentError
            If there are fewer than two vertices, the solution is not finite, or pairs have weights
            with ``jacobian='pcl'``; poses are unchanged then.

        """
        self._check_settings()
        num_others = self.num_vertices - 1
        if num_others < 1:
            raise AlignmentError(f'vertices: {self.num_vertices}, expected two or more')
        ends, poses = self.graph.ends, self.graph.poses
        step = exact_step if self.jacobian == 'exact' else pcl_step
        converged, iterations = False, 0
        while iterations < self.max_iterations and not converged:
            terms, _ = self._terms(ends, poses)
            moved = step(poses, ends, terms)
            change = float(np.sqrt(((moved - poses) ** 2).sum(axis=1)).sum())
            if not math.isfinite(change):
                raise AlignmentError('the edges do not determine the poses: no finite solution')
            poses, iterations = moved, iterations + 1
            converged = change <= self.convergence_threshold * num_others
        self.graph.set_poses(poses)
        return self._result(converged, iterations, ends, terms)

    def pose_covariances(self) -> Floats:
        """
        Return the covariance of every pose at the present poses, (V, 6, 6).

        Of a small motion of the vertex in the frame of vertex 0: translation of its origin, m,
        then rotation vector, rad. It follows from the noise of the pairs and from the weights
        that edges have in the solution. Weights of pairs state their noise, else it is estimated
        from their residuals. Pairs are taken as independent, and weights as of one direction
        each, as those of surfels; weights of rank 3 give three times the covariance. 0 for vertex
        0, nan for vertices that no edge connects to it.

        Raises
        ------
        AlignmentError
            If there are fewer than two vertices, the edges do not determine the poses, or
            ``jacobian`` is ``pcl``.

        """
        if self.num_vertices < 2:
            raise AlignmentError(f'vertices: {self.num_vertices}, expected two or more')
        if self.jacobian == 'pcl':
            raise AlignmentError("covariances need jacobian='exact'")
        ends, poses = self.graph.ends, self.graph.poses
        terms, _ = self._terms(ends, poses)
        freedom = np.ones(len(ends))
        plain = ~self.graph.is_weighted
        num_pairs = self.graph.moments(False)[:, COUNT]
        freedom[plain] = np.maximum(3.0 * num_pairs - 6.0, 1.0)
        return pose_covariances(poses, ends, terms, freedom)

    def _terms(self, ends: npt.NDArray[np.int64], poses: Floats) -> tuple[EdgeTerms, Floats]:
        """Return the terms of all edges at given poses, and the root mean square gaps."""
        weighted = self.graph.is_weighted
        if weighted.any() and self.jacobian == 'pcl':
            raise AlignmentError("PCL does not support pairs with weights; use jacobian='exact'")
        T = transforms(poses)
        T_source, T_target = T[ends[:, 0]], T[ends[:, 1]]
        plain = ~weighted
        sums = edge_sums(self.graph.moments(False), T_source[plain], T_target[plain])
        if self.jacobian == 'pcl':
            return pcl_terms(sums, partial(self.graph.residual, T_source, T_target)), sums.rms
        terms = exact_terms(sums)
        if not weighted.any():
            return terms, sums.rms
        weighed, rms = weighted_terms(
            self.graph.moments(True), T_source[weighted], T_target[weighted]
        )
        order = np.argsort(np.concatenate([np.flatnonzero(plain), np.flatnonzero(weighted)]))
        return terms.joined(weighed, order), np.concatenate([sums.rms, rms])[order]

    def _result(
        self,
        converged: bool,
        iterations: int,
        ends: npt.NDArray[np.int64],
        terms: EdgeTerms,
    ) -> LumResult:
        names: list[Ends] = [(s, t) for s, t in ends.tolist()]
        final, rms = self._terms(ends, self.graph.poses)
        counts = np.ones(len(ends), bool)
        counts[list(terms.dropped)] = False
        component = components(self.num_vertices, ends[counts])
        return LumResult(
            converged=converged and bool(counts.any()),
            iterations=iterations,
            residuals=dict(zip(names, rms.tolist(), strict=True)),
            dropped={names[e]: terms.dropped[e] for e in sorted(terms.dropped)},
            unconnected=tuple(np.flatnonzero(component != component[0]).tolist()),
            edges={
                name: EdgeEstimate(
                    center=final.center[e],
                    motion=final.motion[e],
                    information=final.information[e],
                )
                for e, name in enumerate(names)
                if e not in final.dropped
            },
            open_motions={names[e]: axes for e, axes in terms.weak.items()},
        )
