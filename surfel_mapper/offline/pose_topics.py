# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Which topics of a bag hold the poses that the configuration asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from surfel_mapper.bags.topics import ODOMETRY, POSE, TF, Topics
from surfel_mapper.config import Config
from surfel_mapper.errors import BagError
from surfel_mapper.offline.pose_path import PosePath

TYPES = {'tf': TF, 'odometry': ODOMETRY, 'pose': POSE}
"""Type of the messages that each pose.source reads."""

DEFAULTS = {'tf': '/tf', 'odometry': '/odom', 'pose': '/pose'}


@dataclass(frozen=True, slots=True)
class PoseTopics:
    """
    Where the poses of a replay come from.

    Attributes
    ----------
    kinds : dict of str to str
        By topic the pose.source that reads it.
    static : tuple of str
        Topics of static transforms.
    path : PosePath, optional
        Poses from a file.
    mounts : mapping of str to 7 floats
        By topic of clouds the pose of its sensor in frames.base, x y z qx qy qz qw. Its clouds
        get a frame of the topic's name, whatever frame they state.

    """

    kinds: dict[str, str]
    static: tuple[str, ...] = ()
    path: PosePath | None = None
    mounts: Mapping[str, Sequence[float]] = field(default_factory=dict)


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
    if source == 'registration':
        return PoseTopics({}, () if config.frames.base_to_sensor else static_topics(topics))
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
