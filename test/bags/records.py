# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Records of mcap, and chunks packed in each of the ways of bags."""

from __future__ import annotations

import bz2
import struct

from surfel_mapper.bags.compression import import_zstd


def record(kind: int, content: bytes) -> bytes:
    """Return a record of mcap."""
    return struct.pack('<BQ', kind, len(content)) + content


def text(content: bytes) -> bytes:
    """Return a string of mcap."""
    return struct.pack('<I', len(content)) + content


def packed_as(packing: bytes, records: bytes) -> bytes:
    """Return records packed in one of the ways of bags."""
    if packing == b'zstd':
        return import_zstd().compress(records)
    if packing == b'bz2':
        return bz2.compress(records)
    if packing == b'lz4':
        from lz4.frame import compress

        return compress(records)
    return records
