# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Survey of a bag: its topics with rates and frames, and the poses that its clouds have.

Every source of poses is tried on every cloud with the TransformBuffer that mapping uses, so a
replay finds the same poses, except for scans whose poses come later than ``pose.max_wait_s``.
Only the headers of clouds are read.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
import math
import re
from typing import Any

from surfel_mapper.bags.reader import BagMessage, BagReader
from surfel_mapper.bags.topics import IMAGE, PACKED_IMAGE, Topic, Topics
from surfel_mapper.config import Config
from surfel_mapper.errors import BagError, CloudFormatError, PoseError
from surfel_mapper.geometry import pose_matrix, q_xyzw
from surfel_mapper.messages.cdr import frame_name, stamp_ns
from surfel_mapper.messages.poses import raw_poses, StampedPose
from surfel_mapper.offline.pose_sources import shares_namespace, static_topics, TYPES
from surfel_mapper.poses import above, TransformBuffer

SOURCES = {type_: source for source, types in TYPES.items() for type_ in types}
"""The pose.source that reads each type."""

IMAGES = (IMAGE, PACKED_IMAGE)

ALL_TIME_S = 1e9
"""Buffer length of a survey, s: it holds every transform of a bag."""

DEFAULTS = Config()

FIXED_NAME = re.compile(r'(?:^|[_/])(?:odom|map|world)(?:$|[_/])')
"""Names of fixed frames, as odom_lidar."""


@dataclass(slots=True)
class TopicSurvey:
    """
    Times and frames of the messages of a topic.

    Attributes
    ----------
    topic : Topic
    first_ns, last_ns : int, optional
        Record time of the first and last message, of clouds and poses only.
    frames : list of str
        Frames of clouds, and 'parent -> child' of poses, each once.

    """

    topic: Topic
    first_ns: int | None = None
    last_ns: int | None = None
    frames: list[str] = field(default_factory=list)

    def add(self, record_ns: int, frames: Iterable[str]) -> None:
        """Add the time and frames of a message."""
        self.first_ns = record_ns if self.first_ns is None else self.first_ns
        self.last_ns = record_ns
        self.frames += [name for name in dict.fromkeys(frames) if name not in self.frames]

    @property
    def rate_hz(self) -> float | None:
        """Messages a second from the first to the last; None if unknown."""
        if self.first_ns is None or self.last_ns is None or self.last_ns <= self.first_ns:
            return None
        return (self.topic.count - 1) * 1e9 / (self.last_ns - self.first_ns)


@dataclass(slots=True)
class Survey:
    """
    Topics, clouds and poses of a bag.

    Attributes
    ----------
    topics : dict of str to TopicSurvey
    reader_topics : Topics
        The topics of the bag.
    stamps : dict of (str, str) to list of int
        Stamps of the clouds, ns, by topic and frame.
    poses : dict of str to list of StampedPose
        By topic.
    static : dict of str to list of StampedPose
        Static transforms, by topic.
    leads_ns : dict of str to list of int
        Times by which the stamps of clouds and poses are ahead of their record times, by topic.
    undecodable : int
        Number of damaged messages of clouds and poses.

    """

    topics: dict[str, TopicSurvey]
    reader_topics: Topics
    stamps: dict[tuple[str, str], list[int]] = field(default_factory=dict)
    poses: dict[str, list[StampedPose]] = field(default_factory=dict)
    static: dict[str, list[StampedPose]] = field(default_factory=dict)
    leads_ns: dict[str, list[int]] = field(default_factory=dict)
    undecodable: int = 0

    @property
    def sources(self) -> list[Source]:
        """The topics of poses; that of static transforms stands for a sensor at rest."""
        sources = [
            Source(topic, SOURCES[self.topics[topic].topic.type], poses)
            for topic, poses in self.poses.items()
        ]
        if self.static and 'tf' not in [source.kind for source in sources]:
            sources.append(Source('/tf_static', 'tf', []))
        return sources

    def static_for(self, *names: str) -> list[StampedPose]:
        """Return the static transforms of clouds and poses; see static_topics."""
        chosen = static_topics(self.reader_topics, names)
        return [pose for topic in chosen for pose in self.static.get(topic, [])]


@dataclass(frozen=True, slots=True)
class Offer:
    """
    A source of poses, tried on the clouds of a topic.

    Attributes
    ----------
    clouds, poses : str
        The topics.
    covered, total : int
        Clouds that have a pose at their stamp, and all.
    settings : dict of str
        The settings that choose it.
    missing : str
        Why the last cloud without a pose has none; empty if all have one.

    """

    clouds: str
    poses: str
    covered: int
    total: int
    settings: dict[str, Any]
    missing: str = ''


def survey(
    reader: BagReader,
    on_message: Callable[[], object] = lambda: None,
    stop_ns: int | None = None,
    offsets_ns: Mapping[str, int] | None = None,
) -> Survey:
    """
    Read all clouds and poses of a bag.

    Parameters
    ----------
    reader : BagReader
        The bag.
    on_message : callable
        Called after every message, for a progress bar.
    stop_ns : int, optional
        Record time at which to stop; without, the whole bag is read.
    offsets_ns : mapping of str to int, optional
        Added to the stamps of the clouds of a topic.

    Raises
    ------
    BagError
        If the bag is damaged.

    """
    content = Survey({topic.name: TopicSurvey(topic) for topic in reader.topics}, reader.topics)
    static = static_topics(reader.topics)
    moving = [name for name in surveyed_topics(reader) if name not in static]
    for message in chain(reader.all_messages(static), reader.messages(moving, None, stop_ns)):
        try:
            offset_ns = (offsets_ns or {}).get(message.topic, 0)
            frames = note_message(content, reader, message, static, offset_ns)
        except (BagError, CloudFormatError, PoseError):
            content.undecodable += 1
            frames = []
        content.topics[message.topic].add(message.record_ns, frames)
        on_message()
    return content


def surveyed_topics(reader: BagReader) -> list[str]:
    """Return the topics of clouds, or of depth images without any, and of poses."""
    return [*reader.topics.of_type(*reader.topics.clouds, *SOURCES), *depth_topics(reader)]


def depth_topics(reader: BagReader) -> list[str]:
    """Return the topics of depth images of a bag without clouds, the unpacked ones if any."""
    if reader.topics.of_type(*reader.topics.clouds):
        return []
    for type_ in IMAGES:
        names = [name for name in reader.topics.of_type(type_) if is_depth(reader, name)]
        if names:
            return names
    return []


def is_depth(reader: BagReader, topic: str) -> bool:
    """Return whether the first image of a topic is one of depth; infrared may be mono16 too."""
    try:
        message = next(iter(reader.messages([topic])), None)
        image = None if message is None else reader.decode(message)
    except (BagError, CloudFormatError):
        return False
    encoding = str(getattr(image, 'encoding', getattr(image, 'format', '')))
    is_named = 'depth' in topic.lower()
    return encoding.startswith(('16UC1', '32FC1')) or (
        is_named and ('compressedDepth' in encoding or encoding == 'mono16')
    )


def note_message(
    content: Survey,
    reader: BagReader,
    message: BagMessage,
    static: Collection[str],
    offset_ns: int = 0,
) -> list[str]:
    """Add a message to a survey and return the frames that it names."""
    if message.type in (*reader.topics.clouds, *IMAGES):
        decoded = reader.decode(message)
        frame = frame_name(decoded.header.frame_id)
        stamp = (stamp_ns(decoded.header) or message.record_ns) + offset_ns
        content.stamps.setdefault((message.topic, frame), []).append(stamp)
        content.leads_ns.setdefault(message.topic, []).append(stamp - message.record_ns)
        return [frame]
    kind, base = SOURCES[message.type], DEFAULTS.frames.base
    poses = raw_poses(kind, message.raw, base, message.topic, ros1=reader.is_ros1)
    if message.topic in static:
        content.static.setdefault(message.topic, []).extend(poses)
    else:
        poses = [p if p.stamp_ns else p._replace(stamp_ns=message.record_ns) for p in poses]
        content.poses.setdefault(message.topic, []).extend(poses)
        leads = content.leads_ns.setdefault(message.topic, [])
        leads += [pose.stamp_ns - message.record_ns for pose in poses]
    return [f'{pose.parent} -> {pose.child}' for pose in poses]


def offers(content: Survey) -> list[Offer]:
    """Return every source of poses tried on every topic of clouds, the best of each first."""
    made = [
        tried(source, content.static_for(clouds, source.topic), clouds, frame, stamps)
        for (clouds, frame), stamps in content.stamps.items()
        for source in of_namespace(content.sources, clouds)
    ]
    kinds = list(SOURCES.values())
    return sorted(
        made, key=lambda o: (o.clouds, -o.covered, kinds.index(o.settings['pose.source']))
    )


def of_namespace(sources: Sequence[Source], clouds: str) -> list[Source]:
    """Return the sources of each kind in the innermost namespace of clouds; all if none is."""
    depths = {
        kind: max(
            (
                source.topic.count('/')
                for source in sources
                if source.kind == kind and shares_namespace(source.topic, clouds)
            ),
            default=0,
        )
        for kind in TYPES
    }
    return [
        source
        for source in sources
        if not depths[source.kind]
        or (
            shares_namespace(source.topic, clouds)
            and source.topic.count('/') == depths[source.kind]
        )
    ]


@dataclass(frozen=True, slots=True)
class Source:
    """A topic of poses: its pose.source and its poses."""

    topic: str
    kind: str
    poses: list[StampedPose]


def tried(
    source: Source, static: list[StampedPose], clouds: str, frame: str, stamps: list[int]
) -> Offer:
    """Look the pose of every cloud up in one source."""
    if source.kind == 'tf':
        fixed, base = fixed_frame(source.poses, static, frame), DEFAULTS.frames.base
    else:
        fixed, base = source.poses[0].parent, source.poses[0].child
    settings: dict[str, Any] = {'pose.source': source.kind, 'frames.fixed': fixed}
    (buffer, refused), missing = transforms(source.poses, static), ''
    if source.kind != 'tf' and base != frame:
        mount = mounting(static, base, frame)
        settings |= {'frames.base': base, 'frames.base_to_sensor': mount}
        if not mount:
            missing = f'no place of {frame} in {base} in the bag: measure frames.base_to_sensor'
            if frame == fixed:
                missing = f'poses and clouds are in {fixed}; --poses-from identity maps them'
            frame = base
    covered = 0
    if source.kind != 'tf' and fixed == base:
        return Offer(clouds, source.topic, 0, len(stamps), settings, f'it is of {base} in itself')
    for stamp in stamps:
        try:
            buffer.lookup(fixed, frame, stamp)
            covered += 1
        except PoseError as error:
            missing = (not covered and refused) or str(error)
    return Offer(clouds, source.topic, covered, len(stamps), settings, missing)


def transforms(poses: list[StampedPose], static: list[StampedPose]) -> tuple[TransformBuffer, str]:
    """Return a buffer of all poses but those that mapping would ignore, and why it would."""
    refused = ''
    buffer = TransformBuffer(ALL_TIME_S, ALL_TIME_S, DEFAULTS.pose.max_gap_s or math.inf)
    for pose, is_static in [*((p, True) for p in static), *((p, False) for p in poses)]:
        try:
            transform = pose_matrix(pose.xyz, pose.q_xyzw)
            if is_static:
                buffer.add_static(pose.parent, pose.child, transform)
            else:
                buffer.add(pose.parent, pose.child, pose.stamp_ns, transform)
        except (PoseError, ValueError) as error:
            refused = f'pose of {pose.child} in {pose.parent}: {error}'
    return buffer, refused


def fixed_frame(poses: list[StampedPose], static: list[StampedPose], frame: str) -> str:
    """
    Return the frame to map in: odom or map if the tree has it above a frame, else its root.

    Some odometry is published upside down: the moving child of the root is then a frame like odom.
    """
    parents = {pose.child: pose.parent for pose in [*poses, *static]}
    chain = above(parents, frame)
    customary = [name for name in ('odom', 'map') if name in chain[1:]]
    below = [p.child for p in poses if p.parent == chain[-1] and FIXED_NAME.search(p.child)]
    return (customary or below or chain[1:][-1:] or [DEFAULTS.frames.fixed])[0]


def mounting(static: list[StampedPose], base: str, frame: str) -> list[float]:
    """
    Return the pose of a sensor in its base as frames.base_to_sensor wants it; empty if unknown.

    A direct transform is returned unchanged, so that mapping with it gives the same bits.
    """
    direct = [pose for pose in static if (pose.parent, pose.child) == (base, frame)]
    if direct:
        return [*direct[-1].xyz, *direct[-1].q_xyzw]
    try:
        transform = transforms([], static)[0].lookup(base, frame, 0)
    except PoseError:
        return []
    return [float(value) for value in (*transform[:3, 3], *q_xyzw(transform))]
