# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Scans of the simulated street, drifting odometry, and errors of relative poses."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import se3_exp, se3_log
from surfel_mapper.scan import Scan
from surfel_mapper.simulation import Lidar, Simulation, World

Floats = npt.NDArray[np.float64]


@cache
def street_scans(
    num_scans: int, step: int = 1, range_noise_m: float = 0.02
) -> tuple[list[Scan], Floats]:
    """Return scans of the street, 0.5 m times step apart, and their true poses (S, 4, 4)."""
    lidar = Lidar(columns=1024, range_noise_m=range_noise_m)
    world = World.street(seed=1, length_m=60.0)
    simulation = Simulation(world, lidar, num_scans=num_scans * step)
    scans = [simulation.scan(number) for number in range(0, num_scans * step, step)]
    poses = np.array([simulation.drive.T_odom_sensor(scan.stamp_ns) for scan in scans])
    return scans, poses


def drifted(poses: Floats, share: float = 0.01, deg_m: float = 0.05) -> Floats:
    """Return poses with odometry drift: a scale error and a constant turn rate."""
    result = [poses[0]]
    for before, after in pairwise(poses):
        step = np.linalg.inv(before) @ after
        length = np.linalg.norm(step[:3, 3])
        error = np.array([*(share * step[:3, 3]), 0.0, 0.0, np.deg2rad(deg_m) * length])
        result.append(result[-1] @ step @ se3_exp(error))
    return np.array(result)


def relative_errors(poses: Floats, true: Floats, apart: int) -> tuple[float, float]:
    """Return mean errors, m and rad, of the poses relative to the scan ``step`` before."""
    errors = []
    for first in range(len(true) - apart):
        last = first + apart
        found = np.linalg.inv(poses[first]) @ poses[last]
        expected = np.linalg.inv(true[first]) @ true[last]
        errors.append(se3_log(np.linalg.inv(expected) @ found))
    lengths = np.linalg.norm(np.reshape(errors, (-1, 2, 3)), axis=2)
    distance_m, angle_rad = lengths.mean(axis=0).tolist()
    return distance_m, angle_rad
