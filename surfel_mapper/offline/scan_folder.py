# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Scans in files, one file each, through the pipeline: a folder of them, or a single file.

With a file of poses, the scans are in frames.base, whose poses it gives; if
frames.base_to_sensor is set, they are in a frame called sensor on it. Without poses they are
registered. The time of a scan is in the name of its file or in a file of times (scan_times.py);
else scans follow each other at 10 Hz; by such times poses are looked up only if no number is
missing among the names. With as many poses, of other times, the time of scan i is that of pose i.
Poses without times are those of the scans in their order. There may be fewer, if each scan of the
part has one, or more, if scans are named by the numbers of their poses. Folders of data sets have
their own layout, times and poses (datasets.py), a capture of an Ouster lidar has all scans in one
file (ouster_pcap.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TYPE_CHECKING

from surfel_mapper.bags.paths import is_storage, METADATA
from surfel_mapper.config import Config
from surfel_mapper.errors import BagError, ConfigError, FileFormatError
from surfel_mapper.files.scan_files import scan_files, scan_reader, SUFFIXES
from surfel_mapper.offline import ouster_pcap
from surfel_mapper.offline.datasets import Dataset, find_dataset
from surfel_mapper.offline.depth_folders import (
    DepthFolder,
    find_depth_folder,
    for_depth_images,
    layout_of,
)
from surfel_mapper.offline.ouster_pcap import OusterPcap
from surfel_mapper.offline.pose_choice import (
    choose_for_folder,
    is_default,
    pose_summary,
    why_not_deskewed,
)
from surfel_mapper.offline.pose_sources import PosePath
from surfel_mapper.offline.request import Request, span_of
from surfel_mapper.offline.scan_times import (
    is_gapless,
    numbered,
    rows_of,
    stem,
    times_beside,
    times_in_names,
)
from surfel_mapper.offline.viewpoints import (
    NOT_USED,
    PLACE,
    POSES,
    viewpoint_poses,
    viewpoints_of,
    with_viewpoint,
)
from surfel_mapper.scan import Scan

if TYPE_CHECKING:
    from surfel_mapper.pipeline import Mapper, Update

SENSOR = 'sensor'
"""The frame of the scans, if frames.base_to_sensor is set."""

SURFEL_COLUMNS = {'planarity', 'num_points'}
"""Columns by which surfels that were written before are recognised."""

PERIOD_NS = 100_000_000
"""Period of scans that have no time: 10 Hz."""

ASSUMED = 'none: 10 Hz'
"""Source of such times."""


class ScanFolder:
    """
    Scans of a folder or of one file, with their poses if there are any.

    Parameters
    ----------
    request : Request
        The directory or the file, the part of it, and the source of poses.
    config : Config
        Its ``pose.source`` counts if it is not the default.
    poses : PosePath, optional
        Poses of frames.base.

    Raises
    ------
    BagError
        If poses cannot be assigned to the scans, or the points are surfels of a map; those of
        later files are refused when they are read.

    """

    cuts: tuple[str, ...] = ()
    format = 'scans in files'
    """Name of the layout, for info."""

    first_error = ''
    """Why the first file cannot be read; empty if it can."""

    def __init__(self, request: Request, config: Config, poses: PosePath | None) -> None:
        self.path = request.path
        self.dataset: Dataset | DepthFolder | OusterPcap | None
        if self.path.suffix.lower() == ouster_pcap.SUFFIX:
            self.dataset = OusterPcap(self.path)
        else:
            self.dataset = find_dataset(self.path) or find_depth_folder(self.path)
        if isinstance(self.dataset, DepthFolder):
            config = for_depth_images(config)
        if self.dataset is not None:
            self.files, self.format = self.dataset.files, self.dataset.format
        else:
            files = [self.path] if self.path.is_file() else scan_files(self.path)
            self.files = list(times_in_names(files)) or files
            self._read_file = scan_reader(self.files, request.bin_columns)
        is_free = poses is None and request.poses_from is None and is_default(config)
        if self.dataset and self.dataset.trajectory and is_free:
            poses = PosePath(self.dataset.poses_path or self.path, None, self.dataset.trajectory)
        viewpoints = [] if self.dataset or poses is not None else viewpoints_of(self.files)
        differing, reason = viewpoint_poses(viewpoints), ''
        if differing is not None and request.poses_from is None:
            poses = PosePath(self.path, None, differing) if is_free else None
            reason = POSES if is_free else NOT_USED
        self.poses = poses
        self.stamps, self.times_from = self._stamps()
        self._rows, rows_reason = self._pose_rows()
        missing = self.dataset.missing if isinstance(self.dataset, Dataset) else reason
        first = self.first_scan()
        if first is None and len(self.files) == 1:
            raise FileFormatError(self.first_error)
        if isinstance(self.dataset, DepthFolder) and first is not None:
            self.dataset.check_scale(first)
        choice = choose_for_folder(request, config, poses is not None, first, missing)
        self.config, self.pose_reason = choice.config, choice.reason or rows_reason or reason
        is_alone = self.config.pose.source == 'identity' or (len(self.files) == 1 and is_free)
        if is_alone and (seen_from := with_viewpoint(config, viewpoints)):
            self.config, self.pose_reason = seen_from, PLACE
        self.deskew_reason = why_not_deskewed(self.config, [first] if first else [])
        self.span = span_of(request, self.stamps[0], self.stamps[-1])
        if poses is not None and self.num_scans:
            poses.check_scan(self._rows[self._numbers[-1]])

    @property
    def num_scans(self) -> int:
        """Number of scans in the part that is mapped."""
        return len(self._numbers)

    @property
    def _numbers(self) -> list[int]:
        """Numbers of the scans in the part that is mapped."""
        numbers = [n for n, stamp_ns in enumerate(self.stamps) if self.span.holds(stamp_ns)]
        return numbers[:: self.span.every]

    @property
    def recorded_s(self) -> float:
        """Duration of the part that is mapped, s."""
        start_ns, stop_ns = self.span.clipped(self.stamps[0], self.stamps[-1])
        return (stop_ns - start_ns) / 1e9

    def describe(self) -> dict[str, Any]:
        """Return the sources of scans and poses, for the summary."""
        path = None if self.poses is None else self.poses.path
        return {
            'bag': str(self.path),
            'times_from': self.times_from,
            'poses': None if path is None else str(path),
            **pose_summary(self.config, path, self.pose_reason, self.deskew_reason),
        }

    def first_scan(self) -> Scan | None:
        """Return the first scan that can be read; None if there is none, see first_error."""
        for number, stamp_ns in enumerate(self.stamps):
            try:
                return self._read(number, stamp_ns, '')
            except ConfigError:  # a wrong limit concerns all scans
                raise
            except (FileFormatError, ValueError) as error:
                self.first_error = self.first_error or str(error)
        return None

    def replay(
        self, mapper: Mapper, stopped: Callable[[], bool] = lambda: False
    ) -> Iterator[Update]:
        """Feed the scans to a mapper; yield the update of each."""
        frames = mapper.config.frames
        frame = SENSOR if frames.base_to_sensor else frames.base
        for number in self._numbers:
            if stopped():
                break
            self._add(mapper, number, frame)
            yield from mapper.insert_ready()
        mapper.end_scans()
        yield from mapper.insert_ready()
        mapper.finish()

    def _add(self, mapper: Mapper, number: int, frame: str) -> None:
        """Read one scan and queue it; a bad one is counted."""
        stamp_ns = self.stamps[number]
        try:
            with mapper.counters.timed('decode'):
                scan = self._read(number, stamp_ns, frame)
        except ConfigError:  # a wrong limit concerns all scans
            raise
        except (FileFormatError, ValueError) as error:
            mapper.refuse_clouds('bad_cloud', str(self.path), str(error))
            return
        if self.poses is not None:
            offset_ns = round(1e9 * mapper.config.input.time_offset_s)
            self.poses.add_for(mapper, stamp_ns + offset_ns, self._rows[number])
        mapper.add_scan(scan)

    def _read(self, number: int, stamp_ns: int, frame: str) -> Scan:
        if isinstance(self.dataset, DepthFolder):
            return self.dataset.depth_scan(number, stamp_ns, frame)
        if self.dataset is None:
            points, columns = self._read_file(self.files[number])
            if columns.keys() >= SURFEL_COLUMNS:
                raise BagError(
                    f'{self.files[number]}: surfels of a map, expected scans; extract, evaluate '
                    'and view read them; to continue a map, set map.load to its map.npz'
                )
        else:
            points, columns = self.dataset.scan(number)
        return Scan(points=points, stamp_ns=stamp_ns, frame_id=frame, columns=columns)

    def _own_stamps(self) -> tuple[list[int], str]:
        """Return the times of the scans, ns, by layout, names or file, and their source."""
        if self.dataset is not None:
            return self.dataset.stamps_ns, self.format
        times = times_in_names(self.files)
        if times:
            return list(times.values()), 'names'
        listed = times_beside(self.path, self.files) if self.path.is_dir() else None
        if listed is not None:
            return listed[0], str(listed[1])
        return [PERIOD_NS * at for at in range(len(self.files))], ASSUMED

    def _stamps(self) -> tuple[list[int], str]:
        """Return the time of every scan, ns, and the source of these times."""
        own, source = self._own_stamps()
        stamps = None if self.poses is None else self.poses.trajectory.stamp_ns
        if self.poses is None or stamps is None or self.dataset is not None:
            return own, source
        if source == ASSUMED and len(stamps) == len(own):
            return stamps.tolist(), 'poses'
        # a registration of these very scans has their times, but not those that it dropped
        may_have = source != ASSUMED or is_gapless(self.files)
        if may_have and 2 * len(set(own).intersection(stamps.tolist())) > len(stamps):
            return own, source
        if len(stamps) == len(own):
            return stamps.tolist(), 'poses'
        if source == ASSUMED:
            raise BagError(
                f'{self.poses.path}: {len(stamps)} poses for {len(own)} scans in {self.path}, '
                'expected as many, or times of the scans: in their names (1532402927.647951.pcd), '
                'or in a times.txt beside them with a line for each'
            )
        return own, source

    def _pose_rows(self) -> tuple[list[int], str]:
        """Return the number of the pose of every scan, for poses without times, and its reason."""
        num_scans = len(self.files)
        num_poses = 0 if self.poses is None else len(self.poses.trajectory)
        numbers = None if self.poses is None else self.poses.trajectory.number
        if numbers is not None:
            return self._numbered_rows(set(numbers.tolist()))
        if self.poses is None or self.poses.has_stamps or num_poses <= num_scans:
            return list(range(num_scans)), ''
        rows = rows_of(self.files, num_poses)
        if rows is None:
            raise BagError(
                f'{self.poses.path}: {num_poses} poses without times for {num_scans} scans in '
                f'{self.path}, expected one for each, {numbered(num_poses)}, or poses with times '
                '(TUM)'
            )
        return rows, f'{self.files[0].name} has pose {rows[0]}, counted from 0, of {num_poses}'

    def _numbered_rows(self, numbers: set[int]) -> tuple[list[int], str]:
        """Return the number of every scan, by its name or its place, for poses of some scans."""
        names = [stem(file) for file in self.files]
        is_named = all(map(str.isdecimal, names))
        rows = [int(name) for name in names] if is_named else list(range(len(names)))
        posed = numbers.intersection(rows)
        if not posed:
            raise BagError(
                f'{self.path}: scans {rows[0]} to {rows[-1]}, poses of {min(numbers)} to '
                f'{max(numbers)}; expected scans named by the numbers of their poses'
            )
        return rows, f'{len(posed)} of {len(rows)} scans have a pose of their number'


def is_scans(path: Path) -> bool:
    """Return whether a path is a file of points, or a directory of scans and not of a bag."""
    if path.is_file():
        return path.suffix.lower() in (ouster_pcap.SUFFIX, *SUFFIXES)
    if not path.is_dir() or (path / METADATA).exists():
        return False
    if layout_of(path) is not None or find_dataset(path) is not None:
        return True
    return not any(map(is_storage, path.iterdir())) and bool(scan_files(path))
