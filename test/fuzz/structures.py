# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Harnesses that build well-formed files from choices, with sizes and counts that do not agree.

Mutated bytes rarely survive a checksum or a decompressor. Here checksums are right and packed data
unpacks, so that the readers reach the false sizes: in headers of arrays and images, in chunks,
in footers, in aliases.
"""

from __future__ import annotations

import bz2
import contextlib
from functools import cache
import io
import json
from pathlib import Path
import sqlite3
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
from surfel_mapper.messages.pointcloud2 import MAX_FIELDS, parse_cloud, to_scan
from surfel_mapper.offline.datasets import find_dataset
from test.bags.recorded import CLOUD, Entries
from test.fuzz.files import folder, read_bag, read_state, refused, timed_read
from test.fuzz.messages import read
from test.fuzz.mutations import mutations
from test.fuzz.source import Source
from test.offline.dataset_folders import ALL

SIZES = (0, 1, 7, 1000, 65_536, 1 << 24, 1 << 31, 1 << 40, (1 << 63) - 1)


def record(kind: int, content: bytes) -> bytes:
    """Return a record of mcap."""
    return struct.pack('<BQ', kind, len(content)) + content


def text(content: bytes) -> bytes:
    """Return a string of mcap."""
    return struct.pack('<I', len(content)) + content


def mcap(data: bytes) -> None:
    """Read an mcap file of chunks that may state false sizes and checksums."""
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
        packed = packed_as(packing, records)
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


def ros1(data: bytes) -> None:
    """Read a ROS 1 bag whose sizes, offsets and index may not agree with its chunks."""
    source = Source(data)

    def fields(**values: bytes) -> bytes:
        parts = [name.encode() + b'=' + value for name, value in values.items()]
        return b''.join(struct.pack('<I', len(part)) + part for part in parts)

    def record1(content: bytes, **values: bytes) -> bytes:
        header = fields(**values)
        return struct.pack('<I', len(header)) + header + struct.pack('<I', len(content)) + content

    def number(value: int, code: str = '<I') -> bytes:
        if source.chance(12):
            value = source.number() % (1 << 8 * struct.calcsize(code))
        return struct.pack(code, value)

    described = fields(
        topic=b'/a', type=b'std_msgs/String', md5sum=b'x', message_definition=b'string data'
    )
    connection = record1(described, op=b'\x07', conn=struct.pack('<I', 0), topic=b'/a')
    parts, infos = [b'#ROSBAG V2.0\n', b''], []
    for _ in range(1 + source.below(4)):
        count = source.pick((1, 10, 1000))
        content = struct.pack('<I', 3) + b'abc'
        message = record1(content, op=b'\x02', conn=number(0), time=struct.pack('<II', 5, 7))
        records = connection + message * count
        packing = source.pick((b'none', b'bz2', b'lz4'))
        packed = packed_as(packing, records)
        size = source.pick(SIZES) % 2**32 if source.chance(4) else len(records)
        at = sum(map(len, parts)) + HEADER_BYTES
        parts.append(
            record1(packed, op=b'\x05', compression=packing, size=struct.pack('<I', size))
        )
        info = {'ver': number(1), 'chunk_pos': number(at, '<Q'), 'count': number(1)}
        span = {'start_time': number(5, '<Q'), 'end_time': number(5, '<Q')}
        counts = struct.pack('<I', 0) + number(count)
        infos += [record1(counts, op=b'\x06', **info, **span)] * source.pick((1, 1, 1, 40))
    index_at = sum(map(len, parts)) + HEADER_BYTES
    counts = {'conn_count': number(1), 'chunk_count': number(len(infos))}
    header = fields(op=b'\x03', index_pos=number(index_at, '<Q'), **counts)
    padding = bytes(HEADER_BYTES - 8 - len(header))
    parts[1] = struct.pack('<I', len(header)) + header + struct.pack('<I', len(padding)) + padding
    content = b''.join([*parts, connection, *infos])
    if source.chance(4):
        content = content[: len(content) - source.below(200)]
    refused(read_bag, 'structure.bag', content)


HEADER_BYTES = 4096
"""Size of the first record of a ROS 1 bag, with its padding."""


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


DATABASE = """
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,
offered_qos_profiles TEXT);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);
"""

STATEMENTS = (
    'CREATE VIEW schema AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) '
    'SELECT i AS schema_version FROM n',
    'ALTER TABLE messages ADD COLUMN more BLOB AS (zeroblob(1000000000))',
    'CREATE TABLE schema(schema_version INTEGER)',
    "INSERT INTO topics VALUES (2, '/b', 7, NULL, 3)",
    "INSERT INTO topics VALUES (3, '/a', 'std_msgs/msg/String', 'cdr', '')",
    "INSERT INTO messages VALUES (100000, 9, 'text', 4)",
    'INSERT INTO messages VALUES (100001, NULL, NULL, NULL)',
    'INSERT INTO messages VALUES (100002, 1, -9223372036854775808, zeroblob(100000))',
    'CREATE INDEX by_time ON messages (timestamp)',
    'CREATE TRIGGER t AFTER INSERT ON topics BEGIN SELECT 1; END',
    'PRAGMA user_version = -1',
)


def sqlite(data: bytes) -> None:
    """Read a sqlite3 bag with rows of other types, further objects, and pages cut or changed."""
    source = Source(data)
    path = Path(folder().name, 'made.db3')
    path.unlink(missing_ok=True)
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute(f'PRAGMA page_size = {source.pick((512, 4096, 65536))}')
        database.executescript(DATABASE)
        row = (1, '/a', 'std_msgs/msg/String', source.pick(('cdr', 'cdr', 'json')), '')
        database.execute('INSERT INTO topics VALUES (?, ?, ?, ?, ?)', row)
        content = bytes(source.pick((0, 9, 5000, 100_000)))
        stamps = (source.pick((5, 2**63 - 1, -1)) for _ in range(source.pick((0, 3, 100))))
        for stamp in stamps:
            database.execute('INSERT INTO messages VALUES (NULL, 1, ?, ?)', (stamp, content))
        for _ in range(source.below(3)):
            with contextlib.suppress(sqlite3.Error):
                database.execute(source.pick(STATEMENTS))
        database.commit()
    changed = bytearray(path.read_bytes())
    for _ in range(source.below(4)):
        at = source.below(1 << 16) % len(changed)
        changed[at] = source.below(256)
    if source.chance(4):
        del changed[source.below(1 << 16) % len(changed) :]
    refused(read_bag, 'structure.db3', bytes(changed))


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
    with timed_read(len(message.data)), contextlib.suppress(CloudFormatError):
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
    with timed_read(path.stat().st_size), contextlib.suppress(SurfelMapperError):
        read_map(path)


ITEMS = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
"""NumPy types of the datatypes of a PointField."""


def cloud(data: bytes) -> None:
    """
    Read a cloud of up to some thousand points and fields, whose sizes may not agree.

    Where they agree, the coordinates are those that NumPy reads at the same places.
    """
    source = Source(data)
    store = Entries()
    wide = source.pick(('f4', 'f8'))
    fields, offset = [], source.pick((0, 0, 3))
    others = source.pick((0, 1, 5, 60, 1021, 1022))
    false = 3 + others > MAX_FIELDS
    for number in range(3 + others):
        name = (
            'xyz'[number] if number < 3 else source.pick((f'c{number}', 'a' * 300 + str(number)))
        )
        code = 7 + (wide == 'f8') if number < 3 else 1 + source.below(8)
        count = 1 if number < 3 else source.pick((1, 1, 2, 30))
        place = offset
        if source.chance(200):
            false = True
            name, code = source.pick(('x', '', 'c3')), source.below(12)
            place, count = source.number() % 2**32, source.pick(SIZES) % 2**32
        fields.append(
            store.make(
                'sensor_msgs/msg/PointField', name=name, offset=place, datatype=code, count=count
            )
        )
        offset += np.dtype(ITEMS.get(code, 'u1')).itemsize * min(count, 30)
    sizes = {
        'height': source.pick((1, 1, 16)),
        'width': source.pick((0, 1, 100, 4000)),
        'point_step': offset + source.pick((0, 0, 5)),
    }
    sizes['width'] = min(sizes['width'], (1 << 20) // (sizes['height'] * offset))
    sizes['row_step'] = sizes['width'] * sizes['point_step'] + source.pick((0, 0, 7))
    content = np.resize(np.arange(251, dtype=np.uint8), sizes['row_step'] * sizes['height'])
    if source.chance(4):
        false = True
        name = source.pick(sorted(sizes))
        sizes[name] = source.pick(SIZES) % 2**32
    if source.chance(8):
        false = True
        content = content[: source.below(1 << 16)]
    big = source.chance(3)
    message = store.make(
        CLOUD,
        header=store.header(5, 'lidar'),
        fields=fields,
        is_bigendian=big,
        data=content,
        is_dense=True,
        **sizes,
    )
    raw = bytes(store.store.serialize_cdr(message, CLOUD))
    scan = None
    with timed_read(len(raw)), contextlib.suppress(SurfelMapperError):
        scan = to_scan(parse_cloud(raw))
        read(scan)
    if not false:
        assert scan is not None
        order = '>' if big else '<'
        layout = np.dtype(
            {
                'names': ['x', 'y', 'z'],
                'formats': [order + wide] * 3,
                'offsets': [field.offset for field in fields[:3]],
                'itemsize': sizes['point_step'],
            }
        )
        used = sizes['width'] * sizes['point_step']
        rows = content.reshape(sizes['height'], -1)[:, :used].tobytes()
        expected = np.frombuffer(rows, layout)
        for axis, name in enumerate('xyz'):
            np.testing.assert_array_equal(scan.points[:, axis], expected[name])


@cache
def data_sets() -> list[tuple[Path, list[Path]]]:
    """Return a small folder of each data set, and its files."""
    found = []
    for make in ALL:
        root = Path(folder().name, make.__name__)
        root.mkdir()
        path, _, _ = make(root)
        found.append((path, sorted(file for file in root.rglob('*') if file.is_file())))
    return found


def data_set(data: bytes) -> None:
    """Read the folder of a data set, one file of which is changed."""
    source = Source(data)
    path, files = source.pick(data_sets())
    file = source.pick(files)
    original = file.read_bytes()
    *_, content = mutations([original], 1, seed=source.below(1 << 16))
    if file.suffix == '.json' and source.chance(4):
        content = b'[' + source.pick((b'{},', b'[],', b'"",', b'0,')) * 100_000 + b'0]'
    file.write_bytes(content)
    try:
        size = sum(each.stat().st_size for each in files)
        with timed_read(size), contextlib.suppress(SurfelMapperError):
            found = find_dataset(path)
            for each in found.files if found is not None else []:
                found.read(each)
    finally:
        file.write_bytes(original)
