# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
What can be replayed, bags and folders of scans, behind one face.

A Request says what is to be mapped in plain values, so that it can be sent to another process;
``open_recording`` finds out what lies at its path and which topics and poses it has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
import math
from pathlib import Path
from typing import Any, Protocol, TYPE_CHECKING

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.bags.topics import CLOUD
from surfel_mapper.config import Config
from surfel_mapper.errors import BagError
from surfel_mapper.offline.pose_path import PosePath
from surfel_mapper.offline.pose_topics import pose_topics, PoseTopics, static_topics
from surfel_mapper.offline.replay import replay
from surfel_mapper.offline.scan_folder import is_scan_folder, ScanFolder
from surfel_mapper.offline.span import part

if TYPE_CHECKING:
    from surfel_mapper.pipeline import Mapper, Update


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """
    What is to be mapped.

    Attributes
    ----------
    path : Path
        A bag or a folder of scans.
    topics : tuple of str
        Of clouds; empty: the only one.
    pose_topic : str, optional
        Of poses, where there are several.
    poses : Path, optional
        A file of poses of frames.base instead.
    poses_format : str, optional
        tum, kitti or csv.
    mounts : mapping of str to 7 floats
        By topic: the pose of its sensor in frames.base.
    start_s, duration_s, every : float, float, int
        The part to map; see ``part``.

    """

    path: Path
    topics: tuple[str, ...] = ()
    pose_topic: str | None = None
    poses: Path | None = None
    poses_format: str | None = None
    mounts: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    start_s: float = 0.0
    duration_s: float = math.inf
    every: int = 1


class Recording(Protocol):
    """
    Scans with their poses.

    Attributes
    ----------
    config : Config
        What the mapper has to be made with: the one given, with the source of the poses.
    cuts : sequence of str
        What of it ends too early.

    """

    config: Config

    @property
    def cuts(self) -> list[str] | tuple[str, ...]:
        """What of it ends too early."""

    @property
    def num_scans(self) -> int:
        """About how many scans are mapped."""

    @property
    def recorded_s(self) -> float:
        """How long the part that is mapped took to record."""

    def describe(self) -> dict[str, Any]:
        """Return where scans and poses come from, for the summary."""

    def replay(self, mapper: Mapper, stopped: Callable[[], bool] = ...) -> Iterator[Update]:
        """Feed the scans to a mapper; yield what each did."""


@contextmanager
def open_recording(request: Request, config: Config) -> Iterator[Recording]:
    """
    Give what lies at the path of a request.

    Raises
    ------
    BagError
        If it is neither a bag nor a folder of scans, or lacks what is asked for.
    FileFormatError
        If the file of poses cannot be read.

    """
    poses = None if request.poses is None else PosePath(request.poses, request.poses_format)
    span = {'start_s': request.start_s, 'duration_s': request.duration_s, 'every': request.every}
    if is_scan_folder(request.path):
        named = [*request.topics, *request.mounts, *filter(None, [request.pose_topic])]
        if named:
            raise BagError(f'{request.path}: a folder of scans has no topic {named[0]}')
        yield ScanFolder(request.path, config, poses, **span)
        return
    with BagReader(request.path) as reader:
        yield BagRecording(reader, request, config, poses)


class BagRecording:
    """
    The clouds of a bag, with their poses.

    Parameters
    ----------
    reader : BagReader
        The bag.
    request : Request
        Which of it.
    config : Config
        Where poses come from.
    path : PosePath, optional
        Poses from a file.

    Raises
    ------
    BagError
        If the bag lacks what is asked for.

    """

    def __init__(
        self, reader: BagReader, request: Request, config: Config, path: PosePath | None
    ) -> None:
        """Choose topics and poses."""
        self.reader = reader
        self.cuts = reader.cuts
        configured = [f'/{name.lstrip("/")}' for name in config.input.topics]
        named = [*request.topics] or [*request.mounts] or configured
        names: list[str | None] = [*named] or [None]
        choose: Callable[[str | None], str] = partial(reader.topics.choose, CLOUD)
        if config.input.kind == 'depth':
            choose = reader.topics.choose_image
        self.topics = [choose(name) for name in dict.fromkeys(names)]
        for name in config.tsdf.image_topics.values():
            reader.topics.choose_image(f'/{name.lstrip("/")}')
        check_mounts(request, self.topics, config)
        if request.mounts:
            config = config.replace({'frames.base_to_sensor': ()})
        self.poses = self._poses(request, config, path)
        self.config = config if path is None else config.replace({'pose.source': 'pose'})
        self.span = part(
            str(request.path),
            reader.start_ns,
            reader.end_ns,
            start_s=request.start_s,
            duration_s=request.duration_s,
            every=request.every,
        )

    def _poses(self, request: Request, config: Config, path: PosePath | None) -> PoseTopics:
        """Return where the poses come from."""
        topics = self.reader.topics
        if path is None:
            found = pose_topics(topics, config, request.pose_topic)
        elif request.pose_topic is not None:
            raise BagError(f'{request.path}: poses of {request.pose_topic} or of {path.path}?')
        elif not path.has_stamps and len(self.topics) > 1:
            raise BagError(f'{path.path}: poses without times, for several topics of clouds')
        else:
            static = () if config.frames.base_to_sensor else static_topics(topics)
            found = PoseTopics({}, static, path)
        if request.mounts and config.pose.source != 'tf':
            found = replace(found, static=())  # else two places of one sensor might disagree
        return replace(found, mounts=request.mounts)

    @property
    def num_scans(self) -> int:
        """About how many scans are mapped: as many as evenly fall into the part."""
        first_ns, last_ns = self.reader.start_ns, self.reader.end_ns
        start_ns, stop_ns = self.span.clipped(first_ns, last_ns)
        share = (stop_ns - start_ns) / (last_ns - first_ns) if last_ns > first_ns else 1.0
        return math.ceil(share * self.reader.topics.num_messages(self.topics) / self.span.every)

    @property
    def recorded_s(self) -> float:
        """How long the part that is mapped took to record."""
        start_ns, stop_ns = self.bounds_ns
        return (stop_ns - start_ns) / 1e9

    @property
    def bounds_ns(self) -> tuple[int, int]:
        """Record time of the first and last message of what is mapped."""
        return self.span.clipped(self.reader.start_ns, self.reader.end_ns)

    def describe(self) -> dict[str, Any]:
        """Return where scans and poses come from, for the summary."""
        path = self.poses.path
        return {
            'bag': str(self.reader.path),
            'topics': self.topics,
            'pose_topics': [*self.poses.kinds, *self.poses.static],
            'poses': None if path is None else str(path.path),
        }

    def replay(
        self, mapper: Mapper, stopped: Callable[[], bool] = lambda: False
    ) -> Iterator[Update]:
        """Feed the clouds to a mapper; yield what each did."""
        return replay(
            self.reader, mapper, self.topics, self.poses, span=self.span, stopped=stopped
        )


def check_mounts(request: Request, topics: list[str], config: Config) -> None:
    """Refuse places of sensors that leave one out, or take one place for several sensors."""
    missing = [topic for topic in topics if topic not in request.mounts]
    unknown = [topic for topic in request.mounts if topic not in topics]
    if request.mounts and (missing or unknown):
        raise BagError(
            f'{request.path}: places of sensors for {", ".join(request.mounts)}, expected one '
            f'for each of {", ".join(topics)}'
        )
    frames = config.frames
    if len(topics) > 1 and not (request.mounts or frames.sensors) and frames.base_to_sensor:
        raise BagError(
            f'{request.path}: frames.base_to_sensor is the place of one sensor, not of '
            f'{len(topics)}; name one for each topic with --mount, or their frames in '
            'frames.sensors'
        )
