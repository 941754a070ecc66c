# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A drive of 10 km in 20,000 full scans with three loops: memory, seconds, error.

Scans are 64 beams by 1600 columns, 80,000 to 94,000 points with a return, 0.5 m apart, without
poses. Every fourth is simulated; the three after it hold the same places of the surfaces as seen
from their own poses, with noise of their own, because a scan costs 60 ms to simulate and 6 ms this
way. One process simulates and maps; its peak of memory is stated, seconds are those of mapping
alone. The points wait on the disk in --cache, 23 GB. Progress goes to stderr.

``--scans N`` drives only the first N scans.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import pairwise
import json
import math
from pathlib import Path
import subprocess
import sys
import tempfile

import numpy as np
import numpy.typing as npt

from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.scan import Scan
from surfel_mapper.simulation import Drive, Lidar, Simulation, World
from test.bench.loops import closed, CORNERS, errors_around, path_m
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.peers.run import ROOT
from test.bench.report import Row

LONG_CORNERS = tuple((2.0 * x, 2.0 * y) for x, y in CORNERS)
"""The blocks of the drive of 5 km, twice as long, m."""

STEP_M = 0.5
NOISE_M = 0.02
SIMULATED = 4
"""One scan of this many is simulated."""


def run(options: Options) -> list[Row]:
    """Return one row."""
    drive = simulation()
    number = drive.num_scans
    number = number if options.scans == Options().scans else min(number, options.scans)
    options.cache.mkdir(parents=True, exist_ok=True)
    with one_core(), tempfile.TemporaryDirectory(dir=options.cache) as scratch:
        command = [sys.executable, '-m', 'test.bench.long_drive', str(number), scratch]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT)
        poses = np.array([drive.drive.T_odom_sensor(drive.stamp_ns(n)) for n in range(number)])
        errors = errors_around(Path(scratch), poses)
    return [{'scans': number, 'path_m': path_m(poses), **errors, **json.loads(done.stdout)}]


@cache
def simulation() -> Simulation:
    """Return the drive, with ranges free of noise; its 9,000 objects take a second to place."""
    legs = [math.dist(*leg) for leg in pairwise(LONG_CORNERS)]
    world = World.circuit(LONG_CORNERS, seed=5)
    course = Drive(start=world.start, speed_m_s=10.0 * STEP_M, corners=LONG_CORNERS)
    number = min(int((sum(legs) - 100.0) / STEP_M), 20_000)
    return Simulation(world, Lidar(beams=64, columns=1600), course, num_scans=number)


def full_scans(drive: Simulation, number: int) -> Iterator[Scan]:
    """Yield scans with noise, every SIMULATED of them measured from its own pose."""
    places: npt.NDArray[np.float64] = np.empty((0, 3))
    for scan in range(number):
        stamp_ns = drive.stamp_ns(scan)
        pose = drive.drive.T_odom_sensor(stamp_ns)
        if scan % SIMULATED == 0:
            points = drive.scan(scan).points.astype(np.float64)
            seen = points[np.isfinite(points).all(axis=1)]
            places = seen @ pose[:3, :3].T + pose[:3, 3]
        else:
            seen = (places - pose[:3, 3]) @ pose[:3, :3]
        noise_m = np.random.default_rng((1, scan)).normal(0.0, NOISE_M, len(seen))
        seen = seen * (1.0 + noise_m / np.linalg.norm(seen, axis=1))[:, None]
        yield Scan(
            points=np.asfortranarray(seen.astype(np.float32)), stamp_ns=stamp_ns, frame_id='lidar'
        )


def say(row: Row) -> None:
    """Print a row of progress."""
    print(json.dumps(row), file=sys.stderr, flush=True)


def main() -> None:
    """Map the first scans of the drive, close the loops, write the poses to a directory."""
    number, directory = int(sys.argv[1]), sys.argv[2]
    keep_freed_memory()
    drive = simulation()
    stamps_ns = [drive.stamp_ns(scan) for scan in range(number)]
    found = closed(full_scans(drive, number), stamps_ns, directory, say)
    json.dump(found, sys.stdout)


if __name__ == '__main__':
    main()
