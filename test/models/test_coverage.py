# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Dense patches cover cells of one voxel that have points; sparse ones keep wide cells."""

from __future__ import annotations

import numpy as np
from PIL import Image
import pytest

from surfel_mapper.config import ModelsConfig
from surfel_mapper.models import fit
from surfel_mapper.models.kernels.coverage import count_points, cover_cells
from test.models.scenes import sheet

SIZE_M = 0.04
CONFIG = ModelsConfig(voxel_size_m=SIZE_M, noise_m=0.002)
VIEW = (0.0, 0.0, 2.0)


def covering(points, config=CONFIG, view=VIEW):
    """Return the only plane of a cloud."""
    (plane,) = fit(np.asarray(points, np.float32), config, view).planes
    return plane


def test_counts_and_weights_are_those_of_a_loop_over_points():
    rng = np.random.default_rng(0)
    points, numbers = rng.uniform(-1.0, 1.0, (500, 3)), rng.integers(1, 28, 500)
    label = rng.integers(-1, 3, 500).astype(np.int32)
    frames = np.array([[*np.roll(np.eye(3), k, axis=0), [0.1, 0.0, -0.2]] for k in range(2)])
    view, pitch = np.array([0.0, 0.5, 3.0]), 0.25
    corners, sizes = np.array([[-1.25, -1.0], [-0.5, -1.25]]), np.array([[9, 9], [5, 10]])
    first = np.array([0, 81])
    counts, weights = np.zeros(131, np.int64), np.zeros(131)
    grids = first, corners, sizes
    count_points(points, label, frames, view, grids, pitch, counts, weights, numbers)

    expected, sums = np.zeros(131, np.int64), np.zeros(131)
    for point, k, number in zip(points, label, numbers, strict=True):
        if k in (0, 1):
            local = frames[k, :2] @ (point - frames[k, 3])
            x, y = np.floor((local - corners[k]) / pitch).astype(int)
            if 0 <= x < sizes[k, 0] and 0 <= y < sizes[k, 1]:
                expected[first[k] + x * sizes[k, 1] + y] += number
                sums[first[k] + x * sizes[k, 1] + y] += number * np.linalg.norm(point - view) ** 3
    assert (counts == expected).all()
    assert counts.sum() < numbers[np.isin(label, (0, 1))].sum()  # some lie beyond the grids
    np.testing.assert_allclose(weights, sums)


def test_cells_are_covered_by_their_points_or_by_their_neighbours():
    rng = np.random.default_rng(1)
    counts, near = rng.integers(0, 12, (9, 12)), rng.uniform(0.5, 1.5, (9, 12))
    counts[3:5, 4:9] = 0
    weights, held = counts * near, np.ones((4, 5), np.bool_)
    held[0, 1] = held[3, 3] = False
    inner = held.copy()
    inner[[0, -1]] = inner[:, [0, -1]] = inner[1, 1] = inner[2, 3] = False
    grids = np.array([0]), np.array([[0.0, 0.0]]), np.array([[9, 12]])
    coarse = np.array([0.2]), np.array([[0.1, 0.1]]), np.array([0]), np.array([[4, 5]]), held
    filled, gaps = np.zeros(108, np.uint8), np.empty(1)
    cover_cells(
        *(counts.ravel(), weights.ravel(), grids, 0.1),
        *((*coarse[:4], held.ravel()), (6.0, 0.25, 5), filled, gaps),
    )

    counts[[0, -1]] = counts[:, [0, -1]] = 0
    usual = (weights * counts).sum() / counts.sum()
    by_points = (counts > 0) & (weights >= 0.25 * usual)
    expected, num_inner, num_empty = by_points.copy(), 0, 0
    for i, j in np.ndindex(7, 10):
        around = by_points[i : i + 3, j : j + 3].sum() - by_points[i + 1, j + 1]
        expected[i + 1, j + 1] |= around >= 5
        row, column = i // 2, j // 2  # grids differ by one cell of 0.1
        if row < 4 and inner[row, column]:
            num_inner += 1
            num_empty += not expected[i + 1, j + 1]
    assert ((filled.reshape(9, 12) > 0) == expected).all()
    assert (expected & ~by_points).any()
    assert num_empty > 0
    assert gaps[0] == num_empty / num_inner


def test_a_dense_plane_covers_its_points_and_not_its_hole():
    points = sheet(2.0, 2.0, 0.005, sigma=0.001)
    in_hole = (np.abs(points[:, :2] - [0.3, 0.2]) < [0.2, 0.3]).all(axis=1)
    plane = covering(points[~in_hole])
    assert plane.grid.pitch_m == SIZE_M
    samples = plane.samples(0.01)
    assert (
        not (np.abs(samples[:, :2] - [0.3, 0.2]) < np.subtract([0.2, 0.3], 2 * SIZE_M))
        .all(1)
        .any()
    )
    assert np.abs(samples[:, :2]).max() < 1.0 + SIZE_M
    boundary_m = 4 * 2.0 + 2 * (0.4 + 0.6)
    area_m2 = 4.0 - 0.4 * 0.6
    assert plane.grid.area_m2(4) == pytest.approx(area_m2, abs=0.5 * SIZE_M * boundary_m)


def test_boundary_cells_are_those_with_an_empty_neighbour():
    rng = np.random.default_rng(0)
    points = sheet(1.0, 1.0, 0.004)
    points = points[np.linalg.norm(points[:, :2] - rng.uniform(-0.2, 0.2, 2), axis=1) > 0.15]
    for plane in fit(points.astype(np.float32), CONFIG, VIEW).planes:
        filled = {tuple(cell) for cell in np.argwhere(plane.grid.filled).tolist()}
        steps = ((1, 0), (-1, 0), (0, 1), (0, -1))
        rim = {(x, y) for x, y in filled if any((x + i, y + j) not in filled for i, j in steps)}
        assert {tuple(cell) for cell in np.argwhere(plane.grid.rim).tolist()} == rim
        assert len(rim) > 50


def test_few_points_beyond_the_boundary_cover_nothing():
    points = sheet(2.0, 2.0, 0.005, sigma=0.001)
    strays = np.random.default_rng(0).uniform([1.03, -1.0, 0.0], [1.1, 1.0, 0.0], (40, 3))
    plane = covering(np.concatenate([points, strays]))
    assert plane.samples(0.01)[:, 0].max() < 1.0 + SIZE_M


def test_a_floor_is_covered_as_far_as_it_is_seen():
    """A camera 1.2 m above a floor has 30 times as many points at 1 m as at 4 m."""
    u, v = np.meshgrid(np.arange(640) - 320.0, np.arange(480) - 100.0)
    rays = np.stack([u / 525.0, v / 525.0, np.ones_like(u)], axis=-1).reshape(-1, 3)
    rays = rays[rays[:, 1] > 1.2 / 4.0]
    floor = rays * (1.2 / rays[:, 1:2])
    plane = covering(floor, view=(0.0, 0.0, 0.0))
    samples = plane.samples(SIZE_M)
    for z in (2.0, 3.0, 3.8):
        strip = samples[np.abs(samples[:, 2] - z) < 0.1]
        width = 2 * 320 / 525.0 * z
        assert len(strip) == pytest.approx(width * 0.2 / SIZE_M**2, rel=0.1)


def test_rings_of_a_lidar_keep_wide_cells():
    angle = np.linspace(0.0, 2.0 * np.pi, 4000, endpoint=False)
    rings = [[r * np.cos(angle), r * np.sin(angle), 0 * angle] for r in np.arange(1.0, 2.5, 0.11)]
    plane = covering(np.concatenate(np.transpose(rings, (0, 2, 1))))
    assert plane.grid.pitch_m > 2.0 * SIZE_M
    assert plane.grid.area_m2(4) == pytest.approx(np.pi * (2.43**2 - 1.0), rel=0.1)


def test_a_frame_of_a_room_is_precise_in_few_bytes(data_folder):
    """With wide cells and undivided Gaussians precision is 14.2 mm."""
    (file,) = (data_folder / 'data' / 'rgbd' / 'sevenscenes').glob('frame-000000.depth.png')
    depth = np.array(Image.open(file)).astype(np.float32) / 1000.0
    v, u = np.nonzero((depth > 0.0) & (depth < 60.0))
    z = depth[v, u]
    points = np.stack([(u - 320.0) * z / 585.0, (v - 240.0) * z / 585.0, z], axis=1)
    points = points.astype(np.float32)
    model = fit(points, ModelsConfig(voxel_size_m=SIZE_M))
    figures = model.evaluate(points)
    assert figures.precision_rms_m < 0.0132
    assert figures.completeness_rms_m < 0.020
    assert figures.coverage > 0.99
    assert len(model.to_bytes()) < 5000
