# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes, surfaces and Gaussians, and points sampled from them.

A patch has a frame: R_patch_map rotates offsets from its mean to x, y and z, with z towards the
viewpoint.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import Record
from surfel_mapper.models.bspline import HeightField
from surfel_mapper.models.grid import Grid

Array = npt.NDArray[np.float64]

SIGMAS = 3.0
"""Samples of a Gaussian beyond this number of sigmas are drawn again."""

SAMPLES_PER_VOXEL = 2.0
"""
A Gaussian has at most this number of samples a voxel along each axis of its box of SIGMAS, plus
one: 88 if it fills one voxel evenly. A thinned cloud, one point a voxel, has fewer points.
"""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Plane(Record):
    """
    A bounded piece of a plane.

    Attributes
    ----------
    id : int
        Its label.
    num_points : int
        Points of the thinned cloud.
    mean : (3,) float64, m
        Mean of the points.
    covariance : (3, 3) float64, m^2
        Covariance of the points.
    R_patch_map : (3, 3) float64
        Rows x, y and normal; right-handed.
    rms_m : float
        Root mean square distance of the points along the normal.
    grid : Grid
        Covered area.

    """

    id: int
    num_points: int
    mean: Array
    covariance: Array
    R_patch_map: Array
    rms_m: float
    grid: Grid

    @property
    def normal(self) -> Array:
        """Unit normal, (3,), towards the viewpoint; the mean direction for a surface."""
        normal: Array = self.R_patch_map[2]
        return normal

    @property
    def offset_m(self) -> float:
        """Offset d of the plane normal . p + d = 0."""
        return -float(self.normal @ self.mean)

    def heights(self, xy: Array) -> Array:
        """Return z at (M, 2) locations in the frame, m."""
        return np.zeros(len(xy))

    def to_local(self, points: Array) -> Array:
        """Transform (M, 3) points to the frame of the patch."""
        local: Array = (points - self.mean) @ self.R_patch_map.T
        return local

    def lifted(self, xy: Array) -> Array:
        """Return the points (M, 3) of the patch at (M, 2) locations in its frame."""
        local = np.column_stack([xy, self.heights(xy)])
        points: Array = local @ self.R_patch_map + self.mean
        return points

    def samples(self, step_m: float) -> Array:
        """Return points (M, 3) on the patch at about this spacing."""
        return self.lifted(self.grid.samples(step_m))

    def bent(self, spline: HeightField, rms_m: float) -> Surface:
        """Return the surface of a spline over the plane."""
        values = {field.name: getattr(self, field.name) for field in fields(Plane)}
        return Surface(**{**values, 'rms_m': rms_m}, spline=spline)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Surface(Plane):
    """A bounded piece of a curved surface: a height field over its frame."""

    spline: HeightField

    def heights(self, xy: Array) -> Array:
        """Return z at (M, 2) locations in the frame, m."""
        return self.spline.heights(xy)

    def normals(self, xy: Array) -> Array:
        """Return the unit normals, (M, 3), at (M, 2) locations in the frame."""
        slopes = self.spline.slopes(xy)
        local = np.column_stack([-slopes, np.ones(len(xy))])
        normals: Array = local @ self.R_patch_map
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return normals


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Gaussians(Record):
    """
    Gaussians of the points on neither plane nor surface, G rows.

    Attributes
    ----------
    id : (G,) int64
        Their labels.
    num_points : (G,) int64
        Points of the thinned cloud; in a map, all points.
    mean : (G, 3) float64, m
    covariance : (G, 3, 3) float64, m^2

    """

    id: npt.NDArray[np.int64]
    num_points: npt.NDArray[np.int64]
    mean: Array
    covariance: Array

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.id)

    def sample_counts(self, voxel_size_m: float) -> npt.NDArray[np.int64]:
        """
        Return how many samples stand for the points of each, (G,).

        One a point, see SAMPLES_PER_VOXEL for the most: voxels of a map without a window gain
        points with every scan. A sample of a Gaussian with more points has a larger weight,
        num_points by this number.

        Parameters
        ----------
        voxel_size_m : float
            Edge of the voxels, m.

        """
        sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(self.covariance), 0.0))
        per_axis = 1.0 + SAMPLES_PER_VOXEL / voxel_size_m * 2.0 * SIGMAS * sigma
        most = np.minimum(per_axis.prod(axis=1), np.iinfo(np.int32).max)
        counts: npt.NDArray[np.int64] = np.minimum(self.num_points, most.astype(np.int64))
        return counts

    def samples(self, seed: int = 0, counts: npt.NDArray[np.int64] | None = None) -> Array:
        """
        Draw points of each, (M, 3), none farther out than SIGMAS.

        Without that limit the tails alone make the samples a tenth less precise.

        Parameters
        ----------
        seed : int
            Seed of the samples.
        counts : (G,) int64, optional
            Number of points of each; num_points if omitted.

        """
        counts = self.num_points if counts is None else counts
        values, vectors = np.linalg.eigh(self.covariance)
        scale = np.repeat(np.sqrt(np.maximum(values, 0.0)), counts, axis=0)
        rng = np.random.default_rng(seed)
        drawn = rng.standard_normal(scale.shape)
        while (far := np.flatnonzero((drawn**2).sum(axis=1) > SIGMAS**2)).size:
            drawn[far] = rng.standard_normal((len(far), 3))
        turned = np.einsum('nij,nj->ni', np.repeat(vectors, counts, axis=0), drawn * scale)
        points: Array = turned + np.repeat(self.mean, counts, axis=0)
        return points
