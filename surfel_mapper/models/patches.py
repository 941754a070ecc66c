# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Fit planes and surfaces to groups of points: frames, coverage, splines.

All patches of a cloud go through each kernel together; one call for each would take longer than
the work.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models.bspline import (
    fit_grids,
    fit_lsqr,
    fit_pspline,
    HeightField,
    initial_field,
    is_small,
)
from surfel_mapper.models.grid import Cells
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


def fit_patches(groups: PatchPoints, config: ModelsConfig, viewpoint: Array) -> list[Plane | None]:
    """Return a Plane or Surface for every group, in order; None for multi-valued ones."""
    number, by_paper = len(groups.thickness), is_paper(config)
    a = config.voxel_size_m
    means, frames = np.empty((number, 3)), np.empty((number, 3, 3))
    covariances, curved = np.empty((number, 3, 3)), np.empty(number, np.bool_)
    thickness, bent = groups.thickness, not by_paper
    if groups.curved is not None:
        thickness, bent = np.where(groups.curved, 0.0, np.inf), False
    rules = (thickness, SURFACE_PITCH_VOXELS * a, bent, not by_paper)
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
    splines = splines_of(cells, np.flatnonzero(curved), config)
    numbers, grids = np.diff(groups.starts), cells.grids()
    rms_m = rms_across(covariances, frames[:, 2], numbers)
    found: list[Plane | None] = []
    for k in range(number):
        plane = Plane(
            id=k,
            num_points=int(numbers[k]),
            mean=means[k],
            covariance=covariances[k],
            R_patch_map=frames[k],
            rms_m=float(rms_m[k]),
            grid=grids[k],
        )
        far_m = max(FAR_VOXELS * a, FAR_THICKNESS * float(groups.thickness[k]))
        points = local[groups.starts[k] : groups.starts[k + 1]]
        found.append(surface_of(plane, splines[k], points, far_m) if curved[k] else plane)
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


def splines_of(cells: Cells, curved: Indices, config: ModelsConfig) -> dict[int, HeightField]:
    """Return the splines of the curved patches."""
    by_lsqr = is_paper(config) or config.solver == 'lsqr'
    together = is_small(cells.sizes[curved], config.degree) & (not by_lsqr)
    chosen = curved[together]
    fields, _ = fit_grids(cells, chosen, config.degree, config.smoothing)
    found = dict(zip(chosen.tolist(), fields, strict=True))
    for k in curved[~together].tolist():
        sums, shape = cells.sums[cells.of(k)], cells.sizes[k]
        used = sums[:, 3] > 0.0
        means = np.zeros((len(sums), 3))
        means[used] = sums[used, :3] / sums[used, 3:]
        heights, filled = means[:, 2].reshape(shape), used.reshape(shape)
        pitch_m = float(cells.pitches[k])
        start = initial_field(pitch_m, cells.origins[k], heights, filled, config.degree)
        xy, z = means[used, :2], means[used, 2]
        found[k] = (
            fit_lsqr(start, xy, z)
            if by_lsqr
            else fit_pspline(start, xy, z, sums[used, 3], config.smoothing)
        )
    return found


def surface_of(plane: Plane, spline: HeightField, points: Array, far_m: float) -> Surface | None:
    """Return the surface of (n, 3) points in a frame; None if it is multi-valued."""
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
        grid=plane.grid,
        spline=spline,
    )


def rms_across(covariances: Array, normals: Array, numbers: Indices) -> Array:
    """Return the root mean square distances (K,) of points from their means along directions."""
    variance = np.einsum('ki,kij,kj->k', normals, covariances, normals)
    found: Array = np.sqrt(np.maximum(variance, 0.0) * (numbers - 1) / numbers)
    return found
