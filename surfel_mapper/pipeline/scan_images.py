# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Colours and labels of points from images, joined with scans by their stamps.

A scan waits until an image that is not older has come, so the image that it gets does not depend
on the order in which the two arrive; as for poses, the wait ends after ``pose.max_wait_s``. The
colours and labels become columns of the scan and pass the filters with it. Columns that a cloud
already has stay.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.geometry import Transform
from surfel_mapper.layers import Images
from surfel_mapper.scan import ComputedColumns, DepthImage, Scan
from surfel_mapper.sensors.depth import LABEL, PinholeCamera, SceneImage

MAX_IMAGES = 60
"""Images kept of each kind, 2 s at 30 Hz."""

COLUMNS = {'color': ('rgba', 'rgb'), LABEL: ('label',)}
"""Columns of a scan that hold the values of a kind of image; the first is the one added."""


class ScanImages:
    """
    The latest images of every kind.

    Parameters
    ----------
    wanted : Images
        The kinds of images that layers want, and the tolerance of their stamps.

    Attributes
    ----------
    ended : bool
        Set when no more images come; scans then wait for none.

    """

    def __init__(self, wanted: Images) -> None:
        self.wanted = wanted
        self.ended = False
        self._images: dict[str, deque[SceneImage]] = {
            kind: deque(maxlen=MAX_IMAGES) for kind in wanted.topics
        }
        self._tolerance_ns = round(wanted.tolerance_s * 1e9)

    def add(self, image: SceneImage) -> None:
        """Add an image; one older than the last drops all before it."""
        images = self._images[image.kind]
        if images and image.stamp_ns < images[-1].stamp_ns:
            images.clear()
        images.append(image)

    def is_waiting(self, scan: Scan) -> bool:
        """Return whether an image may come that belongs to a scan."""
        return not self.ended and any(
            not images or images[-1].stamp_ns < scan.stamp_ns
            for kind, images in self._images.items()
            if not has_column(scan, kind)
        )

    def will_give(self, scan: Scan, column: str) -> bool:
        """
        Return whether every point of a scan gets a column from images, if they come.

        Only the points of depth images do: a camera sees some of the points of a lidar.
        """
        return bool(scan.camera) and any(column in COLUMNS[kind] for kind in self._images)

    def joined(
        self, scan: Scan, pose_of: Callable[[SceneImage], Transform]
    ) -> tuple[Scan, list[str]]:
        """
        Return a scan with columns from its images, and the kinds of which no image came.

        Parameters
        ----------
        scan : Scan
            In the frame of its sensor.
        pose_of : callable
            Returns T_camera_sensor for an image.

        Raises
        ------
        CloudFormatError
            If an image is not of the size of the depth image.

        """
        columns, missing, depth = dict(scan.columns), [], scan.depth
        for kind in self._images:
            if has_column(scan, kind):
                continue
            image = self._nearest(kind, scan.stamp_ns)
            if image is None:
                missing.append(kind)
                continue
            if depth is not None:
                check_size(image, scan)
                depth = replace(depth, **{kind: image.pixels})
                continue
            values = seen_in(image, scan, pose_of)
            if values is not None:
                columns[COLUMNS[kind][0]] = values
        if depth is not None:
            return replace(scan, depth=depth, columns=pixel_columns(scan, depth)), missing
        return replace(scan, columns=columns), missing

    def _nearest(self, kind: str, stamp_ns: int) -> SceneImage | None:
        """Return the image nearest to a time, the older of two; None if it is too far off."""
        images = self._images[kind]
        nearest = min(images, key=lambda image: abs(image.stamp_ns - stamp_ns), default=None)
        if nearest is None or abs(nearest.stamp_ns - stamp_ns) > self._tolerance_ns:
            return None
        return nearest


def has_column(scan: Scan, kind: str) -> bool:
    """Return whether a scan has a column of a kind of image already."""
    return any(name in scan.columns for name in COLUMNS[kind])


def seen_in(
    image: SceneImage, scan: Scan, pose_of: Callable[[SceneImage], Transform]
) -> npt.NDArray[Any] | None:
    """
    Return the pixels of an image at the points of a scan; None if no point is in the image.

    (N,) uint32, packed with an alpha of 255, or labels, (N,) int32. Points that are not in the
    image get 0, whose alpha is 0 too, or -1.
    """
    if scan.camera:
        check_size(image, scan)
        camera, points = camera_of(scan), scan.points
    else:
        assert image.camera is not None, 'images beside a lidar come with their camera'
        camera, T = image.camera, pose_of(image)
        points = scan.points @ T[:3, :3].T + T[:3, 3]
    pixel = pixels_of(camera, points, image.pixels.shape[:2])
    if not len(pixel) or pixel.max() < 0:
        return None
    return pixel_values(image.kind, image.pixels, pixel)


def pixel_values(
    kind: str, pixels: npt.NDArray[Any], pixel: npt.NDArray[np.int32]
) -> npt.NDArray[Any]:
    """Return the values of an image at pixels counted row by row, as seen_in; -1: none."""
    values: npt.NDArray[Any]
    values, nothing = (pixels.ravel(), -1) if kind == LABEL else (packed(pixels), 0)
    chosen = values[pixel]
    chosen[pixel < 0] = nothing
    return chosen


def check_size(image: SceneImage, scan: Scan) -> None:
    """Raise CloudFormatError if an image is not of the size of the depth image of a scan."""
    width, height = int(scan.camera[0]), int(scan.camera[1])
    if image.pixels.shape[:2] != (height, width):
        raise CloudFormatError(
            f'{image.kind} image of {image.pixels.shape[1]} x {image.pixels.shape[0]} pixels, '
            f'expected {width} x {height} as the depth image has'
        )


def camera_of(scan: Scan) -> PinholeCamera:
    """Return the camera of the points of a depth image."""
    return PinholeCamera(int(scan.camera[0]), int(scan.camera[1]), *scan.camera[2:])


def pixel_columns(scan: Scan, depth: DepthImage) -> ComputedColumns:
    """
    Return the columns of a depth image, and those taken from images of its pixels when first read.

    The distance field reads the images themselves, and often nothing else needs the columns.
    """
    kinds = {COLUMNS[kind][0]: kind for kind in COLUMNS if not has_column(scan, kind)}
    kinds = {name: kind for name, kind in kinds.items() if getattr(depth, kind) is not None}

    def compute(name: str) -> npt.NDArray[Any]:
        if name not in kinds:
            return scan.columns[name]
        camera = camera_of(scan)
        pixel = pixels_of(camera, scan.points, (camera.height, camera.width))
        return pixel_values(kinds[name], getattr(depth, kinds[name]), pixel)

    return ComputedColumns([*scan.columns, *kinds], compute, len(scan))


def packed(pixels: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint32]:
    """Return the colours of an image packed as in a column rgba, with an alpha of 255."""
    rgba = np.full((*pixels.shape[:2], 4), 255, np.uint8)
    rgba[..., 2::-1] = pixels
    return rgba.view('<u4').astype(np.uint32, copy=False).ravel()


def pixels_of(
    camera: PinholeCamera, points: npt.NDArray[Any], size: tuple[int, ...]
) -> npt.NDArray[np.int32]:
    """Return the pixel of a camera that each point is in, counted row by row, (N,); -1: none."""
    x, y, z = (np.ascontiguousarray(points[:, axis], np.float32) for axis in range(3))
    with np.errstate(all='ignore'):  # points behind the camera, and nan
        u = x / z * np.float32(camera.fx) + np.float32(camera.cx + 0.5)
        v = y / z * np.float32(camera.fy) + np.float32(camera.cy + 0.5)
        inside = (z > 0) & (u >= 0) & (u < size[1]) & (v >= 0) & (v < size[0])
        row, column = v.astype(np.int32), u.astype(np.int32)
    pixel: npt.NDArray[np.int32] = row * np.int32(size[1]) + column
    pixel[~inside] = -1
    return pixel
