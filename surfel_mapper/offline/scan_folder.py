# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A folder of scans, one file each, through the pipeline.

The scans are in the frame frames.base, whose poses are read from a file; if
frames.base_to_sensor is set, they are in a frame called sensor on it. The time of scan i is that
of pose i, if there are as many poses as scans; else it is parsed from the name of its file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TYPE_CHECKING

from surfel_mapper.bags.paths import is_storage, METADATA
from surfel_mapper.config import Config
from surfel_mapper.errors import BagError, FileFormatError
from surfel_mapper.files.scan_files import read_scan, scan_files
from surfel_mapper.files.trajectory import nanoseconds
from surfel_mapper.offline.pose_sources import PosePath
from surfel_mapper.offline.request import part, Span
from surfel_mapper.scan import Scan

if TYPE_CHECKING:
    from surfel_mapper.pipeline import Mapper, Update

SENSOR = 'sensor'
"""The frame of the scans, if frames.base_to_sensor is set."""

PERIOD_NS = 100_000_000
"""Period of scans that have no time: 10 Hz."""

UNITS = {19: 'ns', 16: 'us', 13: 'ms'}
"""Unit of a whole number in the name of a file, by its number of digits."""


class ScanFolder:
    """
    Scans of a folder, with their poses.

    Parameters
    ----------
    path : Path
        The directory.
    config : Config
        Without poses its ``pose.source`` has to be identity.
    poses : PosePath, optional
        Poses of frames.base.
    part_of : mapping
        start_s, duration_s, every; see ``part``.

    Raises
    ------
    BagError
        If there are no poses, or they cannot be assigned to the scans.

    """

    cuts: tuple[str, ...] = ()

    def __init__(self, path: Path, config: Config, poses: PosePath | None, **part_of: Any) -> None:
        self.path = path
        self.files = scan_files(path)
        self.poses = poses
        if poses is None and config.pose.source != 'identity':
            raise BagError(
                f'{path}: scans without poses; name a file of poses with --poses, or set '
                'pose.source to identity if they are in the fixed frame'
            )
        self.config = config if poses is None else config.replace({'pose.source': 'pose'})
        self.stamps = self._stamps()
        self.span: Span = part(str(path), self.stamps[0], self.stamps[-1], **part_of)

    @property
    def num_scans(self) -> int:
        """Number of scans in the part that is mapped."""
        return -(-sum(map(self.span.holds, self.stamps)) // self.span.every)

    @property
    def recorded_s(self) -> float:
        """Duration of the part that is mapped, s."""
        start_ns, stop_ns = self.span.clipped(self.stamps[0], self.stamps[-1])
        return (stop_ns - start_ns) / 1e9

    def describe(self) -> dict[str, Any]:
        """Return the sources of scans and poses, for the summary."""
        return {'bag': str(self.path), 'poses': str(self.poses.path) if self.poses else None}

    def replay(
        self, mapper: Mapper, stopped: Callable[[], bool] = lambda: False
    ) -> Iterator[Update]:
        """Feed the scans to a mapper; yield the update of each."""
        frames = mapper.config.frames
        frame = SENSOR if frames.base_to_sensor else frames.base
        held = [n for n, stamp_ns in enumerate(self.stamps) if self.span.holds(stamp_ns)]
        for number in held[:: self.span.every]:
            if stopped():
                break
            self._add(mapper, number, frame)
            yield from mapper.insert_ready(more_follows=True)
        yield from mapper.insert_ready()
        mapper.finish()

    def _add(self, mapper: Mapper, number: int, frame: str) -> None:
        """Read one scan and queue it; a bad one is counted."""
        stamp_ns = self.stamps[number]
        try:
            with mapper.counters.timed('decode'):
                points, columns = read_scan(self.files[number])
                scan = Scan(points=points, stamp_ns=stamp_ns, frame_id=frame, columns=columns)
        except (FileFormatError, ValueError) as error:
            mapper.refuse_clouds('bad_cloud', str(self.path), str(error))
            return
        if self.poses is not None:
            self.poses.add_for(mapper, stamp_ns, number)
        mapper.add_scan(scan)

    def _stamps(self) -> list[int]:
        """Return the time of every scan."""
        number = len(self.files)
        if self.poses is None:
            return [PERIOD_NS * at for at in range(number)]
        stamps = self.poses.trajectory.stamp_ns
        if len(self.poses.trajectory) == number:
            return [PERIOD_NS * at for at in range(number)] if stamps is None else stamps.tolist()
        if stamps is None:
            raise BagError(
                f'{self.poses.path}: {len(self.poses.trajectory)} poses without times for '
                f'{number} scans in {self.path}, expected one for each'
            )
        try:
            times = [name_ns(file) for file in self.files]
        except FileFormatError as error:
            raise BagError(
                f'{self.poses.path}: {len(stamps)} poses for {number} scans, expected as many, '
                f'or names that are times: {error}'
            ) from error
        if times != sorted(set(times)):
            raise BagError(f'{self.path}: the names of its files are no ascending times')
        return times


def name_ns(file: Path) -> int:
    """Return the time in the name of a file: 1532402927.647951.pcd, 1532402927647951.pcd.bin."""
    text = file.name.removesuffix('.bin').removesuffix('.pcd').removesuffix('.ply')
    return nanoseconds(text, str(file), UNITS.get(len(text), ''))


def is_scan_folder(path: Path) -> bool:
    """Return whether a path is a directory of scans and not of a bag."""
    if not path.is_dir() or (path / METADATA).exists():
        return False
    return not any(map(is_storage, path.iterdir())) and bool(scan_files(path))
