# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Record a simulation as a bag with its ground truth.

The bag holds /points (PointCloud2 in the frame lidar), /odom and /tf (odom to base_link, every
10 ms and at every stamp of a scan), and /tf_static (base_link to lidar). Poses are recorded at
their stamp and a cloud after its turn, as by a driver. The directory also holds world.json and
simulation.json, from which load_simulation restores the simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict
import heapq
import json
from pathlib import Path
from typing import Any

import numpy as np

from surfel_mapper.bags.writer import BagWriter
from surfel_mapper.budget import read_small_file
from surfel_mapper.errors import ConfigError, FileFormatError, refusing
from surfel_mapper.files.atomic import write_json
from surfel_mapper.messages.pointcloud2 import CloudBytes, field_of
from surfel_mapper.messages.poses import StampedPose
from surfel_mapper.scan import Scan
from surfel_mapper.simulation.drive import Drive, Simulation
from surfel_mapper.simulation.lidar import Lidar
from surfel_mapper.simulation.world import World

ODOM, BASE, SENSOR = 'odom', 'base_link', 'lidar'
"""Names of the frames."""

ODOMETRY_STEP_NS = 10_000_000
"""Period of the recorded poses; further ones are at the stamps of scans."""

DRIVER_DELAY_NS = 2_000_000
"""Delay from the end of a turn to the recording of its cloud."""

WORLD_FILE, SIMULATION_FILE = 'world.json', 'simulation.json'

POINT = np.dtype(
    {
        'names': ['x', 'y', 'z', 'intensity', 'ring', 'time'],
        'formats': ['<f4', '<f4', '<f4', '<f4', '<u2', '<f4'],
        'offsets': [0, 4, 8, 16, 20, 24],
        'itemsize': 32,
    }
)
"""Layout of a point, with padding as drivers have it."""

FIELDS = tuple(field_of(name, POINT) for name in POINT.names or ())


def record(
    simulation: Simulation,
    path: str | Path,
    *,
    storage: str = 'mcap',
    overwrite: bool = False,
    on_scan: Callable[[Scan], None] | None = None,
) -> None:
    """
    Write a simulation as a rosbag2 directory, whole or not at all.

    Parameters
    ----------
    simulation : Simulation
        The simulation.
    path : str or Path
        Directory of the bag.
    storage : str
        mcap or sqlite3.
    overwrite : bool
        Whether an existing bag is replaced.
    on_scan : callable, optional
        Called with each scan after it is written.

    Raises
    ------
    BagError
        If the path exists and may not be overwritten, or writing fails.

    """
    with BagWriter(path, storage, overwrite=overwrite) as bag:
        _write_description(simulation, bag.directory)
        drive = simulation.drive
        mount = drive.base_to_sensor
        static = StampedPose(BASE, SENSOR, drive.start_ns, mount[:3], mount[3:])
        bag.write_transform('/tf_static', drive.start_ns, static, latched=True)
        for record_ns, number in heapq.merge(_pose_times(simulation), _scan_times(simulation)):
            if number < 0:
                pose = StampedPose(ODOM, BASE, record_ns, *drive.pose(record_ns))
                bag.write_odometry('/odom', record_ns, pose)
                bag.write_transform('/tf', record_ns, pose)
            else:
                scan = simulation.scan(number, SENSOR)
                cloud = cloud_bytes(scan, simulation.lidar.beams)
                bag.write_cloud('/points', record_ns, scan.stamp_ns, SENSOR, cloud)
                if on_scan is not None:
                    on_scan(scan)


def cloud_bytes(scan: Scan, beams: int) -> CloudBytes:
    """Return an organised PointCloud2 of a simulated scan, one row a beam."""
    points = np.zeros(len(scan), POINT)
    for axis, name in enumerate('xyz'):
        points[name] = scan.points[:, axis]
    for name in ('intensity', 'ring', 'time'):
        points[name] = scan.columns[name]
    width = len(scan) // beams
    return CloudBytes(
        height=beams,
        width=width,
        fields=FIELDS,
        is_bigendian=False,
        point_step=POINT.itemsize,
        row_step=POINT.itemsize * width,
        data=points.view(np.uint8),
        is_dense=bool(np.isfinite(scan.points).all()),
    )


def load_simulation(path: str | Path) -> Simulation:
    """
    Return the simulation that a bag was recorded from.

    Parameters
    ----------
    path : str or Path
        Directory of the bag.

    Raises
    ------
    FileFormatError
        If its world.json or simulation.json is missing or damaged.

    """
    world = World.load(Path(path) / WORLD_FILE)
    file = Path(path) / SIMULATION_FILE
    with refusing(file):
        document = json.loads(read_small_file(file))
        try:
            lidar, drive = Lidar(**_tuples(document['lidar'])), Drive(**_tuples(document['drive']))
            return Simulation(
                world, lidar, drive, num_scans=document['num_scans'], rolling=document['rolling']
            )
        except ConfigError as error:
            raise FileFormatError(f'{file}: {error}') from error


def _write_description(simulation: Simulation, directory: Path) -> None:
    """Write world.json and simulation.json."""
    simulation.world.save(directory / WORLD_FILE)
    description = {
        'lidar': asdict(simulation.lidar),
        'drive': asdict(simulation.drive),
        'num_scans': simulation.num_scans,
        'rolling': simulation.rolling,
    }
    write_json(directory / SIMULATION_FILE, description)


def _tuples(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values with lists converted to tuples; JSON has no tuples."""
    return {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}


def _turn_ns(simulation: Simulation) -> int:
    """Return the duration of a turn of the lidar, ns."""
    return round(1e9 / simulation.lidar.rate_hz)


def _pose_times(simulation: Simulation) -> Iterator[tuple[int, int]]:
    """Yield the stamp of each recorded pose until the end of the last turn, and -1."""
    start = simulation.drive.start_ns
    scans = [simulation.stamp_ns(number) for number in range(simulation.num_scans)]
    end = scans[-1] + _turn_ns(simulation)
    steps = range(start, end + ODOMETRY_STEP_NS, ODOMETRY_STEP_NS)
    for stamp_ns in sorted({*steps, *scans}):
        yield stamp_ns, -1


def _scan_times(simulation: Simulation) -> Iterator[tuple[int, int]]:
    """Yield the time at which each cloud is recorded, and the number of its scan."""
    delay = _turn_ns(simulation) + DRIVER_DELAY_NS
    for number in range(simulation.num_scans):
        yield simulation.stamp_ns(number) + delay, number
