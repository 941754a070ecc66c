# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Bounded decompression: chunks of bags (zstd, lz4, bz2), and messages and files packed with zstd.

Data is unpacked piece by piece. So a truncated input yields everything before the cut, and no
output gets larger than it claims to be or than its packed size makes plausible: a few kilobytes
of zstd can be made to unpack to gigabytes. The modules for zstd and lz4 come with rosbags.
"""

from __future__ import annotations

import bz2
from collections.abc import Callable
from pathlib import Path
import sys
from typing import Any

from surfel_mapper.errors import BagError, DependencyError

PIECE_BYTES = 1 << 16

MAX_UNPACKED_BYTES = 1 << 30
"""Limit of an unpacked chunk or message; real ones have some megabytes."""

FLOOR_BYTES = 1 << 26
"""Always allow 64 MiB, whatever the ratio: a chunk of black images packs very small."""

MAX_RATIO = 100
"""Limit of the compression ratio above FLOOR_BYTES."""

ZSTD_HEAD_BYTES = 18
ZSTD_BLOCK_BYTES = 1 << 17

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
"""How a zstd frame begins; no CDR message does."""


def unpacked(packed: bytes, compression: str, size: int) -> bytes:
    """
    Return packed bytes unpacked: ``size`` bytes, or fewer if the input ends or is damaged before.

    Raises
    ------
    ValueError
        If the compression is unknown, or ``size`` is not plausible for the packed size.

    """
    limit = max_unpacked_bytes(len(packed))
    if size > limit:
        raise ValueError(f'{size} bytes of a chunk, expected at most {limit}')
    if not compression or compression == 'none':
        return packed[:size]
    machine = decompressor(compression)
    content = bytearray()
    for start in range(0, len(packed), PIECE_BYTES):
        piece = packed[start : start + PIECE_BYTES]
        while True:
            try:
                content += machine.decompress(piece, min(size - len(content), PIECE_BYTES * 16))
            except Exception:  # each library has errors of its own
                return bytes(content)  # the part before the damage; callers compare the size
            if machine.eof or len(content) >= size:
                return bytes(content)
            if machine.needs_input:
                break
            piece = b''
    return bytes(content)


def unpacked_message(packed: bytes | memoryview) -> bytes:
    """Return a message that the recorder packed with zstd."""
    machine = decompressor('zstd')
    content: bytes = machine.decompress(bytes(packed), max_unpacked_bytes(len(packed)))
    if not machine.eof:
        raise ValueError('packed message truncated, or too large')
    return content


def unpack_file(path: Path, target: Path) -> bool:
    """
    Unpack a file that the recorder packed with zstd; return whether it was complete.

    Raises
    ------
    BagError
        If it is not zstd, damaged before its end, or unpacks to more than is plausible.

    """
    with open(path, 'rb') as source, open(target, 'wb') as sink:
        machine, left = decompressor('zstd'), max_unpacked_file_bytes(path.stat().st_size)
        packed = source.read(PIECE_BYTES)
        while packed or not (machine.needs_input or machine.eof):
            if machine.eof:  # the next frame
                machine = decompressor('zstd')
            try:
                piece = machine.decompress(packed, PIECE_BYTES * 16)
            except Exception as error:
                raise BagError(f'{path}: cannot be unpacked: {error}') from error
            left -= sink.write(piece)
            if left < 0:
                raise BagError(f'{path}: unpacks to more than is plausible for its size')
            packed = machine.unused_data if machine.eof else b''
            if not packed and (machine.eof or machine.needs_input):
                packed = source.read(PIECE_BYTES)
        return bool(machine.eof)


def max_unpacked_bytes(packed_size: int) -> int:
    """Return the limit of an unpacked chunk or message, in memory."""
    return min(max(FLOOR_BYTES, MAX_RATIO * packed_size), MAX_UNPACKED_BYTES)


def max_unpacked_file_bytes(packed_size: int) -> int:
    """Return the limit of an unpacked file, on the disk."""
    return max(FLOOR_BYTES, MAX_RATIO * packed_size)


def bunzip2(packed: bytes) -> bytes:
    """Return bz2 unpacked, or raise ValueError if it is truncated or too large."""
    machine, limit = bz2.BZ2Decompressor(), max_unpacked_bytes(len(packed))
    content = machine.decompress(packed, limit)
    if not machine.eof:
        raise ValueError(f'chunk truncated, or larger than {limit} bytes')
    return content


def check_zstd(read: Callable[[int, int], bytes], start: int, size: int) -> None:
    """
    Refuse a zstd chunk that may unpack to more than its packed size makes plausible.

    A frame consists of blocks of at most 128 KiB, and their headers give an upper bound of the
    size without unpacking anything.

    Parameters
    ----------
    read : callable
        Called with offset and length, returns bytes of the file.
    start, size : int
        Offset and length of the chunk.

    Raises
    ------
    ValueError
        If it may unpack to more than ``max_unpacked_bytes``.

    """
    limit, total, end = max_unpacked_bytes(size), 0, start + size
    at = start
    while at < end:
        head = read(at, ZSTD_HEAD_BYTES)
        if head[:4] != ZSTD_MAGIC:
            return  # rosbags refuses or skips the rest
        flags = head[4]
        is_single, has_checksum = flags >> 5 & 1, flags >> 2 & 1
        at += 5 + (not is_single) + (0, 1, 2, 4)[flags & 3] + (is_single, 2, 4, 8)[flags >> 6]
        is_last = False
        while not is_last:
            block = int.from_bytes(read(at, 3), 'little')
            is_last, kind, length = bool(block & 1), block >> 1 & 3, block >> 3
            total += length if kind < 2 else ZSTD_BLOCK_BYTES
            at += 3 + (1 if kind == 1 else length)
            if total > limit:
                raise ValueError(f'chunk of {size} bytes that may unpack to over {limit}')
            if at >= end:
                return
        at += 4 * has_checksum


def decompressor(compression: str) -> Any:
    """Return a decompressor with the interface of bz2.BZ2Decompressor."""
    if compression == 'bz2':
        return bz2.BZ2Decompressor()
    if compression == 'zstd':
        return import_zstd().ZstdDecompressor()
    if compression == 'lz4':
        from lz4.frame import LZ4FrameDecompressor

        return LZ4FrameDecompressor()
    raise ValueError(f'compression {compression!r}, expected zstd, lz4, bz2 or none')


def import_zstd() -> Any:
    """Return the module for zstd: Python's own from 3.14 on, before that its backport."""
    try:
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
    except ImportError as error:
        raise DependencyError(
            f'backports.zstd cannot be loaded ({error}). It unpacks compressed bags; install it '
            'with `pip install backports.zstd`'
        ) from error
    return zstd
