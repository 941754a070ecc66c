# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The map against the truth: normals of the default simulated street, without noise.

Points are off their plane by the rounding of float32 and of the lattice only, a few micrometres.
That turns the normal of a voxel that holds a few millimetres of a plane by hundredths of a
degree, and nothing else should.
"""

import numpy as np
import pytest

from surfel_mapper import SurfelMap
from surfel_mapper.simulation import Simulation, World

VOXEL_M = 0.5
NUM_SCANS = 12


@pytest.fixture(scope='module')
def mapped():
    """Return the simulation, its surfels of one plane only, and their true surface."""
    simulation = Simulation(World.street(seed=0, length_m=70.0), num_scans=NUM_SCANS)
    surfel_map = SurfelMap(voxel_size_m=VOXEL_M)
    keys, truth = [], []
    for scan in simulation.scans():
        hit = scan.columns['surface'] >= 0
        T = simulation.drive.T_odom_sensor(scan.stamp_ns)
        points = scan.points[hit].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        surfel_map.add(points, T[:3, 3])
        keys.append(key_of(np.floor(points / VOXEL_M)))
        truth.append(scan.columns['surface'][hit])
    key, inverse = np.unique(np.concatenate(keys), return_inverse=True)
    surface = np.concatenate(truth)
    lowest, highest = np.full(len(key), 2**40), np.full(len(key), -1)
    np.minimum.at(lowest, inverse, surface)
    np.maximum.at(highest, inverse, surface)

    surfels = surfel_map.surfels(min_points=5)
    at = np.searchsorted(key, key_of(surfels.voxel_index))
    plane = (lowest == highest) & simulation.world.is_plane(highest)
    chosen = plane[at] & (surfels.planarity > 0.05)
    return simulation, surfels.position[chosen], surfels.normal[chosen], highest[at][chosen]


def key_of(voxel_index):
    i, j, k = (np.asarray(voxel_index).astype(np.int64) + 2**20).T
    return (i << 42) | (j << 21) | k


def test_normals_of_voxels_with_one_plane_are_the_true_ones(mapped):
    simulation, position, normal, surface = mapped
    found, distance_m, true_normal = simulation.world.surface_at(position)

    assert len(position) > 5000
    assert (found == surface).all()
    assert distance_m.max() < 1e-5
    sine = np.linalg.norm(np.cross(normal, true_normal), axis=1)
    error_deg = np.degrees(np.arcsin(np.minimum(sine, 1.0)))
    assert np.percentile(error_deg, 99.9) < 0.01
    assert error_deg.max() < 0.03


def test_normals_point_out_of_surfaces_not_seen_edge_on(mapped):
    simulation, position, normal, _ = mapped
    true_normal = simulation.world.normal_at(position)
    stamps = [simulation.stamp_ns(number) for number in range(NUM_SCANS)]
    places = np.array([simulation.drive.T_odom_sensor(stamp)[:3, 3] for stamp in stamps])
    height_m = np.einsum('nj,snj->sn', true_normal, places[:, None] - position).min(axis=0)

    # A voxel counts as seen from its centre, which may be half a diagonal above the surface.
    from_above = height_m > VOXEL_M * np.sqrt(0.75)
    outward = np.einsum('ij,ij->i', normal, true_normal) > 0.0
    assert outward[from_above].all()
    assert from_above.mean() > 0.5
    assert outward.mean() > 0.999
