# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Images of colours and of labels out of messages, to be joined with scans.

sensor_msgs/Image as cameras and segmentation networks publish them, and what compressed_image.py
unpacks, labels as PNG alone. Those that belong to depth images fit them pixel by pixel and need
no calibration; those that are beside a lidar wait for the first camera_info of their camera, as
depth images do.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError
from surfel_mapper.messages.compressed_image import unpacked
from surfel_mapper.messages.depth_image import CameraImage, DepthImages, pixels_in
from surfel_mapper.messages.pointcloud2 import checked_stamp_ns
from surfel_mapper.messages.pose_messages import frame_name
from surfel_mapper.sensors.depth import COLOR, SceneImage

COLORS = {
    'rgb8': (3, [0, 1, 2]),
    'bgr8': (3, [2, 1, 0]),
    'rgba8': (4, [0, 1, 2]),
    'bgra8': (4, [2, 1, 0]),
    'mono8': (1, [0, 0, 0]),
}
"""Encodings of colours: bytes of a pixel, and where red, green and blue are among them."""

LABELS = {'8UC1': 'u1', 'mono8': 'u1', '16UC1': 'u2', 'mono16': 'u2', '32SC1': 'i4'}
"""Encodings of labels, and numpy's names of their pixels."""


class SceneImages:
    """
    What turns messages into images.

    Parameters
    ----------
    config : Config
        Says whether they belong to depth images or to clouds.

    Attributes
    ----------
    needs_cameras : bool
        Whether images wait for the calibration of their camera.

    """

    def __init__(self, config: Config) -> None:
        """Know no camera."""
        self.needs_cameras = config.input.kind == 'cloud'
        self._images = DepthImages()

    def add_info(self, kind: str, topic: str, msg: Any) -> list[SceneImage]:
        """
        Take the calibration for a topic of images; return the images that waited for it.

        Raises
        ------
        CloudFormatError
            If it describes no camera, or an image cannot be read.

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
    """Return the images of messages, of colours or of labels."""
    return [scene_image(kind, image, topic) for image in images]


def scene_image(kind: str, image: CameraImage, topic: str) -> SceneImage:
    """
    Return the image of a message.

    Raises
    ------
    CloudFormatError
        If encoding, sizes and data do not fit together.

    """
    msg = unpacked(image.msg, topic, exact=kind != COLOR)
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
        known = ', '.join(COLORS)
        raise CloudFormatError(f'{topic}: encoding {msg.encoding!r}, expected one of {known}')
    channels, order = COLORS[msg.encoding]
    return np.ascontiguousarray(pixels_in(msg, topic, 'u1', channels)[:, :, order])


def labels_in(msg: Any, topic: str) -> npt.NDArray[np.int32]:
    """Return the labels of an image, (H, W) int32."""
    if msg.encoding not in LABELS:
        known = ', '.join(LABELS)
        raise CloudFormatError(f'{topic}: encoding {msg.encoding!r}, expected one of {known}')
    return pixels_in(msg, topic, LABELS[msg.encoding])[:, :, 0].astype(np.int32)
