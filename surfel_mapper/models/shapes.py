# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Shapes of primitives for drawing and export: outlines, triangles, boxes, ellipsoids.

An outline takes a quarter of a millisecond, that of a large floor several, and there are hundreds:
Shapes caches them by version.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.multi_model import Gaussians, MultiModel, Plane, Surface
from surfel_mapper.models.outlines import areas, local_outline, triangles, triangulated

Array = npt.NDArray[np.float64]

SIGMAS = 2.0
"""Half axes of an ellipsoid, in standard deviations."""

GOLDEN = 0.5 * (1.0 + 5.0**0.5)
"""The golden ratio."""

CORNERS = np.array(
    [
        np.roll([0.0, x, GOLDEN * y], turn)
        for turn in range(3)
        for x in (-1.0, 1.0)
        for y in (-1.0, 1.0)
    ]
) / np.hypot(1.0, GOLDEN)
"""Corners of an icosahedron in the unit sphere, (12, 3)."""


def faces_of_icosahedron() -> npt.NDArray[np.int64]:
    """Return the 20 faces (20, 3), facing out: triples of mutually nearest corners."""
    near = np.linalg.norm(CORNERS[:, None] - CORNERS, axis=2) < 1.1
    return np.array(
        [
            (a, b, c)
            for a, b, c in np.ndindex(12, 12, 12)
            if a < b
            and a < c
            and near[a, b]
            and near[b, c]
            and near[a, c]
            and b != c
            and np.linalg.det(CORNERS[[a, b, c]]) > 0.0
        ]
    )


FACES = faces_of_icosahedron()


@dataclass(frozen=True, slots=True, eq=False)
class PatchShape:
    """
    Shape of a plane or surface.

    Attributes
    ----------
    patch : Plane
        The patch.
    rings : list of (M, 3) float64, m
        Its outline; see outlines.outline.
    vertices : (V, 3) float64, m
    faces : (T, 3) int64
        Its triangles, facing along the normal; those of a plane cover exactly the inside of the
        rings.
    low, high : (3,) float64, m
        Bounding box in the frame of the patch.
    area_m2 : float
        Area of the triangles.

    """

    patch: Plane
    rings: list[Array]
    vertices: Array
    faces: npt.NDArray[np.int64]
    low: Array
    high: Array
    area_m2: float

    @property
    def corners(self) -> Array:
        """The corners of every triangle, (T, 3, 3) m."""
        return self.vertices[self.faces]

    @property
    def is_curved(self) -> bool:
        """Whether it is a surface."""
        return isinstance(self.patch, Surface)

    @property
    def centre(self) -> Array:
        """Middle of the box, (3,) m."""
        centre: Array = 0.5 * (self.low + self.high) @ self.patch.R_patch_map + self.patch.mean
        return centre


def shape_of(patch: Plane) -> PatchShape:
    """Return the shape of a patch."""
    local_rings = local_outline(patch)
    if isinstance(patch, Surface):
        vertices, faces = triangles(patch)
    else:
        xy, faces = indexed(triangulated(local_rings))
        vertices = patch.lifted(xy)
    rings = [patch.lifted(rim) for rim in local_rings]
    local = np.concatenate([patch.to_local(vertices), *map(patch.to_local, rings)])
    low, high = local.min(axis=0), local.max(axis=0)
    if not isinstance(patch, Surface):
        low[2] = high[2] = 0.0  # exact up to rounding
    return PatchShape(
        patch=patch,
        rings=rings,
        vertices=vertices,
        faces=faces,
        low=low,
        high=high,
        area_m2=float(areas(vertices[faces]).sum()),
    )


def indexed(triangles: Array) -> tuple[Array, npt.NDArray[np.int64]]:
    """Return the distinct corners of triangles (T, 3, 2), (V, 2) by x and y, and faces (T, 3)."""
    corners = triangles.reshape(-1, 2)
    order = np.lexsort(corners.T[::-1])
    ordered = corners[order]
    is_new = np.ones(len(ordered), np.bool_)
    is_new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    number = np.empty(len(ordered), np.int64)
    number[order] = np.cumsum(is_new) - 1
    return ordered[is_new], number.reshape(-1, 3)


class Shapes:
    """Cache of the shapes of patches, by id and version."""

    def __init__(self) -> None:
        self._kept: dict[int, tuple[int, PatchShape]] = {}

    def make(
        self, model: MultiModel, versions: Mapping[int, int], at_most: int | None = None
    ) -> bool:
        """Compute up to `at_most` missing shapes; return whether all are cached."""
        missing = [
            patch
            for patch in model.patches
            if self._kept.get(patch.id, (0,))[0] != versions[patch.id]
        ]
        made = missing[:at_most]
        for patch in made:
            self._kept[patch.id] = versions[patch.id], shape_of(patch)
        return len(made) == len(missing)

    def of(self, model: MultiModel, versions: Mapping[int, int]) -> list[PatchShape]:
        """Return the shapes of planes, then surfaces, whose versions are given by id."""
        self.make(model, versions)
        self._kept = {patch.id: self._kept[patch.id] for patch in model.patches}
        return [shape for _, shape in self._kept.values()]


def ellipsoid_frames(gaussians: Gaussians) -> tuple[Array, Array]:
    """Return axes (G, 3, 3) as columns, right-handed, and half axes (G, 3), m, ascending."""
    values, axes = np.linalg.eigh(gaussians.covariance)
    axes[np.linalg.det(axes) < 0.0, :, 2] *= -1.0
    return axes, SIGMAS * np.sqrt(np.maximum(values, 0.0))


def ellipsoid_corners(gaussians: Gaussians) -> Array:
    """Return points (G, 12, 3) on the ellipsoids of Gaussians, m: the corners of FACES."""
    R_map_axes, half = ellipsoid_frames(gaussians)
    corners: Array = CORNERS * half[:, None] @ np.swapaxes(R_map_axes, 1, 2)
    return corners + gaussians.mean[:, None]
