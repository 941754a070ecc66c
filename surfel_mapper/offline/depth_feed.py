# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The depth images of a bag, each with the calibration of its camera, as the node pairs them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import Any

from surfel_mapper.bags.reader import BagMessage
from surfel_mapper.messages.depth_image import (
    camera_info_topic,
    CameraImage,
    depth_scan,
    DepthImages,
)
from surfel_mapper.scan import Scan

Decode = Callable[[Any, str], Scan]

Add = Callable[[BagMessage, int, Decode], None]
"""Decodes a message, whose number on its topic is given, and gives the scan to a mapper."""


class DepthFeed:
    """
    Holds images back until their camera is known.

    Parameters
    ----------
    topics : collection of str
        Of the images.
    add : callable
        Takes images that are ready.

    Attributes
    ----------
    info_topics : dict of str to str
        Topics of calibrations, and of the images that they are for.

    """

    def __init__(self, topics: Collection[str], add: Add) -> None:
        """Know no camera."""
        self.info_topics = {camera_info_topic(topic): topic for topic in topics}
        self._images = DepthImages()
        self._add = add

    def take_image(self, message: BagMessage, number: int) -> None:
        """Take an image."""
        self._give(self._images.add_image(message.topic, (message, number)))

    def take_info(self, topic: str, info: Any) -> None:
        """
        Take a decoded calibration.

        Raises
        ------
        CloudFormatError
            If it describes no camera.

        """
        self._give(self._images.add_info(self.info_topics[topic], info))

    def _give(self, images: Iterable[CameraImage]) -> None:
        for (message, number), camera in images:

            def decode(msg: Any, topic: str, camera: Any = camera) -> Scan:
                return depth_scan(CameraImage(msg, camera), topic)

            self._add(message, number, decode)
