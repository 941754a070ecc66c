# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Images of a bag with the calibration of their camera, paired as the node pairs them.

``DepthFeed`` turns depth images into scans; ``SceneFeed`` hands images of colours and labels to
the mapper. Both hold an image back until the calibration of its camera has been read.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import Any

from surfel_mapper.bags.reader import BagMessage, BagReader
from surfel_mapper.errors import BagError, CloudFormatError
from surfel_mapper.messages.images import (
    camera_info_topic,
    CameraImage,
    depth_scan,
    DepthImages,
    SceneImages,
)
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan

Decode = Callable[[Any, str], Scan]
"""Takes a decoded message and its topic; returns the scan."""

Add = Callable[[BagMessage, int, Decode], None]
"""Decodes a message, given its number on its topic, and queues the scan at a mapper."""


class DepthFeed:
    """
    Holds depth images back until their camera is known.

    Parameters
    ----------
    topics : collection of str
        Topics of the depth images.
    add : callable
        Takes the images that are ready.

    Attributes
    ----------
    info_topics : dict of str to str
        Topic of the images by the topic of their calibration.

    """

    def __init__(self, topics: Collection[str], add: Add) -> None:
        self.info_topics = {camera_info_topic(topic): topic for topic in topics}
        self._images = DepthImages()
        self._add = add

    def add_image(self, message: BagMessage, number: int) -> None:
        """Add an image, and hand it on if its camera is known."""
        self._hand_on(self._images.add_image(message.topic, (message, number)))

    def add_info(self, topic: str, info: Any) -> None:
        """
        Add a decoded calibration, and hand on the images that waited for it.

        Raises
        ------
        CloudFormatError
            If it describes no camera.

        """
        self._hand_on(self._images.add_info(self.info_topics[topic], info))

    def _hand_on(self, images: Iterable[CameraImage]) -> None:
        for (message, number), camera in images:

            def decode(msg: Any, topic: str, camera: Any = camera) -> Scan:
                return depth_scan(CameraImage(msg, camera), topic)

            self._add(message, number, decode)


class SceneFeed:
    """
    Decodes images of colours and labels, and their calibrations; bad ones are counted.

    Parameters
    ----------
    mapper : Mapper
        Takes the images; its configuration names their topics.

    Attributes
    ----------
    topics : set of str
        Topics of the images and, if calibrations are needed, of these.

    """

    def __init__(self, mapper: Mapper) -> None:
        named = mapper.config.image_topics
        self._mapper = mapper
        self._images = SceneImages(mapper.config)
        self._kinds = {f'/{topic.lstrip("/")}': kind for kind, topic in named.items()}
        self._infos: dict[str, list[str]] = {}
        if self._images.needs_cameras:
            for topic in self._kinds:
                self._infos.setdefault(camera_info_topic(topic), []).append(topic)
        self.topics = {*self._kinds, *self._infos}

    def add(self, reader: BagReader, message: BagMessage) -> None:
        """Decode a message and give the mapper the images that are ready with it."""
        try:
            msg, images = reader.decode(message), self._images
            if message.topic in self._kinds:
                ready = images.add_image(self._kinds[message.topic], message.topic, msg)
            else:
                ready = [
                    image
                    for topic in self._infos[message.topic]
                    for image in images.add_info(self._kinds[topic], topic, msg)
                ]
        except (CloudFormatError, BagError) as error:
            self._mapper.ignore_message('bad_image', f'image ignored: {error}')
            return
        for image in ready:
            self._mapper.add_image(image)
