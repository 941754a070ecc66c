# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Gestalt: which places become keypoints, and that their relief does not depend on the side."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.filters.gestalt import describe, relief
from test.filters.examples import filter_of, scan_of

NAME = 'GestaltDataPointsFilter'


def steps(seed=1):
    """Return a floor and a wall with a ledge, as no plane describes them."""
    rng = np.random.default_rng(seed)
    floor = rng.uniform([4, -4, 0], [8, 4, 0], (800, 3))
    wall = rng.uniform([8, -4, 0], [8, 4, 3], (2500, 3))
    ledge = rng.uniform([7, 0, 2], [8, 4, 2], (300, 3))
    return np.concatenate([floor, wall, ledge])


def turned(points, angle):
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


EVERY = {'ratio': 0.9999999, 'radius': 2.0}


def test_keypoints_are_points_of_the_scan_at_most_one_a_voxel():
    scan = scan_of(steps(), row=range(3600))
    found = filter_of(NAME, **EVERY).apply(scan)
    rows = found.columns['row']
    assert 20 < len(found) < 100
    assert (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(found.points, scan.points[rows])
    voxels = np.floor(found.points - scan.points.min(axis=0))
    assert len(np.unique(voxels, axis=0)) == len(found)


def test_on_a_plane_or_a_floor_there_are_no_keypoints():
    rng = np.random.default_rng(2)
    wall = rng.uniform([5, -4, 0], [5, 4, 4], (2000, 3))
    floor = rng.uniform([-4, -4, -0.4], [4, 4, 0.4], (2000, 3))
    for points in (wall, floor):
        found = filter_of(NAME, **{**EVERY, 'radius': 1.5}).apply(scan_of(points))
        inside = (np.abs(found.points[:, 1]) < 2.0) & (np.abs(found.points[:, 0]) < 2.0)
        assert not inside.any()


def test_the_description_is_the_same_from_every_side():
    points = steps()
    place = np.array([8.0, 0.5, 1.5])
    near = points[np.linalg.norm(points - place, axis=1) < 2.0]
    one = describe(place, near, 2.0)
    for angle in (0.4, 2.0, 4.5):
        other = describe(turned(place, angle), turned(near, angle), 2.0)
        for name in ('gestaltMeans', 'gestaltVariances', 'warpedXYZ', 'gestaltShapes'):
            np.testing.assert_allclose(other[name], one[name], atol=1e-9)
        np.testing.assert_allclose(other['normal'], turned(one['normal'], angle), atol=1e-9)
    assert one['normal'][0] < -0.9  # the wall looks to the sensor at the origin


def test_relief_holds_mean_and_variance_of_heights_by_ring_and_sector():
    #          ring 0, sector 0    the same    ring 2, sector 2    beyond the last ring
    points = [[0.5, 0.1, 1.0], [0.6, 0.1, 3.0], [0.1, 2.5, 5.0], [-9.0, -0.1, 7.0]]
    means, variances = relief(np.array(points), 4.0)
    expected = np.zeros((4, 8))
    expected[:, 0] = 2.0  # rings without points take over from the next one inwards
    expected[2:, 1] = 5.0
    expected[3, 4] = 7.0
    np.testing.assert_array_equal(means, expected)
    expected[:] = 0.0
    expected[:, 0] = 1.0
    np.testing.assert_array_equal(variances, expected)


def test_features_are_rows_of_32():
    found = filter_of(NAME, **EVERY).apply(scan_of(steps())).columns
    assert {name: column.shape[1] for name, column in found.items()} == {
        'normals': 3,
        'gestaltMeans': 32,
        'gestaltVariances': 32,
        'warpedXYZ': 3,
        'gestaltShapes': 2,
    }
    planarity, cylindricality = found['gestaltShapes'].T
    assert planarity.max() <= 0.9
    assert cylindricality.min() >= 0.0


@pytest.mark.parametrize(
    ('settings', 'some'),
    [
        ({'maxTimeWindow': 10}, False),
        ({'maxTimeWindow': 9999}, True),
        ({'maxBoxDim': 0.5}, False),
        ({'maxBoxDim': 4.0}, True),
        ({'knn': 3000}, False),
    ],
)
def test_keypoints_whose_neighbours_are_too_few_or_spread_are_dropped(settings, some):
    scan = scan_of(steps(), t=np.arange(3600))
    assert bool(len(filter_of(NAME, **EVERY, **settings).apply(scan))) is some
