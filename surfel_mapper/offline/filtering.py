# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A chain of filters applied to files of clouds, folders of scans and bags, without mapping them.

All columns are written, those added by filters too. A bag keeps all its other messages, so that
it can be replayed with the filtered clouds; those that are not CDR, or of a type that neither
Jazzy nor the bag defines, are left out with a warning. A scan of a bag that a filter refuses is
left out and counted; a file that is refused is an error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
import logging
from pathlib import Path
from typing import Any

from surfel_mapper.bags.paths import is_ros1, is_storage, METADATA
from surfel_mapper.bags.reader import BagMessage, BagReader
from surfel_mapper.bags.topics import CLOUD
from surfel_mapper.bags.writer import BagWriter
from surfel_mapper.counters import Counters
from surfel_mapper.errors import BagError, CloudFormatError, FileFormatError, FilterError
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.atomic import check_free, make_directory
from surfel_mapper.files.scan_files import (
    Points,
    scan_files,
    scan_reader,
    SUFFIXES,
    WRITERS,
)
from surfel_mapper.filters.chain import Chain
from surfel_mapper.filters.columns import as_fields
from surfel_mapper.geometry import Transform
from surfel_mapper.messages.pointcloud2 import from_columns, to_scan
from surfel_mapper.offline import ouster_pcap
from surfel_mapper.offline.datasets import find_dataset
from surfel_mapper.offline.depth_folders import DepthFolder, find_depth_folder
from surfel_mapper.offline.ouster_pcap import OusterPcap
from surfel_mapper.scan import Scan

log = logging.getLogger(__name__)

Read = Callable[[], Points]

Show = Callable[[int, int], None]
"""Progress: scans done and expected."""


@dataclass(slots=True)
class FilteredClouds:
    """
    Counts and times of a chain over all clouds.

    Attributes
    ----------
    scans, refused : int
        Scans written, and scans of bags that a filter refused or that cannot be decoded.
    points_in, points_out : int
        Points of the scans written, before and after the chain.
    outputs : list of Path
        Files and bags written.
    filters : dict of str to dict
        points_in, points_out, not_finite and milliseconds of every filter.

    """

    scans: int = 0
    refused: int = 0
    points_in: int = 0
    points_out: int = 0
    outputs: list[Path] = field(default_factory=list)
    filters: dict[str, Any] = field(default_factory=dict)


def filter_clouds(
    chain: Chain,
    inputs: Sequence[str | Path],
    output: str | Path,
    *,
    topics: Sequence[str] = (),
    T_base_sensor: Transform | None = None,
    bin_columns: int | None = None,
    overwrite: bool = False,
    show: Show = lambda done, expected: None,
) -> FilteredClouds:
    """
    Apply a chain to clouds and write the results.

    Parameters
    ----------
    chain : Chain
        The filters.
    inputs : sequence of path
        Files of clouds, folders of them and of data sets, captures (.pcap), and bags.
    output : path
        For one file: a .ply or .pcd. For one bag: the directory of the bag to write. Else, or for
        a folder: a directory, in which every file and bag has the name of its input.
    topics : sequence of str
        Topics of a bag whose clouds are filtered; empty: all clouds.
    T_base_sensor : (4, 4) float64, optional
        Pose of the sensor on the robot, for filters that need it.
    bin_columns : int, optional
        Number of columns of .bin files; without, that which fits their values.
    overwrite : bool
        Whether outputs may be replaced; without it, a directory must be new or empty.
    show : callable
        Called with the scans done and the scans expected.

    Raises
    ------
    FileFormatError, BagError
        If an input cannot be read, an output cannot be written, or two inputs have the same one.
    FilterError
        If a filter refuses a file.

    """
    work = _Work(chain, topics, T_base_sensor, show)
    pairs = list(outputs_of([Path(path) for path in inputs], Path(output)))
    sources: dict[Path, Path] = {}
    for source, target, _ in pairs:
        if target in sources:
            raise FileFormatError(
                f'{sources[target]}, {source}: expected an output for each, both would be '
                f'{target}; filter them one after the other, into several directories'
            )
        sources[target] = source
    check_free(Path(output), overwrite)
    files = [source for source, _, read in pairs if read is None and not is_bag(source)]
    read_file = scan_reader(files, bin_columns)
    chain.warm_up()
    for source, target, read in pairs:
        log.info('%s is filtered into %s', source, target)
        make_directory(target.parent)
        if read is None and is_bag(source):
            work.filter_bag(source, target, overwrite)
        else:
            work.filter_file(source, target, len(pairs), read or partial(read_file, source))
        work.done.outputs.append(target)
    work.done.filters = work.counters.summary()['filters']
    return work.done


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a storage file, or a directory with one or with metadata."""
    if not path.is_dir():
        return is_storage(path) or is_ros1(path)
    return (path / METADATA).exists() or any(is_storage(file) for file in path.iterdir())


def outputs_of(inputs: list[Path], output: Path) -> Iterator[tuple[Path, Path, Read | None]]:
    """Yield every file and bag to read, the path to write for it, and the reader of others."""
    first = inputs[0]
    if len(inputs) == 1 and is_bag(first):
        yield first, output, None
        return
    if len(inputs) == 1 and first.is_file() and first.suffix.lower() != ouster_pcap.SUFFIX:
        if output.suffix.lower() not in WRITERS:
            raise FileFormatError(f'{output}: expected a file ending in {" or ".join(WRITERS)}')
        yield first, output, None
        return
    for source in inputs:
        if is_bag(source):
            yield source, output / (source.name if source.is_dir() else source.stem), None
            continue
        if scans := scans_of_dataset(source):
            yield from ((source, output / f'{name}.ply', read) for name, read in scans.items())
            continue
        files = scan_files(source) if source.is_dir() else [source]
        if not files:
            raise FileFormatError(
                f'{source}: no bag, no scans in it; expected files ending in {", ".join(SUFFIXES)}'
            )
        for file in files:
            suffix = file.suffix if file.suffix.lower() in WRITERS else '.ply'
            yield file, output / f'{file.stem}{suffix}', None


def scans_of_dataset(path: Path) -> dict[str, Read]:
    """Return the reader of each scan of a data set or a capture by its name; none for others."""
    if path.suffix.lower() == ouster_pcap.SUFFIX:
        capture = OusterPcap(path)
        names = [f'{path.stem}_{number:06}' for number in range(len(capture.files))]
        return {name: partial(capture.scan, number) for number, name in enumerate(names)}
    dataset = find_dataset(path) or find_depth_folder(path)
    if dataset is None:
        return {}
    scan = partial(points_of, dataset) if isinstance(dataset, DepthFolder) else dataset.scan
    return {file.stem: partial(scan, number) for number, file in enumerate(dataset.files)}


def points_of(folder: DepthFolder, number: int) -> Points:
    """Return the points of a depth image, without columns."""
    return folder.depth_scan(number, folder.stamps_ns[number], '').points, {}


def definitions_of(reader: BagReader) -> dict[str, tuple[str, str] | None]:
    """
    Return the definition of the type of each topic of a ROS 2 bag, None for types of Jazzy.

    Topics that cannot be copied are left out, with a warning for each type.
    """
    topics: dict[str, list[str]] = {}
    for topic in reader.topics:
        if topic.count:
            topics.setdefault(topic.type, []).append(topic.name)
    definitions: dict[str, tuple[str, str] | None] = {}
    for type_, names in topics.items():
        try:
            definitions |= dict.fromkeys(names, reader.definition(type_))
        except BagError as error:
            log.warning('%s; topics left out: %s', error, ', '.join(names))
    return definitions


class _Work:
    """The chain, its counts so far, and the progress."""

    def __init__(
        self, chain: Chain, topics: Sequence[str], pose: Transform | None, show: Show
    ) -> None:
        self.chain = chain
        self.topics = tuple(topics)
        self.pose = pose
        self.show = show
        self.counters = Counters()
        self.done = FilteredClouds()

    def filter_file(self, source: Path, target: Path, expected: int, read: Read) -> None:
        """Filter the cloud of a file; its number is its stamp, which random filters use."""
        points, columns = read()
        number = self.done.scans
        scan = Scan(points=points, stamp_ns=number, frame_id='sensor', columns=columns)
        try:
            scan = self._filtered(scan)
        except FilterError as error:
            raise FilterError(f'{source}: {error}') from error
        fields = as_fields(scan, is_flat=True, has_int64=target.suffix.lower() == '.pcd')
        if target.suffix.lower() == '.ply':
            ply.write_points(target, fields)
        else:
            is_pcd = source.suffix.lower() == '.pcd'
            pcd.write_points(target, fields, pcd.read_viewpoint(source) if is_pcd else pcd.ORIGIN)
        self.show(self.done.scans, expected)

    def filter_bag(self, source: Path, target: Path, overwrite: bool) -> None:
        """Filter the clouds of a bag and copy its other messages."""
        with (
            BagReader(source) as reader,
            BagWriter(target, overwrite=overwrite) as writer,
        ):
            topics = self._cloud_topics(reader)
            if reader.is_ros1:
                log.warning('%s: a ROS 1 bag; only its clouds are written', source)
            copied = dict.fromkeys(topics) if reader.is_ros1 else definitions_of(reader)
            count = sum(topic.count for topic in reader.topics if topic.name in topics)
            latched = {topic.name for topic in reader.topics if reader.is_latched(topic.name)}
            for message in reader.messages(copied):
                if message.topic in topics:
                    self._filter_message(reader, writer, message)
                    self.show(self.done.scans + self.done.refused, count)
                else:
                    writer.write(
                        message.topic,
                        message.type,
                        message.record_ns,
                        message.raw,
                        latched=message.topic in latched,
                        definition=copied[message.topic],
                    )

    def _filter_message(self, reader: BagReader, writer: BagWriter, message: BagMessage) -> None:
        """Write the filtered cloud of a message; a refused one is counted."""
        try:
            scan = self._filtered(to_scan(reader.decode(message), message.topic))
        except (CloudFormatError, FilterError) as error:
            if not self.done.refused:
                log.warning('%s: %s; further ones are only counted', message.topic, error)
            self.done.refused += 1
            return
        writer.write_cloud(
            message.topic,
            message.record_ns,
            scan.stamp_ns,
            scan.frame_id,
            from_columns(as_fields(scan)),
        )

    def _filtered(self, scan: Scan) -> Scan:
        """Return the scan filtered, and count it."""
        filtered, steps = self.chain.run(replace(scan, T_base_sensor=self.pose))
        for step in steps:
            self.counters.add_filter(step)
        self.done.scans += 1
        self.done.points_in += len(scan)
        self.done.points_out += len(filtered)
        return filtered

    def _cloud_topics(self, reader: BagReader) -> tuple[str, ...]:
        """Return the topics of a bag to filter."""
        clouds = [topic.name for topic in reader.topics if topic.type == CLOUD and topic.count]
        missing = [name for name in self.topics if name not in clouds]
        if missing or not clouds:
            raise BagError(
                f'{reader.path}: no topic {", ".join(missing) or CLOUD}; '
                f'PointCloud2 topics: {", ".join(clouds) or "none"}'
            )
        return self.topics or tuple(clouds)
