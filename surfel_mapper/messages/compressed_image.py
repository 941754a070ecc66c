# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Decoding sensor_msgs/CompressedImage as ROS's image_transport writes it.

The transport ``compressed`` holds a JPEG or a PNG; ``compressedDepth`` a header of twelve bytes
and a PNG of 16 bits: millimetres, or for depth in metres the quantised inverse depth. The result
has the attributes of a sensor_msgs/Image; an Image is returned unchanged. JPEG is accepted for
colours only: its losses would change labels and depths.

Only the decoders of JPEG and PNG are enabled, and the size in the header is checked before
decoding, so that a few bytes cannot allocate all memory.
"""

from __future__ import annotations

import io
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import CloudFormatError

TRANSPORTS = ('compressed', 'compressedDepth')
"""Last part of the name of a topic of compressed images."""

DEPTH_HEADER = np.dtype([('format', '<i4'), ('quantum', '<f4', 2)])
"""Header of compressedDepth: the two numbers convert quantised inverse depth to metres."""

MAX_PIXELS = 1 << 25
"""Larger images are refused: 8192 x 4096 pixels, which need 0.3 GB while they are decoded."""

JPEG_MAGIC, START_OF_SCAN = b'\xff\xd8', b'\xff\xda'
"""First bytes of a JPEG; mark before each of its scans, which no compressed data contains."""

MAX_SCANS = 32
"""Limit of the scans of a JPEG: progressive ones have 10, a thumbnail one more."""

ENCODINGS = {'L': 'mono8', 'RGB': 'rgb8', 'I;16': '16UC1', 'I;16B': '16UC1', 'I': '16UC1'}
"""Pillow's mode of an image, and the encoding of a message."""


def is_packed(topic: str) -> bool:
    """Return whether a topic has compressed images, by its name."""
    return topic.rpartition('/')[2] in TRANSPORTS


def base_topic(topic: str) -> str:
    """Return the topic of the raw images of a compressed topic; other names unchanged."""
    return topic.rpartition('/')[0] if is_packed(topic) else topic


def unpacked(msg: Any, topic: str, *, exact: bool, size: tuple[int, int] | None = None) -> Any:
    """
    Return an image that may be compressed with the attributes of a sensor_msgs/Image.

    Parameters
    ----------
    msg : sensor_msgs/Image or sensor_msgs/CompressedImage
        From rclpy or rosbags.
    topic : str
        Named in errors.
    exact : bool
        Whether to refuse JPEG, which changes values.
    size : (int, int), optional
        Width and height by the calibration; an image of another size is not decoded.

    Raises
    ------
    CloudFormatError
        If the bytes are not an image of the stated format.

    """
    if not hasattr(msg, 'format'):
        return msg
    encoding, _, packing = (word.strip() for word in str(msg.format).partition(';'))
    try:
        data = bytes(memoryview(msg.data))
    except (TypeError, ValueError, BufferError) as error:
        raise CloudFormatError(
            f'{topic}: data is a {type(msg.data).__name__}, expected a buffer of bytes: {error}'
        ) from error
    if packing.startswith('compressedDepth'):
        encoding, pixels = depth_of(data, encoding, packing, topic, size)
    else:
        formats = ('PNG',) if exact else ('PNG', 'JPEG')
        encoding, pixels = pixels_of(data, topic, formats, size)
    return SimpleNamespace(
        header=msg.header,
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=pixels.reshape(-1).view(np.uint8),
    )


def depth_of(
    data: bytes, encoding: str, packing: str, topic: str, size: tuple[int, int] | None
) -> tuple[str, npt.NDArray[Any]]:
    """Return encoding and pixels of a compressedDepth image."""
    if packing.endswith('rvl') or encoding not in ('16UC1', 'mono16', '32FC1'):
        raise CloudFormatError(
            f'{topic}: format {encoding}; {packing}, expected a png of 16UC1, mono16 or 32FC1; '
            'set .compressedDepth.format of the publisher to png'
        )
    if len(data) < DEPTH_HEADER.itemsize:
        raise CloudFormatError(f'{topic}: {len(data)} bytes, expected a header and a PNG')
    header = np.frombuffer(data, DEPTH_HEADER, 1)[0]
    actual, steps = pixels_of(data[DEPTH_HEADER.itemsize :], topic, ('PNG',), size)
    if actual != '16UC1':
        raise CloudFormatError(f'{topic}: a PNG of {actual}, expected one of 16 bits')
    if encoding != '32FC1':
        return actual, steps
    scale, offset = header['quantum']
    with np.errstate(all='ignore'):
        depth = scale / (steps.astype(np.float32) - offset)
    return encoding, np.where((steps > 0) & np.isfinite(depth), depth, np.float32(np.nan))


def pixels_of(
    data: bytes, topic: str, formats: tuple[str, ...], size: tuple[int, int] | None
) -> tuple[str, npt.NDArray[Any]]:
    """Return encoding and pixels of a file, (H, W) or (H, W, 3), little-endian."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=formats) as image:
            check_scans(data, topic)
            width, height = image.size
            check_size(width, height, topic, size)
            shown = image if image.mode in ENCODINGS else image.convert('RGB')
            pixels = np.asarray(shown)
    except CloudFormatError:
        raise
    except Exception as error:  # Pillow's are of many types
        expected = ' or '.join(formats)
        raise CloudFormatError(f'{topic}: not a readable {expected}: {error}') from error
    encoding = ENCODINGS[shown.mode]
    return encoding, np.ascontiguousarray(pixels, '<u2' if encoding == '16UC1' else 'u1')


def check_scans(data: bytes, topic: str) -> None:
    """
    Raise CloudFormatError if a JPEG has more scans than encoders write.

    Each scan of 23 bytes makes the decoder pass over all pixels: 76 kB took over a minute.
    """
    number = data.count(START_OF_SCAN) if data.startswith(JPEG_MAGIC) else 0
    if number > MAX_SCANS:
        raise CloudFormatError(f'{topic}: a JPEG of {number} scans, expected at most {MAX_SCANS}')


def check_size(width: int, height: int, topic: str, size: tuple[int, int] | None) -> None:
    """Raise CloudFormatError if an image is not of its calibration, or too large."""
    if size is not None and (width, height) != size:
        raise CloudFormatError(
            f'{topic}: image of {width} x {height} pixels, the calibration is for '
            f'{size[0]} x {size[1]}'
        )
    if width * height > MAX_PIXELS:
        raise CloudFormatError(f'{topic}: {width} x {height} pixels, more than {MAX_PIXELS}')
