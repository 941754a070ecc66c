# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A real depth camera: points of further images lie on the surface of field and mesh."""

from dataclasses import astuple, replace

import numpy as np
import pytest

from surfel_mapper.config import Config
from surfel_mapper.geometry import q_xyzw
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import DepthImage, Scan
from surfel_mapper.sensors.depth import depth_points, PinholeCamera, SceneImage


def frames(data_folder, numbers):
    """Yield depth in mm, colour and pose of images."""
    pyplot = pytest.importorskip('matplotlib.pyplot')
    folder = data_folder / 'data' / 'rgbd'
    if not (folder / 'sevenscenes').is_dir():
        pytest.skip(f'{folder}: no images')
    table = np.load(folder / 'sevenscenes_poses.npz')
    for number in numbers:
        name = str(folder / 'sevenscenes' / f'frame-{number:06d}')
        depth = np.rint(pyplot.imread(f'{name}.depth.png') * 65535).astype(np.uint16)
        (row,) = np.flatnonzero(table['frame'] == number)
        pose = table['T_world_cam'][row].astype(float)
        u, _, vt = np.linalg.svd(pose[:3, :3])  # stored with three digits too few
        pose[:3, :3] = u @ vt
        yield depth, pyplot.imread(f'{name}.color.jpg'), pose


def fused(data_folder, numbers):
    """Return the mesh that a mapper makes of images, with the colours joined by stamp."""
    mapper = Mapper(
        Config.from_mapping(
            {
                'input.kind': 'depth',
                'pose.source': 'odometry',
                'frames.base': 'kinect',
                'layers.tsdf.enabled': True,
                'layers.tsdf.voxel_size_m': 0.02,
                'layers.tsdf.truncation_m': 0.08,
                'layers.tsdf.min_range_m': 0.4,
                'layers.tsdf.max_range_m': 4.0,
                'layers.tsdf.carve_m': 0.0,
                'layers.tsdf.color': True,
                'layers.tsdf.color_topic': 'color',
            }
        )
    )
    camera = PinholeCamera(640, 480, 585.0, 585.0, 320.0, 240.0)
    for depth, color, pose in frames(data_folder, numbers):
        stamp_ns = (len(mapper.window) + 1) * 10**8
        mapper.add_pose('odom', 'kinect', stamp_ns, pose[:3, 3], q_xyzw(pose))
        mapper.add_image(
            SceneImage(
                kind='color', stamp_ns=stamp_ns, frame_id='kinect', camera=None, pixels=color
            )
        )
        points = depth_points(depth, camera)
        scan = Scan(points=points, stamp_ns=stamp_ns, frame_id='kinect', camera=astuple(camera))
        mapper.add_scan(replace(scan, depth=DepthImage(points=points, depth=depth)))
        assert len(list(mapper.insert_ready())) == 1
    return mapper.tsdf.mesh()


def test_the_mesh_lies_on_what_other_images_show_and_looks_like_them(data_folder):
    mesh = fused(data_folder, range(0, 200, 20))
    assert len(mesh) > 50_000
    off_m, off_color, covered = [], [], []
    for depth, color, pose in frames(data_folder, range(10, 190, 60)):
        x, y, z = ((mesh.vertices - pose[:3, 3]) @ pose[:3, :3]).T
        z[z < 0.4] = np.nan
        u, v = np.rint(585.0 * x / z + 320.0), np.rint(585.0 * y / z + 240.0)
        inside = (u >= 0) & (u < 640) & (v >= 0) & (v < 480)
        u, v, z = u[inside].astype(int), v[inside].astype(int), z[inside]
        measured = depth[v, u] * 1e-3
        known = (measured > 0.4) & (measured < 3.5)
        visible = known & (np.abs(z - measured) < 0.08)  # others are hidden, or hide
        off_m.append(np.abs(z - measured)[visible])
        off_color.append(np.abs(mesh.colors[inside][visible] - color[v, u][visible].astype(float)))
        shown = np.zeros((60, 80), bool)
        shown[v[visible] // 8, u[visible] // 8] = True
        there = ((depth > 400) & (depth < 3500)).reshape(60, 8, 80, 8).mean(axis=(1, 3)) > 0.9
        covered.append(shown[there].mean())
    assert np.median(np.concatenate(off_m)) < 0.018
    assert np.median(np.concatenate(off_color)) < 20.0
    assert min(covered) > 0.7
