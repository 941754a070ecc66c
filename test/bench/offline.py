# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Replay of a bag of the simulated street, on one core, in times real time.

The lidar turns at 10 Hz, so 10 ms a scan are ten times real time. ``read`` yields the messages of
clouds and poses, ``decode`` makes scans and poses of them, ``replay`` maps them at 0.5 m with all
scans kept, ``command`` is the whole of `surfel-mapper replay`: a process of its own, kernels
loaded, map, picture, report and summary written. Each is the fastest of several runs, with the
bag in the cache of the system; core_ms_scan is processor time, which depends little on other
load. The bag is kept beside the scans of the other benches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import os
from pathlib import Path
import subprocess
import sys
import tempfile
from time import perf_counter

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.bags.topics import CLOUD
from surfel_mapper.config import load_config
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.messages.poses import raw_poses
from surfel_mapper.offline.bag_recording import feed as replay_bag
from surfel_mapper.offline.pose_sources import pose_topics
from surfel_mapper.offline.replay import ALL_SCANS
from surfel_mapper.pipeline import Mapper
from surfel_mapper.simulation.recording import record
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.report import Row
from test.bench.street import Street

RUNS = 3

POINTS, ODOMETRY = '/points', '/odom'

BUDGET_TIMES = 10.0
"""Least speed of a replay, times real time."""


def run(options: Options) -> list[Row]:
    """Return a row for each part of a replay."""
    street = Street(options)
    bag = recorded(street, options)
    mount = ', '.join(repr(value) for value in street.simulation.drive.base_to_sensor)
    settings = f'pose: {{source: odometry}}\nframes: {{base_to_sensor: [{mount}]}}\n'
    with tempfile.TemporaryDirectory() as directory, one_core():
        config = Path(directory, 'config.yaml')
        config.write_text(settings, encoding='utf-8')
        keep_freed_memory()
        rows = [row(part, options, bag, config) for part in (read, decode, replay, command)]
    rows[-2] = {**rows[-2], 'budget': BUDGET_TIMES}
    return rows


def recorded(street: Street, options: Options) -> Path:
    """Return the bag of a number of scans, recorded at the first call."""
    path = street.directory.with_name(f'{street.directory.name}-{options.scans}-bag')
    if not path.exists():
        print(f'recording {options.scans} scans into {path}', file=sys.stderr)
        record(replace(street.simulation, num_scans=options.scans), path)
    return path


def row(part: Callable[[Path, Path], None], options: Options, bag: Path, config: Path) -> Row:
    """Return the fastest of some runs."""
    seconds, on_core = [], []
    for _ in range(RUNS):
        start, busy = perf_counter(), busy_s()
        part(bag, config)
        seconds.append(perf_counter() - start)
        on_core.append(busy_s() - busy)
    with BagReader(bag) as reader:
        recorded_s = (reader.end_ns - reader.start_ns) / 1e9
    return {
        'part': part.__name__,
        'scans': options.scans,
        'seconds': min(seconds),
        'ms_scan': min(seconds) * 1e3 / options.scans,
        'times_real': recorded_s / min(seconds),
        'core_ms_scan': min(on_core) * 1e3 / options.scans,
    }


def busy_s() -> float:
    """Return the processor time of this process and its children, s."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def read(bag: Path, config: Path) -> None:
    """Read the messages of clouds and poses."""
    with BagReader(bag) as reader:
        for _ in reader.messages({POINTS, ODOMETRY}):
            pass


def decode(bag: Path, config: Path) -> None:
    """Read them and make scans and poses of them."""
    with BagReader(bag) as reader:
        for message in reader.messages({POINTS, ODOMETRY}):
            if message.type == CLOUD:
                _ = to_scan(reader.decode(message)).points  # decodes them
            else:
                raw_poses('odometry', message.raw, 'base_link', message.topic)


def replay(bag: Path, config: Path) -> None:
    """Map them."""
    mapper = Mapper(load_config(config).replace(ALL_SCANS))
    with BagReader(bag) as reader:
        for _ in replay_bag(reader, mapper, POINTS, pose_topics(reader.topics, mapper.config)):
            pass


def command(bag: Path, config: Path) -> None:
    """Map them in a process of its own, with all its files."""
    subprocess.run(
        [
            *(sys.executable, '-m', 'surfel_mapper.cli.main', 'replay', str(bag)),
            *(
                '--config',
                str(config),
                '--output',
                str(config.parent / 'out'),
                '--overwrite',
                '--json',
            ),
        ],
        check=True,
        stdout=subprocess.DEVNULL,
    )
