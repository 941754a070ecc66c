# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A bag through the pipeline: its clouds and poses into a Mapper, in the order of record time.

That order is the one in which the node receives them, so that both map the same; nothing is
looked up ahead, although a bag would allow it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from surfel_mapper.config import Config
from surfel_mapper.errors import BagError, CloudFormatError
from surfel_mapper.io.bag import BagMessage, BagReader
from surfel_mapper.io.bag_topics import ODOMETRY, POSE, TF, Topics
from surfel_mapper.io.pointcloud2 import to_scan
from surfel_mapper.io.pose_messages import poses_in

if TYPE_CHECKING:  # it brings the compiler, which a look into a bag does not need
    from surfel_mapper.pipeline import Mapper, Update

TYPES = {'tf': TF, 'odometry': ODOMETRY, 'pose': POSE}
"""Type of the messages that each pose.source reads."""

DEFAULTS = {'tf': '/tf', 'odometry': '/odom', 'pose': '/pose'}

ALL_SCANS = {
    'window.max_scans': 0,
    'window.max_age_s': 0.0,
    'window.max_distance_m': 0.0,
    'window.max_bytes': 0,
    'map.max_voxels': 0,
}
"""Settings with which no scan leaves the map."""


@dataclass(frozen=True, slots=True)
class PoseTopics:
    """Where the poses of a replay come from: topics by kind, and topics of static transforms."""

    kinds: dict[str, str]
    static: tuple[str, ...] = ()


def pose_topics(topics: Topics, config: Config, name: str | None = None) -> PoseTopics:
    """
    Return the topics that hold the poses which ``pose.source`` asks for.

    Parameters
    ----------
    topics : Topics
        Of the bag.
    config : Config
        Its ``pose.source``; with ``frames.base_to_sensor`` static transforms are needed for tf
        only.
    name : str, optional
        The topic of poses, where there are several.

    Raises
    ------
    BagError
        If the bag has no such topic; names the sources that it does offer.

    """
    source = config.pose.source
    if source == 'identity':
        return PoseTopics({})
    if not topics.of_type(TYPES[source]):
        raise BagError(
            f'{topics.path}: pose.source is {source}, but no topic is of type {TYPES[source]}; '
            f'the bag offers {offered_sources(topics)}'
        )
    if source == 'tf':
        return transform_topics(topics, name)
    chosen = topics.choose(TYPES[source], name, DEFAULTS[source])
    static = () if config.frames.base_to_sensor else static_topics(topics)
    return PoseTopics({chosen: source}, static)


def transform_topics(topics: Topics, name: str | None) -> PoseTopics:
    """Return the topics of the tree of transforms; static ones alone do for a sensor at rest."""
    static = static_topics(topics)
    moving = [topic for topic in topics.of_type(TF) if topic not in static]
    if name is None and len(moving) <= 1:
        return PoseTopics(dict.fromkeys(moving, 'tf'), static)
    return PoseTopics({topics.choose(TF, name, DEFAULTS['tf']): 'tf'}, static)


def static_topics(topics: Topics) -> tuple[str, ...]:
    """Return the topics of transforms that hold for all time, by their customary name."""
    return tuple(topic for topic in topics.of_type(TF) if topic.endswith('tf_static'))


def offered_sources(topics: Topics) -> str:
    """Return the pose sources that a bag has messages for, for an error."""
    found = [
        f'{source} ({", ".join(topics.of_type(type_))})'
        for source, type_ in TYPES.items()
        if topics.of_type(type_)
    ]
    return ', '.join(found) or 'no poses at all; identity maps clouds that are in a fixed frame'


def replay(
    reader: BagReader, mapper: Mapper, cloud_topic: str, poses: PoseTopics
) -> Iterator[Update]:
    """
    Feed a bag to a mapper; yield what each scan did.

    Clouds and poses that cannot be decoded are counted, the first of each is warned about.

    Raises
    ------
    BagError
        If the bag is damaged.

    """
    for message in reader.messages({cloud_topic, *poses.kinds, *poses.static}):
        if message.topic == cloud_topic:
            add_cloud(reader, mapper, message)
        else:
            add_poses(reader, mapper, message, poses)
        yield from mapper.insert_ready()
    mapper.finish()


def add_cloud(reader: BagReader, mapper: Mapper, message: BagMessage) -> None:
    """Decode a cloud and queue it as a scan; a bad one is counted."""
    try:
        with mapper.counters.timed('decode'):
            scan = to_scan(reader.decode(message), message.topic)
    except CloudFormatError as error:
        mapper.refuse_clouds('bad_cloud', message.topic, str(error))
        return
    mapper.add_scan(scan)


def add_poses(reader: BagReader, mapper: Mapper, message: BagMessage, topics: PoseTopics) -> None:
    """Decode a message of poses and enter them; a bad one is counted."""
    try:
        decoded = reader.decode(message)
    except BagError as error:
        mapper.ignore_message('bad_message', f'pose ignored: {error}')
        return
    kind = topics.kinds.get(message.topic, 'tf')
    for pose in poses_in(kind, decoded, mapper.config.frames.base):
        mapper.add_pose(*pose, static=message.topic in topics.static)
