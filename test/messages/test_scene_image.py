# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of colours and labels as messages of any library."""

import numpy as np
import pytest

from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError
from surfel_mapper.messages.depth_image import MAX_EARLY
from surfel_mapper.messages.scene_image import SceneImages
from surfel_mapper.sensors.depth import PinholeCamera
from test.messages.test_depth_image import image, info

TOPIC = '/camera/color/image'
RGB = np.random.default_rng(0).integers(0, 256, (3, 4, 3)).astype(np.uint8)


def read(kind, message, **settings):
    (found,) = SceneImages(Config.from_mapping({'input.kind': 'depth'})).add_image(
        kind, TOPIC, message
    )
    return found


@pytest.mark.parametrize('padding', [0, 5])
@pytest.mark.parametrize(
    ('encoding', 'stored'),
    [
        ('rgb8', RGB),
        ('bgr8', RGB[..., ::-1]),
        ('rgba8', np.concatenate([RGB, RGB[..., :1]], axis=2)),
        ('bgra8', np.concatenate([RGB[..., ::-1], RGB[..., :1]], axis=2)),
    ],
)
def test_colours_of_any_layout_are_red_green_blue(encoding, stored, padding):
    found = read('color', image(np.ascontiguousarray(stored), encoding, padding))
    np.testing.assert_array_equal(found.pixels, RGB)
    assert (found.stamp_ns, found.frame_id, found.kind) == (5 * 10**9 + 6, 'optical', 'color')


def test_grey_is_a_colour():
    found = read('color', image(RGB[..., 0].copy(), 'mono8'))
    np.testing.assert_array_equal(found.pixels, np.repeat(RGB[..., :1], 3, axis=2))


@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize(
    ('encoding', 'dtype'), [('8UC1', 'u1'), ('mono16', 'u2'), ('16UC1', 'u2'), ('32SC1', 'i4')]
)
def test_labels_are_whole_numbers(encoding, dtype, big):
    labels = np.arange(12).reshape(3, 4).astype(dtype) * 20
    if dtype == 'i4':
        labels[0, 0] = -1
    np.testing.assert_array_equal(read('label', image(labels, encoding, big=big)).pixels, labels)


@pytest.mark.parametrize(
    ('kind', 'changes', 'message'),
    [
        ('color', {'encoding': '16UC1'}, r"/camera/color/image: encoding '16UC1', expected one"),
        ('label', {'encoding': 'rgb8'}, r"encoding 'rgb8', expected one of 8UC1"),
        ('color', {'step': 4}, r'expected height 3 rows of at least 12'),
    ],
)
def test_what_is_no_such_image_is_refused(kind, changes, message):
    with pytest.raises(CloudFormatError, match=message):
        read(kind, image(RGB, **{'encoding': 'rgb8', **changes}))


def test_beside_a_lidar_images_wait_for_their_camera():
    images = SceneImages(Config())
    assert images.add_image('color', TOPIC, image(RGB, 'rgb8')) == []
    (found,) = images.add_info('color', TOPIC, info())
    assert found.camera == PinholeCamera(width=4, height=3, fx=5.0, fy=6.0, cx=1.5, cy=1.0)
    assert len(images.add_image('color', TOPIC, image(RGB, 'rgb8'))) == 1


def test_an_image_whose_camera_never_comes_is_refused():
    images = SceneImages(Config())
    for _ in range(MAX_EARLY):
        images.add_image('color', TOPIC, image(RGB, 'rgb8'))
    with pytest.raises(CloudFormatError, match='no calibration; is camera_info published'):
        images.add_image('color', TOPIC, image(RGB, 'rgb8'))
