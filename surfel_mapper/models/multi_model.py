# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes, surfaces and Gaussians of a cloud, and clouds sampled from them.

A patch has a frame: R_patch_map rotates offsets from its mean to x, y and z, with z towards the
viewpoint.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_real
from surfel_mapper.models.bspline import HeightField
from surfel_mapper.models.evaluation import compare, Evaluation
from surfel_mapper.models.grid import Grid

Array = npt.NDArray[np.float64]

PATCH_BYTES = 4 + 1 + 8 + 24 + 16 + 24 + 4 + 12
"""Id, kind, number of points, mean, rotation, covariance, rms and viewing direction."""

GAUSSIAN_BYTES = 4 + 8 + 12 + 24 + 4
"""Id, number of points, mean, covariance and weight."""

SIGMAS = 3.0
"""Samples of a Gaussian beyond this number of sigmas are drawn again."""

SAMPLES_PER_VOXEL = 2.0
"""
A Gaussian has at most this number of samples a voxel along each axis of its box of SIGMAS, plus
one: 88 if it fills one voxel evenly. A thinned cloud, one point a voxel, has fewer points.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
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

    @property
    def size_bytes(self) -> int:
        """Bytes when packed."""
        return PATCH_BYTES + self.grid.size_bytes


@dataclass(frozen=True, slots=True, eq=False)
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

    @property
    def size_bytes(self) -> int:
        """Bytes when packed; control points as float32, and two degrees."""
        return PATCH_BYTES + self.grid.size_bytes + 2 + 4 * self.spline.control.size


@dataclass(frozen=True, slots=True, eq=False)
class Gaussians:
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

    @property
    def size_bytes(self) -> int:
        """Bytes when packed."""
        return GAUSSIAN_BYTES * len(self)


@dataclass(frozen=True, slots=True, eq=False)
class MultiModel:
    """
    Planes, surfaces and Gaussians of one cloud.

    Attributes
    ----------
    planes : list of Plane
    surfaces : list of Surface
    gaussians : Gaussians
        Together they hold every point once.
    labels : (N,) int32
        The id of the primitive of each given point; -1 if the point is not finite.
    voxel_size_m : float
        Edge of the voxels for thinning.
    num_thinned : int
        Points of the thinned cloud.
    milliseconds : dict of str to float
        Duration of each stage.
    noise : (float, float)
        Noise that was used, sigma = noise[0] + noise[1] range^2, m.

    """

    planes: list[Plane]
    surfaces: list[Surface]
    gaussians: Gaussians
    labels: npt.NDArray[np.int32]
    voxel_size_m: float
    num_thinned: int
    milliseconds: dict[str, float] = field(default_factory=dict)
    noise: tuple[float, float] = (0.0, 0.0)

    @property
    def patches(self) -> list[Plane]:
        """Planes, then surfaces."""
        return [*self.planes, *self.surfaces]

    @property
    def size_bytes(self) -> int:
        """Bytes of all primitives when packed, without the labels."""
        return sum(patch.size_bytes for patch in self.patches) + self.gaussians.size_bytes

    def translated(self, offset: npt.ArrayLike) -> MultiModel:
        """Return the models moved by an offset (3,), m; labels and figures stay."""
        by = np.asarray(offset, np.float64)
        gaussians = replace(self.gaussians, mean=self.gaussians.mean + by)
        return replace(
            self,
            planes=[replace(plane, mean=plane.mean + by) for plane in self.planes],
            surfaces=[replace(surface, mean=surface.mean + by) for surface in self.surfaces],
            gaussians=gaussians,
        )

    def resample(self, step_m: float | None = None, seed: int = 0) -> Array:
        """
        Return a cloud (M, 3) sampled from the models, m.

        Its size is bounded by the volume of the models, however many points a map has: see
        Gaussians.sample_counts.

        Parameters
        ----------
        step_m : float, optional
            Spacing of points on planes and surfaces; the voxel size if omitted.
        seed : int
            Seed of the samples of Gaussians.

        Raises
        ------
        ValueError
            If the spacing is not positive and finite.

        """
        step_m = self.voxel_size_m if step_m is None else as_real('step_m', step_m)
        if not 0.0 < step_m < math.inf:
            raise ValueError(f'step_m: {step_m:g}, expected a positive distance, m')
        samples = [patch.samples(step_m) for patch in self.patches]
        counts = self.gaussians.sample_counts(self.voxel_size_m)
        return np.concatenate([*samples, self.gaussians.samples(seed, counts)])

    def evaluate(self, reference: npt.NDArray[Any], seed: int = 0) -> Evaluation:
        """
        Compare samples of the models with a cloud.

        The expected precision is that of one sample for each point of a Gaussian, as samples that
        stand for several have their weight. Completeness is that of the samples.

        Parameters
        ----------
        reference : (..., 3) float, m
            The cloud as it came from the sensor, not thinned; points that are not finite are left
            out.
        seed : int
            Seed of the samples of Gaussians.

        """
        samples, points = self.resample(seed=seed), self.gaussians.num_points
        counts = self.gaussians.sample_counts(self.voxel_size_m)
        weight = np.ones(len(samples))
        weight[len(samples) - counts.sum() :] = np.repeat(points / np.maximum(counts, 1), counts)
        return compare(
            samples,
            reference,
            weight=weight,
            near_m=self.voxel_size_m,
            counts=(len(self.planes), len(self.surfaces), len(self.gaussians)),
            size_bytes=self.size_bytes,
        )


def evaluate(model: MultiModel, reference: npt.NDArray[Any], seed: int = 0) -> Evaluation:
    """Compare samples of models with a cloud; see MultiModel.evaluate."""
    return model.evaluate(reference, seed)
