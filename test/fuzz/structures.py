# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Harnesses that build well-formed files from choices, with sizes and counts that do not agree.

Mutated bytes rarely survive a checksum or a decompressor. Here checksums are right and packed data
unpacks, so that the readers reach the sizes that lie: in headers of arrays and images, in chunks,
in footers, in aliases.
"""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
import struct
from types import SimpleNamespace
import zipfile
import zlib

import numpy as np

from surfel_mapper.bags.compression import import_zstd
from surfel_mapper.config import load_config
from surfel_mapper.errors import CloudFormatError, SurfelMapperError
from surfel_mapper.files.state import content_sha256, FORMAT, VERSION
from surfel_mapper.filters.chain import Chain
from surfel_mapper.messages.compressed_image import unpacked
from test.fuzz.files import folder, read_bag, read_state, refused
from test.fuzz.source import Source

SIZES = (0, 1, 7, 1000, 65_536, 1 << 24, 1 << 31, 1 << 40, (1 << 63) - 1)


def record(kind: int, content: bytes) -> bytes:
    """Return a record of mcap."""
    return struct.pack('<BQ', kind, len(content)) + content


def text(content: bytes) -> bytes:
    """Return a string of mcap."""
    return struct.pack('<I', len(content)) + content


def mcap(data: bytes) -> None:
    """Read an mcap file of chunks that may lie about their sizes and checksums."""
    source = Source(data)
    schema = struct.pack('<H', 1) + text(b'std_msgs/msg/String') + text(b'ros2msg') + text(b'')
    channel = struct.pack('<HH', 1, 1) + text(b'/a') + text(b'cdr') + struct.pack('<I', 0)
    parts = [b'\x89MCAP0\r\n', record(1, text(b'ros2') + text(b''))]
    for _ in range(1 + source.below(4)):
        head = struct.pack('<HIQQ', 1, 0, source.number() % 2**64, 5)
        message = record(5, head + bytes(source.pick((0, 8, 1000))))
        records = record(3, schema) + record(4, channel)
        records += message * source.pick((1, 10, 1000, 20_000))
        packing = source.pick((b'', b'zstd', b'lz4'))
        packed = records
        if packing == b'zstd':
            packed = import_zstd().compress(records)
        elif packing == b'lz4':
            from lz4.frame import compress

            packed = compress(records)
        size = source.pick(SIZES) if source.chance(4) else len(records)
        packed_size = source.pick(SIZES) if source.chance(6) else len(packed)
        checksum = source.number() % 2**32 if source.chance(4) else zlib.crc32(records)
        chunk = struct.pack('<QQQI', 5, 5, size, checksum) + text(packing)
        chunk = record(6, chunk + struct.pack('<Q', packed_size) + packed)
        parts += [chunk] * source.pick((1, 1, 3))
    content = b''.join(parts)
    if source.chance(3):
        content = content[: len(content) - source.below(200)]
    refused(read_bag, 'structure.mcap', content)


def png(data: bytes) -> None:
    """Decode a PNG whose header may state more pixels than it has."""
    source = Source(data)

    def chunk(kind: bytes, content: bytes) -> bytes:
        checksum = zlib.crc32(kind + content)
        return struct.pack('>I', len(content)) + kind + content + struct.pack('>I', checksum)

    width, height = (source.pick((1, 40, 3000, 60_000, 2**31 - 1)) for _ in range(2))
    depth, color = source.pick(((8, 0), (16, 0), (8, 2), (8, 3), (1, 0), (8, 6)))
    header = struct.pack('>IIBBBBB', width, height, depth, color, 0, 0, source.below(2))
    pixels = zlib.compress(bytes(min(width * height, source.pick((0, 1000, 10**7)))))
    parts = [b'\x89PNG\r\n\x1a\n', chunk(b'IHDR', header)]
    if source.chance(3):
        parts.append(chunk(b'zTXt', b'a\0\0' + zlib.compress(bytes(10**7))))
    parts += [chunk(b'IDAT', pixels)] * source.pick((1, 1, 5)) + [chunk(b'IEND', b'')]
    size = (40, 40) if source.chance(2) else None
    message = SimpleNamespace(header=None, format='png', data=b''.join(parts))
    with contextlib.suppress(CloudFormatError):
        unpacked(message, '/image', exact=True, size=size)


def yaml(data: bytes) -> None:
    """Read settings and chains of filters with anchors, aliases and nesting."""
    source = Source(data)
    lines = []
    for number in range(1 + source.below(30)):
        item = source.pick(('1', '{a: 1}', '[' + ', '.join('1' * source.below(2000)) + ']'))
        if source.chance(2) and number:
            item = ', '.join([f'*a{source.below(number)}'] * source.pick((1, 100, 5000)))
            item = f'[{item}]'
        depth = source.pick((0, 1, 40, 400))
        anchor = f'&a{number} ' if source.chance(2) else ''
        lines.append(f'- {anchor}{"[" * depth}{item}{"]" * depth}')
    content = '\n'.join(lines).encode()
    refused(load_config, 'structure.yaml', content)
    refused(Chain.load, 'structure.yaml', content)


def npz(data: bytes) -> None:
    """Read a state whose arrays state other shapes than they have, with the right hash."""
    source = Source(data)
    arrays, entries, members = [], [], {}
    for name in ('map.key', 'map.count', 'scans.pose')[: 1 + source.below(3)]:
        array = np.zeros(source.pick((0, 5, 4000)), source.pick(('<i8', '<f8', '|u1')))
        file = io.BytesIO()
        np.lib.format.write_array(file, array, allow_pickle=False)
        content = file.getvalue()
        shape = [source.pick(SIZES)] if source.chance(3) else list(array.shape)
        if source.chance(3):
            lie = str((source.pick(SIZES),)).encode()
            content = content.replace(str(array.shape).encode(), lie.ljust(len(lie)), 1)
        members[name] = content
        arrays.append(array)
        entries.append({'name': name, 'dtype': array.dtype.str, 'shape': shape})
    attributes = {'kind': 'surfel map', 'voxel_size_m': 0.5, 'level': 0, 'columns': []}
    if source.chance(4):
        attributes['columns'] = ['x' * 1000] * source.pick((1, 1000))
    manifest = {
        'format': FORMAT,
        'version': VERSION,
        'attributes': attributes,
        'arrays': entries,
    }
    manifest['sha256'] = content_sha256(manifest, arrays)
    path = Path(folder().name, 'structure.npz')
    kind = zipfile.ZIP_DEFLATED * source.below(2)
    with zipfile.ZipFile(path, 'w', kind) as archive:
        archive.writestr('manifest.json', json.dumps(manifest))
        for name, content in members.items():
            archive.writestr(f'{name}.npy', content)
    read_state(path)


def parquet(data: bytes) -> None:
    """Read a map in Parquet with columns of other types, or of many equal rows."""
    import pyarrow
    from pyarrow import parquet as pq

    from surfel_mapper.files.parquet import read_map
    from test.fuzz import corpus

    source = Source(data)
    path = Path(folder().name, 'structure.parquet')
    path.write_bytes(corpus.parquet()[0])
    table = pq.read_table(path)
    if source.chance(2):
        table = table.take(np.zeros(source.pick((1, 1000, 20_000, 170_000)), np.int64))
    if source.chance(2):
        name = source.pick(table.column_names)
        values = source.pick(([None], ['x' * 1000], [[1]], [0.5], [True])) * len(table)
        table = table.set_column(table.column_names.index(name), name, pyarrow.array(values))
    options = {'compression': source.pick(('zstd', 'snappy', 'none'))}
    groups = source.pick((1, min(len(table), 100)))
    pq.write_table(table, path, row_group_size=-(-len(table) // groups), **options)
    with contextlib.suppress(SurfelMapperError):
        read_map(path)
