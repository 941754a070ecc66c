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
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.viz.discs import DrawnDiscs
from surfel_mapper.viz.kernels import painting

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]

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
"""Darkness of hollows, see ``hollow_shade``."""

HOLLOW_STEPS = (1, 2, 4)
"""Distances at which a pixel is compared with its neighbours, px."""

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
) -> tuple[Image, Image]:
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
    depth: Image = np.full(size, np.inf, np.float32)
    image: Image = np.zeros((*size, 4), np.float32)
    rows, facing = facing_discs(camera, discs)
    opaque = np.ones(len(rows), np.uint8)
    painting.paint(facing, np.column_stack([colours[rows], opaque]).astype('f4'), depth, image)
    image /= np.maximum(image[..., 3:], 1e-6)  # the last channel becomes 1 or 0
    image = np.asarray(image[::FINER] + image[1::FINER])
    image = np.asarray(image[:, ::FINER] + image[:, 1::FINER])
    image[..., :3] /= 255.0 * np.maximum(image[..., 3:], 1.0)
    image[..., 3] /= FINER**2
    depth = depth[::FINER, ::FINER]
    unit_m = depth / camera.px_per_m if camera.eye_m is not None else 1.0 / camera.px_per_m
    image[..., :3] *= hollow_shade(depth, unit_m)[..., None]
    return image, depth


def hollow_shade(depth: Image, unit_m: Any) -> Image:
    """
    Return the shade of pixels that lie deeper than the mean of their neighbours, (H, W) 0.4 to 1.

    Parameters
    ----------
    depth : (H, W) float32, m
        inf without a disc; such pixels shade none.
    unit_m : float or (H, W) float32
        Size of a pixel at its depth, m: an angle between surfaces has the same shade at any scale,
        and a plane none, however it lies.

    Notes
    -----
    Eye-dome lighting (Boucheny 2009) by second differences at distances of 1, 2 and 4 px.

    """
    most = HOLLOW_STEPS[-1]
    finite_depth = np.where(np.isfinite(depth), depth, np.float32(np.nan))
    wide = np.pad(finite_depth, most, constant_values=np.nan)
    height, width = depth.shape
    hollow = np.zeros_like(finite_depth)
    for step in HOLLOW_STEPS:
        steps_m = np.float32(step) * unit_m
        for down, right in step * np.array([(0, 1), (1, 0), (1, 1), (1, -1)]):
            total = np.zeros_like(finite_depth)
            for sign in (-1, 1):
                top, column = most + sign * down, most + sign * right
                rise = finite_depth - wide[top : top + height, column : column + width]
                total += np.maximum(rise / steps_m, -4.0)
            hollow += np.fmin(np.fmax(total - 0.25, 0.0), 2.0)  # 0 for nan
    shade: Image = np.maximum(np.exp(hollow * np.float32(-STRENGTH / 12.0)), np.float32(0.4))
    return shade


def facing_discs(camera: Camera, discs: DrawnDiscs) -> tuple[npt.NDArray[np.int64], Image]:
    """Return the rows of the discs that face the viewer, and their form for ``paint``."""
    R, position, near = camera.R_view_map, discs.position, camera.R_view_map[2]
    if camera.eye_m is not None:
        position = position - camera.eye_m
        near = -position
    facing = (discs.normal * near).sum(axis=1)
    ahead = position @ R[2] < -NEAREST_M
    rows = np.flatnonzero((facing > 0.0) & (ahead | (camera.eye_m is None)))
    in_camera, normal = position[rows] @ R.T, discs.normal[rows] @ R.T
    scale = np.full((len(rows), 1), FINER * camera.px_per_m)
    ray = np.tile(-R[2], (len(rows), 1))  # for each metre of depth
    if camera.eye_m is not None:
        scale /= -in_camera[:, 2:]
        normal[:, 2] = facing[rows] / -in_camera[:, 2]
        ray = position[rows] / -in_camera[:, 2:]
    normal[:, 2] = np.maximum(normal[:, 2], EDGE_ON)
    normal /= np.sqrt((normal * normal).sum(axis=1))[:, None]
    radius_m = discs.radius_m[rows, None]
    larger = radius_m + CLOSING * np.minimum(radius_m, np.median(radius_m) if len(rows) else 0.0)
    radius_m = np.maximum(larger, FINER * THINNEST_PX / scale)
    image_centre = 0.5 * FINER * np.array([camera.width, camera.height]) - 0.5
    centre = image_centre + (in_camera[:, :2] - camera.centre_m) * scale * [1.0, -1.0]
    steps_m = normal[:, :2] / normal[:, 2:] * [1.0, -1.0] / scale  # of depth, right and down
    across = [sign * R[k] / scale + steps_m[:, k, None] * ray for k, sign in ((0, 1), (1, -1))]
    columns = [
        centre,
        pixel_box(centre, radius_m * scale * np.sqrt(1.0 - normal[:, :2] ** 2), camera),
        -in_camera[:, 2:],
        steps_m,
        0.5 * radius_m,
        *(values / radius_m for values in (*across, *discs.select(rows).cells())),
    ]
    return rows, np.concatenate(columns, axis=1).astype(np.float32)


def pixel_box(centre: Array, reach: Array, camera: Camera) -> Array:
    """Return the first and last + 1 row and column of discs in the image, (K, 4)."""
    size = FINER * np.array([camera.width, camera.height])
    first = np.clip(np.ceil(centre - reach), 0.0, size)
    end = np.clip(np.floor(centre + reach) + 1.0, 0.0, size)
    return np.stack([first[:, 1], end[:, 1], first[:, 0], end[:, 0]], axis=1)


def round_length(most: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20, ... that is at most a length."""
    power = 10.0 ** np.floor(np.log10(most))
    digits = [step for step in (1, 2, 5) if step * power <= most * (1.0 + 1e-9)]
    return float(power * digits[-1])
