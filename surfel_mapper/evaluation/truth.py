# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Truth for comparisons: surfaces and poses of a simulated bag, poses of a file.

A simulated world extends beyond the reach of its lidar, so completeness is measured against the
points that the drive could see: the returns of the same drive without noise.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FileFormatError
from surfel_mapper.evaluation.comparison import Nearest
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.simulation.drive import Simulation
from surfel_mapper.simulation.recording import load_simulation, SIMULATION_FILE, WORLD_FILE
from surfel_mapper.simulation.world import World

Floats = npt.NDArray[np.float64]

SCANS = 20
"""Scans of a drive that are cast again, evenly spread: most places are seen by several."""

ON_SURFACE_M = 1e-6
"""A place is on a surface if it is nearer than this, m."""


class WorldTruth:
    """
    Surfaces of a simulated world as truth, for comparison.py.

    Parameters
    ----------
    world : World
    simulation : Simulation, optional
        The drive by which the map was made.

    """

    def __init__(self, world: World, simulation: Simulation | None = None) -> None:
        self._world = world
        self._simulation = simulation

    def nearest(self, position: Floats) -> Nearest:
        """Return the points of surfaces nearest to positions (K, 3), m."""
        _, distance_m, normal = self._world.surface_at(position)
        outside, inside = (position - side * distance_m[:, None] * normal for side in (1.0, -1.0))
        nearer = self._world.surface_at(outside)[1] <= self._world.surface_at(inside)[1]
        point = np.where(nearer[:, None], outside, inside)
        point[self._world.surface_at(point)[1] > ON_SURFACE_M] = np.nan  # nearest to an edge
        return Nearest(distance_m, distance_m, normal, point)

    def samples(self) -> Floats | None:
        """Return the points (N, 3), m, that the drive sees without noise; None without a drive."""
        if self._simulation is None:
            return None
        lidar = replace(self._simulation.lidar, range_noise_m=0.0)
        noise_free = replace(self._simulation, lidar=lidar)
        sampled = []
        for number in range(0, noise_free.num_scans, -(-noise_free.num_scans // SCANS)):
            scan = noise_free.scan(number)
            pose = noise_free.drive.T_odom_sensor(scan.stamp_ns)
            points = scan.points[scan.columns['surface'] >= 0].astype(np.float64)
            sampled.append(points @ pose[:3, :3].T + pose[:3, 3])
        return np.concatenate(sampled)


def is_world(path: Path) -> bool:
    """Return whether a path is a world: its file, or the directory of a simulated bag."""
    return (path / WORLD_FILE).is_file() or path.suffix == '.json'


def load_truth(path: Path) -> WorldTruth:
    """
    Return the surfaces at a path: a world.json, or the directory of a simulated bag.

    Raises
    ------
    FileFormatError
        If the files cannot be read.

    """
    directory = path if path.is_dir() else path.parent
    if (directory / SIMULATION_FILE).is_file() and path.name in (WORLD_FILE, directory.name):
        simulation = load_simulation(directory)
        return WorldTruth(simulation.world, simulation)
    return WorldTruth(World.load(path / WORLD_FILE if path.is_dir() else path))


def read_poses(path: Path, *, by_number: bool = False) -> tuple[npt.NDArray[np.int64], Floats]:
    """
    Return stamps (S,), ns, and poses (S, 4, 4) of a trajectory in a file.

    Poses without times may have their numbers as seconds instead.

    Raises
    ------
    FileFormatError
        If it cannot be read, or its poses have no times.

    """
    trajectory = read_trajectory(path)
    stamps_ns = trajectory.stamp_ns
    if stamps_ns is None and by_number:
        rows = np.arange(len(trajectory), dtype=np.int64)
        stamps_ns = 10**9 * (rows if trajectory.number is None else trajectory.number)
    if stamps_ns is None:
        raise FileFormatError(f'{path}: poses without times, expected a times.txt beside it')
    return stamps_ns, trajectory.matrices


def true_poses(
    path: Path, stamps_ns: npt.NDArray[np.int64], *, by_number: bool = False
) -> tuple[npt.NDArray[np.int64], Floats]:
    """
    Return true stamps and poses: of a file, or of the lidar of a simulated bag at given stamps.

    Parameters
    ----------
    path : Path
        A trajectory, or the directory of a simulated bag.
    stamps_ns : (S,) int64
        Stamps at which the poses of a simulated bag are wanted.
    by_number : bool
        Whether poses without times have their numbers as seconds.

    Returns
    -------
    (T,) int64, (T, 4, 4) float64
        Stamps, and the poses of the sensor in the fixed frame.

    Raises
    ------
    FileFormatError
        If there are no true poses at the path.

    """
    if not path.is_dir():
        return read_poses(path, by_number=by_number)
    if not (path / SIMULATION_FILE).exists():
        raise FileFormatError(
            f'{path}: not a simulated bag, which has a {SIMULATION_FILE}; '
            'expected one, or a trajectory (TUM, KITTI, CSV, g2o)'
        )
    drive = load_simulation(path).drive
    poses = [drive.T_odom_sensor(int(stamp_ns)) for stamp_ns in stamps_ns]
    return stamps_ns, np.array(poses).reshape(-1, 4, 4)
