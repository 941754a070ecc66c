# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The topics of a bag, and the choice among them.

A topic that was not named is chosen only if it is the only one of its type: a map from the wrong
one of two lidars looks right.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from surfel_mapper.errors import BagError
from surfel_mapper.messages.converters import converter

CLOUD = 'sensor_msgs/msg/PointCloud2'
IMAGE = 'sensor_msgs/msg/Image'
PACKED_IMAGE = 'sensor_msgs/msg/CompressedImage'
ODOMETRY = 'nav_msgs/msg/Odometry'
POSE = 'geometry_msgs/msg/PoseStamped'
POSE_WITH_COVARIANCE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
TF = 'tf2_msgs/msg/TFMessage'

SAME_AS = {'tf/msg/tfMessage': TF}
"""Names of types in early ROS 1, and the type with the same content."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag, with type and number of messages by the index."""

    name: str
    type: str
    count: int


class Topics(list[Topic]):
    """
    The topics of the bag at a path, which errors name.

    Attributes
    ----------
    clouds : tuple of str
        The types that can be read as clouds, PointCloud2 first.

    """

    def __init__(
        self, path: Path, topics: Collection[Topic], clouds: tuple[str, ...] = (CLOUD,)
    ) -> None:
        super().__init__(topics)
        self.path, self.clouds = path, clouds

    def num_messages(self, names: Collection[str]) -> int:
        """Return the number of messages of the named topics by the index."""
        return sum(topic.count for topic in self if topic.name in names)

    def of_type(self, *types: str) -> list[str]:
        """Return the names of the topics of any of the types."""
        return [topic.name for topic in self if topic.type in types]

    def choose_cloud(self, name: str | None = None) -> str:
        """Return the topic of clouds to read; other types if named, or without PointCloud2."""
        is_usual = name is None and self.of_type(CLOUD)
        return self.choose(CLOUD, name, or_else=() if is_usual else self.clouds[1:])

    def choose_image(self, name: str | None = None) -> str:
        """
        Return the topic of images to read, chosen as in choose.

        Compressed images are chosen if they are named, or if there are no others.
        """
        packed = () if name is None and self.of_type(IMAGE) else (PACKED_IMAGE,)
        return self.choose(IMAGE, name, or_else=packed)

    def choose(
        self,
        type_: str,
        name: str | None = None,
        default: str | None = None,
        *,
        or_else: tuple[str, ...] = (),
    ) -> str:
        """
        Return the topic to read: the one named, else the default, else the only one of its type.

        Parameters
        ----------
        type_ : str
            The type it must have, such as sensor_msgs/msg/PointCloud2.
        name : str, optional
            What the user asked for.
        default : str, optional
            Taken if ``name`` is not given and the bag has it.
        or_else : tuple of str
            Further types that are accepted.

        Raises
        ------
        BagError
            If there is no such topic, it has another type, or there are several to choose from.

        """
        offered = self.of_type(type_, *or_else)
        short = type_.rpartition('/')[2]
        offers = f'{short} topics: {", ".join(offered) or "none"}'
        if name is not None:
            if name in offered:
                return name
            types = [topic.type for topic in self if topic.name == name]
            problem = f'{name} is of type {types[0]}, not {short}' if types else f'no topic {name}'
            raise BagError(f'{self.path}: {problem}; {offers}')
        if default is not None and default in offered:
            return default
        if len(offered) == 1:
            return offered[0]
        if offered:
            option = '--topic' if type_ in (CLOUD, IMAGE) else '--pose-topic'
            raise BagError(
                f'{self.path}: several topics to choose from, name one with {option}; {offers}'
            )
        every = ', '.join(f'{topic.name} ({topic.type})' for topic in self)
        advice = '; '.join(converters(self)) if type_ == CLOUD else ''
        images = type_ == CLOUD and self.of_type(IMAGE)
        raise BagError(
            f'{self.path}: no topic of type {type_}; its topics: {every}'
            f'{f"; to convert: {advice}" if advice else ""}'
            f'{"; images are read if they are depth as 16UC1 or 32FC1" if images else ""}'
        )


def converters(topics: Collection[Topic]) -> list[str]:
    """Return the program that makes PointCloud2 of each type for which there is one."""
    types = dict.fromkeys(topic.type for topic in topics)
    return [f'{type_}: {program}' for type_ in types if (program := converter(type_))]
