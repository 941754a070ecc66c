# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The share of the map that a scan sees through."""

import numpy as np
import pytest

from surfel_mapper.alignment.scan_view import ScanView
from surfel_mapper.geometry import pose_matrix

POSE = pose_matrix((4.0, -2.0, 1.0), (0.0, 0.0, 0.6, 0.8))


def sphere(radius_m, num=40000):
    """Return points on a sphere about the sensor, evenly spread (a Fibonacci lattice)."""
    number = np.arange(num) + 0.5
    z = 1.0 - 2.0 * number / num
    angle = np.pi * (1.0 + 5.0**0.5) * number
    across = np.sqrt(1.0 - z**2)
    return radius_m * np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def share(cells, surfaces):
    """Return the share of surfaces, in the frame of the sensor, that are seen through."""
    moved = surfaces @ POSE[:3, :3].T + POSE[:3, 3]
    return ScanView(cells).seen_through(moved, POSE, 0.5)


@pytest.mark.parametrize(
    ('radius_m', 'expected'),
    [
        (9.4, 0.0),  # the same surface within 0.5 m and 5 % of the range
        (8.0, 1.0),
        (3.0, 1.0),
        (0.9, 0.0),  # too near: the robot itself
        (12.0, 0.0),  # behind the surface that the scan sees
    ],
)
def test_surfaces_in_front_of_a_scan_are_seen_through(radius_m, expected):
    assert share(sphere(10.0), sphere(radius_m, 3000)) == expected


def test_surfaces_behind_the_scan_do_not_count():
    surfaces = np.concatenate([sphere(5.0, 1000), sphere(10.0, 1000), sphere(20.0, 5000)])
    assert share(sphere(10.0), surfaces) == pytest.approx(0.5)


def test_directions_without_a_return_say_nothing():
    scan = sphere(10.0)
    ahead = scan[scan[:, 0] > 0.0]
    surfaces = sphere(5.0, 3000)
    assert share(ahead, surfaces[surfaces[:, 0] < -0.5]) == 0.0
    assert share(ahead, surfaces) == 1.0


def test_nothing_is_seen_through_without_a_map_or_a_scan():
    assert share(sphere(10.0), np.empty((0, 3))) == 0.0
    assert share(np.empty((0, 3)), sphere(5.0)) == 0.0
