# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Organised clouds of depth cameras: walls with the noise of a Kinect, and frames of real ones."""

from __future__ import annotations

import numpy as np
import pytest

FOCAL_PX, BASELINE_M, STEPS_PER_PX = 585.0, 0.075, 8
"""Focal length and baseline of a Kinect, and its steps of disparity in a pixel."""

SIGMA = 1.425e-3
"""Sigma of its depth by depth^2, 1/m."""

STEP_SIGMA = 1.0 / (FOCAL_PX * BASELINE_M * STEPS_PER_PX * 12.0**0.5)
"""The same of evenly distributed errors of one step."""

CAMERAS = {
    'sevenscenes': ('frame-{:06d}.depth.png', (585.0, 585.0, 320.0, 240.0)),
    'slambook2': ('depth_{}.png', (518.0, 519.0, 325.5, 253.5)),
}
"""Names of depth images, and fx, fy, cx, cy of their camera."""


def wall(slope, *, white=False, matched=0, steps=False, seed=0):
    """
    Return points (480, 640, 3) float32 of a wall at 2.45 m ahead.

    white: independent noise; matched: noise averaged over windows of this number of pixels; steps:
    disparity in eighths of a pixel
    """
    from scipy.ndimage import uniform_filter

    v, u = np.mgrid[:480, :640]
    x, y = (u - 320) / FOCAL_PX, (v - 240) / FOCAL_PX
    z = 2.45 / (1.0 - slope * x)
    noise = np.random.default_rng(seed).standard_normal(z.shape)
    if matched:
        noise = uniform_filter(noise, matched)
        noise /= noise.std()
    if white or matched:
        z += SIGMA * z**2 * noise
    if steps:
        least = FOCAL_PX * BASELINE_M * STEPS_PER_PX
        z = least / np.rint(least / z)
    return np.stack([x * z, y * z, z], axis=-1).astype(np.float32)


def real_frame(data_folder, name, number):
    """Return the points (480, 640, 3) float32 of a frame of data/rgbd; nan without depth."""
    pyplot = pytest.importorskip('matplotlib.pyplot')
    pattern, (fx, fy, cx, cy) = CAMERAS[name]
    file = data_folder / 'data' / 'rgbd' / name / pattern.format(number)
    if not file.exists():
        pytest.skip(f'{file}: no such image')
    raw = np.rint(pyplot.imread(file) * 65535.0)
    z = np.where((raw > 0) & (raw < 65535), 1e-3 * raw, np.nan)
    v, u = np.mgrid[: z.shape[0], : z.shape[1]]
    return np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=-1).astype(np.float32)


def posed_frames(data_folder, number):
    """Yield points (N, 3) in the map of the first frames of 7-Scenes, and the camera's place."""
    poses = data_folder / 'data' / 'rgbd' / 'sevenscenes_poses.npz'
    if not poses.exists():
        pytest.skip(f'{poses}: no such file')
    table = np.load(poses)
    for frame, pose in zip(table['frame'][:number], table['T_world_cam'], strict=False):
        points = real_frame(data_folder, 'sevenscenes', frame).reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
        u, _, vt = np.linalg.svd(pose[:3, :3])  # stored with three digits too few
        yield points @ (u @ vt).T + pose[:3, 3], pose[:3, 3]


def table_of_books(seed, number=5):
    """
    Return points (307200, 3) float32 of a camera above books on a table, and labels: table 1.

    Books are boxes of 12 to 28 cm and 1.5 to 5 cm high; noise is matched and in steps.
    """
    from scipy.ndimage import uniform_filter

    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:480, :640]
    rays = np.stack([(u - 320) / 525.0, (v - 240) / 525.0, np.ones((480, 640))], -1).reshape(-1, 3)
    tilt = np.radians(35.0)
    up = np.array([0.0, -np.cos(tilt), -np.sin(tilt)])
    R_table_camera = np.stack([[1.0, 0.0, 0.0], np.cross(up, [1.0, 0.0, 0.0]), up])
    local, eye = rays @ R_table_camera.T, -R_table_camera @ [0.0, 0.05, 0.95]
    depth = np.where(local[:, 2] < 0.0, -eye[2] / local[:, 2], np.inf)
    depth[(np.abs(eye + depth[:, None] * local) > [0.6, 0.45, 1.0]).any(axis=1)] = np.inf
    labels = np.isfinite(depth).astype(np.int64)
    for book in range(number):
        a = rng.uniform(0.0, np.pi)
        turn = np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
        x, y = rng.uniform([-0.35, -0.3], [0.35, 0.3])
        half, height = rng.uniform([0.08, 0.06], [0.14, 0.1]), rng.uniform(0.015, 0.05)
        start, way = turn @ (eye - [x, y, 0.0]), local @ turn.T
        ends = np.array([[-half[0], -half[1], 0.0], [half[0], half[1], height]])
        first, last = np.sort((ends[:, None] - start) / way, axis=0)
        near = first.max(axis=1)
        hit = (near < last.min(axis=1)) & (near > 0.0) & (near < depth)
        depth[hit], labels[hit] = near[hit], book + 2
    noise = uniform_filter(rng.standard_normal((480, 640)), 5).ravel()
    z = np.where(labels > 0, depth, 1.0)
    z += SIGMA * z**2 * noise / noise.std()
    least = FOCAL_PX * BASELINE_M * STEPS_PER_PX
    z = np.where(labels > 0, least / np.rint(least / z), np.nan)
    return (rays * z[:, None]).astype(np.float32), labels


def disparity_noise(cloud, side=48):
    """
    Return sigma of the depth by depth^2, 1/m, from windows of pixels.

    A plane has a disparity that is affine in the pixels. Windows keep nine tenths of their pixels
    without outliers; the result is the third decile, as edges only add.
    """
    sigma = []
    columns = np.mgrid[:side, :side].reshape(2, -1)
    design = np.column_stack([np.ones(side * side), columns.T / side])
    for v in range(0, cloud.shape[0] - side + 1, side):
        for u in range(0, cloud.shape[1] - side + 1, side):
            inverse = 1.0 / cloud[v : v + side, u : u + side, 2].astype(np.float64).ravel()
            valid = np.isfinite(inverse)
            if valid.mean() < 0.9:
                continue
            used = valid
            for _ in range(5):
                terms = np.linalg.lstsq(design[used], inverse[used], rcond=None)[0]
                away = np.abs(inverse - design @ terms)
                used = valid & (away <= 3.0 * 1.4826 * np.median(away[used]) + 1e-12)
            if used.sum() > 0.9 * valid.sum():
                sigma.append(np.sqrt(np.mean(away[used] ** 2)))
    return float(np.quantile(sigma, 0.3))
