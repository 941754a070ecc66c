# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The scans of all benchmarks: a lidar of 131,072 points driving through the simulated street.

Scans are simulated once and kept as .npy, a file a scan, in a directory named by a hash of the
parameters. Messages have the layout of drivers, 32 bytes a point, 4 MiB each.
"""

from __future__ import annotations

from dataclasses import asdict, fields
import hashlib
import json
from pathlib import Path
import sys

import numpy as np
import numpy.typing as npt

from surfel_mapper.files.atomic import replace_file
from surfel_mapper.messages.cdr import Header, Stamp
from surfel_mapper.messages.pointcloud2 import RawCloud
from surfel_mapper.scan import Scan
from surfel_mapper.simulation import Lidar, Simulation, World
from surfel_mapper.simulation.recording import cloud_bytes, SENSOR
from test.bench.options import Options

LENGTH_M = 600.0
"""Length of the street: room for 1200 scans, one every 0.5 m."""

NOISE_M = 0.02

SWEEP_S = 0.05
"""Time from the first to the last point of a message, s."""


class Street:
    """
    Scans of a drive at 10 Hz and 5 m/s.

    Parameters
    ----------
    options : Options
        Size of the lidar, and the cache.

    """

    def __init__(self, options: Options) -> None:
        lidar = Lidar(beams=options.beams, columns=options.columns, range_noise_m=NOISE_M)
        world = World.street(seed=1, length_m=LENGTH_M)
        self.simulation = Simulation(world, lidar)
        self.directory = options.cache / f'street-{self._hash()}'
        self._rows = options.beams

    def pose(self, number: int) -> npt.NDArray[np.float64]:
        """Return T_odom_sensor (4, 4) of a scan."""
        return self.simulation.drive.T_odom_sensor(self.simulation.stamp_ns(number))

    def points(self, number: int) -> npt.NDArray[np.float32]:
        """Return the points of a scan, (N, 3) in the sensor frame, m; nan for missing returns."""
        path = self.path(number)
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            with replace_file(path) as file:
                np.save(file, self._made(number))
        points: npt.NDArray[np.float32] = np.load(path)
        return points

    def path(self, number: int) -> Path:
        """Return the file of a scan."""
        return self.directory / f'{number:05d}.npy'

    def prepare(self, num_scans: int) -> None:
        """Simulate the missing ones of the first ``number`` scans."""
        missing = [n for n in range(num_scans) if not self.path(n).exists()]
        if missing:
            print(f'simulating {len(missing)} scans into {self.directory}', file=sys.stderr)
        for number in missing:
            self.points(number)

    def message(self, number: int) -> RawCloud:
        """
        Return a scan as a PointCloud2.

        Intensity and ring are zero and unread; times run to 0 within SWEEP_S, for deskewing.
        """
        points = self.points(number)
        zeros = np.zeros(len(points), np.float32)
        times = np.linspace(-SWEEP_S, 0.0, len(points), dtype=np.float32)
        columns = {'intensity': zeros, 'ring': zeros, 'time': times}
        stamp_ns = self.simulation.stamp_ns(number)
        scan = Scan(points=points, stamp_ns=stamp_ns, frame_id=SENSOR, columns=columns)
        cloud = cloud_bytes(scan, self._rows)
        header = Header(Stamp(*divmod(stamp_ns, 10**9)), SENSOR)
        return RawCloud(header=header, **{f.name: getattr(cloud, f.name) for f in fields(cloud)})

    def _made(self, number: int) -> npt.NDArray[np.float32]:
        """Return the points of a scan that is not kept yet."""
        points: npt.NDArray[np.float32] = self.simulation.scan(number).points
        return points

    def _hash(self) -> str:
        """Return a short hash of the parameters of the points."""
        primitives = [asdict(primitive) for primitive in self.simulation.world.primitives]
        state = [primitives, asdict(self.simulation.lidar), asdict(self.simulation.drive)]
        return hashlib.sha256(json.dumps(state).encode()).hexdigest()[:12]
