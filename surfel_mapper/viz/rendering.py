# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The renderer of all pictures: discs shaded by normal, light and depth.

Discs that face away from the viewer are left out, because they would hide the others: the ceiling
of a room from above, its near walls from the side. Images are drawn at twice their size and
reduced, which smooths the rims.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.viz.discs import DrawnDiscs
from surfel_mapper.viz.kernels.painting import blend_colours, draw_depth, shade_hollows

Array = npt.NDArray[np.float64]

EDGE_ON = 0.18
"""Thickness of a disc seen edge-on, relative to its radius."""

CLOSING = 0.15
"""Added to the radius of a disc, relative to the median: closes gaps where voxels cut a wall."""

THINNEST_PX = 0.7
"""Smallest radius of a drawn disc, so that it covers a pixel."""

NEAREST_M = 0.5
"""Distance from the eye below which nothing is drawn, m."""

SPARE = 0.04
"""Empty rim of a view relative to its size."""

STRENGTH = 1.5
"""Darkness of hollows, see ``shade_hollows``."""

FINER = 2
"""Drawn pixels for each pixel of the image along an axis."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """
    A direction of view and the part of it that an image shows.

    Attributes
    ----------
    R_view_map : (3, 3) float64
        Rows: to the right, up, and towards the viewer.
    centre_m : (2,) float64
        The middle of the image, to the right and up.
    width, height : int, px
    px_per_m : float

    """

    R_view_map: Array
    centre_m: Array
    width: int
    height: int
    px_per_m: float
    eye_m: Array | None = None

    @property
    def limits(self) -> tuple[Array, Array]:
        """Return the lower left and the upper right corner of the image, (2,) m each."""
        half = 0.5 * np.array([self.width, self.height]) / self.px_per_m
        return self.centre_m - half, self.centre_m + half

    def projected(self, positions: Array) -> Array:
        """Return positions (K, 3) to the right and up, (K, 2) m."""
        return np.asarray(positions @ self.R_view_map[:2].T)

    def contains(self, positions: Array) -> npt.NDArray[np.bool_]:
        """Return which positions (K, 3) the image shows."""
        low, high = self.limits
        at = self.projected(positions)
        return np.asarray(((at >= low) & (at <= high)).all(axis=1))


def direction(yaw: float, pitch: float) -> Array:
    """
    Return the axes of a view as rows: to the right, up, towards the viewer.

    Parameters
    ----------
    yaw : float, rad
        Direction to the viewer in the plane, from x to y.
    pitch : float, rad
        Height of the viewer; pi / 2 is a plan with y up for a yaw of -pi / 2.

    """
    flat = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    near = np.cos(pitch) * flat + [0.0, 0.0, np.sin(pitch)]
    right = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    return np.stack([right, np.cross(near, right), near])


def fitted(R: Array, low: Array, high: Array, width: int, height: int) -> Camera:
    """Return the camera that shows a rectangle with a rim."""
    px_per_m = (1.0 - 2.0 * SPARE) * min(width / (high - low)[0], height / (high - low)[1])
    return Camera(R, 0.5 * (low + high), width, height, float(px_per_m))


def rendered(
    camera: Camera, discs: DrawnDiscs, colours: npt.NDArray[np.uint8]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """
    Return the image of discs and their depth.

    Parameters
    ----------
    camera : Camera
        The view.
    discs : DrawnDiscs
        K discs in the frame of the map.
    colours : (K, 3) uint8
        Their colours.

    Returns
    -------
    (H, W, 4) float32
        Red, green, blue and opacity, 0 to 1; transparent without a disc.
    (H, W) float32, m
        Depth of the nearest disc along the view; inf without one.

    """
    size = FINER * camera.height, FINER * camera.width
    depth = np.full(size, np.inf, np.float32)
    image, weight = np.zeros((*size, 3), np.float32), np.zeros(size, np.float32)
    rows, facing = facing_discs(camera, discs)
    draw_depth(facing, depth)
    blend_colours(facing, colours[rows].astype(np.float32), depth, image, weight)
    image /= np.maximum(weight, 1e-6)[..., None]
    has_eye = camera.eye_m is not None
    shade_hollows(depth, 1.0 / (FINER * camera.px_per_m), has_eye, STRENGTH, image)
    cover = (weight > 0.0).astype(np.float32)[..., None]
    blocks = (camera.height, FINER, camera.width, FINER, -1)
    image, cover = (values.reshape(blocks).sum(axis=(1, 3)) for values in (image, cover))
    opaque = cover / FINER**2
    rgba = np.concatenate([image / (255.0 * np.maximum(cover, 1.0)), opaque], axis=2)
    return np.clip(rgba, 0.0, 1.0), depth[::FINER, ::FINER]


def facing_discs(camera: Camera, discs: DrawnDiscs) -> tuple[npt.NDArray[np.int64], Array]:
    """Return the rows of the discs that face the viewer, and their form for ``draw_depth``."""
    position, near = discs.position, camera.R_view_map[2]
    if camera.eye_m is not None:
        position = position - camera.eye_m
        near = -position
    facing = (discs.normal * near).sum(axis=1)
    ahead = position @ camera.R_view_map[2] < -NEAREST_M
    rows = np.flatnonzero((facing > 0.0) & (ahead | (camera.eye_m is None)))
    seen = position[rows] @ camera.R_view_map.T
    normal = discs.normal[rows] @ camera.R_view_map.T
    scale = np.full(len(rows), FINER * camera.px_per_m)
    if camera.eye_m is not None:
        scale /= -seen[:, 2]
        normal[:, 2] = facing[rows] / -seen[:, 2]
    normal[:, 2] = np.maximum(normal[:, 2], EDGE_ON)
    normal /= np.sqrt((normal * normal).sum(axis=1))[:, None]
    middle = 0.5 * FINER * np.array([camera.width, camera.height]) - 0.5
    drawn = np.empty((len(rows), 8))
    drawn[:, 0] = middle[0] + (seen[:, 0] - camera.centre_m[0]) * scale
    drawn[:, 1] = middle[1] - (seen[:, 1] - camera.centre_m[1]) * scale
    drawn[:, 2] = -seen[:, 2]
    radius_m = discs.radius_m[rows]
    least = np.median(radius_m) if len(rows) else 0.0
    larger = radius_m + CLOSING * np.minimum(radius_m, least)
    drawn[:, 3] = np.maximum(larger, FINER * THINNEST_PX / scale)
    drawn[:, 4] = scale
    drawn[:, 5:] = normal
    return rows, drawn


def round_length(most: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20, ... that is at most a length."""
    power = 10.0 ** np.floor(np.log10(most))
    digits = [step for step in (1, 2, 5) if step * power <= most * (1.0 + 1e-9)]
    return float(power * digits[-1])
