# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Images that a transport has packed: sensor_msgs/CompressedImage as ROS's image_transport writes it.

The transport ``compressed`` holds a JPEG or a PNG; ``compressedDepth`` twelve bytes, of which two
numbers matter, and a PNG of 16 bits: millimetres, or for depth in metres its inverse in even
steps. An image is unpacked where its pixels are wanted and is a sensor_msgs/Image from there on;
one that is none already is handed through. What a JPEG loses does not matter to colours, but
would make labels and depths that nobody measured.

Only the decoders of JPEG and PNG are let near the bytes, and none for more pixels than a camera
has, so that a few bytes cannot ask for all memory.
"""

from __future__ import annotations

import io
import struct
from types import SimpleNamespace
from typing import Any
import zlib

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import CloudFormatError

TRANSPORTS = ('compressed', 'compressedDepth')
"""What the last part of the name of a topic of packed images is."""

DEPTH_HEADER = np.dtype([('format', '<i4'), ('quantum', '<f4', 2)])
"""What comes before the PNG of compressedDepth: the two numbers make metres of its steps."""

MAX_PIXELS = 1 << 26
"""An image of more is refused: 8192 x 8192."""

ENCODINGS = {'L': 'mono8', 'RGB': 'rgb8', 'I;16': '16UC1', 'I;16B': '16UC1', 'I': '16UC1'}
"""What Pillow calls the pixels of a file, and their encoding in a message."""

DAMAGED = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    EOFError,
    LookupError,
    struct.error,
    zlib.error,
)
"""What Pillow raises for bytes that are no image, or stop being one."""


def is_packed(topic: str) -> bool:
    """Return whether a topic is, by its name, one of packed images."""
    return topic.rpartition('/')[2] in TRANSPORTS


def base_topic(topic: str) -> str:
    """Return the topic of the images that a topic has packed; of others their own."""
    return topic.rpartition('/')[0] if is_packed(topic) else topic


def unpacked(msg: Any, topic: str, *, exact: bool) -> Any:
    """
    Return a sensor_msgs/Image, or what looks like one, of an image that may be packed.

    Parameters
    ----------
    msg : sensor_msgs/Image or sensor_msgs/CompressedImage
        Of any library.
    topic : str
        For errors.
    exact : bool
        Whether the values matter one by one, so that a JPEG will not do.

    Raises
    ------
    CloudFormatError
        If its bytes are no image of the format that it states.

    """
    if not hasattr(msg, 'format'):
        return msg
    encoding, _, packing = (part.strip() for part in str(msg.format).partition(';'))
    try:
        data = bytes(memoryview(msg.data))
    except (TypeError, ValueError, BufferError) as error:
        raise CloudFormatError(
            f'{topic}: data is a {type(msg.data).__name__}, expected a buffer of bytes: {error}'
        ) from error
    if packing.startswith('compressedDepth'):
        encoding, pixels = depth_of(data, encoding, packing, topic)
    else:
        encoding, pixels = pixels_of(data, topic, ('PNG',) if exact else ('PNG', 'JPEG'))
    return SimpleNamespace(
        header=msg.header,
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=pixels.reshape(-1).view(np.uint8),
    )


def depth_of(data: bytes, encoding: str, packing: str, topic: str) -> tuple[str, npt.NDArray[Any]]:
    """Return encoding and pixels of what compressedDepth has packed."""
    if packing.endswith('rvl') or encoding not in ('16UC1', '32FC1'):
        raise CloudFormatError(
            f'{topic}: format {encoding}; {packing}, expected a png of 16UC1 or 32FC1; set '
            '.compressedDepth.format of the publisher to png'
        )
    if len(data) < DEPTH_HEADER.itemsize:
        raise CloudFormatError(f'{topic}: {len(data)} bytes, expected a header and a PNG')
    header = np.frombuffer(data, DEPTH_HEADER, 1)[0]
    found, steps = pixels_of(data[DEPTH_HEADER.itemsize :], topic, ('PNG',))
    if found != '16UC1':
        raise CloudFormatError(f'{topic}: a PNG of {found}, expected one of 16 bits')
    if encoding == '16UC1':
        return encoding, steps
    scale, offset = header['quantum']
    with np.errstate(all='ignore'):
        depth = scale / (steps.astype(np.float32) - offset)
    return encoding, np.where((steps > 0) & np.isfinite(depth), depth, np.float32(np.nan))


def pixels_of(data: bytes, topic: str, formats: tuple[str, ...]) -> tuple[str, npt.NDArray[Any]]:
    """Return encoding and pixels of a file, (H, W) or (H, W, 3), little-endian."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=formats) as image:
            width, height = image.size
            if width * height > MAX_PIXELS:
                raise ValueError(f'{width} x {height} pixels, more than {MAX_PIXELS}')
            shown = image if image.mode in ENCODINGS else image.convert('RGB')
            pixels = np.asarray(shown)
    except (*DAMAGED, Image.DecompressionBombError) as error:
        expected = ' or '.join(formats)
        raise CloudFormatError(f'{topic}: no {expected} that can be read: {error}') from error
    encoding = ENCODINGS[shown.mode]
    return encoding, np.ascontiguousarray(pixels, '<u2' if encoding == '16UC1' else 'u1')
