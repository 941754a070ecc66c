# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Depth images enter the distance field as images, points without theirs as points."""

from dataclasses import astuple, replace

import numpy as np
import pytest

from surfel_mapper.config import Config
from surfel_mapper.pipeline import Mapper
from surfel_mapper.scan import DepthImage, Scan
from surfel_mapper.sensors.depth import depth_points, PinholeCamera, SceneImage
from surfel_mapper.tsdf.queries import FREE, states, UNKNOWN
from test.pipeline.test_scan_images import mapped, mapper_with

CAMERA = PinholeCamera(width=80, height=60, fx=70.0, fy=70.0, cx=39.5, cy=29.5)
LABELS = {
    'layers.tsdf.semantics': 'single',
    'layers.tsdf.label_topic': 'labels',
}


def steps_mm():
    """Return depths of a wall with steps; unknown at the border, which rounding may cut off."""
    depth = np.full((60, 80), 2000, np.uint16)
    depth[20:40, 10:30] = 1500
    depth[45:50, 50:70] = 65535
    depth[0], depth[-1], depth[:, 0], depth[:, -1] = 0, 0, 0, 0
    return depth


def scan_of(depth, *, has_image=True):
    points = depth_points(depth, CAMERA)
    image = DepthImage(points=points, depth=depth) if has_image else None
    return Scan(
        points=points, stamp_ns=10**9, frame_id='camera', camera=astuple(CAMERA), depth=image
    )


def scene_images():
    rng = np.random.default_rng(3)
    color = rng.integers(0, 255, (60, 80, 3)).astype(np.uint8)
    label = np.where(np.arange(80) < 40, 7, -1) * np.ones((60, 1), np.int64)
    for kind, pixels in (('color', color), ('label', label.astype(np.int32))):
        yield SceneImage(
            kind=kind, stamp_ns=10**9, frame_id='camera', camera=CAMERA, pixels=pixels
        )


def filled(scan, **settings):
    """Return a mapper that has mapped a scan with its colours and labels."""
    mapper = mapper_with(**LABELS, **settings)
    for image in scene_images():
        mapper.add_image(image)
    mapper.add_scan(scan)
    assert mapped(mapper) == [10**9]
    return mapper


def test_points_of_a_camera_without_its_image_give_their_surface():
    mapper = filled(scan_of(steps_mm(), has_image=False))
    z = mapper.tsdf.mesh().vertices[:, 2]
    off_m = np.minimum(np.abs(z - 1.5), np.abs(z - 2.0))
    assert len(z) > 1000
    assert np.median(off_m) < 1e-3
    blocks = mapper.tsdf.blocks
    assert blocks.color[:, 3].any()
    assert (blocks.votes[blocks.rows(), 0] == 8).any()  # label 7


def test_filtered_points_are_not_taken_from_the_image(tmp_path):
    chain = tmp_path / 'chain.yaml'
    box = 'xMin: 0, xMax: 9, yMin: -9, yMax: 9, zMin: 0, zMax: 9, removeInside: 1'
    chain.write_text(f'- BoundingBoxDataPointsFilter: {{{box}}}\n')
    mapper = filled(scan_of(steps_mm()), filters=str(chain))
    places = np.array([[-0.5, 0.0, 1.2], [0.5, 0.0, 1.2]])
    assert states(mapper.tsdf.blocks, places).tolist() == [FREE, UNKNOWN]


def test_scan_with_other_points_has_no_image():
    scan = scan_of(steps_mm())
    assert scan.depth is not None
    assert replace(scan, stamp_ns=5).depth is scan.depth
    assert scan.select(np.arange(10)).depth is None
    assert replace(scan, points=scan.points + np.float32(1.0)).depth is None


def test_infinite_depth_frees_space_up_to_the_range_and_nan_none():
    depth = np.full((60, 80), np.nan, np.float32)
    depth[:, 40:] = np.inf
    depth[30, 5] = 2.0
    settings = {'layers.tsdf.carve_m': 20.0, 'layers.tsdf.max_range_m': 3.0}
    mapper = Mapper(
        Config.from_mapping(
            {
                'pose.source': 'identity',
                'input.kind': 'depth',
                'layers.tsdf.enabled': True,
                **settings,
            }
        )
    )
    mapper.add_scan(scan_of(depth))
    assert mapped(mapper) == [10**9]
    places = np.array([[0.5, 0.0, 2.5], [-0.5, 0.0, 2.5], [0.5, 0.0, 3.4]])
    assert states(mapper.tsdf.blocks, places).tolist() == [FREE, UNKNOWN, UNKNOWN]


@pytest.mark.parametrize('shape', [(30, 40, 3), (60, 81, 3)])
def test_color_of_another_size_leaves_the_depth_without(shape, caplog):
    mapper = mapper_with()
    pixels = np.zeros(shape, np.uint8)
    image = SceneImage(
        kind='color', stamp_ns=10**9, frame_id='camera', camera=CAMERA, pixels=pixels
    )
    mapper.add_image(image)
    mapper.add_scan(scan_of(steps_mm()))
    assert mapped(mapper) == [10**9]
    assert 'expected 80 x 60 as the depth image has' in caplog.text
    assert len(mapper.tsdf.mesh()) > 1000
    assert not mapper.tsdf.blocks.color[:, 3].any()


def test_map_sums_the_colours_of_the_image():
    mapper = filled(scan_of(steps_mm()), **{'map.color': True, 'map.min_points': 1})
    (color, _) = scene_images()
    surfels = mapper.map.surfels(min_points=1)
    totals = surfels.channels['red'] @ surfels.num_points
    is_point = (steps_mm() > 0) & (steps_mm() < 65535)
    assert totals == pytest.approx(color.pixels[is_point][:, 0].sum())


def test_map_with_colours_drops_depth_images_without():
    mapper = mapper_with(**{'map.color': True})
    mapper.add_scan(scan_of(steps_mm()))
    mapper.end_images()
    assert mapped(mapper) == []
    assert mapper.counters.dropped['missing_column'] == 1
    assert mapper.map.num_voxels == 0


def test_dropped_scan_without_colours_states_its_columns(caplog):
    mapper = mapper_with(**{'map.color': True})
    scan = replace(scan_of(steps_mm(), has_image=False), camera=())
    mapper.add_scan(replace(scan, columns={'reflectivity': np.ones(len(scan))}))
    assert 'its points have no rgb among reflectivity' in caplog.text


def test_map_with_colours_refuses_lidar_scans_that_a_camera_sees_in_part():
    mapper = mapper_with(**{'map.color': True})
    mapper.add_scan(replace(scan_of(steps_mm(), has_image=False), camera=()))
    assert mapper.counters.dropped['missing_column'] == 1
