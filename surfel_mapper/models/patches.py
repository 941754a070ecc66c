# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fit planes and surfaces to groups of points: frames, coverage, splines.

All patches of a cloud go through each kernel together; one call for each would take longer than
the work.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models.bspline import fit_lsqr, fit_pspline, HeightField, initial_field
from surfel_mapper.models.grid import Grid
from surfel_mapper.models.kernels.grid import fill_cells, place_grids
from surfel_mapper.models.kernels.patches import describe_patches
from surfel_mapper.models.multi_model import Plane, Surface
from surfel_mapper.models.segmentation import is_paper

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

PAPER_PLANE_PITCH_VOXELS = 5.0
"""Edge of the cells of planes in profile paper."""
SURFACE_PITCH_VOXELS = 3.0
"""Edge of the cells of surfaces."""
MARGIN_VOXELS = 0.5
"""Distance between a cut and the points."""

FAR_VOXELS, FAR_THICKNESS, FAR_SHARE = 1.5, 0.35, 0.05
"""
A surface is multi-valued if a larger share of its points is farther, in voxels and in thicknesses
of a plane, which follow the noise.
"""


@dataclass(frozen=True, slots=True, eq=False)
class PatchPoints:
    """
    Points of K patches, one patch after the other.

    Attributes
    ----------
    points : (N, 3) float64, m
    starts : (K + 1,) int64
        First point of each patch, and N.
    normals : (K, 3) float64
        Mean normals.
    thickness : (K,) float64, m
        Largest thickness, 6 sigma, of a plane.
    curved : (K,) bool, optional
        Which are surfaces; if omitted, thickness decides.

    """

    points: Array
    starts: Indices
    normals: Array
    thickness: Array
    curved: npt.NDArray[np.bool_] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """The cells of all patches, one row each; see models/kernels/grid.py."""

    pitches: Array
    origins: Array
    sizes: Indices
    first: Indices
    sums: Array
    rim: npt.NDArray[np.bool_]
    corner: npt.NDArray[np.uint8]
    cuts: npt.NDArray[np.uint8]

    def of(self, patch: int) -> slice:
        """Return the rows of a patch."""
        begin, (x, y) = int(self.first[patch]), self.sizes[patch].tolist()
        return slice(begin, begin + x * y)

    def grid(self, patch: int) -> Grid:
        """Return the coverage of a patch."""
        rows, shape = self.of(patch), tuple(self.sizes[patch].tolist())
        return Grid(
            pitch_m=float(self.pitches[patch]),
            origin=self.origins[patch],
            filled=(self.sums[rows, 3] > 0.0).reshape(shape),
            rim=self.rim[rows].reshape(shape),
            corner=self.corner[rows].reshape(shape),
            cuts=self.cuts[rows].reshape(*shape, 3),
        )


def fit_patches(groups: PatchPoints, config: ModelsConfig, viewpoint: Array) -> list[Plane | None]:
    """Return a Plane or Surface for every group, in order; None for multi-valued ones."""
    number, by_paper = len(groups.thickness), is_paper(config)
    a = config.voxel_size_m
    means, frames = np.empty((number, 3)), np.empty((number, 3, 3))
    covariances, curved = np.empty((number, 3, 3)), np.empty(number, np.bool_)
    thickness = groups.thickness
    if groups.curved is not None:
        thickness = np.where(groups.curved, 0.0, np.inf)
    rules = (thickness, SURFACE_PITCH_VOXELS * a, not by_paper, not by_paper)
    describe_patches(
        groups.points,
        groups.starts,
        groups.normals,
        viewpoint,
        rules,
        means,
        covariances,
        frames,
        curved,
    )
    local = np.empty_like(groups.points)
    plane_pitch = PAPER_PLANE_PITCH_VOXELS if by_paper else config.plane_pitch_voxels
    pitches = np.where(curved, SURFACE_PITCH_VOXELS, plane_pitch) * a
    cells = cells_of(groups, (means, frames, pitches, local), a, snapped=not by_paper)
    found: list[Plane | None] = []
    for k in range(number):
        points = local[groups.starts[k] : groups.starts[k + 1]]
        plane = Plane(
            id=len(found),
            num_points=len(points),
            mean=means[k],
            covariance=covariances[k],
            R_patch_map=frames[k],
            rms_m=rms_across(covariances[k], frames[k, 2], len(points)),
            grid=cells.grid(k),
        )
        far_m = max(FAR_VOXELS * a, FAR_THICKNESS * float(groups.thickness[k]))
        found.append(surface_of(plane, cells, points, config, far_m) if curved[k] else plane)
    return found


def cells_of(
    groups: PatchPoints, frames: tuple[Array, Array, Array, Array], a: float, *, snapped: bool
) -> Cells:
    """Return the cells of all patches; frames: means, rotations, pitches, local coordinates."""
    means, rotations, pitches, local = frames
    origins, sizes = np.empty((len(means), 2)), np.empty((len(means), 2), np.int64)
    place_grids(
        groups.points, groups.starts, means, rotations, pitches, snapped, local, origins, sizes
    )
    ends = np.cumsum(sizes.prod(axis=1))
    total = int(ends[-1]) if len(ends) else 0
    cells = Cells(
        pitches=pitches,
        origins=origins,
        sizes=sizes,
        first=ends - sizes.prod(axis=1),
        sums=np.zeros((total, 4)),
        rim=np.zeros(total, np.bool_),
        corner=np.zeros(total, np.uint8),
        cuts=np.zeros((total, 3), np.uint8),
    )
    fill_cells(
        local,
        groups.starts,
        pitches,
        origins,
        sizes,
        cells.first,
        cells.sums,
        cells.rim,
        cells.corner,
        cells.cuts,
        MARGIN_VOXELS * a,
    )
    return cells


def surface_of(
    plane: Plane, cells: Cells, points: Array, config: ModelsConfig, far_m: float
) -> Surface | None:
    """Return the surface of (n, 3) points in a frame; None if it is multi-valued."""
    sums = cells.sums[cells.of(plane.id)]
    used = sums[:, 3] > 0.0
    means = np.zeros((len(sums), 3))
    means[used] = sums[used, :3] / sums[used, 3:]
    grid = plane.grid
    heights = means[:, 2].reshape(grid.filled.shape)
    start = initial_field(grid.pitch_m, grid.origin, heights, grid.filled, config.degree)
    spline = fitted(start, means[used], sums[used, 3], config)
    error = points[:, 2] - spline.heights(points[:, :2])
    if np.mean(np.abs(error) > far_m) > FAR_SHARE:
        return None
    return Surface(
        id=plane.id,
        num_points=plane.num_points,
        mean=plane.mean,
        covariance=plane.covariance,
        R_patch_map=plane.R_patch_map,
        rms_m=float(np.sqrt(np.mean(error**2))),
        grid=grid,
        spline=spline,
    )


def rms_across(covariance: Array, normal: Array, number: int) -> float:
    """Return the root mean square distance of points from their mean along a direction."""
    variance = max(float(normal @ covariance @ normal), 0.0)
    return math.sqrt(variance * (number - 1) / number)


def fitted(start: HeightField, means: Array, number: Array, config: ModelsConfig) -> HeightField:
    """Return the spline that fits the (C, 3) means of cells with (C,) points."""
    if is_paper(config) or config.solver == 'lsqr':
        return fit_lsqr(start, means[:, :2], means[:, 2])
    return fit_pspline(start, means[:, :2], means[:, 2], number, config.smoothing)
