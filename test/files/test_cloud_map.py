# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Plain clouds as maps: dense, thinned, of surfels, far from their origin, and refused ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.cloud_map import is_cloud, read_cloud_map
from surfel_mapper.mapping.surfel_map import SurfelMap

SIZE_M = 0.5


def plane(spacing_m, normal=(0.6, 0.0, 0.8)):
    """Return points of a square of 10 m through the origin, and their normal."""
    normal = np.array(normal)
    u, v = np.array([0.8, 0.0, -0.6]), np.array([0.0, 1.0, 0.0])
    a, b = np.meshgrid(*[np.arange(-5.0, 5.0, spacing_m)] * 2)
    return (a.reshape(-1, 1) * u + b.reshape(-1, 1) * v), np.tile(normal, (a.size, 1))


def written(path, points, normals=None, names=('nx', 'ny', 'nz'), dtype=np.float64):
    columns = dict(zip('xyz', np.asarray(points, dtype).T, strict=True))
    if normals is not None:
        columns |= dict(zip(names, normals.astype(np.float32).T, strict=True))
    (pcd if path.suffix == '.pcd' else ply).write_points(path, columns)
    return path


@pytest.mark.parametrize('name', ['hall.ply', 'hall.pcd', 'HALL.PLY'])
def test_a_dense_cloud_is_the_map_of_its_points(tmp_path, name):
    points, normals = plane(0.05)
    path = written(tmp_path / name, points, normals)
    expected = SurfelMap(SIZE_M)
    expected.add(points)

    assert read_cloud_map(path, SIZE_M).digest() == expected.digest()


def test_points_that_are_not_finite_are_left_out(tmp_path):
    points, _ = plane(0.05)
    expected = SurfelMap(SIZE_M)
    expected.add(points)
    bad = np.concatenate([points, np.full((3, 3), np.nan), np.full((2, 3), np.inf)])

    assert read_cloud_map(written(tmp_path / 'a.ply', bad), SIZE_M).digest() == expected.digest()


@pytest.mark.parametrize('names', [('nx', 'ny', 'nz'), ('normal_x', 'normal_y', 'normal_z')])
def test_a_thin_cloud_with_normals_has_their_surfels(tmp_path, names):
    points, normals = plane(0.6)
    path = written(tmp_path / 'thin.ply', points, 3.0 * normals, names)

    surfels = read_cloud_map(path, SIZE_M).surfels(min_points=5)

    assert len(surfels) > 0.5 * len(points)
    across_m = surfels.position @ normals[0]
    np.testing.assert_allclose(across_m, 0.0, atol=1e-4)
    np.testing.assert_allclose(np.abs(surfels.normal @ normals[0]), 1.0, atol=1e-3)


def test_surfels_of_a_map_are_a_map_of_equal_normals(tmp_path):
    points, normals = plane(0.05)
    surfel_map = SurfelMap(SIZE_M)
    surfel_map.add(points)
    ply.write_surfels(tmp_path / 'map.ply', surfel_map.surfels(min_points=5))

    surfels = read_cloud_map(tmp_path / 'map.ply', SIZE_M).surfels(min_points=5)

    inner = np.abs(surfels.position).max(axis=1) < 3.5  # beyond, voxels hold a line of points
    assert inner.sum() > 200
    np.testing.assert_allclose(np.abs(surfels.normal[inner] @ normals[0]), 1.0, atol=1e-3)


def test_a_cloud_in_utm_has_an_origin_of_its_own(tmp_path):
    points, _ = plane(0.05)
    far = np.array([400123.25, 5400321.5, 100.0])
    path = written(tmp_path / 'utm.ply', points + far)

    surfel_map = read_cloud_map(path, SIZE_M)

    assert surfel_map.origin_m.tolist() == [400000.0, 5400000.0, 0.0]
    surfels = surfel_map.surfels(min_points=5)
    middle = surfels.position.mean(axis=0) + surfel_map.origin_m
    np.testing.assert_allclose(middle, far, atol=0.3)


@pytest.mark.parametrize(
    ('points', 'words'),
    [
        (np.full((5, 3), np.nan), r'no finite points among 5; expected a cloud'),
        (1000.0 * plane(0.1)[0], r'0% are in voxels of 5 or more, .*in millimetres'),
        (plane(0.6)[0], r'0% are in voxels of 5 or more, .*larger voxels \(map\.voxel_size_m\)'),
        (np.zeros((0, 3)), r'a\.ply: no finite points among 0'),
    ],
)
def test_clouds_of_which_no_map_can_be_made_are_refused(tmp_path, points, words):
    path = written(tmp_path / 'a.ply', points)

    with pytest.raises(FileFormatError, match=words):
        read_cloud_map(path, SIZE_M)


@pytest.mark.parametrize(
    ('name', 'expected'),
    [('a.ply', True), ('a.LAZ', True), ('a.npz', False), ('a.parquet', False), ('a', False)],
)
def test_clouds_are_told_by_their_endings(name, expected):
    assert is_cloud(Path(name)) is expected
