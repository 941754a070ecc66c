# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Compressed images as image_transport writes them are decoded; others are refused."""

import io
from types import SimpleNamespace
import zlib

import numpy as np
from PIL import Image
import pytest

from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError
from surfel_mapper.messages.compressed_image import is_packed, unpacked
from surfel_mapper.messages.images import camera_info_topic, CameraImage, depth_scan, SceneImages
from surfel_mapper.sensors.depth import depth_points
from test.messages.test_images import CAMERA, DEPTH_MM, image

TOPIC = '/camera/image/compressed'
ROW, COLUMN = np.indices((48, 64))
SMOOTH = np.stack([2 * ROW, 3 * COLUMN, 200 - ROW - COLUMN], axis=2).astype(np.uint8)


def packed(pixels, format_, kind='PNG', before=b''):
    """Return a message of pixels packed as PNG or JPEG."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **({'quality': 95} if kind == 'JPEG' else {}))
    message = image()
    return SimpleNamespace(header=message.header, format=format_, data=before + file.getvalue())


def packed_depth(depth, format_='', header=(0.0, 0.0)):
    """Return a message of depth as compressedDepth packs it, with its two numbers."""
    before = np.int32(0).tobytes() + np.array(header, np.float32).tobytes()
    return packed(depth, format_ or '16UC1; compressedDepth png', before=before)


def scene(kind, message):
    images = SceneImages(Config.from_mapping({'input.kind': 'depth'}))
    (found,) = images.add_image(kind, TOPIC, message)
    return found


@pytest.mark.parametrize('format_', ['rgb8; png compressed bgr8', 'bgr8; png compressed', 'png'])
def test_a_png_of_any_encoding_keeps_its_colours(format_):
    found = scene('color', packed(SMOOTH, format_))
    np.testing.assert_array_equal(found.pixels, SMOOTH)
    assert (found.stamp_ns, found.frame_id) == (5_000_000_006, 'optical')


def test_a_jpeg_keeps_its_colours_within_its_losses():
    found = scene('color', packed(SMOOTH, 'bgr8; jpeg compressed bgr8', 'JPEG'))
    off = np.abs(found.pixels.astype(int) - SMOOTH)
    assert found.pixels.shape == SMOOTH.shape
    assert off.mean() < 2.0  # red and blue exchanged it is 60


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
def test_labels_of_a_png_are_exact(dtype):
    labels = (np.arange(12).reshape(3, 4) * (20 if dtype == np.uint8 else 5000)).astype(dtype)
    np.testing.assert_array_equal(scene('label', packed(labels, 'png')).pixels, labels)


def test_labels_of_a_jpeg_are_refused():
    with pytest.raises(CloudFormatError, match=f'^{TOPIC}: not a readable PNG'):
        scene('label', packed(SMOOTH[..., 0].copy(), 'mono8; jpeg compressed', 'JPEG'))


@pytest.mark.parametrize(
    'format_',
    ['16UC1; compressedDepth png', '16UC1; compressedDepth', 'mono16; compressedDepth png'],
)
def test_depth_in_millimetres_is_the_same_packed(format_):
    scan = depth_scan(CameraImage(packed_depth(DEPTH_MM, format_), CAMERA))
    np.testing.assert_array_equal(scan.points, depth_points(DEPTH_MM, CAMERA))
    plain = depth_scan(CameraImage(packed(DEPTH_MM, '16UC1; png compressed'), CAMERA))
    np.testing.assert_array_equal(plain.points, scan.points)


def test_depth_in_metres_has_the_resolution_of_its_quantised_inverse():
    # As image_transport packs it: quantisation 100, largest depth 10 m.
    first = 100.0 * 101.0
    second = 1.0 - first / 10.0
    depth = np.array([[0.5, 1.0, 2.0, 4.0], [8.0, 9.9, 3.3, np.nan], [0.7, 0.8, 0.9, 5.0]])
    with np.errstate(invalid='ignore'):
        steps = np.where(np.isfinite(depth), np.rint(first / depth + second), 0)
    message = packed_depth(steps.astype(np.uint16), '32FC1; compressedDepth png', (first, second))
    found = unpacked(message, TOPIC, exact=True)
    pixels = found.data.view(np.float32).reshape(3, 4)
    assert (found.encoding, found.step, found.height) == ('32FC1', 16, 3)
    assert np.isnan(pixels[1, 3])
    step_m = depth**2 / first  # of which rounding is half
    known = np.isfinite(depth)
    assert (np.abs(pixels - depth)[known] <= 0.51 * step_m[known]).all()
    assert len(depth_scan(CameraImage(message, CAMERA))) == 11


@pytest.mark.parametrize(
    ('message', 'said'),
    [
        (packed_depth(DEPTH_MM, '16UC1; compressedDepth rvl'), 'expected a png of 16UC1'),
        (packed_depth(DEPTH_MM, '8UC3; compressedDepth png'), 'format 8UC3; compressedDepth png'),
        (packed_depth(SMOOTH[:3, :4].copy()), 'a PNG of rgb8, expected one of 16 bits'),
        (SimpleNamespace(**{**vars(packed_depth(DEPTH_MM)), 'data': b'123'}), '3 bytes, expected'),
        (SimpleNamespace(**{**vars(packed_depth(DEPTH_MM)), 'data': 7}), 'data is a int'),
        (packed(SMOOTH[:3, :4].copy(), 'png'), "encoding 'rgb8', expected 16UC1 or 32FC1"),
        (packed(DEPTH_MM.T.copy(), 'png'), r'image of 3 x 4 pixels, the calibration is for 4 x 3'),
    ],
)
def test_an_image_without_depth_is_refused_by_topic(message, said):
    with pytest.raises(CloudFormatError, match=f'^{TOPIC}: .*{said}'):
        depth_scan(CameraImage(message, CAMERA), TOPIC)


@pytest.mark.parametrize('kind', ['PNG', 'JPEG'])
def test_truncated_and_changed_images_are_refused(kind):
    message = packed(SMOOTH, kind.lower(), kind)
    whole = message.data
    for length in range(0, len(whole) - 20, max(len(whole) // 40, 1)):
        message.data = whole[:length]
        with pytest.raises(CloudFormatError, match='not a readable'):
            unpacked(message, TOPIC, exact=False)
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(200):
        damaged = np.frombuffer(whole, np.uint8).copy()
        damaged[rng.integers(0, len(damaged), 3)] ^= rng.integers(1, 256, 3).astype(np.uint8)
        message.data = damaged.tobytes()
        try:
            unpacked(message, TOPIC, exact=False)
        except CloudFormatError:
            refused += 1
    assert refused > (100 if kind == 'PNG' else 5)


@pytest.mark.parametrize('side', [9000, 2**31 - 1])
def test_an_image_of_too_many_pixels_is_refused_before_decoding(side):
    message = packed(SMOOTH, 'png')
    size = np.array([side, side], '>u4').tobytes()
    header = b'IHDR' + size + message.data[24:29]
    message.data = (
        message.data[:12] + header + zlib.crc32(header).to_bytes(4, 'big') + message.data[33:]
    )
    with pytest.raises(CloudFormatError, match='pixels'):
        unpacked(message, TOPIC, exact=True)


def test_formats_other_than_png_and_jpeg_are_refused():
    message = packed(SMOOTH, 'bmp', 'BMP')
    with pytest.raises(CloudFormatError, match='not a readable PNG or JPEG'):
        unpacked(message, TOPIC, exact=False)


def test_the_name_of_a_topic_gives_its_transport_and_camera_info():
    assert is_packed('/camera/color/image_raw/compressed')
    assert is_packed('/camera/depth/image_raw/compressedDepth')
    assert not is_packed('/camera/compressed/image_raw')
    assert camera_info_topic('/camera/depth/image_raw/compressedDepth') == (
        '/camera/depth/camera_info'
    )
