# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Tracking on hard input: thinned scans, trucks that move along, spins, corridors, tunnels.

Errors are the root mean square of the positions after the best fit of the whole track, all with
one estimator. Our rows have the counts of the summary of a replay: lost, ambiguous and degenerate
scans, parts that stayed apart. Peers run at 0.5 and 1 m voxels; the better is shown. The last
column compares ours with the best of the peers, and the last row counts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import os
from pathlib import Path
import tempfile
from typing import Any

import numpy as np

from surfel_mapper.config import Config
from surfel_mapper.evaluation.trajectory_errors import absolute_errors
from surfel_mapper.offline.summary import MOST_SURROUNDED
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.peers import ODOMETRY_PEERS
from test.bench.peers.run import environment, PeerError, run_odometry
from test.bench.registration import recorded, Recording, rms, SIZES_M
from test.bench.report import Row
from test.bench.scenarios import Scenario, scenarios

EQUAL = 1.05
"""Errors that differ by a smaller factor are as good as each other."""

BETTER = 'better than both'

TWICE = 2.0
"""Factor above which ours is called worse."""

THINNED = (('hall_os0_full', 2), ('hall_os0_full', 3), ('hall_os0_long', 2))
"""Real bags of which every second or third scan is taken."""


def run(options: Options) -> list[Row]:
    """Return a row a sequence."""
    with one_core(), tempfile.TemporaryDirectory() as scratch:
        rows = [row(options, each) for each in sequences(options, Path(scratch))]
    return [*rows, total(rows)] if options.peers else rows


def row(options: Options, sequence: Recording) -> Row:
    """Return the errors of each package on a sequence."""
    result: dict[str, Any] = {'sequence': sequence.name, **ours(sequence)}
    for peer in ODOMETRY_PEERS if options.peers else ():
        errors = []
        for size_m in SIZES_M:
            try:
                python = environment(peer, options.cache)
                poses = run_odometry(python, peer, sequence.paths, size_m)[1]
                errors.append(rms(absolute_errors(poses, sequence.poses).translation_m))
            except PeerError as error:
                result[f'{peer.name}: not measured'] = str(error)
        result[f'{peer.name}_m'] = min(errors, default=None)
    return {**result, 'ours is': verdict(result)} if options.peers else result


def verdict(row: Row) -> str:
    """Return how the error of ours compares with the best peer's, and if the summary warns."""
    measured = [row.get(f'{peer.name}_m') for peer in ODOMETRY_PEERS]
    errors = [error for error in measured if error is not None]
    if len(errors) < len(measured):
        return ''
    ratio = row['ours_m'] / min(errors)
    if ratio * EQUAL < 1.0:
        found = BETTER
    elif ratio <= EQUAL:
        found = 'as good as the best'
    else:
        found = 'within twice the best' if ratio <= TWICE else 'worse'
    warns = row['ambiguous'] or row['degenerate'] or row['surrounded'] >= MOST_SURROUNDED
    return f'{found}, reported' if warns else found


def total(rows: Sequence[Row]) -> Row:
    """Return the row that counts the sequences in which ours is better than both peers."""
    better = sum(str(row['ours is']).startswith(BETTER) for row in rows)
    return {'sequence': 'all', 'ours is': f'{BETTER} on {better} of {len(rows)}'}


def ours(sequence: Recording) -> Row:
    """Return the error of the Mapper at 0.5 m voxels, and its own counts."""
    mapper = Mapper(Config.from_mapping({'pose.source': 'registration'}))
    mapper.warm_up()
    found = {}
    for path, stamp_ns in zip(sequence.paths, sequence.stamps_ns, strict=True):
        points = np.asfortranarray(np.load(path))
        mapper.add_scan(Scan(points=points, stamp_ns=int(stamp_ns), frame_id='lidar'))
        for update in mapper.insert_ready():
            found[update.stamp_ns] = update.T_map_sensor
    mapper.finish()
    stamps = [int(stamp) for stamp in sequence.stamps_ns]
    at = [place for place, stamp in enumerate(stamps) if stamp in found]
    estimated = np.array([found[stamps[place]] for place in at])
    errors = absolute_errors(estimated, sequence.poses[at])
    said = mapper.summary()['registration']
    return {
        'scans': len(stamps),
        'mapped': len(at),
        'ours_m': rms(errors.translation_m),
        'max_m': float(np.max(errors.translation_m)),
        'ambiguous': said['ambiguous'],
        'degenerate': said['degenerate'],
        'surrounded': said['tracking']['surrounded']['scans'],
    }


def sequences(options: Options, scratch: Path) -> Iterator[Recording]:
    """Yield the scans of all sequences as files; the real ones if their data is present."""
    data = os.environ.get('SURFEL_MAPPER_TEST_DATA')
    for name, every in THINNED if data else ():
        whole = recorded(Path(str(data)) / 'data' / 'bags' / name, scratch)
        yield Recording(
            f'{name}, every {every}',
            whole.paths[::every],
            whole.stamps_ns[::every],
            whole.poses[::every],
        )
    for scenario in scenarios():
        yield simulated(scenario, options.cache / 'scenarios' / scenario.name.replace(' ', '_'))


def simulated(scenario: Scenario, directory: Path) -> Recording:
    """Return the scans of a scenario as files."""
    directory.mkdir(parents=True, exist_ok=True)
    paths, stamps, poses = [], [], []
    for number, (scan, pose) in enumerate(scenario.scans()):
        paths.append(directory / f'{number:05d}.npy')
        np.save(paths[-1], scan.points)
        stamps.append(scan.stamp_ns)
        poses.append(pose)
    return Recording(scenario.name, paths, stamps, np.array(poses))
