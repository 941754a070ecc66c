# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The images of colours and labels of a bag, given to a mapper as the node gives them."""

from __future__ import annotations

from surfel_mapper.bags.reader import BagMessage, BagReader
from surfel_mapper.errors import BagError, CloudFormatError
from surfel_mapper.messages.depth_image import camera_info_topic
from surfel_mapper.messages.scene_image import SceneImages
from surfel_mapper.pipeline import Mapper


class SceneFeed:
    """
    Decodes images and calibrations; bad ones are counted.

    Parameters
    ----------
    mapper : Mapper
        Takes the images; its configuration names their topics.

    Attributes
    ----------
    topics : set of str
        Of images, and of calibrations where they are needed.

    """

    def __init__(self, mapper: Mapper) -> None:
        """Know no camera."""
        named = mapper.config.tsdf.image_topics
        self._mapper = mapper
        self._images = SceneImages(mapper.config)
        self._kinds = {f'/{topic.lstrip("/")}': kind for kind, topic in named.items()}
        self._infos: dict[str, list[str]] = {}
        if self._images.needs_cameras:
            for topic in self._kinds:
                self._infos.setdefault(camera_info_topic(topic), []).append(topic)
        self.topics = {*self._kinds, *self._infos}

    def take(self, reader: BagReader, message: BagMessage) -> None:
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
