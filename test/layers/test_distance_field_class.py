# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""DistanceField: fused, queried, meshed, saved and loaded by one class."""

from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper import DistanceField
from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import CloudFormatError
from surfel_mapper.tsdf.queries import FREE, OCCUPIED, UNKNOWN
from surfel_mapper.tsdf.sensors import CameraModel
from test.tsdf.scenes import lidar_rays

CONFIG = TsdfConfig(voxel_size_m=0.1, truncation_m=0.3, color=True, semantics='single')
CAMERA = CameraModel(columns=80, rows=60, fx=70.0, fy=70.0, cx=40.0, cy=30.0)
SPHERE = 2.0 * lidar_rays(64, 360, 60.0).reshape(-1, 3)


def test_field_of_a_sphere_has_its_distances_gradients_colours_and_labels():
    field = DistanceField(CONFIG)
    done = field.add(
        SPHERE,
        np.eye(4),
        colors=np.tile(np.array([10, 20, 30], np.uint8), (len(SPHERE), 1)),
        labels=np.full(len(SPHERE), 3, np.uint8),
    )
    assert done.num_updated == len(field) > 0

    turn = np.linspace(0.0, 2.0 * np.pi, 50)
    ahead = np.stack([np.cos(turn), np.sin(turn), np.zeros(50)], axis=1)
    np.testing.assert_allclose(field.sample(1.95 * ahead), 0.05, atol=0.02)
    np.testing.assert_allclose(field.gradient(2.0 * ahead), -ahead, atol=0.15)
    assert set(field.labels_at(2.0 * ahead)[0]) == {3}
    assert set(field.states(1.5 * ahead)) == {FREE}
    assert set(field.states(2.08 * ahead)) == {OCCUPIED}
    assert set(field.states(9.0 * ahead)) == {UNKNOWN}
    mesh = field.mesh()
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 2.0).max() < 0.05
    assert set(map(tuple, mesh.colors.tolist())) == {(10, 20, 30)}
    assert field.esdf(max_m=3.0).sample([(1.0, 0.0, 0.0)]) == pytest.approx(1.0, abs=0.2)


def test_labels_are_unknown_until_they_are_nine_times_as_likely_as_others():
    field = DistanceField(replace(CONFIG, label_confidence=0.75))
    leads = []
    for label in (3, 3, 4, 4, 4):  # 3:1 each: two ahead are 9:1
        image = np.full((60, 80), label)
        field.add_depth(np.full((60, 80), 1.55), CAMERA, np.eye(4), label=image)
        label, lead = field.labels_at([[0.0, 0.0, 1.55]])
        leads.append((label[0], lead[0]))
        assert set(field.mesh().labels) == {label[0]}
    assert leads == [(-1, 0.0), (3, 2.0), (-1, 0.0), (-1, 0.0), (-1, 0.0)]


def test_labels_beyond_the_largest_are_refused_and_the_field_unchanged():
    field = DistanceField(CONFIG)
    with pytest.raises(CloudFormatError, match=r'labels: .* to 16777216, expected .* to 16777215'):
        field.add(SPHERE, np.eye(4), labels=np.full(len(SPHERE), 1 << 24))
    assert len(field) == 0
    field.add(SPHERE, np.eye(4), labels=np.full(len(SPHERE), (1 << 24) - 1))
    assert set(field.labels_at(SPHERE)[0]) == {(1 << 24) - 1}


def test_depth_image_is_fused_with_its_colours():
    field = DistanceField(CONFIG)
    color = np.full((60, 80, 3), 77, np.uint8)
    field.add_depth(np.full((60, 80), 1.55, np.float32), CAMERA, np.eye(4), color=color)
    mesh = field.mesh()
    assert np.abs(mesh.vertices[:, 2] - 1.55).max() < 1e-3
    assert (mesh.colors == 77).all()


CAMERA = CameraModel(columns=80, rows=60, fx=70.0, fy=70.0, cx=40.0, cy=30.0)


def test_depth_in_other_units_is_scaled():
    field = DistanceField(CONFIG)
    depth = np.full((60, 80), 3100, np.uint16)
    field.add_depth(depth, CAMERA, np.eye(4), scale=0.0005)
    assert np.abs(field.mesh().vertices[:, 2] - 1.55).max() < 1e-3
    with pytest.raises(CloudFormatError, match='scale: 0'):
        field.add_depth(depth, CAMERA, np.eye(4), scale=0.0)


def test_a_depth_that_means_unknown_frees_nothing():
    field = DistanceField(CONFIG)
    depth = np.full((60, 80), 9.0, np.float32)
    field.add_depth(depth, CAMERA, np.eye(4), unknown=9.0)
    field.add_depth(np.full((60, 80), 65535, np.uint16), CAMERA, np.eye(4))
    assert len(field) == 0
    field.add_depth(depth, CAMERA, np.eye(4))
    assert set(field.states([(0.0, 0.0, 2.0)])) == {FREE}


def test_masked_pixels_free_space_and_leave_no_surface():
    field = DistanceField(CONFIG)
    depth = np.full((60, 80), 1.55, np.float32)
    field.add_depth(depth, CAMERA, np.eye(4), mask=np.ones((60, 80), bool))
    assert len(field.mesh()) == 0
    assert set(field.states([(0.0, 0.0, 1.0)])) == {FREE}


def test_without_allocation_only_blocks_of_the_field_are_updated():
    field = DistanceField(CONFIG)
    depth = np.full((60, 80), 1.55, np.float32)
    assert field.add_depth(depth, CAMERA, np.eye(4), allocate_blocks=False).num_updated == 0
    field.add_depth(depth, CAMERA, np.eye(4))
    count, version = len(field), field.blocks.version
    field.add_depth(depth + 1.0, CAMERA, np.eye(4), allocate_blocks=False)
    assert len(field) == count
    assert field.blocks.version > version
