# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Harnesses of files: bags, maps, points, poses, settings; and of requested file names."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
from functools import cache
from pathlib import Path
import tempfile

import numpy as np

from surfel_mapper.bags.compression import unpack_file
from surfel_mapper.bags.reader import BagReader
from surfel_mapper.config import load_config, TsdfConfig
from surfel_mapper.errors import ConfigError, SurfelMapperError
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.map_state import load_map
from surfel_mapper.files.parquet import read_map
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.files.tsdf_state import load_tsdf
from surfel_mapper.filters.chain import Chain
from surfel_mapper.filters.chain import example as example_scan

MOST_MESSAGES = 5000
"""Number of messages read of a bag."""


@cache
def folder() -> tempfile.TemporaryDirectory:
    """Return a directory for inputs that have to be files; it is deleted with the process."""
    return tempfile.TemporaryDirectory(prefix='surfel_mapper-fuzz-')


def refused(function: Callable[..., object], name: str, data: bytes) -> None:
    """Pass bytes to a function as a file; accept our own errors."""
    path = Path(folder().name, name)
    path.write_bytes(data)
    with contextlib.suppress(SurfelMapperError):
        function(path)


def read_bag(path: Path) -> None:
    """Read all messages of a bag; continue after those that cannot be read."""
    with BagReader(path) as reader:
        for topic in reader.topics:
            reader.is_latched(topic.name)
        for number, message in enumerate(reader.messages()):
            with contextlib.suppress(SurfelMapperError):
                reader.decode(message)
            if number == MOST_MESSAGES:
                return


def mcap(data: bytes) -> None:
    """Read an mcap file."""
    refused(read_bag, 'input.mcap', data)


def sqlite(data: bytes) -> None:
    """Read a sqlite3 bag."""
    refused(read_bag, 'input.db3', data)


def ros1(data: bytes) -> None:
    """Read a bag of ROS 1."""
    refused(read_bag, 'input.bag', data)


def metadata(data: bytes) -> None:
    """Read the metadata.yaml of a rosbag2 directory."""
    directory = Path(folder().name, 'bag')
    directory.mkdir(exist_ok=True)
    (directory / 'input.mcap').write_bytes(b'')
    (directory / 'metadata.yaml').write_bytes(data)
    with contextlib.suppress(SurfelMapperError):
        read_bag(directory)


def packed(data: bytes) -> None:
    """Unpack a file."""
    refused(lambda path: unpack_file(path, path.with_suffix('.out')), 'input.zstd', data)


def points_ply(data: bytes) -> None:
    """Read a PLY file."""
    refused(ply.read_points, 'input.ply', data)
    refused(read_scan, 'input.ply', data)


def points_pcd(data: bytes) -> None:
    """Read a PCD file."""
    refused(pcd.read_points, 'input.pcd', data)
    refused(read_scan, 'input.pcd', data)


def points_raw(data: bytes) -> None:
    """Read a scan of bare numbers."""
    refused(read_scan, 'input.bin', data)
    refused(read_scan, 'input.pcd.bin', data)


def parquet(data: bytes) -> None:
    """Read a map in Parquet."""
    refused(read_map, 'input.parquet', data)


def read_state(path: Path) -> None:
    """Read a file as every kind of state."""
    for read in (load_map, lambda p: load_tsdf(p, TsdfConfig())):
        with contextlib.suppress(SurfelMapperError):
            read(path)


def state_bytes(data: bytes) -> None:
    """Read a saved map from any bytes."""
    refused(read_state, 'input.npz', data)


def trajectory(data: bytes) -> None:
    """Read poses in every format."""
    for format_ in (None, 'tum', 'kitti', 'csv'):
        refused(lambda path, f=format_: read_trajectory(path, f), 'poses.txt', data)


def settings(data: bytes) -> None:
    """Read a file of settings."""
    refused(load_config, 'input.yaml', data)


def chain(data: bytes) -> None:
    """Read a chain of filters, and apply it."""

    def run(path: Path) -> None:
        chain_ = Chain.load(path)
        if len(chain_) < 5:
            with np.errstate(all='ignore'):
                chain_.apply(example_scan(np.float32))

    refused(run, 'input.yaml', data)


def map_url(data: bytes) -> None:
    """Resolve a map URL: the result is inside the directory, or an error."""
    from surfel_mapper.ros.map_files import path_inside

    directory = Path(folder().name, 'maps')
    directory.mkdir(exist_ok=True)
    for name, target in (('out', '..'), ('deep', '/'), ('loop', 'loop')):
        link = directory / name
        if not link.is_symlink():
            link.symlink_to(target)
    try:
        found = path_inside(directory, data.decode(errors='surrogateescape'))
    except ConfigError:
        return
    assert found.resolve().is_relative_to(directory.resolve()), found
