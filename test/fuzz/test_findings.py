# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Minimal inputs of faults that fuzzing and reviews found."""

from __future__ import annotations

import bz2
import contextlib
from dataclasses import replace
from importlib.util import find_spec
import io
import os
from pathlib import Path
import sqlite3
import struct
import time
import tracemalloc
from types import SimpleNamespace

import numpy as np
from PIL import Image
import pytest

from surfel_mapper import budget
from surfel_mapper.bags import chunked
from surfel_mapper.bags import compression as bag_compression
from surfel_mapper.bags.compression import import_zstd, unpack_file, unpacked
from surfel_mapper.bags.paths import files_of
from surfel_mapper.bags.reader import BagReader
from surfel_mapper.budget import VARIABLE
from surfel_mapper.config import load_config, TsdfConfig
from surfel_mapper.errors import (
    BagError,
    CloudFormatError,
    ConfigError,
    FileFormatError,
    MapError,
    MapLimitError,
    PoseError,
    SurfelMapperError,
)
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.map_state import load_map, save_map
from surfel_mapper.files.obj import read_obj
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.files.state import load_state, save_state
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.files.tsdf_state import load_tsdf
from surfel_mapper.filters.chain import Chain
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.messages.compressed_image import unpacked as unpacked_image
from surfel_mapper.messages.pointcloud2 import Field, to_scan
from surfel_mapper.offline.datasets import content_of
from surfel_mapper.poses import buffer as buffer_module
from surfel_mapper.simulation.world import World
from surfel_mapper.viz.contents import contents
from test import extras
from test.bags import recorded
from test.fuzz import corpus
from test.fuzz.memory import reset_peak, resident

LAUGHS = 'a0: &a0 [x, x]\n' + ''.join(
    f'a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n' for i in range(1, 40)
)
"""A YAML file that expands to 3^39 texts."""


@pytest.mark.parametrize(
    'text',
    [
        LAUGHS,
        'a: &a {b: *a}',
        '[' * 500,
        '- ' * 500,
        'map: {voxel_size_m: 2001-99-99}',
        'map: {voxel_size_m: 0b_}',
    ],
    ids=['laughs', 'itself', 'brackets', 'dashes', 'date', 'binary'],
)
def test_yaml_that_expands_or_is_malformed_is_refused(tmp_path, text):
    path = tmp_path / 'metadata.yaml'
    path.write_text(text)
    with pytest.raises(ConfigError, match=r'metadata\.yaml'):
        load_config(path)
    with pytest.raises(BagError, match='not the metadata'):
        files_of(tmp_path)
    with pytest.raises(ConfigError, match=r'metadata\.yaml'):
        Chain.load(path)


@pytest.mark.parametrize(
    ('text', 'problem'),
    [
        ('map: {voxel_size_m: ' + '1:' * 300_000 + '1}', 'over 4300 digits in line 1'),
        ('map: [' + '1, ' * 300_000 + '1]', 'over 20000 nodes in line 1'),
    ],
    ids=['base 60', 'nodes'],
)
def test_yaml_that_takes_long_is_refused(tmp_path, text, problem):
    """A number of base 60 takes hours, a node of a list 10 us."""
    path = tmp_path / 'a.yaml'
    path.write_text(text)
    start_s = time.thread_time()
    with pytest.raises(ConfigError, match=problem):
        load_config(path)
    assert time.thread_time() - start_s < 1.0


def test_aliases_are_allowed_in_yaml(tmp_path):
    path = tmp_path / 'a.yaml'
    path.write_text('- &a {range_limit: {min_m: 2}}\n- *a\n')
    assert len(Chain.load(path)) == 2


def test_one_long_number_in_a_text_does_not_multiply_memory(tmp_path):
    path = tmp_path / 'a.ply'
    number = 20_000
    head = f'ply\nformat ascii 1.0\nelement vertex {number}\nproperty float x\nend_header\n'
    path.write_text(head + '1 ' * (number - 1) + '0' * 50_000 + '\n')
    tracemalloc.start()
    try:
        assert ply.read_points(path)['x'].sum() == number - 1
        assert tracemalloc.get_traced_memory()[1] < 20_000_000  # was 1 GB
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize('encoding', ['binary', 'ascii', 'binary_compressed'])
def test_a_pcd_of_no_fields_is_refused(tmp_path, encoding):
    path = tmp_path / 'a.pcd'
    head = f'FIELDS\nSIZE\nTYPE\nCOUNT\nPOINTS {10**30}\nDATA {encoding}\n'
    path.write_bytes(head.encode() + bytes(8))
    with pytest.raises(FileFormatError, match='no fields'):
        pcd.read_points(path)


def test_a_map_without_its_digest_is_refused(tmp_path):
    path = tmp_path / 'a.npz'
    save_map(path, *corpus.small_map())
    arrays, attributes = load_state(path)
    del attributes['digest']
    save_state(path, arrays, attributes)
    with pytest.raises(FileFormatError, match='expected None'):
        load_map(path)


@pytest.mark.parametrize('level', [2**70, 21, -1, 0.5, 1.0])
def test_a_map_of_an_invalid_level_is_refused(tmp_path, level):
    path = tmp_path / 'a.npz'
    save_map(path, *corpus.small_map())
    arrays, attributes = load_state(path)
    save_state(path, arrays, {**attributes, 'level': level})
    with pytest.raises(FileFormatError, match='damaged'):
        load_map(path)


def test_a_tsdf_whose_arrays_are_single_numbers_is_refused(tmp_path):
    path = tmp_path / 'a.npz'
    path.write_bytes(corpus.tsdf())
    arrays, attributes = load_state(path)
    save_state(path, {**arrays, 'index': np.int64(1)}, attributes)
    with pytest.raises(FileFormatError, match='damaged'):
        load_tsdf(path, TsdfConfig())


@pytest.fixture
def little(monkeypatch):
    """Lower the limits to 1 MiB, so that test bombs are small."""
    monkeypatch.setenv(VARIABLE, str(1 << 20))
    monkeypatch.setattr(bag_compression, 'FLOOR_BYTES', 1 << 20)


def peak_of(function):
    """Return the exception of a function and its peak of traced memory."""
    tracemalloc.start()
    try:
        with pytest.raises((BagError, FileFormatError, ValueError)) as raised:
            function()
        return raised.value, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize('packing', ['zstd', 'bz2'])
def test_a_chunk_that_claims_to_be_small_takes_little_memory(little, packing):
    content = bytes(50_000_000)
    packed = import_zstd().compress(content) if packing == 'zstd' else bz2.compress(content)
    tracemalloc.start()
    try:
        assert unpacked(packed, packing, 1000) == bytes(1000)
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize('packing', ['zstd', 'bz2', 'lz4'])
def test_a_chunk_of_several_frames_is_unpacked_whole(packing):
    from lz4.frame import compress

    compress = {'zstd': import_zstd().compress, 'bz2': bz2.compress, 'lz4': compress}[packing]
    parts = [bytes([i]) * 300_000 for i in range(3)]
    packed, size = b''.join(map(compress, parts)), 900_000
    assert unpacked(packed, packing, size) == b''.join(parts)
    assert unpacked(packed, packing, size + 1) == b''.join(parts)
    assert unpacked(packed, packing, size - 1) == b''.join(parts)[:-1]
    assert b''.join(parts).startswith(unpacked(packed[:-9], packing, size))


def test_unpacking_a_file_stops_at_the_plausible_size(little, tmp_path):
    path = tmp_path / 'a.mcap.zstd'
    path.write_bytes(import_zstd().compress(bytes(50_000_000)))
    with pytest.raises(BagError, match='more than is plausible'):
        unpack_file(path, tmp_path / 'out')
    assert (tmp_path / 'out').stat().st_size < 4 << 20


def test_only_a_regular_file_is_unpacked(tmp_path):
    pipe = tmp_path / 'a.mcap.zstd'
    os.mkfifo(pipe)
    for path in (pipe, Path('/dev/zero'), tmp_path, tmp_path / 'missing'):
        with pytest.raises(BagError, match=rf'^{path}: cannot be read: '):
            unpack_file(path, tmp_path / 'out')
        assert not (tmp_path / 'out').exists()


def test_a_file_of_several_frames_is_unpacked_whole(tmp_path):
    path, target = tmp_path / 'a.mcap.zstd', tmp_path / 'out'
    parts = [bytes([i]) * 300_000 for i in range(3)]
    path.write_bytes(b''.join(import_zstd().compress(part) for part in parts))
    assert unpack_file(path, target)
    assert target.read_bytes() == b''.join(parts)
    path.write_bytes(path.read_bytes()[:-3])
    assert not unpack_file(path, target)


@pytest.mark.skipif(find_spec('mcap') is None, reason='mcap is not installed')
def test_a_bomb_in_a_chunk_of_mcap_is_refused_before_unpacking(little, tmp_path):
    from mcap.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start('ros2', '')
    channel = writer.register_channel(
        '/a', 'cdr', writer.register_schema('a/msg/A', 'ros2msg', b'')
    )
    writer.add_message(channel, 1, bytes(30_000_000), 1)
    writer.finish()
    path = tmp_path / 'a.mcap'
    path.write_bytes(stream.getvalue())
    del stream, writer
    error, peak = peak_of(lambda: BagReader(path))
    assert 'more than the limit of 10' in str(error)
    assert peak < 10_000_000


def test_a_bomb_in_a_chunk_of_ros1_is_refused_before_unpacking(little, tmp_path):
    entries = recorded.Entries(recorded.ROS1)
    entries.cloud('/points', recorded.START_NS, np.zeros((2_000_000, 3)))
    path = recorded.write_ros1(tmp_path / 'a.bag', entries, 'BZ2')
    del entries

    def read():
        with BagReader(path) as reader:
            list(reader.messages())

    error, peak = peak_of(read)
    assert 'more than the limit of 10' in str(error)
    assert peak < 10_000_000


def test_map_urls_without_a_file_name_are_refused(tmp_path):
    pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')
    from surfel_mapper.ros.map_files import path_inside

    for url in ('/', 'file:///', '.', '../../x', '//[', 'file://[x/y'):
        with pytest.raises(ConfigError, match='map_url'):
            path_inside(tmp_path, url)


def test_a_link_that_leads_to_itself_is_outside_of_the_maps(tmp_path):
    """Resolving it was an error of Python, which no caller expects."""
    pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')
    from surfel_mapper.ros.map_files import path_inside

    (tmp_path / 'loop').symlink_to('loop')
    for url in ('loop/x', 'loop/../y'):
        with pytest.raises(ConfigError, match='is not inside'):
            path_inside(tmp_path, url)


def test_the_number_of_transforms_is_limited(monkeypatch):
    monkeypatch.setattr(buffer_module, 'MAX_EDGES', 3)
    buffer = buffer_module.TransformBuffer()
    for number in range(3):
        buffer.add('odom', f'frame{number}', 1, np.eye(4))
    with pytest.raises(PoseError, match='no more are taken'):
        buffer.add('odom', 'another', 1, np.eye(4))
    buffer.add('odom', 'frame2', 2, np.eye(4))


def cloud_of(fields, points, point_step):
    """Return a PointCloud2 of one row."""
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=0), frame_id='lidar'),
        height=1,
        width=points,
        fields=fields,
        is_bigendian=True,
        point_step=point_step,
        row_step=points * point_step,
        data=bytes(points * point_step),
    )


XYZ = [Field(name, 4 * place, 7, 1) for place, name in enumerate('xyz')]


@pytest.mark.parametrize(
    'others',
    [
        [Field(f'f{i}', 12, 7, 250) for i in range(200)],
        [Field('a', 12, 8, 1), Field('b', 16, 7, 1)],
        [Field('a', 8, 7, 1)],
    ],
    ids=['all', 'partly', 'z'],
)
def test_fields_that_overlap_are_refused_before_memory_is_allocated(others):
    message = cloud_of([*XYZ, *others], 3000, 1012)
    _, peak = peak_of(lambda: to_scan(message))
    assert peak < 1_000_000  # was 1,900 times the message


def test_too_many_fields_are_refused():
    message = cloud_of([*XYZ, *(Field(f'f{i}', 12 + i, 2, 1) for i in range(1100))], 2, 2000)
    with pytest.raises(CloudFormatError, match='1103 fields, expected at most 1024'):
        to_scan(message)


def test_columns_that_are_not_read_are_not_copied():
    message = cloud_of([*XYZ, Field('big', 12, 8, 100)], 3000, 812)
    tracemalloc.start()
    try:
        scan = to_scan(message)
        assert tracemalloc.get_traced_memory()[0] < 100_000
        assert scan.columns['big'].shape == (3000, 100)
        assert tracemalloc.get_traced_memory()[0] > 2_400_000
    finally:
        tracemalloc.stop()


def test_a_path_of_hundreds_of_thousands_of_directories_is_not_resolved(tmp_path, monkeypatch):
    pytest.importorskip('rclpy')
    from surfel_mapper.ros.map_files import is_inside, path_inside

    monkeypatch.setattr(os, 'lstat', lambda path: pytest.fail('it is resolved'))
    with pytest.raises(ConfigError, match='map_url: 1048576 characters, expected 4096 at most'):
        path_inside(tmp_path, ('/oh' * 349_526)[: 1 << 20])
    long = Path('/oh' * 20_000)
    assert not is_inside(long, long / 'map.npz')


@pytest.mark.parametrize('name', ['/dev/zero', 'pipe', 'large.yaml'])
def test_settings_are_read_from_small_regular_files_only(tmp_path, name):
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'large.yaml').write_bytes(b'# ' + bytes(b'x' * (1 << 20)))
    for read in (load_config, Chain.load):
        error, peak = peak_of(lambda read=read: read(tmp_path / name))
        assert isinstance(error, ConfigError)
        assert peak < 10_000_000


def test_yaml_aliases_count_as_the_nodes_that_they_expand_to(tmp_path):
    path = tmp_path / 'a.yaml'
    anchor = '- &a {range_limit: {min_m: [' + ', '.join('1' * 1000) + ']}}\n'
    path.write_text(anchor + '- *a\n' * 30)
    with pytest.raises(ConfigError, match='aliases that expand to over 20000 nodes'):
        Chain.load(path)
    path.write_text('- &a {range_limit: {min_m: 1}}\n' + '- *a\n' * 50)
    assert len(Chain.load(path)) == 51


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('key', -1),
        ('count', 0),
        ('total', 2**40),
        ('product', -1),
        ('product', 2**50),
        ('view', 30_000),
    ],
)
def test_moments_that_no_points_have_do_not_reach_a_map(name, value):
    surfel_map = SurfelMap(0.5)
    before = surfel_map.digest()
    moments = surfel_map.reduce(np.random.default_rng(1).normal(size=(100, 3)), np.eye(4))
    forged = getattr(moments, name).astype(np.int64)
    forged.reshape(len(forged), -1)[0, 0] = value
    with pytest.raises(MapError, match='row 0 of the moments'):
        surfel_map.insert(replace(moments, **{name: forged}))
    assert surfel_map.digest() == before
    surfel_map.insert(moments)


def test_a_transposed_pose_is_refused():
    T = np.eye(4)
    T[:3, 3] = 1.0, 2.0, 3.0
    for wrong in (T.T, 2.0 * T, np.diag([1.0, 1.0, -1.0, 1.0]), T * np.nan, T[:3]):
        with pytest.raises(ValueError, match='T_map_sensor: '):
            SurfelMap(0.5).reduce(np.zeros((1, 3)), wrong)


def test_a_level_that_cannot_be_reached_is_refused_with_those_that_can():
    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.zeros((2, 3)))
    coarse = surfel_map.coarsen(13)
    with pytest.raises(ValueError, match='level: 3, expected 0 to 2 for a map of level 13'):
        coarse.coarsen(3)
    assert coarse.coarsen(2).level == 15
    assert coarse.coarsen(2).num_points == 2
    with pytest.raises(ValueError, match='level: 16, expected 0 to 15'):
        SurfelMap(0.5, level=16)


@pytest.mark.parametrize('level', [8, 14, 15])
def test_a_level_at_which_sums_would_overflow_is_refused_with_the_number_of_points(level):
    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.full((200_000, 3), 0.01))
    with pytest.raises(MapLimitError, match='a voxel would hold 200000 points'):
        surfel_map.coarsen(level)


@pytest.mark.parametrize(
    'within', ['ab', (None, None), ((0, 0), (1, 1)), ((np.nan,) * 3, (1.0,) * 3), ()]
)
def test_a_box_that_is_not_two_voxels_is_refused(within):
    with pytest.raises(ValueError, match='expected two voxel indices'):
        SurfelMap(0.5).coarsen(1, within)


@pytest.mark.parametrize('keys', [[0.5], [[0]], None, 'x'])
def test_keys_that_are_no_integers_are_refused(keys):
    with pytest.raises(TypeError, match='keys: '):
        SurfelMap(0.5).find(keys)


def mcap_of_empty_messages(num_chunks, num_messages):
    """Return an mcap file without an index, of packed chunks with small messages."""

    def record(kind, content):
        return struct.pack('<BQ', kind, len(content)) + content

    def text(content):
        return struct.pack('<I', len(content)) + content

    schema = record(3, struct.pack('<H', 1) + text(b'a/msg/A') + text(b'ros2msg') + text(b''))
    ids = struct.pack('<HH', 1, 1)
    channel = record(4, ids + text(b'/a') + text(b'cdr') + struct.pack('<I', 0))
    message = record(5, struct.pack('<HIQQ', 1, 0, 5, 5))
    records = schema + channel + message * num_messages
    packed = import_zstd().compress(records)
    head = struct.pack('<QQQI', 5, 5, len(records), 0) + text(b'zstd')
    chunk = record(6, head + struct.pack('<Q', len(packed)) + packed)
    return b'\x89MCAP0\r\n' + record(1, text(b'ros2') + text(b'')) + chunk * num_chunks


def test_a_packed_file_of_empty_frames_is_refused(tmp_path, monkeypatch):
    zstd = import_zstd()
    path, made = tmp_path / 'a.zstd', []
    begin = bag_compression.decompressor
    monkeypatch.setattr(
        bag_compression, 'decompressor', lambda kind: made.append(kind) or begin(kind)
    )
    path.write_bytes(zstd.compress(b'') * 116_000)
    with pytest.raises(BagError, match='more zstd frames than is plausible for its size'):
        unpack_file(path, tmp_path / 'a')
    assert len(made) < 2000
    path.write_bytes(zstd.compress(b'abc') * 900)
    assert unpack_file(path, tmp_path / 'a')
    assert (tmp_path / 'a').read_bytes() == b'abc' * 900


def test_a_tile_that_does_not_state_its_voxels_is_refused(tmp_path):
    """Statistics without a least value, as damage leaves them, were a TypeError."""
    parquet = extras.load('pyarrow.parquet')
    from surfel_mapper.files.parquet_tiles import dataset_digest, write_tile

    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.random.default_rng(3).uniform(-1.0, 1.0, (30, 3)))
    path = tmp_path / 'tile_i=0' / 'tile_j=0' / 'surfels.parquet'
    path.parent.mkdir(parents=True)
    write_tile(path, surfel_map)
    parquet.write_table(parquet.read_table(path, partitioning=None), path, write_statistics=False)
    with pytest.raises(FileFormatError, match='row group 0 does not state its smallest i'):
        dataset_digest(tmp_path)


def test_las_of_another_version_is_refused(tmp_path):
    """Laspy takes the count of version 1.4 by the second number, and sizes of layers are read."""
    laspy = pytest.importorskip('laspy')
    pytest.importorskip('lazrs')
    path = tmp_path / 'a.laz'
    data = laspy.LasData(laspy.LasHeader(point_format=6, version='1.4'))
    data.x = data.y = data.z = np.arange(5.0)
    data.write(str(path))
    assert read_scan(path)[0].shape == (5, 3)
    content = bytearray(path.read_bytes())
    content[24] = 0
    path.write_bytes(content)
    error, peak = peak_of(lambda: read_scan(path))
    assert 'a.laz: version 0.4, expected 1.0 to 1.4' in str(error)
    assert peak < 10_000_000


def test_chunks_of_empty_messages_are_refused_before_the_index_fills_memory(tmp_path):
    path = tmp_path / 'a.mcap'
    path.write_bytes(mcap_of_empty_messages(8, 1_900_000))
    assert path.stat().st_size < 60_000
    start_s = time.thread_time()
    reset_peak()
    before = resident('VmRSS')
    with pytest.raises(BagError, match=r'a\.mcap: index of \d+ messages: needs'):
        BagReader(path)
    assert resident('VmHWM') - before < 300 << 20  # was 3.5 GB
    assert time.thread_time() - start_s < budget.FLOOR_S  # as the reader ends itself; was 128 s


def indexed_mcap(chunks, stated, index=None):
    """Return an mcap file of packed chunks, with a summary; stated is the number of messages."""
    spans, content = [], bytearray(b'\x89MCAP0\r\n' + mcap_record(1, mcap_text(b'ros2') * 2))
    for records in chunks:
        packed = import_zstd().compress(records)
        head = struct.pack('<QQQI', 0, 100, len(records), 0) + mcap_text(b'zstd')
        spans.append((len(content), len(head) + 17 + len(packed)))
        content += mcap_record(6, head + struct.pack('<Q', len(packed)) + packed)
    content += mcap_record(15, bytes(4))
    summary_at = len(content)
    content += MCAP_SCHEMA + MCAP_CHANNEL
    share = stated // len(index or spans)
    for start, size in index or spans:
        offsets = struct.pack('<IHQ', 10, 1, start + size)
        rest = struct.pack('<Q', 15 + 16 * share) + mcap_text(b'zstd') + bytes(16)
        content += mcap_record(8, struct.pack('<QQQQ', 0, 100, start, size) + offsets + rest)
    counts = struct.pack('<IHQ', 10, 1, stated)
    content += mcap_record(11, struct.pack('<QHIIIIQQ', stated, 1, 1, 0, 0, 1, 0, 100) + counts)
    content += mcap_record(2, struct.pack('<QQI', summary_at, 0, 0))
    return bytes(content) + b'\x89MCAP0\r\n', spans


def mcap_record(kind, content):
    return struct.pack('<BQ', kind, len(content)) + content


def mcap_text(content):
    return struct.pack('<I', len(content)) + content


MCAP_SCHEMA = mcap_record(
    3, struct.pack('<H', 1) + mcap_text(b'a/msg/A') + mcap_text(b'ros2msg') + mcap_text(b'')
)
MCAP_CHANNEL = mcap_record(
    4, struct.pack('<HH', 1, 1) + mcap_text(b'/a') + mcap_text(b'cdr') + struct.pack('<I', 0)
)


def empty_messages(number, step=0, first=0):
    """Return the records of a chunk of messages without content, by record time."""
    heads = (struct.pack('<HIQQ', 1, 0, first + step * i, 5) for i in range(number))
    return MCAP_SCHEMA + MCAP_CHANNEL + b''.join(mcap_record(5, head) for head in heads)


def cost_of_reading(path):
    """Return error, or number of messages, and memory and processor time of reading a bag."""
    start_s = time.thread_time()
    reset_peak()
    before = resident('VmRSS')
    try:
        with BagReader(path) as reader:
            found = sum(1 for _ in reader.messages())
    except BagError as error:
        found = str(error)
    return found, resident('VmHWM') - before, time.thread_time() - start_s


def test_more_messages_than_a_file_has_room_for_are_refused(tmp_path):
    path = tmp_path / 'a.mcap'
    path.write_bytes(mcap_of_empty_messages(6, 20_000))
    found, _, seconds = cost_of_reading(path)
    assert 'over 100000 messages in' in found
    assert seconds < 3.0  # .2 s


def test_overlapping_chunks_of_an_indexed_mcap_are_not_held_at_once(tmp_path):
    """Rosbags unpacks all chunks of a span into lists of objects: 500 MB for each of these."""
    path = tmp_path / 'a.mcap'
    records = MCAP_SCHEMA + MCAP_CHANNEL + empty_messages(1)[-31:] * 1_900_000
    content, _ = indexed_mcap([records] * 4, 4)
    path.write_bytes(content)
    assert len(content) < 60_000
    found, used, seconds = cost_of_reading(path)
    assert 'index of' in found
    assert 'more than the limit of' in found
    assert used < 200 << 20
    assert seconds < 10.0


def test_the_same_chunk_many_times_in_the_index_is_read_once(tmp_path):
    path = tmp_path / 'a.mcap'
    content, spans = indexed_mcap([empty_messages(10_000)], 10_000)
    path.write_bytes(content)
    assert cost_of_reading(path)[0] == 10_000
    content, _ = indexed_mcap([empty_messages(10_000)], 10_000 * 1000, spans * 1000)
    path.write_bytes(content)
    found, used, _ = cost_of_reading(path)
    assert found == 10_000
    assert used < 64 << 20


def test_chunks_that_alternate_in_time_are_refused_after_the_time_of_the_file(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(chunked, 'KEPT_BYTES', 1 << 20)
    monkeypatch.setattr(budget, 'FLOOR_S', 1.0)
    path = tmp_path / 'a.mcap'
    padding = mcap_record(99, bytes(20_000_000))
    chunks = [empty_messages(20_000, 2, first) + padding for first in (0, 1)]
    path.write_bytes(indexed_mcap(chunks, 40_000)[0])
    found, _, seconds = cost_of_reading(path)
    assert 'reading took over 1.0 s' in found
    assert seconds < 3.0


def test_the_same_chunk_many_times_in_the_index_of_ros1_is_read_once(tmp_path):
    """Rosbags reads the index data of a chunk for each of its entries."""
    path = recorded.write_ros1(tmp_path / 'a.bag', corpus.small_drive(recorded.ROS1), 'BZ2')
    content = path.read_bytes()
    number = cost_of_reading(path)[0]
    (at,) = struct.unpack_from('<Q', content, content.index(b'index_pos=') + len('index_pos='))
    while at < len(content):  # the entry of the only chunk is the last record
        info = content[at:]
        (length,) = struct.unpack_from('<I', content, at)
        (size,) = struct.unpack_from('<I', content, at + 4 + length)
        at += 8 + length + size
    count_at = content.index(b'chunk_count=') + len('chunk_count=')
    forged = bytearray(content + info * 49)
    forged[count_at : count_at + 4] = struct.pack('<I', 50)
    path.write_bytes(forged)
    assert cost_of_reading(path)[0] == number


@pytest.mark.parametrize(
    ('statements', 'problem'),
    [
        (
            'DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION '
            'ALL SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id, i AS timestamp, '
            'zeroblob(1000000000) AS data FROM n',
            "view 'messages', expected tables",
        ),
        (
            'CREATE VIEW message_definitions AS SELECT 1',
            "view 'message_definitions', expected tables",
        ),
        (
            'ALTER TABLE messages RENAME COLUMN data TO old; ALTER TABLE messages ADD COLUMN data '
            'BLOB GENERATED ALWAYS AS (zeroblob(1000000000)) VIRTUAL',
            "table 'messages' has computed columns",
        ),
        ('CREATE TRIGGER t AFTER INSERT ON topics BEGIN SELECT 1; END', "trigger 't'"),
    ],
    ids=['view', 'other view', 'computed', 'trigger'],
)
def test_a_database_that_computes_its_rows_is_refused(tmp_path, statements, problem):
    path = tmp_path / 'a.db3'
    path.write_bytes(corpus.sqlite()[0])
    with contextlib.closing(sqlite3.connect(path)) as database:
        if 'message_definitions' in statements:
            database.executescript('DROP TABLE IF EXISTS message_definitions')
        database.executescript(statements)
        database.commit()
    found, used, seconds = cost_of_reading(path)
    assert problem in found
    assert used < 20 << 20
    assert seconds < 1.0


def endless(content, root):
    """Return a database whose page, a leaf, becomes a tree in which every path leads to it."""
    (page_size,) = struct.unpack_from('>H', content, 16)
    number, depth = len(content) // page_size, 8
    leaf = content[(root - 1) * page_size : root * page_size]
    is_table = leaf[0] == 13
    key = b'\x01' if is_table else b'\x03\x03\x01\x09\x05'  # an entry of timestamp 5, row 1
    children = [*range(number + 2, number + 1 + depth), number + 1]
    pages = []
    for child in children:
        cell = struct.pack('>I', child) + key
        count = 50
        start = page_size - len(cell)
        head = struct.pack('>BHHHBI', 5 if is_table else 2, 0, count, start, 0, child)
        page = bytearray(head + struct.pack('>H', start) * count)
        page += bytes(page_size - len(page))
        page[start:] = cell
        pages.append(bytes(page))
    made = bytearray(content + leaf + b''.join(pages[1:]))
    made[(root - 1) * page_size : root * page_size] = pages[0]
    struct.pack_into('>I', made, 28, len(made) // page_size)
    return bytes(made)


@pytest.fixture
def small_database(tmp_path):
    """Return a sqlite3 bag of one page a table, with the pages of table and index."""
    path = tmp_path / 'a.db3'
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.executescript(
            'CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, '
            'serialization_format TEXT); CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id '
            'INTEGER, timestamp INTEGER, data BLOB); CREATE INDEX by_time ON messages(timestamp);'
            "INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/String', 'cdr')"
        )
        rows = [(1, stamp, b'abc') for stamp in range(20, 0, -1)]
        database.executemany('INSERT INTO messages VALUES (NULL, ?, ?, ?)', rows)
        database.commit()
        roots = dict(database.execute('SELECT name, rootpage FROM sqlite_master'))
    return path, roots


def test_a_small_database_is_read_in_order_of_time(small_database):
    path, _ = small_database
    with BagReader(path) as reader:
        assert [message.record_ns for message in reader.messages()] == [*range(1, 21)]
        assert not reader.cuts


@pytest.mark.parametrize(
    ('name', 'problem'),
    [('messages', 'more messages than a file of'), ('by_time', 'reading took over 0.5 s')],
)
def test_a_database_of_rows_without_end_is_refused(small_database, monkeypatch, name, problem):
    """Rosbags counts 50^8 rows."""
    monkeypatch.setattr(budget, 'FLOOR_S', 0.5)
    path, roots = small_database
    path.write_bytes(endless(path.read_bytes(), roots[name]))
    found, used, seconds = cost_of_reading(path)
    assert problem in str(found)
    assert used < 20 << 20
    assert seconds < 3.0


def test_an_index_that_lacks_messages_is_not_used_and_told(small_database):
    path, roots = small_database
    content = bytearray(path.read_bytes())
    (page_size,) = struct.unpack_from('>H', content, 16)
    at = (roots['by_time'] - 1) * page_size + 3
    assert struct.unpack_from('>H', content, at) == (20,)
    struct.pack_into('>H', content, at, 15)
    path.write_bytes(content)
    with BagReader(path) as reader:
        assert [message.record_ns for message in reader.messages()] == [*range(1, 21)]
        (cut,) = reader.cuts
    assert "20 messages, but 15 in the index 'by_time'" in cut


def test_messages_of_unknown_topics_are_told(small_database):
    path, _ = small_database
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute('UPDATE messages SET topic_id = 2 WHERE id = 3')
        database.commit()
    with BagReader(path) as reader:
        assert sum(1 for _ in reader.messages()) == 19
        assert '1 messages are skipped, as their topic is not described' in reader.cuts[0]


def test_large_chunks_are_unpacked_one_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr(chunked, 'KEPT_BYTES', 1 << 20)
    path = tmp_path / 'a.mcap'
    path.write_bytes(mcap_of_empty_messages(4, 20_000))
    with BagReader(path) as reader:
        assert sum(1 for _ in reader.messages()) == 4 * 20_000
        ((_, storage),) = reader._storages
        assert len(storage._kept) == 1


@pytest.fixture
def parquet_map(tmp_path):
    extras.load('pyarrow')
    from surfel_mapper.files.parquet import write_map

    path = tmp_path / 'a.parquet'
    write_map(path, corpus.small_map()[0])
    return path


def rewritten(path, change):
    """Write a Parquet file again with a changed table."""
    from pyarrow import parquet

    table = parquet.read_table(path)
    parquet.write_table(change(table), path, compression='zstd')


@pytest.mark.parametrize('kind', ['float64', 'string', 'list'])
def test_columns_of_a_wrong_type_are_refused_before_they_are_read(parquet_map, kind):
    import pyarrow

    from surfel_mapper.files.parquet import read_map

    def change(table):
        place, number = table.schema.get_field_index('sum_x'), len(table)
        values = {'float64': [0.5], 'string': ['x' * 1_000_000], 'list': [[1]]}[kind] * number
        return table.set_column(place, 'sum_x', pyarrow.array(values))

    rewritten(parquet_map, change)
    with pytest.raises(FileFormatError, match=r'column sum_x: .*expected int64'):
        read_map(parquet_map)


def test_rows_that_repeat_are_refused_before_they_are_read(parquet_map):
    from surfel_mapper.files.parquet import read_map

    def change(table):
        return table.take(np.zeros(3_000_000, np.int64))

    rewritten(parquet_map, change)
    reset_peak()
    before = resident('VmRSS')
    with pytest.raises(FileFormatError, match=r'3000000 rows: needs .* more than the limit'):
        read_map(parquet_map)
    assert resident('VmHWM') - before < 64 << 20


@pytest.mark.parametrize('dtype', ['c16', 'U4', 'S4', 'O', 'M8[ns]'])
def test_arrays_of_text_and_complex_numbers_are_not_stored(tmp_path, dtype):
    with pytest.raises(ValueError, match=r'expected a name .* integers or floats'):
        save_state(tmp_path / 'a.npz', {'a': np.zeros(3, dtype)}, {})


def test_a_window_with_a_transposed_pose_is_refused(tmp_path):
    path = tmp_path / 'a.npz'
    save_map(path, *corpus.small_map())
    arrays, attributes = load_state(path)
    pose = np.eye(4)
    pose[3, :3] = 1.0, 2.0, 3.0
    save_state(path, {**arrays, 'scans.pose': pose[None]}, attributes)
    with pytest.raises(FileFormatError, match=r'pose of scan 0: .* expected a rigid transform'):
        load_map(path)


@pytest.mark.parametrize(('name', 'value'), [('total', 2**30), ('product', -1), ('view', 2**40)])
def test_a_file_of_sums_that_no_points_have_is_refused(tmp_path, name, value):
    path = tmp_path / 'a.npz'
    surfel_map, _ = corpus.small_map()
    save_map(path, surfel_map)
    arrays, attributes = load_state(path)
    forged = arrays[f'map.{name}'].copy()
    forged[0, 0] = value
    save_state(path, {**arrays, f'map.{name}': forged}, attributes)
    with pytest.raises(FileFormatError, match='damaged: row 0 of the moments'):
        load_map(path)


def png(width, height, mode='L'):
    """Return a black PNG."""
    file = io.BytesIO()
    Image.new(mode, (width, height)).save(file, 'PNG')
    return SimpleNamespace(header=None, format='mono8; png compressed', data=file.getvalue())


def test_images_are_refused_by_the_size_in_their_header():
    large = png(6000, 6000)
    assert len(large.data) < 100_000
    error, peak = peak_of(lambda: unpacked_image(large, '/image', exact=True))
    assert 'image of 6000 x 6000 pixels: needs 216000000 bytes' in str(error)
    assert peak < 10_000_000
    error, peak = peak_of(lambda: unpacked_image(large, '/image', exact=True, size=(640, 480)))
    assert 'image of 6000 x 6000 pixels, the calibration is for 640 x 480' in str(error)
    assert peak < 10_000_000


@pytest.mark.parametrize('mode', ['1', 'P', 'LA', 'RGBA', 'RGB'])
def test_images_that_are_converted_are_charged_for_it(mode):
    large, small = png(3000, 3000, mode), png(1500, 1500, mode)
    error, peak = peak_of(lambda: unpacked_image(large, '/image', exact=True))
    assert f'needs {9_000_000 * (10 if mode == "RGB" else 14)} bytes' in str(error)
    assert peak < 10_000_000
    assert unpacked_image(small, '/image', exact=True).encoding == 'rgb8'


def test_an_image_of_the_size_of_its_camera_is_decoded_however_well_it_is_packed():
    image = unpacked_image(png(4000, 3000), '/image', exact=True, size=(4000, 3000))
    assert (image.width, image.height) == (4000, 3000)


TEXT_PLY = 'ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n'
TEXT_PCD = 'VERSION 0.7\nFIELDS x\nSIZE 4\nTYPE F\nCOUNT 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA '


@pytest.mark.parametrize(
    ('name', 'content', 'problem'),
    [
        ('a.ply', TEXT_PLY + '1.25\n2.5', 'no end of line'),
        ('a.pcd', TEXT_PCD + 'ascii\n1.25\n2.5', 'no end of line'),
        ('a.ply', TEXT_PLY + '1.25\n2.5\n3.5\n', '3 numbers, expected 2'),
        ('a.pcd', TEXT_PCD.replace('WIDTH 2', 'WIDTH 3') + 'ascii\n1\n2\n', 'WIDTH 3, HEIGHT 1'),
        ('a.pcd', TEXT_PCD + 'binary\n' + 'x' * 12, '12 bytes after the header, expected 8'),
        (
            'a.ply',
            TEXT_PLY.replace('ascii', 'binary_little_endian') + 'x' * 12,
            '12 bytes after the header, expected 8',
        ),
    ],
)
def test_counts_are_compared_with_the_points_and_cut_numbers_are_refused(
    tmp_path, name, content, problem
):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(FileFormatError, match=problem):
        (ply if name == 'a.ply' else pcd).read_points(path)


def test_text_with_an_end_of_line_is_read(tmp_path):
    (tmp_path / 'a.ply').write_text(TEXT_PLY + '1.25\n2.5\n')
    (tmp_path / 'a.pcd').write_text(TEXT_PCD + 'ascii\n1.25\n2.5\n')
    for reader, name in ((ply, 'a.ply'), (pcd, 'a.pcd')):
        assert reader.read_points(tmp_path / name)['x'].tolist() == [1.25, 2.5]


@pytest.mark.parametrize(('name', 'head'), [('a.ply', TEXT_PLY), ('a.pcd', TEXT_PCD + 'ascii\n')])
def test_text_is_split_in_pieces(tmp_path, name, head):
    """Split as a whole, each digit is an object of 34 bytes, with 16 bytes of lists."""
    path, number = tmp_path / name, 300_000
    head = head.replace('vertex 2', f'vertex {number}').replace('POINTS 2', f'POINTS {number}')
    path.write_text(head.replace('WIDTH 2', f'WIDTH {number}') + '1 ' * (number - 1) + '7\n')
    tracemalloc.start()
    try:
        values = (ply if name == 'a.ply' else pcd).read_points(path)['x']
        assert tracemalloc.get_traced_memory()[1] < 12_000_000  # was 24 MB
    finally:
        tracemalloc.stop()
    assert values.sum() == number + 6


@pytest.mark.parametrize(('name', 'type_'), [('a.ply', 'uchar'), ('a.pcd', 'U')])
@pytest.mark.parametrize('number', ['300', '-1', '1.5', 'nan', '1e300'])
def test_numbers_that_a_type_cannot_hold_are_refused(tmp_path, name, type_, number):
    path = tmp_path / name
    text = TEXT_PLY.replace('float', type_) if name == 'a.ply' else TEXT_PCD + 'ascii\n'
    text = text.replace('SIZE 4\nTYPE F', f'SIZE 1\nTYPE {type_}')
    path.write_text(f'{text}9\n{number}\n')
    with pytest.raises(FileFormatError, match=r'x: .*, which uint8 cannot hold'):
        (ply if name == 'a.ply' else pcd).read_points(path)


def test_poses_take_little_more_than_their_numbers(tmp_path):
    path = tmp_path / 'poses.txt'
    path.write_text(''.join(f'{i} 0 0 0 0 0 0 1\n' for i in range(5000)))
    tracemalloc.start()
    try:
        assert len(read_trajectory(path)) == 5000
        assert tracemalloc.get_traced_memory()[1] < 1_000_000  # was 3.5 MB
    finally:
        tracemalloc.stop()


def test_a_line_of_poses_without_an_end_is_refused(tmp_path):
    path = tmp_path / 'poses.txt'
    path.write_bytes(b'1 ' * 10_000_000)
    error, peak = peak_of(lambda: read_trajectory(path))
    assert 'poses.txt:1: a line of over 65536 characters' in str(error)
    assert peak < 1_000_000
    error, peak = peak_of(lambda: read_trajectory('/dev/zero'))
    assert '/dev/zero: cannot be read: not a regular file' in str(error)
    assert peak < 1_000_000


@pytest.mark.parametrize(
    ('at', 'code', 'number', 'problem'),
    [
        (247, '<Q', 10**9, 'bytes, expected 34000000375 for 1000000000 points'),
        (100, '<I', 10**9, '1000000000 and 0 records of variable length'),
        (243, '<I', 10**9, '0 and 1000000000 records of variable length'),
    ],
    ids=['points', 'records', 'extended'],
)
def test_counts_in_the_header_of_las_are_compared_with_the_file(
    tmp_path, at, code, number, problem
):
    """Laspy loops over the records stated, and takes the points found for all."""
    laspy = pytest.importorskip('laspy')
    path = tmp_path / 'a.las'
    data = laspy.LasData(laspy.LasHeader(point_format=3, version='1.4'))
    data.x = data.y = data.z = np.arange(5.0)
    data.write(str(path))
    assert read_scan(path)[0].shape == (5, 3)
    content = bytearray(path.read_bytes())
    struct.pack_into(code, content, at, number)
    path.write_bytes(content)
    start_s = time.thread_time()
    with pytest.raises(FileFormatError, match=problem):
        read_scan(path)
    assert time.thread_time() - start_s < 0.5


@pytest.mark.parametrize(
    ('change', 'problem'),
    [
        (
            lambda c, start, table, record: struct.pack_into('<I', c, table + 4, 2**32 - 1),
            'chunks',
        ),
        (lambda c, start, table, record: struct.pack_into('<q', c, start, 2**62), 'chunks'),
        (lambda c, start, table, record: struct.pack_into('<H', c, record + 36, 2**15), 'items'),
        (lambda c, start, table, record: struct.pack_into('<I', c, start + 46, 2**31), 'layers'),
        (lambda c, start, table, record: struct.pack_into('<I', c, record + 12, 1), 'chunks of 1'),
        (lambda c, start, table, record: c.__delitem__(slice(start + 60, None)), 'chunks'),
    ],
    ids=['chunks', 'place', 'items', 'layer', 'count', 'cut'],
)
def test_sizes_in_laz_are_compared_with_the_file(tmp_path, change, problem):
    """Its decoder ended the process if it could not get the memory for the chunks stated."""
    laspy = pytest.importorskip('laspy')
    path = tmp_path / 'a.laz'
    data = laspy.LasData(laspy.LasHeader(point_format=6, version='1.4'))
    data.x = data.y = data.z = np.arange(5.0)
    data.write(str(path))
    assert read_scan(path)[0].tolist() == [[value] * 3 for value in range(5)]
    content = bytearray(path.read_bytes())
    start = struct.unpack_from('<I', content, 96)[0]
    table = struct.unpack_from('<q', content, start)[0]
    record = content.index(b'laszip encoded') + 52
    change(content, start, table, record)
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=f'^{path}: .*{problem}'):
        read_scan(path)


SHOWN = ('.obj', '.glb', '.stl', '.parquet', '.ply')
"""Files that only ``view`` reads, or reads otherwise."""

READERS = {
    'a.mcap': BagReader,
    'a.bag': BagReader,
    'a.db3': BagReader,
    'a.ply': read_scan,
    'a.pcd': read_scan,
    'a.bin': read_scan,
    'a.las': read_scan,
    'a.tum': read_trajectory,
    'a.npz': load_map,
    **{f'b{suffix}': lambda path: list(contents(path)) for suffix in SHOWN},
    'c.bin': content_of,
    'world.json': World.load,
}


@pytest.mark.parametrize('name', READERS)
@pytest.mark.parametrize('kind', ['pipe', 'device'])
def test_pipes_and_devices_are_refused(tmp_path, name, kind):
    """A pipe blocked the reader for good, /dev/zero took memory without end."""
    if 'parquet' in name:
        extras.load('pyarrow')
    path = tmp_path / name
    if kind == 'pipe':
        os.mkfifo(path)
    else:
        path.symlink_to('/dev/zero')
    reset_peak()
    before = resident('VmRSS')
    with pytest.raises(SurfelMapperError, match=r'not a regular file|no such file'):
        READERS[name](path)
    assert resident('VmHWM') - before < 64 << 20


def test_a_line_of_a_model_without_end_is_refused(tmp_path):
    path = tmp_path / 'a.obj'
    path.write_bytes(b'v 0 0 0\n' + b'f' + b' 1' * 5_000_000)
    reset_peak()
    before = resident('VmRSS')
    with pytest.raises(FileFormatError, match=r'a.obj:2: a line of over 65536 characters'):
        read_obj(path)
    assert resident('VmHWM') - before < 64 << 20  # was 800 MB
