# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Scenes of live models, and their voxels by primitive, for comparison regardless of ids."""

from __future__ import annotations

import numpy as np

from surfel_mapper.config import ModelsLayerConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.models.live import LiveModels

VOXEL_M = 0.12
SETTINGS = ModelsLayerConfig(min_points=4, noise_m=0.005)


def live(surfel_map, settings=SETTINGS):
    """Return models that have read a map once (a batch)."""
    models = LiveModels(settings, surfel_map)
    models.update()
    return models


def of_points(points, origin=(0.0, 0.0, 5.0), settings=SETTINGS, voxel_size_m=VOXEL_M):
    """Return a map of points, and its models."""
    surfel_map = SurfelMap(voxel_size_m)
    surfel_map.add(points, origin=origin)
    return surfel_map, live(surfel_map, settings)


def groups(models):
    """Return the voxels of each primitive, by kind: a set of (kind, voxels)."""
    model = models.model
    kind = {patch.id: 'patch' for patch in model.patches}
    kind.update({int(number): 'gaussian' for number in model.gaussians.id})
    members = {}
    voxels = models.surfels.voxel_index.tolist()
    for voxel, label in zip(voxels, model.labels.tolist(), strict=True):
        members.setdefault(label, set()).add(tuple(voxel))
    return {(kind.get(label, 'none'), frozenset(voxels)) for label, voxels in members.items()}


def ids(models):
    """Return the ids of all primitives."""
    return {patch.id for patch in models.model.patches} | set(models.model.gaussians.id.tolist())


def id_at(models, place):
    """Return the id of the primitive at a location; -1 for none."""
    voxel = np.floor(np.array(place) / models.map.voxel_size_m)
    found = np.flatnonzero((models.surfels.voxel_index == voxel).all(axis=1))
    return int(models.model.labels[found[0]]) if len(found) else -1
