# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Sources of poses of a recording: topics of a bag, or a file of poses.

``pose_topics`` finds the topics for the ``pose.source`` of the configuration. ``PosePath`` feeds
the poses of a file to a mapper as the scans come: a mapper forgets poses older than a minute, so
they cannot all be entered at the start. Each scan gets those up to a little after its stamp,
which is all that interpolation needs.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surfel_mapper.bags.topics import ODOMETRY, POSE, POSE_WITH_COVARIANCE, TF, Topics
from surfel_mapper.config import Config
from surfel_mapper.errors import BagError, PoseError
from surfel_mapper.files.trajectory import read_trajectory, Trajectory
from surfel_mapper.messages.poses import raw_poses, StampedPose
from surfel_mapper.poses import AUTO

if TYPE_CHECKING:
    from surfel_mapper.bags.reader import BagReader
    from surfel_mapper.pipeline import Mapper

TYPES = {'tf': (TF,), 'odometry': (ODOMETRY,), 'pose': (POSE, POSE_WITH_COVARIANCE)}
"""Types of the messages that each pose.source reads, the usual one first."""

SET_BY_HAND = 'initialpose'
"""End of the name of topics whose poses users set in RViz; these are no source."""

SAME_PLACE = 1e-4
"""Difference of the numbers of two static transforms that agree, as of rounded texts, m."""

STATIC = 'tf_static'
"""End of the name of topics of static transforms."""

DEFAULTS = {'tf': '/tf', 'odometry': '/odom', 'pose': '/pose'}
"""Topic that each pose.source takes if the bag has several of its type."""

MARGIN_NS = 2_000_000_000
"""
Poses of a file are entered from 2 s before the first scan (scans may come out of order) to 2 s
after each scan (its points are recorded until the end of its sweep).
"""


class PosePath:
    """
    Poses of frames.base in frames.fixed, from a file.

    Parameters
    ----------
    path : Path
        A trajectory; see read_trajectory.
    format_ : str, optional
        tum, kitti, csv or g2o.
    trajectory : Trajectory, optional
        The poses, if they have been read from the file.

    Attributes
    ----------
    trajectory : Trajectory
        The poses; if they have no stamps, they belong to scans by number.

    """

    def __init__(
        self, path: Path, format_: str | None = None, trajectory: Trajectory | None = None
    ) -> None:
        self.path = path
        self.trajectory = trajectory or read_trajectory(path, format_)
        number = self.trajectory.number
        self._rows = None if number is None else {n: row for row, n in enumerate(number.tolist())}
        self._next: int | None = None

    @property
    def has_stamps(self) -> bool:
        """Whether poses belong to scans by time, not by number."""
        return self.trajectory.stamp_ns is not None

    def add_for(self, mapper: Mapper, stamp_ns: int, number: int) -> None:
        """
        Enter the poses that a scan needs.

        Parameters
        ----------
        mapper : Mapper
            Takes the poses.
        stamp_ns : int
            Stamp of the scan.
        number : int
            Number of the pose of the scan, from 0, if poses have no stamps. A scan without one
            waits for those of others.

        Raises
        ------
        BagError
            If the poses have no stamps, and there are fewer of them than scans.

        """
        self.check_scan(number)
        stamps = self.trajectory.stamp_ns
        if stamps is None:
            row = number if self._rows is None else self._rows.get(number)
            if row is not None:
                self._add(mapper, row, stamp_ns)
            return
        if self._next is None:
            self._next = int(np.searchsorted(stamps, stamp_ns - MARGIN_NS))
            self._next = max(self._next - 1, 0)
        while self._next < len(stamps):
            self._add(mapper, self._next, int(stamps[self._next]))
            self._next += 1
            if stamps[self._next - 1] >= stamp_ns + MARGIN_NS:
                return

    def check_scan(self, number: int) -> None:
        """Raise BagError if the poses have no stamps, and there is none for a scan's number."""
        if not self.has_stamps and self._rows is None and number >= len(self.trajectory):
            raise BagError(
                f'{self.path}: {len(self.trajectory)} poses, none for scan {number + 1}; '
                'expected one for every scan, or a times.txt beside it'
            )

    def _add(self, mapper: Mapper, row: int, stamp_ns: int) -> None:
        frames, poses = mapper.config.frames, self.trajectory
        mapper.add_pose(frames.fixed, frames.base, stamp_ns, poses.xyz[row], poses.q_xyzw[row])


@dataclass(frozen=True, slots=True)
class PoseTopics:
    """
    Sources of the poses of a replay.

    Attributes
    ----------
    kinds : dict of str to str
        The pose.source that reads each topic of poses.
    static : tuple of str
        Topics of static transforms.
    path : PosePath, optional
        Poses from a file.
    mounts : mapping of str to 7 floats
        Pose of the sensor of each topic of clouds in frames.base, x y z qx qy qz qw. Clouds of
        these topics get the topic's name as frame; the frame in their header is ignored.
    offsets_ns : mapping of str to int
        Added to the stamps of the clouds of a topic.
    unstamped : frozenset of str
        Topics whose stamps are not set: their record times are used.

    """

    kinds: dict[str, str]
    static: tuple[str, ...] = ()
    path: PosePath | None = None
    mounts: Mapping[str, Sequence[float]] = field(default_factory=dict)
    offsets_ns: Mapping[str, int] = field(default_factory=dict)
    unstamped: frozenset[str] = frozenset()


def pose_topics(
    topics: Topics,
    config: Config,
    name: str | None = None,
    clouds: Collection[str] = (),
    static: Collection[str] = (),
) -> PoseTopics:
    """
    Return the topics that hold the poses for ``pose.source``.

    Parameters
    ----------
    topics : Topics
        Topics of the bag.
    config : Config
        Gives ``pose.source``, auto for the first that is there. If ``frames.base_to_sensor`` is
        set, static transforms are needed for tf only.
    name : str, optional
        The topic of poses, if there are several.
    clouds : collection of str
        The topics of clouds, in the namespaces of which static transforms are looked for.
    static : collection of str
        The topics of static transforms instead.

    Raises
    ------
    BagError
        If the bag has no such topic; names the sources that it does offer.

    """
    source, names = config.pose.source, [*clouds]
    if source == 'identity':
        return PoseTopics({})
    if source == 'registration':
        if config.frames.base_to_sensor:
            return PoseTopics({})
        return PoseTopics({}, static_topics(topics, names, static))
    if source == AUTO and name is not None:  # no source has it
        raise BagError(
            f'{topics.path}: no poses on {name}; the bag offers {offered_sources(topics)}'
        )
    if source == AUTO:
        source = next((kind for kind in TYPES if source_topics(topics, kind)), 'tf')
    usual, *further = TYPES[source]
    if not topics.of_type(usual, *further):
        raise BagError(
            f'{topics.path}: pose.source is {source}, but no topic is of type '
            f'{" or ".join(TYPES[source])}; the bag offers {offered_sources(topics)}'
        )
    if source == 'tf' and name is None:
        moving = source_topics(topics, 'tf')
        chosen = moving if len(moving) <= 1 else [topics.choose(TF, None, DEFAULTS['tf'])]
    elif name is None and len(source_topics(topics, source)) == 1:
        chosen = source_topics(topics, source)
    else:
        chosen = [topics.choose(usual, name, DEFAULTS[source], or_else=tuple(further))]
    names += chosen
    is_mounted = source != 'tf' and config.frames.base_to_sensor
    mounts = () if is_mounted else static_topics(topics, names, static)
    return PoseTopics(dict.fromkeys(chosen, source), mounts)


def source_topics(topics: Topics, source: str) -> list[str]:
    """Return the topics that a pose.source may read: no static transforms, no poses from RViz."""
    names = topics.of_type(*TYPES[source])
    return [name for name in names if not name.endswith((STATIC, SET_BY_HAND))]


def static_topics(
    topics: Topics, names: Collection[str] = (), chosen: Collection[str] = ()
) -> tuple[str, ...]:
    """
    Return the topics of static transforms: tf_static in some namespace.

    Parameters
    ----------
    topics : Topics
        Topics of the bag.
    names : collection of str
        Topics of clouds and poses: the static transforms of their namespaces are returned. If
        there are none, those of all namespaces without clouds of another robot.
    chosen : collection of str
        Topics that the user named instead.

    """
    static = [topic for topic in topics.of_type(TF) if topic.endswith(STATIC)]
    if chosen:
        return tuple(topics.choose(TF, name) for name in chosen)
    own = [topic for topic in static if any(shares_namespace(topic, name) for name in names)]
    foreign = [cloud for cloud in topics.of_type(*topics.clouds) if names and cloud not in names]
    unowned = [t for t in static if not any(shares_namespace(t, cloud) for cloud in foreign)]
    return tuple(own or unowned)


def shares_namespace(topic: str, name: str) -> bool:
    """Return whether a topic of transforms is in the namespace of another topic or above it."""
    return name.startswith(f'{topic.rpartition("/")[0]}/')


def static_transforms(
    reader: BagReader, topics: Collection[str]
) -> dict[tuple[str, str], StampedPose]:
    """
    Return the first static transform of each pair of frames in a bag, by topic and child frame.

    They hold from the beginning, whenever they were recorded, as ``/tf_static`` is latched.

    Raises
    ------
    BagError
        If two topics disagree about a frame.

    """
    first: dict[tuple[str, str], StampedPose] = {}
    for message in reader.all_messages(topics):
        with suppress(PoseError):
            for pose in raw_poses('tf', message.raw, '', message.topic, ros1=reader.is_ros1):
                first.setdefault((message.topic, pose.child), pose._replace(stamp_ns=0))
    by_child: dict[str, tuple[str, StampedPose]] = {}
    for (topic, child), pose in first.items():
        first_topic, agreed = by_child.setdefault(child, (topic, pose))
        first_numbers, numbers = ([*other.xyz, *other.q_xyzw] for other in (agreed, pose))
        is_same = np.allclose(first_numbers, numbers, atol=SAME_PLACE, rtol=0.0, equal_nan=True)
        if agreed.parent != pose.parent or not is_same:
            raise BagError(
                f'{reader.path}: {first_topic} and {topic} disagree about the frame {child}: '
                f'{placed(agreed)}, {placed(pose)}; --static-topic selects one, --mount states '
                'the pose of a sensor'
            )
    return first


def placed(pose: StampedPose) -> str:
    """Return the pose of a frame in another, x y z qx qy qz qw, for an error."""
    return f'at {" ".join(f"{value:g}" for value in (*pose.xyz, *pose.q_xyzw))} in {pose.parent}'


def offered_sources(topics: Topics) -> str:
    """Return the pose sources that a bag has messages for, for an error."""
    sources = [
        f'{source} ({", ".join(topics.of_type(*types))})'
        for source, types in TYPES.items()
        if topics.of_type(*types)
    ]
    return ', '.join(sources) or 'no poses at all; identity maps clouds that are in a fixed frame'
