# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A bag through the pipeline: its clouds and poses into a Mapper, in the order of record time.

That order is the one in which the node receives them, so that both make the same map; no message
is looked up ahead, although a bag would allow it. ``BagRecording`` chooses topics and poses,
``feed`` is the loop over messages.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import asdict, replace
from functools import cache, partial
from itertools import islice
import logging
import math
from typing import Any, TYPE_CHECKING

from surfel_mapper.bags.reader import BagMessage, BagReader
from surfel_mapper.config import Config
from surfel_mapper.errors import BagError, CloudFormatError, PoseError
from surfel_mapper.messages.cdr import stamp_ns
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.messages.poses import raw_poses, StampedPose
from surfel_mapper.offline.clocks import clock_offsets
from surfel_mapper.offline.depth_folders import for_depth_images
from surfel_mapper.offline.pose_choice import (
    choose_for_bag,
    first_scans,
    pose_summary,
    sampled,
    why_not_deskewed,
)
from surfel_mapper.offline.pose_sources import (
    pose_topics,
    PosePath,
    PoseTopics,
    STATIC,
    static_topics,
    static_transforms,
)
from surfel_mapper.offline.request import Request, Span, span_of, WHOLE
from surfel_mapper.offline.survey import depth_topics
from surfel_mapper.poses import ClockOffset

if TYPE_CHECKING:  # they load the compiler, which `info` does not need
    from surfel_mapper.offline.image_feeds import Decode, DepthFeed, SceneFeed
    from surfel_mapper.pipeline import Mapper, Update

_log = logging.getLogger(__name__)

CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
"""Type of the calibrations that the feeds of images read."""


class BagRecording:
    """
    Clouds of a bag, with their poses.

    Parameters
    ----------
    reader : BagReader
        The bag.
    request : Request
        Topics and part to map.
    config : Config
        Its ``pose.source`` and ``input`` choose the topics.
    path : PosePath, optional
        Poses from a file.

    Raises
    ------
    BagError
        If the bag lacks a topic or poses.

    """

    def __init__(
        self, reader: BagReader, request: Request, config: Config, path: PosePath | None
    ) -> None:
        self.reader = reader
        self.cuts = reader.cuts
        config = with_depth(reader, request, config)
        self.topics = chosen_topics(reader, request, config)
        check_mounts(request, self.topics, config)
        offsets_ns = {
            topic: round(
                1e9 * (config.input.offset_s(topic) + request.time_offsets.get(topic, 0.0))
            )
            for topic in self.topics
        }
        sample = cache(partial(sampled, reader, offsets_ns))
        choice = choose_for_bag(reader, self.topics, request, config, sample)
        self.pose_reason, config = choice.reason, choice.config
        scans = first_scans(reader, self.topics) if config.input.kind == 'cloud' else []
        self.deskew_reason = why_not_deskewed(config, scans)
        if request.mounts:
            config = config.replace({'frames.base_to_sensor': ()})
        chosen = '' if choice.topic.endswith(STATIC) else choice.topic
        self.poses = self._poses(request, config, path, request.pose_topic or chosen or None)
        static_transforms(reader, self.poses.static)  # refuses topics that disagree
        self.clocks: list[ClockOffset] = []
        if self.poses.kinds or (config.pose.source == 'registration' and path is None):
            self.clocks = [
                replace(clock, added_s=self.poses.offsets_ns.get(clock.clouds, 0) / 1e9)
                for clock in clock_offsets(sample(), self.topics, self.poses.kinds or None)
            ]
        self.config = config
        self.span = span_of(request, reader.start_ns, reader.end_ns)
        if path is not None and not path.has_stamps:
            self._check_number(path)

    def _check_number(self, path: PosePath) -> None:
        """
        Raise if a file has poses without times, too many, or too few for the last scan of a part.

        In parts whose last number takes counting, ``PosePath.add_for`` raises at the scan. A bag
        that is cut off has the first clouds of a drive, and fewer than there are poses.
        """
        num_clouds, num_poses = self.reader.topics.num_messages(self.topics), len(path.trajectory)
        if num_poses > num_clouds and not self.cuts:
            raise BagError(
                f'{path.path}: {num_poses} poses without times for {num_clouds} clouds in '
                f'{self.reader.path}, expected one for each, or poses with times (TUM)'
            )
        start_ns, stop_ns, every = self.span.start_ns, self.span.stop_ns, self.span.every
        if stop_ns is None and (start_ns is None or every == 1):
            path.check_scan((num_clouds - 1) // every * every)

    def _poses(
        self, request: Request, config: Config, path: PosePath | None, name: str | None
    ) -> PoseTopics:
        """Return the source of the poses."""
        topics = self.reader.topics
        if path is None:
            chosen = pose_topics(topics, config, name, self.topics, request.static_topics)
        elif request.pose_topic is not None:
            raise BagError(
                f'{request.path}: poses of {request.pose_topic} and of {path.path}, expected one'
            )
        elif not path.has_stamps and len(self.topics) > 1:
            raise BagError(f'{path.path}: poses without times, for several topics of clouds')
        else:
            static = static_topics(topics, self.topics, request.static_topics)
            chosen = PoseTopics({}, () if config.frames.base_to_sensor else static, path)
        if request.mounts and config.pose.source != 'tf':
            chosen = replace(chosen, static=())  # two poses of one sensor might disagree
        unstamped = frozenset(
            name for name in (*self.topics, *chosen.kinds) if is_unstamped(self.reader, name)
        )
        own_ns = {topic: round(1e9 * seconds) for topic, seconds in request.time_offsets.items()}
        return replace(chosen, mounts=request.mounts, offsets_ns=own_ns, unstamped=unstamped)

    @property
    def num_scans(self) -> int:
        """Estimated number of scans in the part: clouds are taken as evenly spread."""
        first_ns, last_ns = self.reader.start_ns, self.reader.end_ns
        start_ns, stop_ns = self.span.clipped(first_ns, last_ns)
        share = (stop_ns - start_ns) / (last_ns - first_ns) if last_ns > first_ns else 1.0
        return math.ceil(share * self.reader.topics.num_messages(self.topics) / self.span.every)

    @property
    def recorded_s(self) -> float:
        """Duration of the part that is mapped, s."""
        start_ns, stop_ns = self.bounds_ns
        return (stop_ns - start_ns) / 1e9

    @property
    def bounds_ns(self) -> tuple[int, int]:
        """Record time of the first and last message of the part that is mapped."""
        return self.span.clipped(self.reader.start_ns, self.reader.end_ns)

    def describe(self) -> dict[str, Any]:
        """Return the sources of clouds and poses, for the summary."""
        path = self.poses.path
        return {
            'bag': str(self.reader.path),
            'topics': self.topics,
            'pose_topics': [*self.poses.kinds, *self.poses.static],
            'poses': None if path is None else str(path.path),
            **pose_summary(self.config, path, self.pose_reason, self.deskew_reason),
            'clock_offsets': [{**asdict(clock), 'text': str(clock)} for clock in self.clocks],
        }

    def replay(
        self, mapper: Mapper, stopped: Callable[[], bool] = lambda: False
    ) -> Iterator[Update]:
        """Feed the clouds to a mapper; yield the update of each."""
        for clock in self.clocks:
            _log.warning('%s', clock)
        for topic in sorted(self.poses.unstamped):
            _log.warning('%s: header.stamp is 0, not set: the record times are used', topic)
        return feed(self.reader, mapper, self.topics, self.poses, span=self.span, stopped=stopped)


def with_depth(reader: BagReader, request: Request, config: Config) -> Config:
    """
    Return the settings of depth images for a bag that has them and no clouds.

    Raises
    ------
    BagError
        If there are several topics of them and none is named.

    """
    topics = depth_topics(reader) if config.input.kind == 'cloud' else []
    if not topics:
        return config
    if request.topics or request.mounts or config.input.topics:
        return for_depth_images(config)
    if len(topics) > 1:
        raise BagError(
            f'{reader.path}: several topics of depth images, name one with --topic: '
            f'{", ".join(topics)}'
        )
    return for_depth_images(config).replace({'input.topics': topics})


def chosen_topics(reader: BagReader, request: Request, config: Config) -> list[str]:
    """Return the topics to map: those of the request, of the configuration, or the only one."""
    configured = [f'/{name.lstrip("/")}' for name in config.input.topics]
    named = [*request.topics] or [*request.mounts] or configured
    names: list[str | None] = [*named] or [None]
    choose: Callable[[str | None], str] = reader.topics.choose_cloud
    if config.input.kind == 'depth':
        choose = reader.topics.choose_image
    topics = [choose(name) for name in dict.fromkeys(names)]
    for name in config.image_topics.values():
        reader.topics.choose_image(f'/{name.lstrip("/")}')
    return topics


def is_unstamped(reader: BagReader, topic: str) -> bool:
    """Return whether the stamps of a topic are not set, by its first two messages."""
    try:
        first = [reader.decode(message) for message in islice(reader.messages([topic]), 2)]
    except (BagError, CloudFormatError):
        return False
    headers = [
        stamped.header
        for message in first
        for stamped in getattr(message, 'transforms', [message])
    ]
    return bool(headers) and not any(map(stamp_ns, headers))


def check_mounts(request: Request, topics: list[str], config: Config) -> None:
    """Refuse mounts and offsets of other topics, and one mount for several sensors."""
    missing = [topic for topic in topics if topic not in request.mounts]
    unknown = [topic for topic in request.mounts if topic not in topics]
    if request.mounts and (missing or unknown):
        raise BagError(
            f'{request.path}: mounts of {", ".join(request.mounts)}, expected one '
            f'for each of {", ".join(topics)}'
        )
    if others := request.time_offsets.keys() - {*topics}:
        raise BagError(
            f'{request.path}: time offset of {min(others)}, expected of {", ".join(topics)}'
        )
    frames = config.frames
    if len(topics) > 1 and not (request.mounts or frames.sensors) and frames.base_to_sensor:
        raise BagError(
            f'{request.path}: frames.base_to_sensor is the pose of one sensor, not of '
            f'{len(topics)}; state one for each topic with --mount, or their frames in '
            'frames.sensors'
        )


def feed(
    reader: BagReader,
    mapper: Mapper,
    cloud_topics: str | Collection[str],
    poses: PoseTopics,
    *,
    span: Span = WHOLE,
    stopped: Callable[[], bool] = lambda: False,
) -> Iterator[Update]:
    """
    Feed a bag to a mapper; yield the update of each scan.

    Clouds and poses that cannot be decoded are counted; the first of each kind is logged.

    Parameters
    ----------
    reader : BagReader
        The bag.
    mapper : Mapper
        Maps it.
    cloud_topics : str or collection of str
        One topic of clouds, or several; their sensors are distinguished by their frames.
    poses : PoseTopics
        Source of the poses.
    span : Span
        The part to map.
    stopped : callable
        Asked before every message; no more are read once it returns True.

    Raises
    ------
    BagError
        If the bag is damaged.

    """
    clouds = {cloud_topics} if isinstance(cloud_topics, str) else set(cloud_topics)
    static = add_static(reader, mapper, poses)
    first = numbers_before(reader, clouds, poses, span)
    counts: Counter[str] = Counter()

    def add(message: BagMessage, number: int, decode: Decode = to_scan) -> None:
        add_cloud(reader, mapper, message, poses, number, decode)

    images: DepthFeed | None = None
    scenes: SceneFeed | None = None
    if mapper.config.input.kind == 'depth' or mapper.config.image_topics:
        from surfel_mapper.offline.image_feeds import DepthFeed, SceneFeed  # the compiler

        images = DepthFeed(clouds, add) if mapper.config.input.kind == 'depth' else None
        scenes = SceneFeed(mapper) if mapper.config.image_topics else None
    infos = images.info_topics if images else {}
    scene_topics = scenes.topics if scenes else set()
    stream = messages(reader, {*clouds, *infos, *scene_topics}, poses, span)
    while not stopped():
        with mapper.counters.timed('read'):
            message = next(stream, None)
        if message is None:
            break
        if scenes and message.topic in scene_topics:
            scenes.add(reader, message)
        elif images and message.topic in infos:
            add_camera_info(reader, mapper, message, images)
        elif message.topic not in clouds:
            with mapper.counters.timed('poses'):
                add_poses(reader, mapper, message, poses, static)
        elif span.holds(message.record_ns):
            if counts[message.topic] % span.every == 0:
                number = first[message.topic] + counts[message.topic]
                (images.add_image if images else add)(message, number)
            counts[message.topic] += 1
        yield from mapper.insert_ready()
    if scenes:
        mapper.end_images()
    mapper.end_scans()
    yield from mapper.insert_ready()
    mapper.finish()


def messages(
    reader: BagReader, clouds: Collection[str], poses: PoseTopics, span: Span
) -> Iterator[BagMessage]:
    """Yield the messages for a part: those that hold from before it, then its clouds and poses."""
    names = {*clouds, *poses.kinds, *poses.static}
    if span.start_ns is not None:
        lasting = {*poses.static, *early_calibrations(reader, names, span)}
        if lasting:
            yield from reader.messages(lasting, None, span.poses_start_ns)
    yield from reader.messages(names, span.poses_start_ns, span.poses_stop_ns)


def early_calibrations(reader: BagReader, names: Collection[str], span: Span) -> list[str]:
    """
    Return the topics of calibrations that were recorded only well before a part.

    A camera whose calibration is recorded with every image has a later one in the margin of the
    poses; to read all earlier ones is to read the bag from its start.
    """
    margin = span.poses_start_ns, span.start_ns
    infos = [name for name in reader.topics.of_type(CAMERA_INFO) if name in names]
    return [name for name in infos if next(reader.messages([name], *margin), None) is None]


def numbers_before(
    reader: BagReader, clouds: Collection[str], poses: PoseTopics, span: Span
) -> Counter[str]:
    """Count the clouds before a part by topic, if poses belong to clouds by number."""
    if poses.path is None or poses.path.has_stamps or span.start_ns is None:
        return Counter()
    return Counter(message.topic for message in reader.messages(clouds, None, span.start_ns))


def add_cloud(
    reader: BagReader,
    mapper: Mapper,
    message: BagMessage,
    poses: PoseTopics,
    number: int,
    decode: Decode = to_scan,
) -> None:
    """Decode a cloud or an image and queue it as a scan, with its pose if a file has it."""
    frame_id, is_mounted = '', message.topic in poses.mounts
    try:
        with mapper.counters.timed('decode'):
            decoded = reader.decode(message)
            frame_id = decoded.header.frame_id
            scan = decode(decoded, message.topic)
    except (CloudFormatError, BagError) as error:
        reason = f'in frame {frame_id!r}, {error}' if frame_id else str(error)
        frame_id = '' if is_mounted else frame_id
        mapper.refuse_clouds('bad_cloud', message.topic, reason, frame_id=frame_id)
        return
    if is_mounted:
        scan = replace(scan, frame_id=message.topic)
    if message.topic in poses.unstamped:
        scan = scan.moved_in_time(message.record_ns - scan.stamp_ns)
    scan = scan.moved_in_time(poses.offsets_ns.get(message.topic, 0))
    if poses.path is not None:
        offset_ns = round(1e9 * mapper.config.input.offset_s(message.topic))
        poses.path.add_for(mapper, scan.stamp_ns + offset_ns, number)
    mapper.add_scan(scan, message.topic)


def add_camera_info(
    reader: BagReader, mapper: Mapper, message: BagMessage, images: DepthFeed
) -> None:
    """Decode a calibration, and map the images that waited for it; a bad one is counted."""
    try:
        images.add_info(message.topic, reader.decode(message))
    except (CloudFormatError, BagError) as error:
        mapper.ignore_message('bad_message', f'calibration ignored: {error}')


def add_static(
    reader: BagReader, mapper: Mapper, poses: PoseTopics
) -> dict[tuple[str, str], StampedPose]:
    """Enter mounts and the first static transforms; return the latter for ``add_poses``."""
    for topic, mount in poses.mounts.items():
        base = mapper.config.frames.base
        mapper.add_pose(base, topic, 0, mount[:3], mount[3:], static=True)
    static = static_transforms(reader, poses.static)
    for pose in static.values():
        add_pose(mapper, pose, poses, is_static=True)
    return static


def add_poses(
    reader: BagReader,
    mapper: Mapper,
    message: BagMessage,
    topics: PoseTopics,
    static: dict[tuple[str, str], StampedPose],
) -> None:
    """Enter the poses of a message that are not in ``static``; one that is damaged is counted."""
    kind, base = topics.kinds.get(message.topic, 'tf'), mapper.config.frames.base
    try:
        poses = raw_poses(kind, message.raw, base, message.topic, ros1=reader.is_ros1)
    except PoseError as error:
        mapper.ignore_message('bad_message', f'pose ignored: {error}')
        return
    is_static = message.topic in topics.static
    for pose in poses:
        if message.topic in topics.unstamped:
            pose = pose._replace(stamp_ns=message.record_ns)
        if is_static:
            key, pose = (message.topic, pose.child), pose._replace(stamp_ns=0)
            if static.get(key) == pose:
                continue
            static[key] = pose
        add_pose(mapper, pose, topics, is_static=is_static)


def add_pose(mapper: Mapper, pose: StampedPose, topics: PoseTopics, *, is_static: bool) -> None:
    """Enter a pose, unless a file has the poses of its frame."""
    if topics.path is None or pose.child != mapper.config.frames.base:
        mapper.add_pose(*pose, static=is_static)
