# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Unpacking what bags pack: chunks with zstd, lz4 or bz2, messages and whole files with zstd.

All of it goes piece by piece, so that of bytes that end too early everything before the end is
had, and so that nothing gets larger than it claims to be, nor than its size makes plausible:
a few kilobytes of zstd unpack to gigabytes if they are made for it. zstd and lz4 are what rosbags
brings.
"""

from __future__ import annotations

import bz2
from collections.abc import Callable
from pathlib import Path
import sys
from typing import Any

from surfel_mapper.errors import BagError, DependencyError

PIECE_BYTES = 1 << 16

MOST_BYTES = 1 << 30
"""What claims or turns out to be larger is damaged: chunks and messages have some megabytes."""

FREE_BYTES = 1 << 26
"""So much may come out of whatever is packed: a chunk of images that are black all over."""

MAX_RATIO = 1000
"""Beyond that, what is packed gets at most so many times larger."""

ZSTD_HEAD_BYTES = 18
ZSTD_BLOCK_BYTES = 1 << 17

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
"""How a zstd frame begins; no CDR message does."""


def unpacked(packed: bytes, compression: str, most: int) -> bytes:
    """
    Return packed bytes unpacked, as far as they go and no more than ``most``.

    Raises
    ------
    ValueError
        If the compression is unknown, or ``most`` beyond all reason.

    """
    limit = most_bytes(len(packed))
    if most > limit:
        raise ValueError(f'{most} bytes of a chunk, expected at most {limit}')
    if not compression or compression == 'none':
        return packed[:most]
    machine = decompressor(compression)
    parts, size = [], 0
    for start in range(0, len(packed), PIECE_BYTES):
        piece = packed[start : start + PIECE_BYTES]
        while True:
            try:
                parts.append(machine.decompress(piece, min(most - size, PIECE_BYTES * 16)))
            except Exception:  # each library has errors of its own
                return b''.join(parts)  # what was whole counts; the caller compares the size
            size += len(parts[-1])
            if machine.eof or size >= most:
                return b''.join(parts)
            if machine.needs_input:
                break
            piece = b''
    return b''.join(parts)


def unpacked_message(packed: bytes | memoryview) -> bytes:
    """Return a message that the recorder packed with zstd."""
    machine = decompressor('zstd')
    content: bytes = machine.decompress(bytes(packed), most_bytes(len(packed)))
    if not machine.eof:
        raise ValueError('a packed message that ends too early, or never')
    return content


def unpack_file(path: Path, target: Path) -> bool:
    """
    Unpack a file that the recorder packed with zstd; return whether it was whole.

    Raises
    ------
    BagError
        If it is no such file, damaged before its end, or gets too large for its size.

    """
    with open(path, 'rb') as source, open(target, 'wb') as sink:
        machine, left = decompressor('zstd'), most_file_bytes(path.stat().st_size)
        packed = source.read(PIECE_BYTES)
        while packed or not (machine.needs_input or machine.eof):
            if machine.eof:  # frames one after the other
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


def most_bytes(packed_size: int) -> int:
    """Return how large a packed chunk or message may get, in memory."""
    return min(max(FREE_BYTES, MAX_RATIO * packed_size), MOST_BYTES)


def most_file_bytes(packed_size: int) -> int:
    """Return how large a packed file may get, on the disk."""
    return max(FREE_BYTES, MAX_RATIO * packed_size)


def bunzip2(packed: bytes) -> bytes:
    """Return bz2 unpacked, or raise ValueError where it gets too large or ends too early."""
    machine, limit = bz2.BZ2Decompressor(), most_bytes(len(packed))
    content = machine.decompress(packed, limit)
    if not machine.eof:
        raise ValueError(f'a chunk that ends too early, or is larger than {limit} bytes')
    return content


def check_zstd(read: Callable[[int, int], bytes], start: int, size: int) -> None:
    """
    Refuse a packed chunk that may unpack to more than its size makes plausible.

    A frame consists of blocks of 128 KiB at most, and their heads say how many there are; so
    nothing needs to be unpacked to bound it.

    Parameters
    ----------
    read : callable
        Gives so many bytes at a place of the file.
    start, size : int
        Where the chunk is.

    Raises
    ------
    ValueError
        If it is no zstd, or may get larger than ``most_bytes``.

    """
    limit, total, end = most_bytes(size), 0, start + size
    at = start
    while at < end:
        head = read(at, ZSTD_HEAD_BYTES)
        if head[:4] != ZSTD_MAGIC:
            return  # rosbags refuses what follows, or passes over it
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
                raise ValueError(f'a chunk of {size} bytes that may unpack to over {limit}')
            if at >= end:
                return
        at += 4 * has_checksum


def decompressor(compression: str) -> Any:
    """Return what has ``decompress``, ``eof``, ``needs_input`` and ``unused_data``."""
    if compression == 'bz2':
        return bz2.BZ2Decompressor()
    if compression == 'zstd':
        return import_zstd().ZstdDecompressor()
    if compression == 'lz4':
        from lz4.frame import LZ4FrameDecompressor

        return LZ4FrameDecompressor()
    raise ValueError(f'compression {compression!r}, expected zstd, lz4, bz2 or none')


def import_zstd() -> Any:
    """Return the module of zstd: of Python's library from 3.14 on, before that a copy of it."""
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
