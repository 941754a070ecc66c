# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A drive of 5 km through streets with three loops: error before and after, memory, seconds.

Scans have no poses. The error is the root mean square of the positions after the best rigid motion
of the whole track; ``gap_m`` is the median error of the relative position of scans that are less
than 5 m apart but more than 300 m of the path. Each runs in a process of its own, whose peak of
memory is stated. Peers have their own defaults, but for one thread and a voxel of 1 m.

``--scans N`` drives only the first N scans, 1.5 m apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
import json
import math
from pathlib import Path
import sys
import tempfile
import time

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from surfel_mapper.config import Config
from surfel_mapper.evaluation.trajectory_errors import absolute_errors
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.offline.replay import ALL_SCANS
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from surfel_mapper.simulation import Drive, Lidar, Simulation, World
from test.bench.machine import one_core, peak_bytes
from test.bench.options import Options
from test.bench.peers import LOOP_PEERS
from test.bench.peers.run import environment, output, PeerError, ROOT, run_odometry
from test.bench.registration import Recording, rms
from test.bench.report import Row

CORNERS = (
    *((0.0, 0.0), (350.0, 0.0), (350.0, 300.0), (0.0, 300.0), (0.0, 0.0), (350.0, 0.0)),
    *((800.0, 0.0), (800.0, 300.0), (350.0, 300.0), (350.0, 0.0), (800.0, 0.0)),
    *((800.0, -350.0), (350.0, -350.0), (350.0, 0.0), (800.0, 0.0)),
)
"""Three blocks, each driven around and on along the street of its begin, m."""

STEP_M = 1.5
LIDAR = Lidar(beams=32, columns=512, range_noise_m=0.02)
VOXEL_M = 1.0
"""Voxel of the peers, m: their default for a range of 100 m."""

NEAR_M, PATH_M = 5.0, 300.0


def run(options: Options) -> list[Row]:
    """Return a row for us and each peer; each is printed as soon as it is known."""
    drive = recorded(options)
    with one_core():
        rows = [ours(drive)]
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
        for peer in LOOP_PEERS if options.peers else ():
            try:
                python = environment(peer, options.cache)
                figures, poses = run_odometry(python, peer, drive.paths, VOXEL_M)
            except PeerError as error:
                rows.append({'who': peer.name, 'not measured': str(error)})
                continue
            seconds = sum(figures['cpu_ms']) / 1e3 + figures['finish_s']
            row = errors(poses, drive.poses)
            rows.append({'who': peer.name, **row, 'cpu_s': seconds, 'peak_mb': figures['peak_mb']})
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    return [{'scans': len(drive.paths), 'path_m': path_m(drive.poses), **row} for row in rows]


def recorded(options: Options) -> Recording:
    """Return the scans of the drive as files, simulated once."""
    directory = options.cache / 'loops'
    directory.mkdir(parents=True, exist_ok=True)
    legs = [math.dist(*leg) for leg in pairwise(CORNERS)]
    number = int((sum(legs) - 100.0) / STEP_M)
    number = number if options.scans == Options().scans else min(number, options.scans)
    world = World.circuit(CORNERS, seed=5)
    course = Drive(start=world.start, speed_m_s=10.0 * STEP_M, corners=CORNERS)
    simulation = Simulation(world, LIDAR, course, num_scans=number)
    paths = [directory / f'{place:05d}.npy' for place in range(number)]
    for place, path in enumerate(paths):
        if not path.exists():
            points = simulation.scan(place).points
            part = path.with_suffix('.part.npy')
            np.save(part, points[np.isfinite(points).all(axis=1)])
            part.rename(path)
    stamps = [simulation.stamp_ns(place) for place in range(number)]
    poses = np.array([course.T_odom_sensor(stamp_ns) for stamp_ns in stamps])
    return Recording('loops', paths, stamps, poses)


def ours(drive: Recording) -> Row:
    """Return the errors of the Mapper before and after its loops, in a process of its own."""
    with tempfile.TemporaryDirectory() as scratch:
        job = {
            'scans': [str(path) for path in drive.paths],
            'stamps_ns': [int(stamp_ns) for stamp_ns in drive.stamps_ns],
            'directory': scratch,
        }
        command = [sys.executable, '-m', 'test.bench.loops']
        found: Row = json.loads(output(command, input=json.dumps(job), cwd=ROOT))
        return {'who': 'ours', **errors_around(Path(scratch), drive.poses), **found}


def errors_around(directory: Path, poses: npt.NDArray[np.float64]) -> Row:
    """Return the errors of the poses before and after the loops, which ``closed`` wrote."""
    before, after, at = (np.load(directory / f'{name}.npy') for name in ('before', 'after', 'at'))
    true = poses[at]
    return {
        'mapped': len(at),
        **{f'{name}_before': value for name, value in errors(before, true).items()},
        **errors(after, true),
    }


def errors(poses: npt.NDArray[np.float64], true: npt.NDArray[np.float64]) -> Row:
    """Return the error of a track, and that between scans where it passes again."""
    found = absolute_errors(poses, true).translation_m
    return {'error_m': rms(found), 'max_m': float(found.max()), 'gap_m': gap_m(poses, true)}


def gap_m(poses: npt.NDArray[np.float64], true: npt.NDArray[np.float64]) -> float | None:
    """Return the median error of the relative positions of scans of one place."""
    way = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1))]
    )
    pairs = cKDTree(true[:, :3, 3]).query_pairs(NEAR_M, output_type='ndarray')
    pairs = pairs[np.abs(way[pairs[:, 0]] - way[pairs[:, 1]]) > PATH_M]
    if not len(pairs):
        return None
    a, b = pairs.T
    off = [np.linalg.inv(p[a]) @ p[b] for p in (poses, true)]
    return float(np.median(np.linalg.norm(off[0][:, :3, 3] - off[1][:, :3, 3], axis=1)))


def path_m(poses: npt.NDArray[np.float64]) -> float:
    """Return the length of a track, m."""
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


def main() -> None:
    """Map the scans of the job on stdin by registration, close the loops, write the poses."""
    job = json.load(sys.stdin)
    files = zip(job['scans'], job['stamps_ns'], strict=True)
    scans = (
        Scan(points=np.load(path), stamp_ns=stamp_ns, frame_id='lidar') for path, stamp_ns in files
    )
    keep_freed_memory()
    found = closed(scans, job['stamps_ns'], job['directory'])
    json.dump(found, sys.stdout)


def closed(
    scans: Iterable[Scan],
    stamps_ns: Sequence[int],
    directory: str,
    progress: Callable[[Row], object] = lambda row: None,
) -> Row:
    """
    Map scans by registration and close the loops; write before.npy, after.npy and at.npy.

    The files have the poses, (M, 4, 4), and the numbers of the scans that were mapped. Seconds are
    those of the processor, without those in which scans are made or read. ``progress`` is called
    every thousand scans.
    """
    mapper = Mapper(
        Config.from_mapping(
            {
                **ALL_SCANS,
                'pose.source': 'registration',
                'loops.enabled': True,
                'loops.directory': directory,
            }
        )
    )
    mapper.warm_up()
    begun, odometry_s = time.perf_counter(), 0.0
    for place, scan in enumerate(scans, start=1):
        start = time.process_time()
        mapper.add_scan(scan)
        for _ in mapper.insert_ready():
            pass
        odometry_s += time.process_time() - start
        if place % 1000 == 0:
            progress({'scans': place, 'odometry_cpu_s': odometry_s, 'peak_mb': peak_mb()})
    mapper.finish()
    assert mapper.loops is not None
    before, odometry_mb = mapper.loops.T_map_sensor, peak_mb()
    start = time.process_time()
    move = mapper.close_loops(lambda text: progress({'loops': text, 'peak_mb': peak_mb()}))
    loops_s = time.process_time() - start
    number = {stamp_ns: place for place, stamp_ns in enumerate(stamps_ns)}
    found = {'before': before, 'after': mapper.loops.T_map_sensor}
    found['at'] = np.array([number[stamp_ns] for stamp_ns in mapper.loops.stamps_ns])
    for name, array in found.items():
        np.save(Path(directory) / f'{name}.npy', array)
    return {
        'loops': len(move.closure.loops),
        'refused': len(move.closure.refusals),
        'odometry_cpu_s': odometry_s,
        'loops_cpu_s': loops_s,
        'cpu_s': odometry_s + loops_s,
        'wall_s': time.perf_counter() - begun,
        'odometry_peak_mb': odometry_mb,
        'peak_mb': peak_mb(),
        'voxels': mapper.map.num_voxels,
        'spool_mb': mapper.loops.nbytes / 1e6,
        'said': str(move),
    }


def peak_mb() -> float:
    """Return the peak memory of this process, without that of its parent, MB."""
    return peak_bytes() / 1e6


if __name__ == '__main__':
    main()
