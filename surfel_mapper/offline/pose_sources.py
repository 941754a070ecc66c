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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surfel_mapper.bags.topics import ODOMETRY, POSE, TF, Topics
from surfel_mapper.config import Config
from surfel_mapper.errors import BagError
from surfel_mapper.files.trajectory import read_trajectory, Trajectory
from surfel_mapper.poses import AUTO

if TYPE_CHECKING:
    from surfel_mapper.pipeline import Mapper

TYPES = {'tf': TF, 'odometry': ODOMETRY, 'pose': POSE}
"""Type of the messages that each pose.source reads."""

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

    """

    kinds: dict[str, str]
    static: tuple[str, ...] = ()
    path: PosePath | None = None
    mounts: Mapping[str, Sequence[float]] = field(default_factory=dict)


def pose_topics(topics: Topics, config: Config, name: str | None = None) -> PoseTopics:
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
    if source == AUTO:
        source = next((kind for kind, type_ in TYPES.items() if topics.of_type(type_)), 'tf')
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
    """Return the topics of the transform tree; static ones alone suffice for a sensor at rest."""
    static = static_topics(topics)
    moving = [topic for topic in topics.of_type(TF) if topic not in static]
    if name is None and len(moving) <= 1:
        return PoseTopics(dict.fromkeys(moving, 'tf'), static)
    return PoseTopics({topics.choose(TF, name, DEFAULTS['tf']): 'tf'}, static)


def static_topics(topics: Topics) -> tuple[str, ...]:
    """Return the topics of static transforms: those whose name ends in tf_static."""
    return tuple(topic for topic in topics.of_type(TF) if topic.endswith('tf_static'))


def offered_sources(topics: Topics) -> str:
    """Return the pose sources that a bag has messages for, for an error."""
    found = [
        f'{source} ({", ".join(topics.of_type(type_))})'
        for source, type_ in TYPES.items()
        if topics.of_type(type_)
    ]
    return ', '.join(found) or 'no poses at all; identity maps clouds that are in a fixed frame'
