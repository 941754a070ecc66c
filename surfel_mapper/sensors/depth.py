# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Depth images to points, by the pinhole model.

The frame is an optical one (REP 103): x right, y down, z ahead, as camera drivers stamp their
images. Depth is measured along z, not along the ray. Images have to be rectified, as depth
images mostly are; the model has no distortion.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.sensors.kernels.depth import unproject

COLOR, LABEL = 'color', 'label'
"""Kinds of the images that are joined with scans."""

UNIT_M = {np.dtype(np.uint16): 1e-3, np.dtype(np.float32): 1.0}
"""One unit of depth in metres, by type of image (REP 118)."""

END = {np.dtype(np.uint16): 65535.0, np.dtype(np.float32): np.inf}
"""Values from this one on mean no depth: Kinects write 65535 for pixels without."""


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """
    A camera whose images are rectified.

    Attributes
    ----------
    width, height : int
        Of its images, pixels.
    fx, fy : float
        Focal lengths, pixels.
    cx, cy : float
        Principal point, pixels from the centre of the first pixel.

    Raises
    ------
    ValueError
        If a size or a focal length is not positive, or a number is not finite.

    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        """Check the numbers."""
        numbers = (self.width, self.height, self.fx, self.fy)
        finite = all(math.isfinite(value) for value in (*numbers, self.cx, self.cy))
        if not finite or min(numbers) <= 0:
            raise ValueError(
                f'camera of {self.width} x {self.height} pixels, focal lengths {self.fx}, '
                f'{self.fy} and centre {self.cx}, {self.cy}: expected finite numbers, sizes and '
                'focal lengths positive; is it calibrated?'
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneImage:
    """
    An image of colours or labels.

    Attributes
    ----------
    kind : str
        color or label.
    stamp_ns : int
        Its time.
    frame_id : str
        The optical frame of its camera.
    camera : PinholeCamera, optional
        Its camera; None if it fits a depth image pixel by pixel.
    pixels : (H, W, 3) uint8 or (H, W) int32
        Red, green and blue, or labels, -1 for unknown.

    """

    kind: str
    stamp_ns: int
    frame_id: str
    camera: PinholeCamera | None
    pixels: npt.NDArray[Any]


def depth_points(depth: npt.NDArray[Any], camera: PinholeCamera) -> npt.NDArray[np.float32]:
    """
    Return the points of a depth image.

    Parameters
    ----------
    depth : (H, W) uint16, mm, or float32, m
        Along the optical axis; 0, negative values, nan, inf and, with some cameras, 65535 mm mean
        no depth.
    camera : PinholeCamera
        Its camera.

    Returns
    -------
    (N, 3) float32, m
        In the optical frame, row by row, of the pixels that have a depth.

    Raises
    ------
    ValueError
        If the image is of another size than the camera's, or of another type.

    """
    if depth.shape != (camera.height, camera.width):
        raise ValueError(
            f'depth image of shape {depth.shape}, expected {(camera.height, camera.width)} '
            'as the camera has it'
        )
    if depth.dtype not in UNIT_M:
        raise ValueError(f'depth of type {depth.dtype}, expected uint16 or float32')
    across = (np.arange(camera.width) - camera.cx) / camera.fx
    down = (np.arange(camera.height) - camera.cy) / camera.fy
    points = np.empty((3, depth.size), np.float32)
    image = np.require(depth, None, ['C', 'A', 'W'])
    unit_m, end = UNIT_M[depth.dtype], END[depth.dtype]
    num = unproject(image, unit_m, end, across, down, points)
    return np.asfortranarray(points[:, :num].T)


def free_rays(depth: npt.NDArray[Any], camera: PinholeCamera) -> npt.NDArray[np.float32] | None:
    """Return unit vectors of the pixels that are inf, free up to the range; None without any."""
    if depth.dtype.kind != 'f':
        return None
    rows, columns = np.nonzero(depth == np.inf)
    if not len(rows):
        return None
    rays = np.ones((len(rows), 3), np.float32)
    rays[:, 0] = (columns - camera.cx) / camera.fx
    rays[:, 1] = (rows - camera.cy) / camera.fy
    unit: npt.NDArray[np.float32] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit
