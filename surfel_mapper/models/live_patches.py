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
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.moments import unpack_keys
from surfel_mapper.models.bspline import fit_grids, HeightField, is_small
from surfel_mapper.models.bspline_incremental import DEGREE, fit_field, FittedField, SMOOTHING
from surfel_mapper.models.grid import Cells
from surfel_mapper.models.kernels.bspline import rms_off_field
from surfel_mapper.models.kernels.patches import describe_patches
from surfel_mapper.models.kernels.surfel_classes import FLAT
from surfel_mapper.models.kernels.surfel_groups import mean_normals, merge_voxels, sample_voxels
from surfel_mapper.models.multi_model import Plane, Surface
from surfel_mapper.models.patches import cells_of, PatchPoints, rms_across
from surfel_mapper.models.surfel_graph import SurfelGraph

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int32]
Indices = npt.NDArray[np.int64]

PLANE_PITCH_VOXELS = 2.0
"""Edge of the cells of a plane."""
POINTS = 9
"""Points across each surfel."""

STILL = 0.1
"""A frame stays while its boundary would move by less than this share of the thickness."""

STILL_RAD = math.radians(1.0)
"""A frame stays while its normal turns by less."""
MOST_TURN_RAD = math.radians(45.0)
"""A frame that turns farther is rebuilt; below, its x is kept."""


@dataclass(slots=True, eq=False)
class Tracked:
    """
    A patch and its input.

    Attributes
    ----------
    patch : Plane
        Plane or Surface, as published.
    rows : (n,) int32
        Rows of its voxels.
    origin : (3,) float64, m
        Anchor of the lattice of its grid.
    fitted : FittedField, optional
        Height field of a surface, relative to the anchor.

    """

    patch: Plane
    rows: Rows
    origin: Array
    fitted: FittedField | None


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

    def fit(
        self, ids: list[int], rows: list[Rows], before: list[Tracked | None]
    ) -> list[tuple[Plane, Array, FittedField | None]]:
        """
        Return patches, the anchors of their grids, and fields relative to these.

        Parameters
        ----------
        ids : list of int
            Ids of the patches.
        rows : list of (n,) int32
            Rows of their voxels.
        before : list of Tracked or None
            The previous patches.

        """
        if not ids:
            return []
        graph, every = self._graph, np.concatenate(rows)
        starts = np.concatenate([[0], np.cumsum([len(part) for part in rows])])
        total, means, covariances = self._merged(every, starts)
        normals = np.empty_like(means)
        mean_normals(every, starts, graph.kind == FLAT, graph.normal, normals)
        thickness = np.full(len(ids), graph.limit_m)
        groups = PatchPoints(self._points(every), POINTS * starts, normals, thickness)
        frames, curved = self._described(groups)
        frames[~curved] = plane_frames(covariances[~curved], normals[~curved])
        origins, stays = self._steadied(before, frames, means, covariances, curved)
        pitches = np.where(curved, self._surface_pitch_m, PLANE_PITCH_VOXELS * self._size_m)
        local = np.empty_like(groups.points)
        cells = cells_of(
            groups, (origins, frames, pitches, local), 0.5 * self._size_m, snapped=True
        )
        fields = self._fields(cells, curved, before, stays)
        shifts = np.einsum('kij,kj->ki', frames, means - origins)
        cells.origins[:] -= shifts[:, :2]  # published grids are relative to the mean
        rms_m = rms_across(covariances, frames[:, 2], total)
        found = []
        for k, grid in enumerate(cells.grids()):
            field, common = fields.get(k), (ids[k], int(total[k]), means[k], covariances[k])
            if field is None:
                patch = Plane(*common, frames[k], float(rms_m[k]), grid)
            else:
                error_m = self._rms_m(field.field, frames[k], origins[k], rows[k])
                spline = moved(field.field, shifts[k])
                patch = Surface(*common, frames[k], error_m, grid, spline)
            found.append((patch, origins[k], field))
        return found

    def _fields(
        self,
        cells: Cells,
        curved: npt.NDArray[np.bool_],
        before: list[Tracked | None],
        stays: npt.NDArray[np.bool_],
    ) -> dict[int, FittedField]:
        """Return the fields of curved patches: small ones anew, large ones near changes."""
        chosen = np.flatnonzero(curved)
        small = is_small(cells.sizes[chosen], DEGREE)
        fitted, heights = fit_grids(cells, chosen[small], DEGREE, SMOOTHING)
        found = {
            k: FittedField(field, heights[cells.of(k)].reshape(cells.sizes[k]))
            for k, field in zip(chosen[small].tolist(), fitted, strict=True)
        }
        for k in chosen[~small].tolist():
            known = before[k]
            sums = cells.sums[cells.of(k)].reshape(*cells.sizes[k], 4)
            was = known.fitted if known is not None and stays[k] else None
            found[k] = fit_field(float(cells.pitches[k]), cells.origins[k].copy(), sums, was)
        return found

    def _merged(self, rows: Rows, starts: Indices) -> tuple[Indices, Array, Array]:
        """Return number, mean and covariance of all points of groups of voxels."""
        number, graph = len(starts) - 1, self._graph
        total, merged = np.empty(number, np.int64), np.empty((number, 6))
        means = np.empty((number, 3))
        merge_voxels(
            rows, starts, graph.count, graph.position, graph.covariance, total, means, merged
        )
        return total, means, symmetric(merged)

    def _points(self, rows: Rows) -> Array:
        """Return the points (9 n, 3) across surfels, m."""
        graph = self._graph
        low = unpack_keys(graph.key[rows]) * self._size_m
        points = np.empty((POINTS * len(rows), 3))
        sample_voxels(rows, graph.position, graph.axes, low, self._size_m, points)
        return points

    def _described(self, groups: PatchPoints) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return the frames (K, 3, 3) of groups as surfaces, and whether they are curved."""
        number = len(groups.thickness)
        means, frames = np.empty((number, 3)), np.empty((number, 3, 3))
        covariances, curved = np.empty((number, 3, 3)), np.empty(number, np.bool_)
        describe_patches(
            groups.points,
            groups.starts,
            groups.normals,
            np.zeros(3),
            (groups.thickness, self._surface_pitch_m, True, True),
            means,
            covariances,
            frames,
            curved,
        )
        return frames, curved

    def _steadied(
        self,
        before: list[Tracked | None],
        frames: Array,
        means: Array,
        covariances: Array,
        curved: npt.NDArray[np.bool_],
    ) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return anchors, and whether frames stay; frames are changed in place."""
        origins, stays = means.copy(), np.zeros(len(means), np.bool_)
        known = {
            k: tracked
            for k, tracked in enumerate(before)
            if tracked is not None and isinstance(tracked.patch, Surface) == curved[k]
        }
        if not known:
            return origins, stays
        rows = np.array(list(known))
        was = np.array([tracked.patch.R_patch_map for tracked in known.values()])
        anchors = np.array([tracked.origin for tracked in known.values()])
        normals = frames[rows, 2]
        turn = np.linalg.norm(was[:, 2] - normals, axis=1)
        radius = 3.0 * np.sqrt(np.trace(covariances[rows], axis1=1, axis2=2))
        # a plane must fit at its boundary; a field adapts its heights
        near = curved[rows] | (turn * radius < STILL * self._graph.thickness_m)
        still = (turn < STILL_RAD) & near
        frames[rows[still]], origins[rows[still]] = was[still], anchors[still]
        stays[rows] = still
        turns = ~still & (turn < MOST_TURN_RAD)
        frames[rows[turns]] = turned(was[turns, 0], normals[turns])
        height = np.einsum('ij,ij->i', anchors - means[rows], normals)
        origins[rows[turns]] = (anchors - height[:, None] * normals)[turns]
        return origins, stays

    def _rms_m(self, field: HeightField, frame: Array, origin: Array, rows: Rows) -> float:
        """Return the root mean square distance of the points of voxels from a field, m."""
        held = self._graph.count, self._graph.position, self._graph.eigenvalues
        found: float = rms_off_field(rows, held, frame, origin, field.parts())
        return found


def turned(x: Array, normals: Array) -> Array:
    """Return the frames (K, 3, 3) of normals with x nearest to given axes."""
    along = x - np.einsum('ij,ij->i', x, normals)[:, None] * normals
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([along, np.cross(normals, along), normals], axis=1)


def symmetric(packed: Array) -> Array:
    """Return matrices (K, 3, 3) from xx xy xz yy yz zz (K, 6)."""
    full: Array = packed[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    return full


def plane_frames(covariances: Array, normals: Array) -> Array:
    """Return principal frames (K, 3, 3) of covariances, with z on the side of the normals."""
    vectors = np.linalg.eigh(covariances)[1]
    z, x = vectors[:, :, 0], vectors[:, :, 2]
    z = z * np.where(np.einsum('ij,ij->i', z, normals) < 0.0, -1.0, 1.0)[:, None]
    most = np.take_along_axis(x, np.abs(x).argmax(axis=1)[:, None], axis=1)
    x = x * np.where(most < 0.0, -1.0, 1.0)
    frames: Array = np.stack([x, np.cross(z, x), z], axis=1)
    return frames


def moved(field: HeightField, shift: Array) -> HeightField:
    """Return a field relative to an origin shifted by (3,) m."""
    origin, control = field.origin - shift[:2], field.control - shift[2]
    return HeightField(field.pitch_m, origin, field.degrees, control)
