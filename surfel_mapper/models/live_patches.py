# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes and surfaces of voxels, in frames that stay put while their content changes little.

Mean, covariance and rms come from the exact moments of all points. Coverage and spline come from
nine points across each surfel, which carry its slope and weigh every location equally, however
often it was seen. The grid keeps its place in the map frame as long as the frame stays, so cells
without changes stay the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.moments import unpack_keys
from surfel_mapper.models.bspline import HeightField
from surfel_mapper.models.frames import (
    eigen,
    mean_normals,
    means_and_scatters,
    oriented,
    PACKED,
)
from surfel_mapper.models.grid import Cells
from surfel_mapper.models.multi_model import Plane, Surface
from surfel_mapper.models.patches import (
    aligned,
    cells_of,
    described,
    MARGIN_VOXELS,
    PatchPoints,
    rms_across,
    splines_of,
)
from surfel_mapper.models.surfel_graph import SurfelGraph

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int32]
Indices = npt.NDArray[np.int64]

PLANE_PITCH_VOXELS = 2.0
"""Edge of the cells of a plane."""
STEPS = np.array(list(product((-1.0, 0.0, 1.0), repeat=2)))
"""Points across each surfel, in half its edges."""

STILL = 0.1
"""A frame stays while its boundary would move by less than this share of the thickness."""

STILL_RAD = math.radians(1.0)
"""A frame stays while its normal turns by less."""

DEGREE, SMOOTHING = 3, 1e-2
"""Degree of the splines, and weight of their second differences."""

MOST_TURN_RAD = math.radians(45.0)
"""A frame that turns farther is rebuilt; below, its x is kept."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """
    A patch and its input.

    Attributes
    ----------
    patch : Plane
        Plane or Surface, as published.
    rows : (n,) int32
        Rows of its voxels.
    beyond : (m,) int32
        Rows of voxels of other surfaces that continue it, to which it is fitted, too.
    normal, box : (3,), (2, 3) float64
        Mean normal; least and greatest coordinates of its surfels, m.
    origin : (3,) float64, m
        Anchor of the lattice of its grid.

    """

    patch: Plane
    rows: Rows
    beyond: Rows
    normal: Array
    box: Array
    origin: Array

    @property
    def is_surface(self) -> bool:
        """Whether the patch is curved."""
        return isinstance(self.patch, Surface)


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """
    Groups of voxels before their fit.

    Attributes
    ----------
    rows : list of (n,) int32
        Rows of the voxels of each.
    total, means, covariances : (K,) int64, (K, 3), (K, 3, 3) float64
        Moments of all points.
    boxes : (K, 2, 3) float64, m
        Least and greatest coordinates of the surfels.
    samples : PatchPoints
        Points across the surfels.
    frames, curved : (K, 3, 3) float64, (K,) bool
        Axes of the patch as rows, and whether it is a surface.

    """

    rows: list[Rows]
    total: Indices
    means: Array
    covariances: Array
    boxes: Array
    samples: PatchPoints
    frames: Array
    curved: npt.NDArray[np.bool_]


class PatchFitter:
    """
    Fits patches to voxels.

    Parameters
    ----------
    graph : SurfelGraph
        The voxels.

    """

    def __init__(self, graph: SurfelGraph) -> None:
        self._graph = graph
        self._size_m = graph.map.voxel_size_m
        self._surface_pitch_m = max(self._size_m, 3.0 * graph.thickness_m)

    def describe(self, rows: list[Rows]) -> Described:
        """Return moments, frames and kind of groups of voxels."""
        graph, every = self._graph, np.concatenate([np.empty(0, np.int32), *rows])
        starts = np.cumsum([0, *(len(group) for group in rows)])
        total, means, covariances = self._merged(every, starts)
        normals = mean_normals(graph.flat_normals(every), starts)
        thickness = np.full(len(rows), graph.limit_m)
        samples = PatchPoints(self._points(every), len(STEPS) * starts, normals, thickness)
        rules = thickness, self._surface_pitch_m, True, True
        _, _, frames, curved = described(samples, np.zeros(3), rules)
        axes = eigen(covariances[~curved])[1]
        frames[~curved] = oriented(axes, normals[~curved])
        positions = graph.position[every]
        boxes = np.stack(
            [end.reduceat(positions, starts[:-1]) for end in (np.minimum, np.maximum)], axis=1
        )
        return Described(rows, total, means, covariances, boxes, samples, frames, curved)

    def fit(
        self,
        ids: list[int],
        groups: Described,
        previous: list[Tracked | None],
        beyond: list[Rows],
    ) -> list[Tracked]:
        """
        Return patches.

        Parameters
        ----------
        ids : list of int
            Ids of the patches.
        groups : Described
            Their voxels; frames are changed in place.
        previous : list of Tracked or None
            The previous patches.
        beyond : list of (m,) int32
            Rows of voxels that continue them.

        """
        samples, frames, curved, means = groups.samples, groups.frames, groups.curved, groups.means
        origins = self._steadied(previous, groups)
        pitches = np.where(curved, self._surface_pitch_m, PLANE_PITCH_VOXELS * self._size_m)
        placed = origins, frames, pitches
        cells = cells_of(samples, placed, MARGIN_VOXELS * 0.5 * self._size_m, snapped=True)
        ends = np.array([len(extra) for extra in beyond])
        fields = splines_of(cells, np.flatnonzero(curved & (ends == 0)), DEGREE, SMOOTHING)
        seams = np.flatnonzero(curved & (ends > 0))
        if len(seams):
            wider = self._wider_cells(seams, samples, beyond, (origins, frames, pitches))
            refitted = splines_of(wider, np.arange(len(seams)), DEGREE, SMOOTHING)
            fields.update((int(seams[k]), field) for k, field in refitted.items())
        shifts = np.einsum('kij,kj->ki', frames, means - origins)
        cells.origins[:] -= shifts[:, :2]  # published grids are relative to the mean
        rms_m = rms_across(groups.covariances, frames[:, 2], groups.total)
        patches = []
        for k, grid in enumerate(cells.grids()):
            rows = groups.rows[k]
            common = ids[k], int(groups.total[k]), means[k], groups.covariances[k], frames[k]
            patch = Plane(*common, float(rms_m[k]), grid)
            if k in fields:
                field, _ = fields[k]
                error_m = self._rms_m(field, frames[k], origins[k], rows)
                patch = Surface(*common, error_m, grid, moved(field, shifts[k]))
            anchor = samples.normals[k], groups.boxes[k], origins[k]
            patches.append(Tracked(patch, rows, beyond[k], *anchor))
        return patches

    def _wider_cells(
        self,
        chosen: Indices,
        samples: PatchPoints,
        beyond: list[Rows],
        frames: tuple[Array, Array, Array],
    ) -> Cells:
        """Return the cells of patches with the voxels beyond; frames: anchors, axes, pitches."""
        chunks = [
            chunk
            for k in chosen
            for chunk in (
                samples.points[samples.starts[k] : samples.starts[k + 1]],
                self._points(beyond[k]),
            )
        ]
        points, ends = np.concatenate(chunks), np.cumsum([len(chunk) for chunk in chunks])[1::2]
        starts = np.concatenate([[0], ends])
        groups = PatchPoints(points, starts, samples.normals[chosen], samples.thickness[chosen])
        origins, axes, pitches = (array[chosen] for array in frames)
        return cells_of(groups, (origins, axes, pitches), None, snapped=True)

    def _merged(self, rows: Rows, starts: Indices) -> tuple[Indices, Array, Array]:
        """Return number, mean and covariance of all points of groups of voxels."""
        graph, counts = self._graph, self._graph.count[rows].astype(np.float64)
        total, means, scatters = means_and_scatters(graph.position[rows], counts, starts)
        own = (counts - 1.0)[:, None] * graph.covariance[rows]
        scatters += np.add.reduceat(own, starts[:-1])[:, PACKED]
        scale = 1.0 / np.maximum(total - 1.0, 1.0)
        return total.astype(np.int64), means, scale[:, None, None] * scatters

    def _points(self, rows: Rows) -> Array:
        """Return the points (9 n, 3) across surfels, m."""
        graph = self._graph
        low = unpack_keys(graph.key[rows]) * self._size_m
        away = np.tensordot(graph.axes[rows], STEPS, ((1,), (1,))).swapaxes(1, 2)
        points = graph.position[rows][:, None] + away
        clipped: Array = np.clip(points, low[:, None], low[:, None] + self._size_m)
        return clipped.reshape(-1, 3)

    def _steadied(self, previous: list[Tracked | None], groups: Described) -> Array:
        """Return anchors; frames that turned little stay, and are changed in place."""
        frames, means, curved = groups.frames, groups.means, groups.curved
        origins = means.copy()
        kept = {
            k: tracked
            for k, tracked in enumerate(previous)
            if tracked is not None and tracked.is_surface == curved[k]
        }
        if not kept:
            return origins
        rows = np.array(list(kept))
        was = np.array([tracked.patch.R_patch_map for tracked in kept.values()])
        anchors = np.array([tracked.origin for tracked in kept.values()])
        normals = frames[rows, 2]
        turn = np.linalg.norm(was[:, 2] - normals, axis=1)
        radius = 3.0 * np.sqrt(np.trace(groups.covariances[rows], axis1=1, axis2=2))
        # a plane must fit at its boundary; a field adapts its heights
        near = curved[rows] | (turn * radius < STILL * self._graph.thickness_m)
        still = (turn < STILL_RAD) & near
        frames[rows[still]], origins[rows[still]] = was[still], anchors[still]
        turns = ~still & (turn < MOST_TURN_RAD)
        frames[rows[turns]] = aligned(was[turns], normals[turns])
        height = np.einsum('ij,ij->i', anchors - means[rows], normals)
        origins[rows[turns]] = (anchors - height[:, None] * normals)[turns]
        return origins

    def _rms_m(self, field: HeightField, frame: Array, origin: Array, rows: Rows) -> float:
        """Return the root mean square distance of the points of voxels from a field, m."""
        graph = self._graph
        local = (graph.position[rows] - origin) @ frame.T
        away = local[:, 2] - field.heights(local[:, :2])
        squares = away**2 + graph.eigenvalues[rows, 0]
        return float(np.sqrt(np.average(squares, weights=graph.count[rows])))


def moved(field: HeightField, shift: Array) -> HeightField:
    """Return a field relative to an origin shifted by (3,) m."""
    origin, control = field.origin - shift[:2], field.control - shift[2]
    return HeightField(field.pitch_m, origin, field.degrees, control)
