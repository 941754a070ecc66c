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
from surfel_mapper.models.bspline import fit_cells, HeightField
from surfel_mapper.models.frames import eigen, means_and_scatters, oriented
from surfel_mapper.models.grid import Cells
from surfel_mapper.models.kernels.coverage import place_points
from surfel_mapper.models.multi_model import Plane, Surface
from surfel_mapper.models.segmentation import is_paper

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

PAPER_PLANE_PITCH_VOXELS = 5.0
"""Edge of the cells of planes in profile paper."""
SURFACE_PITCH_VOXELS = 3.0
"""Edge of the cells of surfaces."""
LEAST_CELLS = 8
"""The curvature of a patch is not tested with fewer cells."""

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
    """
    Return a Plane or Surface for every group, in order; None for multi-valued ones.

    Their ids are 0, 1, 2, ..., first those of the planes.
    """
    number, by_paper = len(groups.thickness), is_paper(config)
    a = config.voxel_size_m
    thickness, bent = groups.thickness, not by_paper
    if groups.curved is not None:
        thickness, bent = np.where(groups.curved, 0.0, np.inf), False
    rules = thickness, SURFACE_PITCH_VOXELS * a, bent, not by_paper
    means, covariances, frames, curved = described(groups, viewpoint, rules)
    plane_pitch = PAPER_PLANE_PITCH_VOXELS if by_paper else config.plane_pitch_voxels
    pitches = np.where(curved, SURFACE_PITCH_VOXELS, plane_pitch) * a
    placed = means, frames, pitches
    cells = cells_of(groups, placed, MARGIN_VOXELS * a, snapped=not by_paper)
    smoothing = None if by_paper else config.smoothing
    splines = splines_of(cells, np.flatnonzero(curved), config.degree, smoothing)
    numbers, grids = np.diff(groups.starts), cells.grids()
    rms_m = rms_across(covariances, frames[:, 2], numbers)
    patches: list[Plane | None] = []
    next_ids = [0, number - int(np.count_nonzero(curved))]
    for k, kind in enumerate(curved.astype(np.int64).tolist()):
        plane = Plane(
            id=next_ids[kind],
            num_points=int(numbers[k]),
            mean=means[k],
            covariance=covariances[k],
            R_patch_map=frames[k],
            rms_m=float(rms_m[k]),
            grid=grids[k],
        )
        far_m = max(FAR_VOXELS * a, FAR_THICKNESS * float(groups.thickness[k]))
        patches.append(surface_of(plane, *splines[k], far_m) if kind else plane)
        next_ids[kind] += patches[-1] is not None
    return patches


def described(
    groups: PatchPoints, viewpoint: Array, rules: tuple[Array, float, bool, bool]
) -> tuple[Array, Array, Array, npt.NDArray[np.bool_]]:
    """
    Return mean (K, 3), covariance and frame (K, 3, 3) of every patch, and which are curved.

    Parameters
    ----------
    groups : PatchPoints
        The points.
    viewpoint : (3,) float64, m
        Normals face it.
    rules : tuple
        Thickness (K,) of a plane, m; edge of the cells for the test of curvature, m; whether it
        is tested; whether the z of a surface is its mean normal.

    """
    thickness, pitch_m, bent, mean_normal = rules
    starts, weights = groups.starts, np.ones(len(groups.points))
    _, means, scatters = means_and_scatters(groups.points, weights, starts)
    covariances = scatters / np.maximum(np.diff(starts) - 1, 1)[:, None, None]
    values, axes = eigen(covariances)
    frames = oriented(axes, viewpoint - means)
    turned = aligned(frames, groups.normals)
    thick = 6.0 * np.sqrt(values[:, 0])
    curved: npt.NDArray[np.bool_] = thick >= thickness
    for k in np.flatnonzero(curved) if bent else ():  # what bends by a thickness is thicker
        local = (groups.points[starts[k] : starts[k + 1]] - means[k]) @ turned[k].T
        bend_m = bend_height(local, pitch_m)
        if bend_m >= 0.0:
            curved[k] = bend_m > thickness[k] or thick[k] >= 2.0 * thickness[k]
    if mean_normal:
        frames[curved] = turned[curved]
    return means, covariances, frames, curved


def aligned(frames: Array, normals: Array) -> Array:
    """Return frames (K, 3, 3) with other normals (K, 3), turned so that x changes least."""
    x = frames[:, 0] - np.einsum('ij,ij->i', frames[:, 0], normals)[:, None] * normals
    length = np.linalg.norm(x, axis=1)
    turned = frames.copy()
    kept = np.flatnonzero(length >= 1e-6)
    x = x[kept] / length[kept, None]
    turned[kept] = np.stack([x, np.cross(normals[kept], x), normals[kept]], axis=1)
    return turned


def bend_height(local: Array, pitch_m: float) -> float:
    """
    Return the 5th to 95th percentile range of the curved part of points (n, 3) in a frame, m.

    0 if a quadric does not fit twice as well as a plane; -1 if there are too few cells.
    """
    x, y = ((local[:, :2] - local[:, :2].min(axis=0)) / pitch_m).astype(np.int64).T
    cell = x * (y.max() + 1) + y
    number = np.bincount(cell)
    used = np.flatnonzero(number)
    if len(used) < LEAST_CELLS:
        return -1.0
    scale = float(np.abs(local[:, :2]).max())
    weight: Array = number[used].astype(np.float64)
    x, y, z = (np.bincount(cell, values)[used] / (weight * scale) for values in local.T)
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    plane, quadric = (weighted_fit(basis[:, :terms], z, weight) for terms in (3, 6))
    errors = [float(weight @ (z - basis[:, : len(fit)] @ fit) ** 2) for fit in (plane, quadric)]
    if not errors[1] < 0.25 * errors[0]:  # squares: half of the root mean square
        return 0.0
    rise, last = np.sort(basis[:, 3:] @ quadric[3:]), len(used) - 1
    return scale * float(rise[int(0.95 * last)] - rise[int(0.05 * last)])


def weighted_fit(basis: Array, z: Array, weight: Array) -> Array:
    """Return the coefficients (T,) of a basis (n, T) that fit values best, by a small ridge."""
    matrix, right = basis.T @ (basis * weight[:, None]), basis.T @ (weight * z)
    matrix += 1e-12 * weight.sum() * np.eye(basis.shape[1])
    return np.asarray(np.linalg.solve(matrix, right), np.float64)


def cells_of(
    groups: PatchPoints,
    frames: tuple[Array, Array, Array],
    margin_m: float | None,
    *,
    snapped: bool,
) -> Cells:
    """
    Return the cells of all patches.

    Parameters
    ----------
    groups : PatchPoints
        The points.
    frames : tuple
        Origins (K, 3) and axes (K, 3, 3) of the frames, edges of the cells (K,), m.
    margin_m : float or None
        Distance between the boundary and the points, m; None for no boundary.
    snapped : bool
        Whether grids start at multiples of the edges of their cells.

    """
    origins, axes, pitches = frames
    patch = np.repeat(np.arange(len(origins)), np.diff(groups.starts))
    local = np.empty((len(patch), 3))
    place_points(groups.points, groups.starts, origins, axes, local)
    return Cells.around(local, patch, pitches, margin_m, snapped=snapped)


def splines_of(
    cells: Cells, chosen: Indices, degree: int, smoothing: float | None
) -> dict[int, tuple[HeightField, Array]]:
    """Return the splines of chosen patches, and the heights of their points above these."""
    return {k: fit_cells(cells, k, degree, smoothing) for k in chosen.tolist()}


def surface_of(plane: Plane, spline: HeightField, error: Array, far_m: float) -> Surface | None:
    """Return the surface of points with errors (n,), m; None if it is multi-valued."""
    if np.mean(np.abs(error) > far_m) > FAR_SHARE:
        return None
    return plane.bent(spline, float(np.sqrt(np.mean(error**2))))


def rms_across(covariances: Array, normals: Array, numbers: Indices) -> Array:
    """Return the root mean square distances (K,) of points from their means along directions."""
    variance = np.einsum('ki,kij,kj->k', normals, covariances, normals)
    rms_m: Array = np.sqrt(np.maximum(variance, 0.0) * (numbers - 1) / numbers)
    return rms_m
