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
import os
from pathlib import Path
import sys
from typing import Any, BinaryIO

from surfel_mapper.budget import limit_for, open_regular, stated_limit
from surfel_mapper.errors import BagError, DependencyError

PIECE_BYTES = 1 << 16

AT_ONCE_BYTES = 1 << 24
"""Limit of chunks unpacked in one piece, a fifth faster; recorders write some megabytes."""

MAX_UNPACKED_BYTES = 1 << 29
"""Limit of an unpacked chunk or message of any file; real ones have some megabytes."""

FLOOR_BYTES = 1 << 26
"""Always allow 64 MiB, whatever the ratio: a chunk of black images packs very small."""

MAX_FILE_RATIO = 100
"""Limit of the compression ratio of a whole file, above FLOOR_BYTES."""

MAX_FRAMES, LEAST_FRAME_BYTES = 1000, 1 << 12
"""Frames that a file may have, and bytes of it for each more; one takes 12 us to begin, and the
recorder writes a single one."""

SLOW_FLOOR_BYTES = 1 << 24
"""The same as FLOOR_BYTES for the chunks of a file in bz2, which takes 5 ns a byte; others 1."""

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
"""How a zstd frame begins; no CDR message does."""


def unpacked(packed: bytes, compression: str, size: int) -> bytes | bytearray:
    """
    Return packed bytes unpacked: ``size`` bytes, or fewer if the input ends or is damaged before.

    The caller has asked its budget for ``size`` bytes. Pages are taken as they are filled, and no
    second copy is made.

    Raises
    ------
    ValueError
        If the compression is unknown.

    """
    if not compression or compression == 'none':
        return packed[:size]
    if size <= AT_ONCE_BYTES and compression == 'zstd':
        whole = unpacked_at_once(packed, size)
        if whole is not None:
            return whole
    machine, content, filled = decompressor(compression), bytearray(size), 0
    for start in range(0, len(packed), PIECE_BYTES):
        piece = packed[start : start + PIECE_BYTES]
        while filled < size:
            if machine.eof:  # the next frame
                piece, machine = machine.unused_data, decompressor(compression)
                if not piece:
                    break
            try:
                part = machine.decompress(piece, min(size - filled, PIECE_BYTES * 16))
            except Exception:  # each library has errors of its own
                del content[filled:]  # the part before the damage; callers compare the size
                return content
            content[filled : filled + len(part)] = part
            filled += len(part)
            if machine.needs_input and not machine.eof:
                break
            piece = b''
    del content[filled:]
    return content


def unpacked_at_once(packed: bytes, size: int) -> bytes | None:
    """Return a frame of zstd of exactly a size, unpacked without copies; None for others."""
    machine = decompressor('zstd')
    try:
        content: bytes = machine.decompress(packed, size)
    except Exception:  # damaged: unpacked again, up to the damage
        return None
    return content if len(content) == size and machine.eof else None


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
        If it is no regular file, not zstd, damaged before its end, or unpacks to more than is
        plausible.

    """
    with open_packed(path) as source, open(target, 'wb') as sink:
        size = os.fstat(source.fileno()).st_size
        machine, left = decompressor('zstd'), max_unpacked_file_bytes(size)
        frames = MAX_FRAMES + size // LEAST_FRAME_BYTES
        packed = source.read(PIECE_BYTES)
        while packed or not (machine.needs_input or machine.eof):
            if machine.eof:
                machine, frames = decompressor('zstd'), frames - 1
            if frames < 0:
                raise BagError(f'{path}: more zstd frames than is plausible for its size')
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


def open_packed(path: Path) -> BinaryIO:
    """Return a regular file opened for reading; raise BagError for others."""
    try:
        return open_regular(path)
    except OSError as error:
        raise BagError(f'{path}: cannot be read: {error.strerror or error}') from error


def max_unpacked_bytes(packed_size: int) -> int:
    """Return the limit of an unpacked chunk or message, in memory."""
    return stated_limit() or min(limit_for(packed_size, floor=FLOOR_BYTES), MAX_UNPACKED_BYTES)


def max_unpacked_file_bytes(packed_size: int) -> int:
    """Return the limit of an unpacked file, on the disk."""
    return max(FLOOR_BYTES, MAX_FILE_RATIO * packed_size)


def max_unpacked_sum(packed_size: int, compression: str) -> int:
    """Return the limit of all unpacked chunks of a file together, which are unpacked in turn."""
    floor = SLOW_FLOOR_BYTES if compression == 'bz2' else FLOOR_BYTES
    return max(floor, MAX_FILE_RATIO * max(packed_size, stated_limit()))


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
