# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Images of depth, colour and labels, and camera calibrations, from messages of rclpy or rosbags.

Depth: sensor_msgs/Image with encoding 16UC1 (millimetres) or 32FC1 (metres), raw or compressed
(compressed_image.py), with the sensor_msgs/CameraInfo that drivers publish beside it as
``camera_info``. Colours and labels: images of cameras and segmentation networks, to be joined with
scans. Those registered to depth images fit them pixel by pixel and need no calibration; those
beside a lidar wait for the first camera_info of their camera, as depth images do. Messages are
read by the names of their attributes and checked before a pixel is read.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import astuple
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError
from surfel_mapper.messages.cdr import checked_stamp_ns, frame_name
from surfel_mapper.messages.compressed_image import base_topic, unpacked
from surfel_mapper.messages.pointcloud2 import bytes_of
from surfel_mapper.scan import DepthImage, Scan
from surfel_mapper.sensors.depth import COLOR, depth_points, free_rays, PinholeCamera, SceneImage

ENCODINGS = {'16UC1': 'u2', 'mono16': 'u2', '32FC1': 'f4'}
"""NumPy dtypes of the encodings of depth; some drivers use mono16."""

MAX_EARLY = 10
"""Number of images per camera that wait for its first camera_info; then the oldest is dropped."""


class CameraImage(NamedTuple):
    """An image and its camera; None if no calibration came."""

    msg: Any
    camera: PinholeCamera | None


class DepthImages:
    """
    Pairs images with the calibration of their camera, topic by topic.

    A calibration is valid until the next one comes. Images that come before the first wait for
    it, so that the map does not depend on which of the two topics is faster.
    """

    def __init__(self) -> None:
        self._cameras: dict[str, PinholeCamera] = {}
        self._early: dict[str, deque[Any]] = {}

    def add_info(self, topic: str, msg: Any) -> list[CameraImage]:
        """
        Take a sensor_msgs/CameraInfo for an image topic; return the images that waited for it.

        Raises
        ------
        CloudFormatError
            If the message is not a valid calibration.

        """
        self._cameras[topic] = camera = camera_in(msg, camera_info_topic(topic))
        return [CameraImage(image, camera) for image in self._early.pop(topic, ())]

    def add_image(self, topic: str, msg: Any) -> list[CameraImage]:
        """Take an image; return the images that are ready or have waited too long."""
        if topic in self._cameras:
            return [CameraImage(msg, self._cameras[topic])]
        early = self._early.setdefault(topic, deque())
        early.append(msg)
        return [CameraImage(early.popleft(), None)] if len(early) > MAX_EARLY else []


def camera_info_topic(image_topic: str) -> str:
    """Return the topic of the calibration of an image topic: ``camera_info`` beside it."""
    folder, slash, _ = base_topic(image_topic).rpartition('/')
    return f'{folder}{slash}camera_info'


def camera_in(msg: Any, topic: str = 'camera_info') -> PinholeCamera:
    """
    Return the camera that a sensor_msgs/CameraInfo describes.

    The intrinsics are those of the rectified image (matrix P), or of K if P is not filled in, for
    the region of interest and the binning that the message states.

    Raises
    ------
    CloudFormatError
        If the message is not a valid calibration.

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
    """Return a matrix of a message, row by row; in ROS 1 its name is in capitals."""
    values = getattr(msg, name) if hasattr(msg, name) else getattr(msg, name.upper(), ())
    return [float(value) for value in values]


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
            f'{topic}: no calibration; is {camera_info_topic(topic)} published?'
        )
    size = (image.camera.width, image.camera.height)
    msg = unpacked(image.msg, topic, exact=True, size=size)
    stamp_ns, depth = checked_stamp_ns(msg.header.stamp, topic), depth_in(msg, topic)
    try:
        points = depth_points(depth, image.camera)
    except ValueError as error:
        raise CloudFormatError(f'{topic}: {error}') from error
    return Scan(
        points=points,
        stamp_ns=stamp_ns,
        frame_id=frame_name(msg.header.frame_id),
        camera=astuple(image.camera),
        depth=DepthImage(points=points, depth=depth),
        free=free_rays(depth, image.camera),
    )


def warm_up() -> None:
    """Compile the kernel for points from depth, for all types of images."""
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


COLORS = {
    'rgb8': (3, [0, 1, 2]),
    'bgr8': (3, [2, 1, 0]),
    'rgba8': (4, [0, 1, 2]),
    'bgra8': (4, [2, 1, 0]),
    'mono8': (1, [0, 0, 0]),
}
"""Encodings of colours: bytes of a pixel, and the offsets of red, green and blue."""

LABELS = {'8UC1': 'u1', 'mono8': 'u1', '16UC1': 'u2', 'mono16': 'u2', '32SC1': 'i4'}
"""Encodings of labels, and their NumPy dtypes."""


class SceneImages:
    """
    Decodes images of colours and labels, with the calibration of their camera if they need one.

    Parameters
    ----------
    config : Config
        Its input.kind states whether the images belong to depth images or to clouds.

    Attributes
    ----------
    needs_cameras : bool
        Whether images wait for the calibration of their camera.

    """

    def __init__(self, config: Config) -> None:
        self.needs_cameras = config.input.kind == 'cloud'
        self._images = DepthImages()

    def add_info(self, kind: str, topic: str, msg: Any) -> list[SceneImage]:
        """
        Take the calibration for a topic of images; return the images that waited for it.

        Raises
        ------
        CloudFormatError
            If it is not a valid calibration, or an image cannot be read.

        """
        return decoded(kind, topic, self._images.add_info(topic, msg))

    def add_image(self, kind: str, topic: str, msg: Any) -> list[SceneImage]:
        """
        Take an image; return it unless it has to wait for its camera.

        Raises
        ------
        CloudFormatError
            If it cannot be read, or the calibration of its camera does not come.

        """
        if not self.needs_cameras:
            return decoded(kind, topic, [CameraImage(msg, None)])
        ready = self._images.add_image(topic, msg)
        if any(image.camera is None for image in ready):
            raise CloudFormatError(f'{topic}: no calibration; is camera_info published beside it?')
        return decoded(kind, topic, ready)


def decoded(kind: str, topic: str, images: Iterable[CameraImage]) -> list[SceneImage]:
    """Return the decoded images, of colours or of labels."""
    return [scene_image(kind, image, topic) for image in images]


def scene_image(kind: str, image: CameraImage, topic: str) -> SceneImage:
    """
    Return the image of a message.

    Raises
    ------
    CloudFormatError
        If encoding, sizes and data do not fit together.

    """
    camera = image.camera
    size = None if camera is None else (camera.width, camera.height)
    msg = unpacked(image.msg, topic, exact=kind != COLOR, size=size)
    decode = colors_in if kind == COLOR else labels_in
    return SceneImage(
        kind=kind,
        stamp_ns=checked_stamp_ns(msg.header.stamp, topic),
        frame_id=frame_name(msg.header.frame_id),
        camera=image.camera,
        pixels=decode(msg, topic),
    )


def colors_in(msg: Any, topic: str) -> npt.NDArray[np.uint8]:
    """Return the colours of an image, (H, W, 3) uint8: red, green, blue."""
    if msg.encoding not in COLORS:
        names = ', '.join(COLORS)
        raise CloudFormatError(f'{topic}: encoding {msg.encoding!r}, expected one of {names}')
    channels, order = COLORS[msg.encoding]
    return np.ascontiguousarray(pixels_in(msg, topic, 'u1', channels)[:, :, order])


def labels_in(msg: Any, topic: str) -> npt.NDArray[np.int32]:
    """Return the labels of an image, (H, W) int32."""
    if msg.encoding not in LABELS:
        names = ', '.join(LABELS)
        raise CloudFormatError(f'{topic}: encoding {msg.encoding!r}, expected one of {names}')
    return pixels_in(msg, topic, LABELS[msg.encoding])[:, :, 0].astype(np.int32)
