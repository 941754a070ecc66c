# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The map in plain numpy holds the same integers and surfels as SurfelMap."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from surfel_mapper.geometry import pose_matrix
from surfel_mapper.mapping.moments import ScanMoments
from surfel_mapper.mapping.surfel_map import SurfelMap
from test.bench.numpy_map import COUNT, NumpyMap, PRODUCT, SUM, VIEW

SIZE_M, WINDOW = 0.5, 3


def pose(number):
    """Return the position of the sensor at a scan; it moves, so voxels come and go."""
    return pose_matrix((1.7 * number, -0.4 * number, 0.2), (0.1, 0.2, 0.3, np.sqrt(0.86)))


def scan(number):
    """Return points about the sensor, some of them nan or inf."""
    rng = np.random.default_rng(number)
    points = rng.normal(0.0, 1.5, (2000, 3)).astype(np.float32)
    points[rng.random(2000) < 0.1] = np.nan
    points[0, 1] = np.inf
    return points


@pytest.fixture(scope='module')
def maps():
    """Return the numpy map, the SurfelMap, and the changes of both after ten scans."""
    numpy_map, surfel_map = NumpyMap(SIZE_M, WINDOW), SurfelMap(SIZE_M)
    scans: list[ScanMoments] = []
    for number in range(10):
        T_map_sensor = pose(number)
        found = numpy_map.step(list(scan(number).T), T_map_sensor)
        version = surfel_map.version
        scans.append(surfel_map.reduce(scan(number), T_map_sensor, origin=T_map_sensor[:3, 3]))
        surfel_map.insert(scans[-1])
        if len(scans) > WINDOW:
            surfel_map.remove(scans.pop(0))
        changed = surfel_map.surfels_changed(version)
    return numpy_map, surfel_map, found, changed


def test_its_integers_equal_ours(maps):
    numpy_map, surfel_map, _, _ = maps
    expected = surfel_map.moments()
    key, moments = numpy_map.state()
    np.testing.assert_array_equal(key, expected.key)
    np.testing.assert_array_equal(moments[:, COUNT].ravel(), expected.count)
    np.testing.assert_array_equal(moments[:, SUM], expected.total)
    np.testing.assert_array_equal(moments[:, PRODUCT], expected.product)
    np.testing.assert_array_equal(moments[:, VIEW], expected.view)


def test_its_surfels_of_the_changed_voxels_are_ours(maps):
    _, _, found, changed = maps
    ours = changed.select(np.lexsort(changed.voxel_index.T))
    order = np.lexsort(found.voxel_index.T)
    theirs = {f.name: getattr(found, f.name)[order] for f in dataclasses.fields(found)}

    np.testing.assert_array_equal(theirs['voxel_index'], ours.voxel_index)
    np.testing.assert_array_equal(theirs['num_points'], ours.num_points)
    np.testing.assert_allclose(theirs['position'], ours.position, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(theirs['eigenvalues'], ours.eigenvalues, rtol=0.0, atol=1e-12)
    clear = (ours.num_points >= 4) & (ours.planarity > 0.1)
    assert clear.sum() > 100
    cosine = np.einsum('ij,ij->i', theirs['normal'], ours.normal)[clear]
    np.testing.assert_allclose(cosine, 1.0, rtol=0.0, atol=1e-9)
    for name in ('planarity', 'curvature'):
        np.testing.assert_allclose(theirs[name][clear], getattr(ours, name)[clear], atol=1e-9)
