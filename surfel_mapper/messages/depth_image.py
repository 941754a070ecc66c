# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Depth images and camera calibrations out of messages, whichever library made them.

sensor_msgs/Image with encoding 16UC1 (millimetres) or 32FC1 (metres), packed or not (see
compressed_image.py), and the sensor_msgs/CameraInfo that drivers publish beside it as
``camera_info``. Like clouds, messages are read by the names of their attributes alone and checked
before a pixel is read.
"""

from __future__ import annotations

from collections import deque
from dataclasses import astuple
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.messages.compressed_image import base_topic, unpacked
from surfel_mapper.messages.pointcloud2 import bytes_of, checked_stamp_ns
from surfel_mapper.scan import Scan
from surfel_mapper.sensors.depth import depth_points, free_rays, PinholeCamera

ENCODINGS = {'16UC1': 'u2', 'mono16': 'u2', '32FC1': 'f4'}
"""Numpy's name of the pixels of each encoding that holds depth; some drivers say mono16."""

MAX_EARLY = 10
"""So many images of a camera wait for its first camera_info; then the oldest is given up."""


class CameraImage(NamedTuple):
    """A depth image and the camera that took it; None where that never became known."""

    msg: Any
    camera: PinholeCamera | None


class DepthImages:
    """
    Brings depth images together with the calibration of their camera, topic by topic.

    A calibration holds from when it comes until the next; images that come before the first
    wait for it, so that what is mapped does not depend on which of two topics is quicker.
    """

    def __init__(self) -> None:
        """Know no camera."""
        self._cameras: dict[str, PinholeCamera] = {}
        self._early: dict[str, deque[Any]] = {}

    def add_info(self, topic: str, msg: Any) -> list[CameraImage]:
        """
        Take a sensor_msgs/CameraInfo for an image topic; return the images that waited for it.

        Raises
        ------
        CloudFormatError
            If it describes no camera.

        """
        self._cameras[topic] = camera = camera_in(msg, camera_info_topic(topic))
        return [CameraImage(image, camera) for image in self._early.pop(topic, ())]

    def add_image(self, topic: str, msg: Any) -> list[CameraImage]:
        """Take an image; return it, or if it has to wait, the one that has waited too long."""
        if topic in self._cameras:
            return [CameraImage(msg, self._cameras[topic])]
        early = self._early.setdefault(topic, deque())
        early.append(msg)
        return [CameraImage(early.popleft(), None)] if len(early) > MAX_EARLY else []


def camera_info_topic(image_topic: str) -> str:
    """Return where the calibration of an image topic is published: its neighbour camera_info."""
    folder, slash, _ = base_topic(image_topic).rpartition('/')
    return f'{folder}{slash}camera_info'


def camera_in(msg: Any, topic: str = 'camera_info') -> PinholeCamera:
    """
    Return the camera that a sensor_msgs/CameraInfo describes.

    That of the rectified image (its matrix P), or where that is not filled in, of K; of the
    part of the image and at the binning that the message states.

    Raises
    ------
    CloudFormatError
        If it describes none.

    """
    P, K = matrix_in(msg, 'p'), matrix_in(msg, 'k')
    if len(P) == 12 and P[0] > 0.0:
        fx, fy, cx, cy = P[0], P[5], P[2], P[6]
    elif len(K) == 9:
        fx, fy, cx, cy = K[0], K[4], K[2], K[5]
    else:
        raise CloudFormatError(f'{topic}: no matrix P or K, expected a calibrated camera')
    roi = msg.roi
    bin_x, bin_y = int(msg.binning_x) or 1, int(msg.binning_y) or 1
    try:
        return PinholeCamera(
            width=(int(roi.width) or int(msg.width)) // bin_x,
            height=(int(roi.height) or int(msg.height)) // bin_y,
            fx=fx / bin_x,
            fy=fy / bin_y,
            cx=(cx - int(roi.x_offset)) / bin_x,
            cy=(cy - int(roi.y_offset)) / bin_y,
        )
    except ValueError as error:
        raise CloudFormatError(f'{topic}: {error}') from error


def matrix_in(msg: Any, name: str) -> list[float]:
    """Return a matrix of a message, row by row; ROS 1 has its name in capitals."""
    found = getattr(msg, name) if hasattr(msg, name) else getattr(msg, name.upper(), ())
    return [float(value) for value in found]


def depth_scan(image: CameraImage, topic: str = 'depth') -> Scan:
    """
    Return the points of a depth image in its optical frame.

    Raises
    ------
    CloudFormatError
        If sizes, encoding and data do not fit together, the image is not the camera's size, or
        the camera is not known.

    """
    if image.camera is None:
        raise CloudFormatError(
            f'{topic}: no calibration; does anybody publish {camera_info_topic(topic)}?'
        )
    msg = unpacked(image.msg, topic, exact=True)
    stamp_ns, depth = checked_stamp_ns(msg.header.stamp, topic), depth_in(msg, topic)
    try:
        points = depth_points(depth, image.camera)
    except ValueError as error:
        raise CloudFormatError(f'{topic}: {error}') from error
    return Scan(
        points=points,
        stamp_ns=stamp_ns,
        frame_id=str(msg.header.frame_id),
        camera=astuple(image.camera),
        free=free_rays(depth, image.camera),
    )


def warm_up() -> None:
    """Compile what makes points of depth, for all types of images."""
    camera = PinholeCamera(1, 1, 1.0, 1.0, 0.0, 0.0)
    for dtype in (np.uint16, np.float32):
        depth_points(np.ones((1, 1), dtype), camera)


def depth_in(msg: Any, topic: str = 'depth') -> npt.NDArray[Any]:
    """
    Return the pixels of a depth image, (H, W) uint16 in mm or float32 in m.

    Raises
    ------
    CloudFormatError
        If the encoding is not 16UC1 or 32FC1, or there are fewer bytes than pixels.

    """
    if msg.encoding not in ENCODINGS:
        raise CloudFormatError(
            f'{topic}: encoding {msg.encoding!r}, expected 16UC1 or 32FC1; is this a depth image?'
        )
    return pixels_in(msg, topic, ENCODINGS[msg.encoding])[:, :, 0]


def pixels_in(msg: Any, topic: str, type_: str, channels: int = 1) -> npt.NDArray[Any]:
    """
    Return the pixels of an image, (H, W, C) in native byte order.

    Raises
    ------
    CloudFormatError
        If there are fewer bytes than pixels.

    """
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    dtype = np.dtype(('>' if msg.is_bigendian else '<') + type_)
    pixel_bytes = channels * dtype.itemsize
    data = bytes_of(msg, topic)
    if step < width * pixel_bytes or len(data) != step * height:
        raise CloudFormatError(
            f'{topic}: {len(data)} bytes in rows of {step}, expected height {height} rows of '
            f'at least {width * pixel_bytes}'
        )
    strides = (step, pixel_bytes, dtype.itemsize)
    pixels: npt.NDArray[Any] = np.ndarray((height, width, channels), dtype, data, 0, strides)
    return pixels.astype(dtype.newbyteorder('='), copy=False)
