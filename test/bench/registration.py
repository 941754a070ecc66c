# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Poses by registration: drift and time a scan, with --peers also of other packages.

All get the same scans, on one core, and one estimator compares them with the same truth: the
error of each step, the drift over segments of the path, and the error at the end. Our time is
that of the Mapper, normals of all changed voxels included. Peers run at the voxel sizes that suit
them: KISS-ICP's default is 1 m for a range of 100 m.

The street has exact truth. The real sequences, if SURFEL_MAPPER_TEST_DATA names their folder,
have the poses of another odometry, which drifts too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import os
from pathlib import Path
import tempfile
from time import perf_counter, thread_time

import numpy as np
import numpy.typing as npt

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.config import Config
from surfel_mapper.evaluation.trajectory_errors import absolute_errors, drift, relative_errors
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.pipeline import Mapper
from surfel_mapper.poses import TransformBuffer
from surfel_mapper.scan import Scan
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.peers import ODOMETRY_PEERS
from test.bench.peers.run import environment, PeerError, run_odometry
from test.bench.report import Row
from test.bench.street import Street
from test.messages.pose_messages import poses_in

STREET_SCANS = 200
"""100 m of the street."""

REAL = ('hall_os0_full', 'hall_os0_long')

SIZES_M = (0.5, 1.0)

Times = dict[str, list[float]]
"""Clock time and processor time of a scan, ms; the latter depends little on other load."""


@dataclass(frozen=True)
class Recording:
    """Scans as files, with their stamps and true poses."""

    name: str
    paths: Sequence[Path]
    stamps_ns: Sequence[int]
    poses: npt.NDArray[np.float64]


def run(options: Options) -> list[Row]:
    """Return a row for each package, by sequence."""
    rows: list[Row] = []
    with one_core(), sequences(options) as found:
        for sequence in found:
            for size_m in SIZES_M:
                times, poses = ours(sequence, size_m)
                rows.append(row(sequence, 'surfel_mapper', size_m, times, poses))
            if options.peers:
                rows += peer_rows(options, sequence)
    return rows


def ours(sequence: Recording, size_m: float) -> tuple[Times, npt.NDArray[np.float64]]:
    """Return times and poses, (S, 4, 4), of the Mapper."""
    config = {'pose.source': 'registration', 'map.voxel_size_m': size_m}
    mapper = Mapper(Config.from_mapping(config))
    mapper.warm_up()
    times: Times = {'milliseconds': [], 'cpu_ms': []}
    poses = []
    for path, stamp_ns in zip(sequence.paths, sequence.stamps_ns, strict=True):
        points = np.asfortranarray(np.load(path))
        scan = Scan(points=points, stamp_ns=int(stamp_ns), frame_id='lidar')
        start, cpu_start = perf_counter(), thread_time()
        mapper.add_scan(scan)
        updates = list(mapper.insert_ready())
        times['milliseconds'].append((perf_counter() - start) * 1e3)
        times['cpu_ms'].append((thread_time() - cpu_start) * 1e3)
        poses += [update.T_map_sensor for update in updates]
    if len(poses) < len(sequence.paths):
        raise RuntimeError(f'{sequence.name}: {mapper.counters.dropped} of the scans dropped')
    return times, np.array(poses)


def peer_rows(options: Options, sequence: Recording) -> list[Row]:
    """Return the rows of the peers; only the reason if one is missing or fails."""
    rows: list[Row] = []
    for peer in ODOMETRY_PEERS:
        for size_m in SIZES_M:
            try:
                python = environment(peer, options.cache)
                times, poses = run_odometry(python, peer, sequence.paths, size_m)
            except PeerError as error:
                who = f'{peer.name}: not measured: {error}'
                rows.append({'sequence': sequence.name, 'who': who, 'voxel_m': size_m})
            else:
                rows.append(row(sequence, peer.name, size_m, times, poses))
    return rows


def row(
    sequence: Recording,
    who: str,
    size_m: float,
    times: Times,
    poses: npt.NDArray[np.float64],
) -> Row:
    """Return the row of a package."""
    step = relative_errors(poses, sequence.poses)
    drift_m, drift_deg = drift(poses, sequence.poses)
    ends = [np.linalg.inv(track[0]) @ track[-1] for track in (poses, sequence.poses)]
    whole = absolute_errors(poses, sequence.poses)
    return {
        'sequence': sequence.name,
        'who': who,
        'voxel_m': size_m,
        'step_mm': rms(step.translation_m) * 1e3,
        'step_deg': rms(step.rotation_deg),
        'drift_m_100m': drift_m,
        'drift_deg_100m': drift_deg,
        'ate_m': rms(whole.translation_m),
        'end_m': float(np.linalg.norm(ends[0][:3, 3] - ends[1][:3, 3])),
        'median_ms': float(np.median(times['milliseconds'])),
        'cpu_ms': float(np.median(times['cpu_ms'])),
        'cpu_p99_ms': float(np.percentile(times['cpu_ms'], 99)),
        'scans': len(poses),
    }


def rms(values: npt.NDArray[np.float64]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


@contextmanager
def sequences(options: Options) -> Iterator[list[Recording]]:
    """Prepare the scans of all sequences as files."""
    street = Street(options)
    numbers = range(min(STREET_SCANS, 2 * options.scans))
    street.prepare(len(numbers))
    found = [
        Recording(
            'street',
            [street.path(number) for number in numbers],
            [street.simulation.stamp_ns(number) for number in numbers],
            np.array([street.pose(number) for number in numbers]),
        )
    ]
    data = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    with tempfile.TemporaryDirectory() as scratch:
        if data:
            bags = Path(data) / 'data' / 'bags'
            found += [recorded(bags / name, Path(scratch)) for name in REAL]
        yield found


def recorded(bag: Path, scratch: Path) -> Recording:
    """Return the scans of a bag with the poses recorded in its /tf."""
    transforms, scans = TransformBuffer(), []
    with BagReader(bag) as reader:
        for message in reader.messages({'/points', '/tf', '/tf_static'}):
            decoded = reader.decode(message)
            if message.topic == '/points':
                scans.append(to_scan(decoded))
                continue
            for parent, child, stamp_ns, xyz, q_xyzw in poses_in('tf', decoded, 'base_link'):
                pose = pose_matrix(xyz, q_xyzw)
                if message.topic == '/tf_static':
                    transforms.add_static(parent, child, pose)
                else:
                    transforms.add(parent, child, stamp_ns, pose)
    paths = [scratch / f'{bag.name}_{number:05d}.npy' for number in range(len(scans))]
    for path, scan in zip(paths, scans, strict=True):
        np.save(path, np.ascontiguousarray(scan.points))
    poses = [transforms.lookup('odom', scan.frame_id, scan.stamp_ns) for scan in scans]
    return Recording(bag.name, paths, [scan.stamp_ns for scan in scans], np.array(poses))
