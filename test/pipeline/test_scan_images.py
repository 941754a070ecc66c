# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Colours and labels out of images: which image a scan gets, and which pixel a point."""

import numpy as np
import pytest

from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import Scan
from surfel_mapper.sensors.depth import depth_points, PinholeCamera, SceneImage
from test.layers.test_distance_field import RAYS, RING

MS = 10**6
CAMERA = PinholeCamera(width=80, height=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
SETTINGS = {
    'pose.source': 'identity',
    'input.kind': 'depth',
    'map.min_points': 1,
    'layers.tsdf.enabled': True,
    'layers.tsdf.voxel_size_m': 0.05,
    'layers.tsdf.truncation_m': 0.15,
    'layers.tsdf.color': True,
    'layers.tsdf.color_topic': 'rgb/image',
}
RED, BLUE = (200, 10, 20), (5, 15, 250)


def mapper_with(**settings):
    return Mapper(Config.from_mapping({**SETTINGS, **settings}))


def wall(stamp_ns, depth_m=2.0):
    depth = np.full((60, 80), depth_m, np.float32)
    camera = (80, 60, 70.0, 70.0, 39.5, 29.5)
    points = depth_points(depth, CAMERA)
    return Scan(points=points, stamp_ns=stamp_ns, frame_id='camera', camera=camera)


def image(stamp_ns, left=RED, right=BLUE, kind='color', shape=(60, 80), frame_id='camera'):
    pixels = np.empty((*shape, *np.shape(left)), np.uint8 if kind == 'color' else np.int32)
    pixels[:, : shape[1] // 2], pixels[:, shape[1] // 2 :] = left, right
    camera = PinholeCamera(shape[1], shape[0], 70.0, 70.0, shape[1] / 2 - 0.5, shape[0] / 2 - 0.5)
    return SceneImage(
        kind=kind, stamp_ns=stamp_ns, frame_id=frame_id, camera=camera, pixels=pixels
    )


def mapped(mapper):
    return [update.stamp_ns for update in mapper.insert_ready()]


def colors_by_side(mapper):
    """Return the mean colours of the mesh, left and right of the middle."""
    mesh = mapper.tsdf.mesh()
    return [mesh.colors[side * mesh.vertices[:, 0] > 0.1].mean(axis=0) for side in (-1, 1)]


def test_a_depth_image_has_the_colours_of_the_image_at_its_stamp_pixel_by_pixel():
    mapper = mapper_with()
    mapper.add_image(image(1000 * MS))
    mapper.add_scan(wall(1000 * MS))
    assert mapped(mapper) == [1000 * MS]
    left, right = colors_by_side(mapper)
    np.testing.assert_allclose(left, RED, atol=1.0)
    np.testing.assert_allclose(right, BLUE, atol=1.0)


def test_a_scan_waits_for_an_image_that_is_not_older_and_takes_the_nearest():
    mapper = mapper_with()
    mapper.add_image(image(990 * MS, RED, RED))
    mapper.add_scan(wall(1000 * MS))
    assert mapped(mapper) == []
    mapper.add_image(image(1008 * MS, BLUE, BLUE))
    assert mapped(mapper) == [1000 * MS]
    np.testing.assert_allclose(colors_by_side(mapper), [BLUE, BLUE], atol=1.0)


@pytest.mark.parametrize('ends', [True, False])
def test_a_scan_waits_for_images_no_longer_than_for_poses_and_not_at_the_end(ends):
    mapper = mapper_with(**{'pose.max_wait_s': 0.3})
    mapper.add_image(image(900 * MS))
    mapper.add_scan(wall(1000 * MS))
    assert mapped(mapper) == []
    if ends:
        mapper.end_images()
    else:
        mapper.add_scan(wall(1301 * MS))
    assert mapped(mapper) == [1000 * MS]
    assert len(mapper.tsdf.mesh())
    assert not mapper.tsdf.mesh().colors.any()  # the image is 0.1 s away


def test_an_image_of_another_size_leaves_the_depth_without_colour(caplog):
    mapper = mapper_with()
    mapper.add_image(image(1000 * MS, shape=(30, 40)))
    mapper.add_scan(wall(1000 * MS))
    assert mapped(mapper) == [1000 * MS]
    assert not mapper.tsdf.mesh().colors.any()
    assert '40 x 30 pixels, expected 80 x 60' in caplog.text


def test_points_of_a_lidar_are_coloured_where_a_camera_sees_them_and_only_there():
    optical = (-0.5, 0.5, -0.5, 0.5)  # x right, y down, z ahead
    mapper = mapper_with(
        **{
            'input.kind': 'cloud',
            'pose.source': 'odometry',
            'frames.base': 'base',
            'layers.tsdf.voxel_size_m': 0.2,
            'layers.tsdf.truncation_m': 0.6,
        }
    )
    mapper.add_pose('base', 'lidar', 0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), static=True)
    mapper.add_pose('base', 'camera', 0, (0.1, 0.0, 1.0), optical, static=True)
    mapper.add_pose('odom', 'base', 1000 * MS, (7.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    mapper.add_image(image(1000 * MS))
    points = (5.0 * RAYS).reshape(-1, 3)
    mapper.add_scan(
        Scan(points=points, stamp_ns=1000 * MS, frame_id='lidar', columns={'ring': RING})
    )
    assert mapped(mapper) == [1000 * MS]
    mesh = mapper.tsdf.mesh()
    x, y, z = (mesh.vertices - [7.0, 0.0, 1.0]).T
    ahead = (x > 4.5) & (np.abs(y) > 0.4) & (np.abs(y) < 1.5) & (np.abs(z) < 1.5)
    np.testing.assert_allclose(mesh.colors[ahead & (y > 0)].mean(axis=0), RED, atol=3.0)
    np.testing.assert_allclose(mesh.colors[ahead & (y < 0)].mean(axis=0), BLUE, atol=3.0)
    assert not mesh.colors[x < 0].any()
    color = mapper.tsdf.blocks.color[mapper.tsdf.blocks.rows()]
    known = color[:, 3] > 0
    assert 0.01 < known.mean() < 0.5
    # No voxel mixes a colour with none: that would be dark.
    assert color[:, :3].sum(axis=1)[known].min() > 150.0


def test_a_cloud_with_colours_of_its_own_waits_for_no_image():
    mapper = mapper_with()
    scan = wall(1000 * MS)
    rgb = np.full(len(scan), (1 << 16) | (2 << 8) | 3, np.uint32)
    mapper.add_scan(Scan(**{**fields(scan), 'columns': {'rgb': rgb}}))
    assert mapped(mapper) == [1000 * MS]
    assert set(map(tuple, mapper.tsdf.mesh().colors.tolist())) == {(1, 2, 3)}


def fields(scan):
    return {name: getattr(scan, name) for name in ('points', 'stamp_ns', 'frame_id', 'camera')}


@pytest.mark.parametrize(
    ('settings', 'message'),
    [
        ({'layers.tsdf.color': False}, r'color: False, expected true where color_topic'),
        ({'layers.tsdf.label_topic': 'labels'}, r'semantics: none, expected another where'),
    ],
)
def test_image_topics_of_channels_not_kept_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        mapper_with(**settings)
