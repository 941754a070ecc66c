# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Bags with one process and two workers: speed, start, and memory for more input.

``speed``: one bag, four times, mapped without writing. Kernels are loaded. They take turns and the
fastest run of each counts. ``start``: until a fresh process, or its workers, have loaded all that
mapping needs. ``holds from`` is the least length of a recording at which workers, their start
included, reach the required speed-up, by these figures. ``memory``: a quarter, a half and all of
the drive, with shards of one quarter, in fresh processes. All digests are compared.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
import multiprocessing
from pathlib import Path
import subprocess
import sys
from time import perf_counter, process_time, time

from surfel_mapper.cluster.map_reduce import map_bags, MappedBags
from surfel_mapper.cluster.shards import cut, shard_length_s
from surfel_mapper.cluster.workers import open_workers, Workers
from surfel_mapper.config import Config
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.replay import ALL_SCANS
from surfel_mapper.offline.request import Request
from surfel_mapper.pipeline import Mapper
from test.bench.machine import peak_bytes
from test.bench.offline import recorded
from test.bench.options import Options
from test.bench.report import Row
from test.bench.street import Street

LONGER = 4
"""Scans of the drive, as a multiple of other benches."""

DRIVES = 4
"""Number of runs for the speed."""

RUNS = 2

CONFIG = Config()

BUDGET_RATIO = 1.6
"""Least speed-up of two workers over one process."""

STARTS = {
    'one process': 'from surfel_mapper.pipeline import Mapper\nMapper().warm_up()\nsay()',
    'two workers': (
        'from surfel_mapper.cluster.workers import open_workers\n'
        'from surfel_mapper.cluster import map_reduce\nwith open_workers(workers=2):\n    say()'
    ),
}
"""Programs that print when they are ready to map."""

SAY = 'import sys, time\ndef say(): print(time.time() - float(sys.argv[1]))\n'


def run(options: Options) -> list[Row]:
    """Return a row for every way and every amount of input."""
    options = replace(options, scans=LONGER * options.scans)
    bag = recorded(Street(options), options)
    speed, start = speed_rows(bag), start_rows()
    return [*speed, *start, holds_from(speed, start), *memory_rows(bag)]


def speed_rows(bag: Path) -> list[Row]:
    """Return the speed of each way."""
    requests = [Request(path=bag) for _ in range(DRIVES)]
    seconds: dict[str, list[float]] = {}
    found: dict[str, tuple[str, float, float]] = {}

    def timed(name: str, way: Callable[[], tuple[str, float, float]]) -> None:
        start = perf_counter()
        found[name] = way()
        seconds.setdefault(name, []).append(perf_counter() - start)

    with open_workers(workers=2) as two:
        by(two, requests[:1])  # pyarrow and the file are loaded
        for _ in range(RUNS):
            timed('two workers', lambda: by(two, requests))
            timed('one process', lambda: in_one_process(requests))
    check_equal({digest for digest, _, _ in found.values()})
    reference_s = min(seconds['one process'])
    return [
        {
            'what': 'speed',
            'who': name,
            'recorded_s': found[name][1],
            'seconds': min(seconds[name]),
            'times_real': found[name][1] / min(seconds[name]),
            'ratio': reference_s / min(seconds[name]),
            'core_s': found[name][2],
            **({'budget': BUDGET_RATIO} if name == 'two workers' else {}),
        }
        for name in sorted(seconds)
    ]


def start_rows() -> list[Row]:
    """Return the start-up time of each way."""
    rows: list[Row] = []
    for name, program in STARTS.items():
        seconds = []
        for _ in range(RUNS):
            command = [sys.executable, '-c', SAY + program, str(time())]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            seconds.append(float(done.stdout))
        rows.append({'what': 'start', 'who': name, 'seconds': min(seconds)})
    return rows


def holds_from(speed: list[Row], start: list[Row]) -> Row:
    """Return the least length of a recording at which workers are fast enough, start included."""
    start_s = {row['who']: row['seconds'] for row in start}
    share = {row['who']: row['seconds'] / row['recorded_s'] for row in speed}
    late_s = BUDGET_RATIO * start_s['two workers'] - start_s['one process']
    gain = share['one process'] - BUDGET_RATIO * share['two workers']
    length_s = max(late_s, 0.0) / gain if gain > 0.0 else None
    return {'what': 'holds from', 'who': 'two workers', 'recorded_s': length_s}


def in_one_process(requests: list[Request]) -> tuple[str, float, float]:
    """Map drives one after the other; return digest, seconds recorded and of the processor."""
    total, recorded_s, start = SurfelMap(CONFIG.map.voxel_size_m), 0.0, process_time()
    for request in requests:
        with open_recording(request, CONFIG.replace(ALL_SCANS)) as recording:
            mapper = Mapper(recording.config)
            for _ in recording.replay(mapper):
                pass
            recorded_s += recording.recorded_s
        total.merge(mapper.map)
    return total.digest(), recorded_s, process_time() - start


def by(executor: Workers, requests: list[Request]) -> tuple[str, float, float]:
    """Map drives with workers; return digest, seconds recorded and seconds of processors."""
    lengths = []
    for request in requests:
        with open_recording(request, CONFIG) as recording:
            lengths.append(recording.recorded_s)
    mapped = summed(executor, requests, shard_length_s(sum(lengths), executor.num_workers))
    return mapped.mapper.map.digest(), sum(lengths), mapped.core_s


def summed(executor: Workers, requests: list[Request], shard_s: float) -> MappedBags:
    """Map drives into one map."""
    return map_bags([cut(request, CONFIG, shard_s) for request in requests], executor)


def memory_rows(bag: Path) -> list[Row]:
    """Return the memory of each way for a quarter, a half and all of a drive."""
    with open_recording(Request(path=bag), CONFIG) as recording:
        whole_s = recording.recorded_s
    rows: list[Row] = []
    for share in (0.25, 0.5, 1.0):
        requests = [Request(path=bag, duration_s=share * whole_s)]
        context = multiprocessing.get_context('spawn')
        with ProcessPoolExecutor(1, mp_context=context) as alone:
            digest, peak = alone.submit(peak_of_one, requests).result()
        with open_workers(workers=2) as executor:
            mapped = summed(executor, requests, 0.25 * whole_s * 1.001)
            of_workers = executor.client.run(peak_bytes).values()
        surfel_map = mapped.mapper.map
        check_equal({digest, surfel_map.digest()})
        common = {'what': 'memory', 'recorded_s': share * whole_s, 'voxels': surfel_map.num_voxels}
        rows.append({**common, 'who': 'one process', 'peak_MB': peak / 1e6})
        rows.append({**common, 'who': 'a worker', 'peak_MB': max(of_workers) / 1e6})
    return rows


def peak_of_one(requests: list[Request]) -> tuple[str, int]:
    """Map drives; return digest and peak memory of this process."""
    keep_freed_memory()
    digest, _, _ = in_one_process(requests)
    return digest, peak_bytes()


def check_equal(digests: set[str]) -> None:
    """Raise an error if two ways make different maps."""
    if len(digests) > 1:
        raise RuntimeError(f'the maps differ: {digests}')
