# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Live models of labelled Kinect frames of objects on a table, by the measure of `fit`.

Stands alone, as its scenes are real and its figures those of test/bench/tabletop.py.
"""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.config import ModelsLayerConfig
from surfel_mapper.mapping.moments import pack_keys
from test.bench import tabletop
from test.models.live_scenes import of_points


def patch_of_points(models, points):
    """Return the index of the patch of each point, -1 for none, and which patches are planes."""
    patches, held = models.model.patches, np.isfinite(points).all(axis=1)
    voxels = np.floor(points[held].astype(np.float64) / models.map.voxel_size_m).astype(np.int64)
    keys = pack_keys(models.surfels.voxel_index)
    order = np.argsort(keys)
    label = models.model.labels[order[np.searchsorted(keys[order], pack_keys(voxels))]]
    ids = np.array([patch.id for patch in patches])
    found = np.full(len(points), -1)
    by_id = np.argsort(ids)
    place = by_id[np.minimum(np.searchsorted(ids[by_id], label), len(ids) - 1)]
    found[held] = np.where(ids[place] == label, place, -1)
    return found, np.arange(len(patches)) < len(models.model.planes)


@pytest.mark.parametrize(
    ('size_m', 'table', 'free'),
    [(0.01, 0.98, 0.03), (0.015, 0.98, 0.05), (0.02, 0.98, 0.05), (0.03, 0.98, 0.1)],
)
def test_the_table_is_one_plane_and_objects_are_patches(data_folder, size_m, table, free):
    found = []
    for file in sorted((data_folder / 'data' / 'osd').glob('*.pcd')):
        points, labels = tabletop.frame(file)
        cloud = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        _, models = of_points(cloud, np.zeros(3), ModelsLayerConfig(), size_m)
        patch, planes = patch_of_points(models, points)
        found.append(tabletop.figures(points, labels, patch, planes))
    assert all(one['pieces'] == 1 for one in found)
    mean = {key: np.mean([one[key] for one in found]) for key in found[0]}
    assert mean['table'] >= table
    assert mean['free'] <= free
    assert mean['impure'] <= 0.005
