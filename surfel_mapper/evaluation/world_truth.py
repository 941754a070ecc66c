# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The truth about a map of a simulated bag: the surfaces of its world, and what its lidar saw.

A world goes on where no lidar ever looked; complete is a map that has what the drive could see,
so the places to be found are the returns of the same drive without noise.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from surfel_mapper.evaluation.comparison import Nearest
from surfel_mapper.simulation.drive import Simulation
from surfel_mapper.simulation.recording import load_simulation, SIMULATION_FILE, WORLD_FILE
from surfel_mapper.simulation.world import World

Floats = npt.NDArray[np.float64]

SCANS = 20
"""Of a drive so many scans are seen again, evenly picked: most places are seen by many."""


class WorldTruth:
    """
    The surfaces of a world, for comparison.py.

    Parameters
    ----------
    world : World
    simulation : Simulation, optional
        The drive by which the map was made.

    """

    def __init__(self, world: World, simulation: Simulation | None = None) -> None:
        """Take a world."""
        self._world = world
        self._simulation = simulation

    def nearest(self, position: Floats) -> Nearest:
        """Return what is nearest to positions (K, 3), m."""
        _, distance_m, normal = self._world.surface_at(position)
        return Nearest(distance_m, distance_m, normal)

    def samples(self) -> Floats | None:
        """Return what the lidar of the drive saw, without noise; None without a drive."""
        if self._simulation is None:
            return None
        lidar = replace(self._simulation.lidar, range_noise_m=0.0)
        again = replace(self._simulation, lidar=lidar)
        seen = []
        for number in range(0, again.num_scans, -(-again.num_scans // SCANS)):
            scan = again.scan(number)
            pose = again.drive.T_odom_sensor(scan.stamp_ns)
            points = scan.points[scan.columns['surface'] >= 0].astype(np.float64)
            seen.append(points @ pose[:3, :3].T + pose[:3, 3])
        return np.concatenate(seen)


def is_world(path: Path) -> bool:
    """Return whether a path is a world: its file, or the directory of a simulated bag."""
    return (path / WORLD_FILE).is_file() or path.suffix == '.json'


def load_truth(path: Path) -> WorldTruth:
    """
    Return the truth at a path: a world.json, or the directory of a simulated bag.

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
