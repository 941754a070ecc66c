# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of depth, colours and labels are decoded and paired with their calibration."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError
from surfel_mapper.messages.images import (
    camera_in,
    camera_info_topic,
    CameraImage,
    depth_scan,
    DepthImages,
    MAX_EARLY,
    SceneImages,
)
from surfel_mapper.sensors.depth import depth_points, PinholeCamera

CAMERA = PinholeCamera(width=4, height=3, fx=5.0, fy=6.0, cx=1.5, cy=1.0)
TOPIC = '/camera/depth/image'
DEPTH_MM = np.arange(12, dtype=np.uint16).reshape(3, 4) * 500


def image(depth=DEPTH_MM, encoding='16UC1', padding=0, big=False, **changes):
    stored = depth.astype(depth.dtype.newbyteorder('>' if big else '<'))
    rows = stored.view(np.uint8).reshape(len(depth), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=5, nanosec=6), frame_id='optical'),
        height=depth.shape[0],
        width=depth.shape[1],
        encoding=encoding,
        is_bigendian=int(big),
        step=rows.shape[1],
        data=rows.tobytes(),
    )
    for name, value in changes.items():
        setattr(message, name, value)
    return message


K = (5.0, 0.0, 1.5, 0.0, 6.0, 1.0, 0.0, 0.0, 1.0)


def info(k=K, p=(0.0,) * 12, binning=0, roi=(0, 0, 0, 0), **more):
    x, y, width, height = roi
    names = {'k': np.array(k, float), 'p': np.array(p, float)}
    return SimpleNamespace(
        width=more.get('width', 4),
        height=more.get('height', 3),
        binning_x=binning,
        binning_y=binning,
        roi=SimpleNamespace(x_offset=x, y_offset=y, width=width, height=height),
        **{name.upper() if more.get('ros1') else name: value for name, value in names.items()},
    )


@pytest.mark.parametrize('padding', [0, 2, 5])
@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize('encoding', ['16UC1', 'mono16', '32FC1'])
def test_images_of_any_layout_give_the_same_points(encoding, big, padding):
    depth = (DEPTH_MM / 1000).astype(np.float32) if encoding == '32FC1' else DEPTH_MM
    scan = depth_scan(CameraImage(image(depth, encoding, padding, big), CAMERA))
    assert (scan.stamp_ns, scan.frame_id) == (5_000_000_006, 'optical')
    np.testing.assert_allclose(scan.points, depth_points(DEPTH_MM, CAMERA), rtol=2e-7)
    assert len(scan) == 11  # one pixel has no depth


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'encoding': 'rgb8'}, "encoding 'rgb8', expected 16UC1 or 32FC1"),
        ({'step': 6}, 'rows of 6, expected height 3 rows of at least 8'),
        ({'data': b'12345'}, '5 bytes in rows of 8'),
        ({'data': 7}, 'data is a int, expected a buffer'),
        ({'height': 6, 'width': 2, 'step': 4}, r'shape \(6, 2\), expected \(3, 4\)'),
        (
            {'header': SimpleNamespace(stamp=SimpleNamespace(sec=-1, nanosec=0), frame_id='x')},
            'no negative time',
        ),
    ],
)
def test_a_damaged_image_is_refused_by_topic(changes, message):
    with pytest.raises(CloudFormatError, match=f'^{TOPIC}: .*{message}'):
        depth_scan(CameraImage(image(**changes), CAMERA), TOPIC)


@pytest.mark.parametrize('ros1', [False, True])
def test_the_camera_of_the_rectified_image_is_preferred(ros1):
    assert camera_in(info(ros1=ros1)) == CAMERA
    rectified = camera_in(info(p=(7.0, 0, 2.0, 0, 0, 8.0, 1.5, 0, 0, 0, 1, 0), ros1=ros1))
    assert rectified == PinholeCamera(4, 3, 7.0, 8.0, 2.0, 1.5)


def test_binning_and_region_of_interest_change_the_camera():
    binned = camera_in(info(width=8, height=6, binning=2))
    assert binned == PinholeCamera(4, 3, 2.5, 3.0, 0.75, 0.5)
    part = camera_in(info(width=80, height=60, roi=(1, 2, 4, 3)))
    assert part == PinholeCamera(4, 3, 5.0, 6.0, 0.5, -1.0)


@pytest.mark.parametrize('k', [(0.0,) * 9, (np.nan,) * 9, ()])
def test_a_camera_that_is_not_calibrated_is_refused(k):
    with pytest.raises(CloudFormatError, match=r'^camera_info: .*calibrated'):
        camera_in(info(k=k))


@pytest.mark.parametrize(
    ('image_topic', 'expected'),
    [
        ('/camera/depth/image_rect_raw', '/camera/depth/camera_info'),
        ('/depth', '/camera_info'),
        ('depth/image', 'depth/camera_info'),
        ('depth', 'camera_info'),
    ],
)
def test_the_calibration_topic_is_beside_the_image_topic(image_topic, expected):
    assert camera_info_topic(image_topic) == expected


def test_images_wait_for_the_first_calibration_of_their_camera():
    images = DepthImages()
    first, second, other = image(), image(), image()
    assert images.add_image('/a', first) == images.add_image('/a', second) == []
    assert images.add_image('/b', other) == []
    ready = images.add_info('/a', info())
    assert ready == [CameraImage(first, CAMERA), CameraImage(second, CAMERA)]
    assert images.add_info('/a', info()) == []
    assert images.add_image('/a', first) == [CameraImage(first, CAMERA)]


def test_a_limited_number_of_images_wait_and_the_oldest_is_dropped():
    images = DepthImages()
    given_up = [found for n in range(MAX_EARLY + 3) for found in images.add_image('/a', n)]
    assert given_up == [CameraImage(number, None) for number in range(3)]
    assert [found.msg for found in images.add_info('/a', info())] == list(range(3, MAX_EARLY + 3))
    with pytest.raises(CloudFormatError, match='is /camera/depth/camera_info published'):
        depth_scan(CameraImage(image(), None), TOPIC)


COLOR_TOPIC = '/camera/color/image'
RGB = np.random.default_rng(0).integers(0, 256, (3, 4, 3)).astype(np.uint8)


def read(kind, message, **settings):
    (found,) = SceneImages(Config.from_mapping({'input.kind': 'depth'})).add_image(
        kind, COLOR_TOPIC, message
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


@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize(
    ('encoding', 'dtype'), [('8UC1', 'u1'), ('mono16', 'u2'), ('16UC1', 'u2'), ('32SC1', 'i4')]
)
def test_labels_are_integers(encoding, dtype, big):
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
def test_images_of_wrong_encoding_or_size_are_refused(kind, changes, message):
    with pytest.raises(CloudFormatError, match=message):
        read(kind, image(RGB, **{'encoding': 'rgb8', **changes}))


def test_beside_a_lidar_images_wait_for_their_camera():
    images = SceneImages(Config())
    assert images.add_image('color', COLOR_TOPIC, image(RGB, 'rgb8')) == []
    (found,) = images.add_info('color', COLOR_TOPIC, info())
    assert found.camera == PinholeCamera(width=4, height=3, fx=5.0, fy=6.0, cx=1.5, cy=1.0)
    assert len(images.add_image('color', COLOR_TOPIC, image(RGB, 'rgb8'))) == 1


def test_an_image_without_calibration_is_refused():
    images = SceneImages(Config())
    for _ in range(MAX_EARLY):
        images.add_image('color', COLOR_TOPIC, image(RGB, 'rgb8'))
    with pytest.raises(CloudFormatError, match='no calibration; is camera_info published'):
        images.add_image('color', COLOR_TOPIC, image(RGB, 'rgb8'))
