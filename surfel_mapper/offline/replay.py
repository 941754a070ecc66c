# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A bag through the pipeline: its clouds and poses into a Mapper, in the order of record time.

That order is the one in which the node receives them, so that both map the same; nothing is
looked up ahead, although a bag would allow it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from surfel_mapper.bags.reader import BagMessage, BagReader
from surfel_mapper.errors import BagError, CloudFormatError, PoseError
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.messages.raw_pose import raw_poses
from surfel_mapper.offline.pose_topics import PoseTopics
from surfel_mapper.offline.span import Span, WHOLE

if TYPE_CHECKING:  # it brings the compiler, which a look into a bag does not need
    import numpy as np
    import numpy.typing as npt

    from surfel_mapper.offline.depth_feed import Decode, DepthFeed
    from surfel_mapper.offline.scene_feed import SceneFeed
    from surfel_mapper.pipeline import Mapper, Update

ALL_SCANS = {
    'window.max_scans': 0,
    'window.max_age_s': 0.0,
    'window.max_distance_m': 0.0,
    'window.max_bytes': 0,
    'map.max_voxels': 0,
}
"""Settings with which no scan leaves the map."""


def load_start(mapper: Mapper) -> None:
    """
    Give a mapper the map that ``map.load`` names, if any; its surfels never leave.

    Raises
    ------
    FileFormatError
        If it cannot be read, or is of another voxel size.
    MapError
        If it has other columns than are configured.

    """
    from surfel_mapper.files.map_state import load_map  # it brings the compiler

    path = mapper.config.map.load
    if path:
        surfel_map, _ = load_map(path, voxel_size_m=mapper.map.voxel_size_m)
        mapper.restore(surfel_map, [])


def replay(
    reader: BagReader,
    mapper: Mapper,
    cloud_topics: str | Collection[str],
    poses: PoseTopics,
    *,
    span: Span = WHOLE,
    stopped: Callable[[], bool] = lambda: False,
) -> Iterator[Update]:
    """
    Feed a bag to a mapper; yield what each scan did.

    Clouds and poses that cannot be decoded are counted, the first of each is warned about.

    Parameters
    ----------
    reader : BagReader
        The bag.
    mapper : Mapper
        Maps it.
    cloud_topics : str or collection of str
        One topic of clouds, or several; their sensors are told apart by their frames.
    poses : PoseTopics
        Where poses come from.
    span : Span
        Which clouds.
    stopped : callable
        Asked before every message; once it is true no more are read.

    Raises
    ------
    BagError
        If the bag is damaged.

    """
    clouds = {cloud_topics} if isinstance(cloud_topics, str) else set(cloud_topics)
    for topic, mount in poses.mounts.items():
        base = mapper.config.frames.base
        mapper.add_pose(base, topic, 0, mount[:3], mount[3:], static=True)
    first = numbers_before(reader, clouds, poses, span)
    seen: Counter[str] = Counter()

    def add(message: BagMessage, number: int, decode: Decode = to_scan) -> None:
        add_cloud(reader, mapper, message, poses, number, decode)

    images = depth_feed(clouds, add) if mapper.config.input.kind == 'depth' else None
    infos = images.info_topics if images else {}
    beside = scene_feed(mapper)
    scenes = beside.topics if beside else set()
    for message in messages(reader, {*clouds, *infos, *scenes}, poses, span):
        if stopped():
            break
        if beside and message.topic in scenes:
            beside.take(reader, message)
        elif images and message.topic in infos:
            add_camera_info(reader, mapper, message, images)
        elif message.topic not in clouds:
            add_poses(reader, mapper, message, poses)
        elif span.holds(message.record_ns):
            if seen[message.topic] % span.every == 0:
                number = first[message.topic] + seen[message.topic]
                (images.take_image if images else add)(message, number)
            seen[message.topic] += 1
        yield from mapper.insert_ready(more_follows=True)
    if beside:
        mapper.end_images()
    yield from mapper.insert_ready()
    mapper.finish()


def depth_feed(
    clouds: Collection[str], add: Callable[[BagMessage, int, Decode], None]
) -> DepthFeed:
    """Return what pairs images with calibrations; loaded here, for it brings the compiler."""
    from surfel_mapper.offline.depth_feed import DepthFeed

    return DepthFeed(clouds, add)


def scene_feed(mapper: Mapper) -> SceneFeed | None:
    """Return what takes images of colours and labels, where the mapper wants any."""
    if not mapper.config.tsdf.image_topics:
        return None
    from surfel_mapper.offline.scene_feed import SceneFeed

    return SceneFeed(mapper)


def messages(
    reader: BagReader, clouds: Collection[str], poses: PoseTopics, span: Span
) -> Iterator[BagMessage]:
    """Yield what a part needs: static transforms from before it, its clouds and their poses."""
    if poses.static and span.poses_start_ns is not None:
        yield from reader.messages(poses.static, None, span.poses_start_ns)
    names = {*clouds, *poses.kinds, *poses.static}
    yield from reader.messages(names, span.poses_start_ns, span.poses_stop_ns)


def numbers_before(
    reader: BagReader, clouds: Collection[str], poses: PoseTopics, span: Span
) -> Counter[str]:
    """Return how many clouds come before a part, where poses are known by their number."""
    if poses.path is None or poses.path.has_stamps or span.start_ns is None:
        return Counter()
    return Counter(message.topic for message in reader.messages(clouds, None, span.start_ns))


def poses_now(
    mapper: Mapper, stamps_ns: Sequence[int], poses: Sequence[npt.NDArray[np.float64]]
) -> list[npt.NDArray[np.float64]]:
    """
    Return the poses of scans as alignment left them, as far as they are in the window.

    Parameters
    ----------
    mapper : Mapper
        Which mapped the scans.
    stamps_ns : sequence of int
        Of the scans, in the order in which they were mapped.
    poses : sequence of (4, 4) float64
        Where each was when it was mapped.

    """
    result = list(poses)
    for place, scan in enumerate(reversed(list(mapper.window)), start=1):
        if place > len(stamps_ns) or stamps_ns[-place] != scan.stamp_ns:
            break
        result[-place] = scan.T_map_sensor
    return result


def add_cloud(
    reader: BagReader,
    mapper: Mapper,
    message: BagMessage,
    poses: PoseTopics,
    number: int,
    decode: Decode = to_scan,
) -> None:
    """Decode a cloud or an image and queue it as a scan, with its pose where a file has it."""
    try:
        with mapper.counters.timed('decode'):
            scan = decode(reader.decode(message), message.topic)
    except (CloudFormatError, BagError) as error:
        mapper.refuse_clouds('bad_cloud', message.topic, str(error))
        return
    if message.topic in poses.mounts:
        scan = replace(scan, frame_id=message.topic)
    if poses.path is not None:
        poses.path.add_for(mapper, scan.stamp_ns, number)
    mapper.add_scan(scan)


def add_camera_info(
    reader: BagReader, mapper: Mapper, message: BagMessage, images: DepthFeed
) -> None:
    """Decode a calibration, and map the images that waited for it; a bad one is counted."""
    try:
        images.take_info(message.topic, reader.decode(message))
    except (CloudFormatError, BagError) as error:
        mapper.ignore_message('bad_message', f'calibration ignored: {error}')


def add_poses(reader: BagReader, mapper: Mapper, message: BagMessage, topics: PoseTopics) -> None:
    """Enter the poses of a message; one that cannot be read is counted."""
    kind, base = topics.kinds.get(message.topic, 'tf'), mapper.config.frames.base
    try:
        poses = raw_poses(kind, message.raw, base, message.topic, ros1=reader.is_ros1)
    except PoseError as error:
        mapper.ignore_message('bad_message', f'pose ignored: {error}')
        return
    for pose in poses:
        if topics.path is None or pose.child != base:  # whose pose is in the file
            mapper.add_pose(*pose, static=message.topic in topics.static)
