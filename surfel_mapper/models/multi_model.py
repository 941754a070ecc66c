# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The result: planes, surfaces and Gaussians that stand for a cloud, and clouds made from them.

A patch has a frame: R_patch_map takes offsets from its mean to x, y and z across it, z towards
the viewpoint.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.bspline import HeightField
from surfel_mapper.models.evaluation import evaluate, Evaluation
from surfel_mapper.models.grid import Grid

Array = npt.NDArray[np.float64]

PATCH_BYTES = 4 + 1 + 8 + 24 + 16 + 24 + 4 + 12
"""Number, kind, points, mean, rotation, covariance, error and direction of view."""

GAUSSIAN_BYTES = 4 + 8 + 12 + 24 + 4
"""Number, points, mean, covariance and weight."""

SIGMAS = 3.0
"""Samples of a Gaussian farther out are drawn again."""


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """
    A bounded piece of a plane.

    Attributes
    ----------
    id : int
        What labels call it.
    num_points : int
        Of the thinned cloud.
    mean : (3,) float64, m
        Of the points.
    covariance : (3, 3) float64, m^2
        Of the points.
    R_patch_map : (3, 3) float64
        Rows x, y and normal; right-handed.
    rms_m : float
        Root mean square distance of the points along the normal.
    grid : Grid
        What is covered.

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
        """Number d of the plane normal . p + d = 0."""
        return -float(self.normal @ self.mean)

    def heights(self, xy: Array) -> Array:
        """Return z of (M, 2) places in the frame, m."""
        return np.zeros(len(xy))

    def to_local(self, points: Array) -> Array:
        """Take (M, 3) points to the frame of the patch."""
        local: Array = (points - self.mean) @ self.R_patch_map.T
        return local

    def lifted(self, xy: Array) -> Array:
        """Return the points (M, 3) of the patch at (M, 2) places in its frame."""
        local = np.column_stack([xy, self.heights(xy)])
        points: Array = local @ self.R_patch_map + self.mean
        return points

    def samples(self, step_m: float) -> Array:
        """Return points (M, 3) on the patch at about this distance."""
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
        """Return z of (M, 2) places in the frame, m."""
        return self.spline.heights(xy)

    def normals(self, xy: Array) -> Array:
        """Return the unit normals, (M, 3), at (M, 2) places in the frame."""
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
    What is neither plane nor surface, G rows.

    Attributes
    ----------
    id : (G,) int64
        What labels call them.
    num_points : (G,) int64
        Of the thinned cloud.
    mean : (G, 3) float64, m
    covariance : (G, 3, 3) float64, m^2

    """

    id: npt.NDArray[np.int64]
    num_points: npt.NDArray[np.int64]
    mean: Array
    covariance: Array

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.id)

    def samples(self, seed: int = 0, sigmas: float = SIGMAS) -> Array:
        """
        Draw as many points (M, 3) as they were made of, none farther out than some sigmas.

        Without that limit the tails alone make the samples a tenth less precise.
        """
        values, vectors = np.linalg.eigh(self.covariance)
        scale = np.repeat(np.sqrt(np.maximum(values, 0.0)), self.num_points, axis=0)
        rng = np.random.default_rng(seed)
        drawn = rng.standard_normal(scale.shape)
        while (far := np.flatnonzero((drawn**2).sum(axis=1) > sigmas**2)).size:
            drawn[far] = rng.standard_normal((len(far), 3))
        turned = np.einsum(
            'nij,nj->ni', np.repeat(vectors, self.num_points, axis=0), drawn * scale
        )
        points: Array = turned + np.repeat(self.mean, self.num_points, axis=0)
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
        The id of what each given point belongs to; -1 for points that are not finite.
    voxel_size_m : float
        What the cloud was thinned with.
    num_thinned : int
        Points of the thinned cloud.
    milliseconds : dict of str to float
        What each stage took.

    """

    planes: list[Plane]
    surfaces: list[Surface]
    gaussians: Gaussians
    labels: npt.NDArray[np.int32]
    voxel_size_m: float
    num_thinned: int
    milliseconds: dict[str, float] = field(default_factory=dict)

    @property
    def patches(self) -> list[Plane]:
        """Planes, then surfaces."""
        return [*self.planes, *self.surfaces]

    @property
    def size_bytes(self) -> int:
        """Bytes of all primitives when packed, without the labels."""
        return sum(patch.size_bytes for patch in self.patches) + self.gaussians.size_bytes

    def resample(self, step_m: float | None = None, seed: int = 0) -> Array:
        """
        Return a cloud (M, 3) that the models stand for, m.

        Parameters
        ----------
        step_m : float, optional
            Distance of points on planes and surfaces; the voxel size without it.
        seed : int
            Of what is drawn from the Gaussians.

        """
        step_m = self.voxel_size_m if step_m is None else step_m
        parts = [patch.samples(step_m) for patch in self.patches]
        return np.concatenate([*parts, self.gaussians.samples(seed)])

    def evaluate(self, reference: npt.NDArray[Any], seed: int = 0) -> Evaluation:
        """Compare what the models generate with a cloud; see models.evaluate."""
        return evaluate(self, reference, seed)
