# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Minimal inputs of faults that fuzzing and reviews found."""

from __future__ import annotations

import bz2
from importlib.util import find_spec
import io
import tracemalloc

import numpy as np
import pytest

from surfel_mapper.bags import compression as bag_compression
from surfel_mapper.bags.compression import import_zstd, unpack_file, unpacked
from surfel_mapper.bags.paths import files_of
from surfel_mapper.bags.reader import BagReader
from surfel_mapper.config import load_config, TsdfConfig
from surfel_mapper.errors import BagError, ConfigError, FileFormatError, PoseError
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.map_state import load_map, save_map
from surfel_mapper.files.state import load_state, save_state
from surfel_mapper.files.tsdf_state import load_tsdf
from surfel_mapper.filters.chain import Chain
from surfel_mapper.poses import buffer as buffer_module
from test.bags import recorded
from test.fuzz import corpus

LAUGHS = 'a0: &a0 [x, x]\n' + ''.join(
    f'a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n' for i in range(1, 40)
)
"""3^39 texts, if written out."""


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


def test_aliases_are_allowed_in_yaml(tmp_path):
    path = tmp_path / 'a.yaml'
    path.write_text('- &a {range_limit: {min_m: 2}}\n- *a\n')
    assert len(Chain.load(path)) == 2


def test_one_long_number_in_a_text_does_not_multiply_memory(tmp_path):
    path = tmp_path / 'a.ply'
    number = 20_000
    head = f'ply\nformat ascii 1.0\nelement vertex {number}\nproperty float x\nend_header\n'
    path.write_text(head + '1 ' * (number - 1) + '0' * 50_000)
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
    """Lower the floor of unpacked sizes to 1 MiB, so that test bombs are small."""
    monkeypatch.setattr(bag_compression, 'FLOOR_BYTES', 1 << 20)


def peak_of(function):
    """Return the exception of a function and its peak of traced memory."""
    tracemalloc.start()
    try:
        with pytest.raises((BagError, ValueError)) as raised:
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


@pytest.mark.parametrize('packing', ['zstd', 'bz2'])
def test_a_chunk_that_claims_more_than_is_plausible_is_refused(little, packing):
    with pytest.raises(ValueError, match='expected at most 1048576'):
        unpacked(bytes(100), packing, 1 << 21)


def test_unpacking_a_file_stops_at_the_plausible_size(little, tmp_path):
    path = tmp_path / 'a.mcap.zstd'
    path.write_bytes(import_zstd().compress(bytes(50_000_000)))
    with pytest.raises(BagError, match='more than is plausible'):
        unpack_file(path, tmp_path / 'out')
    assert (tmp_path / 'out').stat().st_size < 4 << 20


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
    assert 'may unpack to over 1048576' in str(error)
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
    assert 'larger than' in str(error)
    assert peak < 10_000_000


def test_map_urls_without_a_file_name_are_refused(tmp_path):
    pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')
    from surfel_mapper.ros.map_files import path_inside

    for url in ('/', 'file:///', '.', '../../x'):
        with pytest.raises(ConfigError, match='map_url'):
            path_inside(tmp_path, url)


def test_the_number_of_transforms_is_limited(monkeypatch):
    monkeypatch.setattr(buffer_module, 'MAX_EDGES', 3)
    buffer = buffer_module.TransformBuffer()
    for number in range(3):
        buffer.add('odom', f'frame{number}', 1, np.eye(4))
    with pytest.raises(PoseError, match='no more are taken'):
        buffer.add('odom', 'another', 1, np.eye(4))
    buffer.add('odom', 'frame2', 2, np.eye(4))
