# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Scans of drives that return to where they were, with true poses and drifting odometry."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from surfel_mapper.geometry import pose_matrix, q_xyzw, se3_exp
from surfel_mapper.simulation import Lidar, Simulation
from test.simulation.circuit import circuit_world, CircuitDrive

STEP_M = 1.5

SAME_WAY = ((0.0, 0.0), (70.0, 0.0), (70.0, 50.0), (0.0, 50.0), (0.0, 0.0), (65.0, 0.0))
"""Around a block, and further along the first street."""

THERE_AND_BACK = (
    *((0.0, 0.0), (60.0, 0.0), (110.0, 0.0)),
    *((110.0, 50.0), (60.0, 50.0), (60.0, 0.0), (0.0, 0.0)),
)
"""Around a block, and back along the first street in the opposite direction."""


@dataclass(frozen=True)
class Circuit:
    """Scans by number, and their true poses (S, 4, 4)."""

    scans: tuple[np.ndarray, ...]
    poses: np.ndarray

    def __len__(self):
        """Return the number of scans."""
        return len(self.scans)

    def points(self, number):
        """Return the points of a scan, (N, 3) float32."""
        return self.scans[number]

    def narrowed(self, half_deg):
        """Return the circuit as seen by a sensor with a narrow field of view."""
        scans = tuple(
            np.asfortranarray(p[np.abs(np.degrees(np.arctan2(p[:, 1], p[:, 0]))) < half_deg])
            for p in self.scans
        )
        return Circuit(scans, self.poses)


@cache
def circuit(corners) -> Circuit:
    """Return the scans of a lidar of few beams on a drive along corners, STEP_M apart."""
    lidar = Lidar(beams=24, columns=400, range_noise_m=0.02)
    # the corners of the second pass are on streets of the first
    world = circuit_world(corners[:-1], seed=3)
    drive = CircuitDrive(start=world.start, speed_m_s=10.0 * STEP_M, corners=corners)
    length_m = sum(np.hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(corners))
    simulation = Simulation(world, lidar, drive, num_scans=int(length_m / STEP_M) - 10)
    found = [scan.points[np.isfinite(scan.points).all(axis=1)] for scan in simulation.scans()]
    stamps = [simulation.stamp_ns(number) for number in range(simulation.num_scans)]
    poses = np.array([drive.T_odom_sensor(stamp_ns) for stamp_ns in stamps])
    return Circuit(tuple(map(np.asfortranarray, found)), poses)


def drifted(poses, turn_deg_m=0.03, share=0.005, climb=0.002):
    """Return poses with drift: of the heading, along the way and upwards."""
    rng = np.random.default_rng(4)
    result = [poses[0]]
    for before, after in pairwise(poses):
        step = np.linalg.inv(before) @ after
        length_m = np.linalg.norm(step[:3, 3])
        bias = [
            share * length_m,
            0.0,
            climb * length_m,
            0.0,
            0.0,
            np.radians(turn_deg_m * length_m),
        ]
        noise = [*rng.normal(0.0, 0.005, 3), *np.radians(rng.normal(0.0, 0.01, 3))]
        moved = result[-1] @ step @ se3_exp(np.array(bias) + noise)
        result.append(pose_matrix(moved[:3, 3], q_xyzw(moved)))
    return np.array(result)


def distances(found, expected):
    """Return the distances between poses, (S,) m."""
    return np.linalg.norm(found[:, :3, 3] - expected[:, :3, 3], axis=1)


def gap(poses, true, first, last):
    """Return the error of the pose of the last scan in the frame of the first, m."""
    found, expected = (np.linalg.inv(p[first]) @ p[last] for p in (poses, true))
    return float(np.linalg.norm(found[:3, 3] - expected[:3, 3]))
