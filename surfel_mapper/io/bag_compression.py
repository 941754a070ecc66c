# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Unpacking what bags pack: chunks with zstd, lz4 or bz2, messages and whole files with zstd.

All of it goes piece by piece, so that of bytes that end too early everything before the end is
had, and so that nothing gets larger than it claims to be. zstd and lz4 are what rosbags brings.
"""

from __future__ import annotations

import bz2
from pathlib import Path
import sys
from typing import Any

from surfel_mapper.errors import BagError, DependencyError

PIECE_BYTES = 1 << 16

MOST_BYTES = 1 << 30
"""What claims or turns out to be larger is damaged: chunks and messages have some megabytes."""

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
    if most > MOST_BYTES:
        raise ValueError(f'{most} bytes of a chunk, expected at most {MOST_BYTES}')
    if not compression or compression == 'none':
        return packed[:most]
    machine = decompressor(compression)
    parts, size = [], 0
    for start in range(0, len(packed), PIECE_BYTES):
        try:
            parts.append(machine.decompress(packed[start : start + PIECE_BYTES]))
        except Exception:  # each library has errors of its own
            break  # what was whole before it counts; the caller compares the size
        size += len(parts[-1])
        if machine.eof or size >= most:
            break
    return b''.join(parts)[:most]


def unpacked_message(packed: bytes | memoryview) -> bytes:
    """Return a message that the recorder packed with zstd."""
    machine = decompressor('zstd')
    content: bytes = machine.decompress(bytes(packed), MOST_BYTES)
    if not machine.eof:
        raise ValueError('a packed message that ends too early, or never')
    return content


def unpack_file(path: Path, target: Path) -> bool:
    """
    Unpack a file that the recorder packed with zstd; return whether it was whole.

    Raises
    ------
    BagError
        If it is no such file, or damaged before its end.

    """
    with open(path, 'rb') as source, open(target, 'wb') as sink:
        machine = decompressor('zstd')
        while packed := source.read(PIECE_BYTES * 16):
            try:
                sink.write(machine.decompress(packed))
                while machine.eof and machine.unused_data:  # frames one after the other
                    packed = machine.unused_data
                    machine = decompressor('zstd')
                    sink.write(machine.decompress(packed))
            except OSError:
                raise
            except Exception as error:
                raise BagError(f'{path}: cannot be unpacked: {error}') from error
        return bool(machine.eof)


def decompressor(compression: str) -> Any:
    """Return what has ``decompress``, ``eof`` and ``unused_data`` for a compression."""
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
