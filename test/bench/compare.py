# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The map beside plain numpy and, with --peers, beside other packages, on one core.

All get the same scans at the same poses; ``x_ours`` is the ratio of their time to ours. Ours and
numpy read PointCloud2 of 32-byte steps; the peers get packed points, which is less work. The last
column states the work that a peer leaves out; none of the marked ones is exact. The integers of
numpy and of the map are compared at the end. A slow peer is given fewer scans. The window of real
scans is 20, as in the bench ``real``: small_gicp takes 8 s for one of a VLS-128 at 0.2 m.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from surfel_mapper.messages.pointcloud2 import RawCloud
from surfel_mapper.simulation.recording import POINT
from test.bench.machine import one_core
from test.bench.numpy_map import NumpyMap
from test.bench.options import Options
from test.bench.ours import Ours
from test.bench.peers import PEERS
from test.bench.peers.run import environment, PeerError, run_peer
from test.bench.real import drives, WINDOW
from test.bench.report import Row, spread
from test.bench.street import MovedScan, Street


def run(options: Options) -> Iterator[Row]:
    """Yield a row for each package, by scan and voxel size; the first is ours."""
    with one_core():
        for name, street, size in drives(options):
            real = isinstance(street, MovedScan)
            size = replace(size, window=min(size.window, WINDOW)) if real else size
            for found in compared(size, street):
                yield {'scan': name, **found, 'window': size.window}


def compared(options: Options, street: Street) -> Iterator[Row]:
    """Yield the rows of one drive."""
    street.prepare(options.untimed + options.scans)
    for size_m in options.voxel_sizes_m:
        ours, numpy_map = Ours(size_m, options.window), NumpyMap(size_m, options.window)
        times = timed(options, street, ours.step)
        reference_ms = float(np.median(times))
        voxels = ours.map.num_voxels
        yield row(options, size_m, 'surfel_mapper', times, reference_ms, voxels)
        times = timed(options, street, partial(numpy_step, numpy_map))
        ours.check_equal(numpy_map)
        yield row(options, size_m, 'numpy, sorted keys', times, reference_ms, voxels)
        if options.peers:
            yield from peer_rows(options, street, size_m, reference_ms)


def timed(options: Options, street: Street, step: Callable[..., Any]) -> list[float]:
    """Return the times of a step, given message and pose."""
    times = []
    for number, message, counts in street.drive(options.untimed, options.scans):
        pose = street.pose(number)
        start = perf_counter()
        step(message, pose)
        if counts:
            times.append((perf_counter() - start) * 1e3)
    return times


def numpy_step(numpy_map: NumpyMap, message: RawCloud, pose: np.ndarray) -> None:
    """Map a scan with numpy, from the bytes on."""
    points = np.frombuffer(message.data, POINT)
    numpy_map.step([points[name] for name in 'xyz'], pose)


def peer_rows(
    options: Options, street: Street, size_m: float, reference_ms: float
) -> Iterator[Row]:
    """Yield a row for each peer; only the reason if it is missing or fails."""
    for peer in PEERS:
        try:
            python = environment(peer, options.cache)
            times, voxels = run_peer(python, peer, options, street, size_m)
        except PeerError as error:
            yield {'voxel_m': size_m, 'who': peer.name, 'less': f'not measured: {error}'}
        else:
            found = row(options, size_m, peer.name, times, reference_ms, voxels)
            yield {**found, 'less': peer.less}


def row(
    options: Options,
    size_m: float,
    who: str,
    times: list[float],
    reference_ms: float,
    voxels: int,
) -> Row:
    """Return the row of a package."""
    figures = spread(times)
    return {
        'voxel_m': size_m,
        'who': who,
        **figures,
        'x_ours': figures['median_ms'] / reference_ms,
        'Mpt_s': options.num_points / figures['median_ms'] * 1e-3,
        'scans': len(times),
        'voxels': voxels,
        'less': None,
    }
