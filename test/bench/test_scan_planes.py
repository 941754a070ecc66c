# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures of planes in scans, on points whose residual is known; real scans are covered."""

from __future__ import annotations

import numpy as np
import pytest

from test.bench.scan_planes import figures, ours, real_scans


def test_coverage_and_residual_of_known_patches():
    x, y = (part.ravel() for part in np.meshgrid(np.arange(10.0), np.arange(10.0)))
    height = np.where((x + y) % 2 == 0, 0.02, -0.02)
    floor = np.column_stack([x, y, height])
    points = np.concatenate([floor, floor[:, [0, 2, 1]] + [0.0, 50.0, 0.0], 100.0 + floor])
    patch = np.repeat([0, 1, -1], 100)
    found = figures(points, patch)
    assert found['covered'] == pytest.approx(2 / 3)
    assert found['residual_mm'] == pytest.approx(20.0, rel=1e-6)
    assert found['patches'] == 2


@pytest.mark.parametrize(
    ('name', 'size_m', 'covered', 'residual_mm'),
    [
        ('hesai_at128_lab', 0.2, 0.95, 60.0),  # Open3D: 0.70, 145 mm
        ('ouster_os0_128', 0.3, 0.8, 100.0),  # 0.57, 131 mm
        ('velodyne_vlp16_lab', 0.3, 0.95, 60.0),  # 0.79, 159 mm
        ('pcl_room_scan1', 0.5, 0.95, 39.0),  # 0.46, 39 mm
        ('pjlab_64beam_street_ring_timestamp', 0.5, 0.95, 150.0),  # 0.96, 278 mm
    ],
)
def test_most_points_of_a_real_scan_are_in_patches(
    data_folder, monkeypatch, name, size_m, covered, residual_mm
):
    monkeypatch.setenv('SURFEL_MAPPER_TEST_DATA', str(data_folder))
    (points,) = (points for found, points in real_scans() if found == name)
    row = ours(points, size_m)
    assert row['covered'] > covered
    assert row['residual_mm'] < residual_mm
