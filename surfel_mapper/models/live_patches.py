# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes and surfaces through voxels, in frames that stay while what they hold changes little.

Mean, covariance and rms come from the exact moments of all points. What is covered, and the
spline, come from nine points across each voxel, which carry its slope and count alike however
often it was seen. The grid keeps its place in the world as long as the frame does, so cells that
nothing changed in stay what they were.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.config.models_layer import ModelsLayerConfig
from surfel_mapper.kernels.patches import describe
from surfel_mapper.kernels.piece_groups import mean_normals
from surfel_mapper.kernels.pieces import FLAT, merge_moments, spread
from surfel_mapper.mapping.moments import unpack_keys
from surfel_mapper.models.bspline import fit_pspline, HeightField, initial_field
from surfel_mapper.models.multi_model import Plane, Surface
from surfel_mapper.models.patches import Cells, cells_of, Groups, rms_across
from surfel_mapper.models.pieces import Pieces

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int32]
Indices = npt.NDArray[np.int64]

PLANE_PITCH_VOXELS = 2.0
POINTS = 9
"""Across each voxel."""

STILL = 0.1
"""A frame stays while its rim would move by less than so much of the thickness of a plane."""

STILL_RAD = math.radians(1.0)
DEGREE = 3
MOST_WORK = 2e7
"""A spline that takes more multiplications has larger cells."""


@dataclass(slots=True, eq=False)
class Tracked:
    """
    A patch and what it was made of.

    Attributes
    ----------
    patch : Plane
        Or Surface; as it is handed out.
    rows : (n,) int32
        Rows of its voxels.
    component : int
        What its voxels hang together with.
    origin : (3,) float64, m
        Where the lattice of its grid is anchored.

    """

    patch: Plane
    rows: Rows
    component: int
    origin: Array


class PatchFitter:
    """
    Makes patches from voxels.

    Parameters
    ----------
    config : ModelsLayerConfig
        Settings.
    pieces : Pieces
        The voxels.

    """

    def __init__(self, config: ModelsLayerConfig, pieces: Pieces) -> None:
        """Take over the settings."""
        self._pieces = pieces
        self._smoothing = config.smoothing
        self._size_m = pieces.map.voxel_size_m
        self._surface_pitch_m = max(self._size_m, 3.0 * pieces.thickness_m)

    def fit(
        self, ids: list[int], rows: list[Rows], before: list[Tracked | None]
    ) -> list[tuple[Plane, Array]]:
        """
        Return patches, and where the lattices of their grids are anchored.

        Parameters
        ----------
        ids : list of int
            What they are called.
        rows : list of (n,) int32
            Rows of their voxels.
        before : list of Tracked or None
            What they were.

        """
        if not ids:
            return []
        pieces, every = self._pieces, np.concatenate(rows)
        starts = np.concatenate([[0], np.cumsum([len(part) for part in rows])])
        number, total = len(ids), np.empty(len(ids), np.int64)
        means, merged = np.empty((number, 3)), np.empty((number, 6))
        merge_moments(
            every, starts, pieces.count, pieces.position, pieces.covariance, total, means, merged
        )
        normals = np.empty((number, 3))
        mean_normals(every, starts, pieces.kind == FLAT, pieces.normal, normals)
        points = self._points(every)
        groups = Groups(points, POINTS * starts, normals, np.full(number, pieces.limit_m))
        frames, curved = self._described(groups)
        covariances = symmetric(merged)
        frames[~curved] = plane_frames(covariances[~curved], normals[~curved])
        origins = means.copy()
        for k, known in enumerate(before):
            if known is not None and isinstance(known.patch, Surface) == curved[k]:
                frames[k], origins[k] = self._steadied(
                    known, frames[k], means[k], covariances[k]
                )
        pitches = np.where(curved, self._surface_pitch_m, PLANE_PITCH_VOXELS * self._size_m)
        local = np.empty_like(points)
        cells = cells_of(
            groups, (origins, frames, pitches, local), 0.5 * self._size_m, snapped=True
        )
        found = []
        for k in range(number):
            shift = frames[k] @ (means[k] - origins[k])
            plane = Plane(
                id=ids[k],
                num_points=int(total[k]),
                mean=means[k],
                covariance=covariances[k],
                R_patch_map=frames[k],
                rms_m=rms_across(covariances[k], frames[k, 2], int(total[k])),
                grid=cells.grid(k),
            )
            if curved[k]:
                plane = self._surface(plane, cells, k, origins[k], rows[k])
            found.append((moved(plane, shift), origins[k]))
        return found

    def _points(self, rows: Rows) -> Array:
        """Return the points (9 n, 3) across voxels, m."""
        pieces = self._pieces
        low = unpack_keys(pieces.key[rows]) * self._size_m
        points = np.empty((POINTS * len(rows), 3))
        spread(rows, pieces.position, pieces.axes, low, self._size_m, points)
        return points

    def _described(self, groups: Groups) -> tuple[Array, npt.NDArray[np.bool_]]:
        """Return the frames (K, 3, 3) of groups as surfaces, and which of them are."""
        number = len(groups.thickness)
        means, frames = np.empty((number, 3)), np.empty((number, 3, 3))
        covariances, curved = np.empty((number, 3, 3)), np.empty(number, np.bool_)
        describe(
            groups.points, groups.starts, groups.normals, np.zeros(3),
            (groups.thickness, self._surface_pitch_m, True, True),
            means, covariances, frames, curved,
        )  # fmt: skip
        return frames, curved

    def _steadied(
        self, known: Tracked, frame: Array, mean: Array, covariance: Array
    ) -> tuple[Array, Array]:
        """Return frame and anchor: those that were, or as near as the new normal allows."""
        was, normal = known.patch.R_patch_map, frame[2]
        sine = float(np.linalg.norm(np.cross(was[2], normal)))
        radius = 3.0 * math.sqrt(max(float(np.trace(covariance)), 0.0))
        flipped = float(was[2] @ normal) < 0.0
        still = sine < STILL_RAD and sine * radius < STILL * self._pieces.thickness_m
        if isinstance(known.patch, Surface):  # its heights say where it is
            still = sine < STILL_RAD
        if still and not flipped:
            return was, known.origin
        along = was[0] - (was[0] @ normal) * normal
        length = float(np.linalg.norm(along))
        if length < 0.5 or flipped:
            return frame, mean
        x = along / length
        anchor = known.origin - (normal @ (known.origin - mean)) * normal
        return np.stack([x, np.cross(normal, x), normal]), anchor

    def _surface(
        self, plane: Plane, cells: Cells, k: int, origin: Array, rows: Rows
    ) -> Surface:
        """Return the surface whose cells are those of patch k."""
        sums = cells.sums[cells.of(k)]
        used = sums[:, 3] > 0.0
        means = np.zeros((len(sums), 3))
        means[used] = sums[used, :3] / sums[used, 3:]
        grid = plane.grid
        heights = means[:, 2].reshape(grid.filled.shape)
        start = initial_field(grid.pitch_m, grid.origin, heights, grid.filled, DEGREE)
        spline = fit_pspline(
            start, means[used, :2], means[used, 2], sums[used, 3], self._smoothing
        )
        local = (self._pieces.position[rows] - origin) @ plane.R_patch_map.T
        error = local[:, 2] - spline.heights(local[:, :2])
        count = self._pieces.count[rows]
        across = error**2 + self._pieces.eigenvalues[rows, 0]
        return Surface(
            id=plane.id,
            num_points=plane.num_points,
            mean=plane.mean,
            covariance=plane.covariance,
            R_patch_map=plane.R_patch_map,
            rms_m=math.sqrt(float(count @ across) / float(count.sum())),
            grid=grid,
            spline=spline,
        )


def symmetric(packed: Array) -> Array:
    """Return matrices (K, 3, 3) from xx xy xz yy yz zz (K, 6)."""
    full: Array = packed[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    return full


def plane_frames(covariances: Array, normals: Array) -> Array:
    """Return frames (K, 3, 3) along the axes of covariances, z on the side of the normals."""
    vectors = np.linalg.eigh(covariances)[1]
    z, x = vectors[:, :, 0], vectors[:, :, 2]
    z = z * np.where(np.einsum('ij,ij->i', z, normals) < 0.0, -1.0, 1.0)[:, None]
    most = np.take_along_axis(x, np.abs(x).argmax(axis=1)[:, None], axis=1)
    x = x * np.where(most < 0.0, -1.0, 1.0)
    frames: Array = np.stack([x, np.cross(z, x), z], axis=1)
    return frames


def moved(patch: Plane, shift: Array) -> Plane:
    """Return a patch whose grid, which was about another place, is about its mean."""
    grid = replace(patch.grid, origin=patch.grid.origin - shift[:2])
    if not isinstance(patch, Surface):
        return replace(patch, grid=grid)
    spline = HeightField(
        patch.spline.pitch_m,
        patch.spline.origin - shift[:2],
        patch.spline.degrees,
        patch.spline.control - shift[2],
    )
    return replace(patch, grid=grid, spline=spline)
