# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The ground of a street in a sliding window of whole scans, against the surfaces of the world."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest

from surfel_mapper.config import ModelsLayerConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.models.live import LiveModels
from surfel_mapper.simulation import Lidar, Simulation, World

WINDOW, SCANS, STEP = 10, 15, 3
NOISE_M, VOXEL_M, MIN_POINTS = 0.01, 0.5, 10


@pytest.fixture(scope='module', params=[1, 2])
def street(request):
    """Return models after a drive, and the label of the surface of every voxel."""
    world = World.street(seed=request.param, length_m=200.0)
    lidar = Lidar(beams=64, columns=1024, range_noise_m=NOISE_M)
    simulation = Simulation(world, lidar)
    surfel_map = SurfelMap(VOXEL_M)
    models = LiveModels(ModelsLayerConfig(), surfel_map)
    held = deque()
    for number in range(0, STEP * SCANS, STEP):
        scan = simulation.scan(number)
        points = scan.points[np.isfinite(scan.points).all(axis=1)].astype(np.float64)
        pose = simulation.drive.T_odom_sensor(scan.stamp_ns)
        held.append(surfel_map.add(points @ pose[:3, :3].T + pose[:3, 3], origin=pose[:3, 3]))
        if len(held) > WINDOW:
            surfel_map.remove(held.popleft())
        models.update()
    surface, distance_m, _ = world.surface_at(models.surfels.position)
    names = np.array([primitive.label for primitive in world.primitives])
    label = np.where(distance_m < 0.05, names[world.primitive_of(surface)], '')
    return models, label


def pieces(models, chosen):
    """Return the number of chosen voxels in each patch, descending."""
    owner = models.model.labels[chosen]
    ids = [patch.id for patch in models.model.patches]
    return np.sort(np.unique(owner[np.isin(owner, ids)], return_counts=True)[1])[::-1]


def test_the_ground_is_in_few_pieces(street):
    models, label = street
    ground = label == 'ground'
    used = ground & (models.surfels.num_points >= MIN_POINTS)
    found = pieces(models, used)
    assert len(found) <= 6
    assert found.sum() > 0.95 * used.sum()
    assert found[0] > 0.9 * used.sum()
    everywhere = pieces(models, ground)
    assert everywhere[:6].sum() > 0.96 * ground.sum()
    assert everywhere[0] > 0.95 * ground.sum()


def test_patches_are_of_one_surface(street):
    models, label = street
    # pavements are 13 cm high, little more than the thickness of a flat voxel, 10 cm
    label = np.where(label == 'pavement', 'ground', label)
    known = (label != '') & (models.surfels.num_points >= MIN_POINTS)
    wrong = total = 0
    for patch in models.model.patches:
        mine = label[known & (models.model.labels == patch.id)]
        if len(mine):
            counts = np.unique(mine, return_counts=True)[1]
            wrong, total = wrong + len(mine) - int(counts.max()), total + len(mine)
    assert wrong < 0.003 * total
