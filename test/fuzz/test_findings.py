# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Minimal inputs of faults that fuzzing and reviews found."""

from __future__ import annotations

from dataclasses import replace
import os
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from surfel_mapper.bags.compression import import_zstd, unpack_file
from surfel_mapper.bags.paths import files_of
from surfel_mapper.bags.reader import BagReader
from surfel_mapper.config import load_config
from surfel_mapper.errors import (
    BagError,
    CloudFormatError,
    ConfigError,
    FileFormatError,
    MapError,
    SurfelMapperError,
)
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.map_state import load_map, save_map
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.files.state import load_state, save_state
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.filters.chain import Chain
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.messages.pointcloud2 import Field, to_scan
from surfel_mapper.offline.datasets import content_of
from surfel_mapper.simulation.world import World
from surfel_mapper.viz.contents import contents
from test import extras
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


def test_aliases_are_allowed_in_yaml(tmp_path):
    path = tmp_path / 'a.yaml'
    path.write_text('- &a {range_limit: {min_m: 2}}\n- *a\n')
    assert len(Chain.load(path)) == 2


def test_a_map_without_its_digest_is_refused(tmp_path):
    path = tmp_path / 'a.npz'
    save_map(path, *corpus.small_map())
    arrays, attributes = load_state(path)
    del attributes['digest']
    save_state(path, arrays, attributes)
    with pytest.raises(FileFormatError, match='expected None'):
        load_map(path)


def peak_of(function):
    """Return the exception of a function and its peak of traced memory."""
    tracemalloc.start()
    try:
        with pytest.raises((BagError, FileFormatError, ValueError)) as raised:
            function()
        return raised.value, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_a_file_of_several_frames_is_unpacked_whole(tmp_path):
    path, target = tmp_path / 'a.mcap.zstd', tmp_path / 'out'
    parts = [bytes([i]) * 300_000 for i in range(3)]
    path.write_bytes(b''.join(import_zstd().compress(part) for part in parts))
    assert unpack_file(path, target)
    assert target.read_bytes() == b''.join(parts)
    path.write_bytes(path.read_bytes()[:-3])
    assert not unpack_file(path, target)


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


TEXT_PLY = 'ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n'
TEXT_PCD = 'VERSION 0.7\nFIELDS x\nSIZE 4\nTYPE F\nCOUNT 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA '


@pytest.mark.parametrize(('name', 'type_'), [('a.ply', 'uchar'), ('a.pcd', 'U')])
@pytest.mark.parametrize('number', ['300', '-1', '1.5', 'nan', '1e300'])
def test_numbers_that_a_type_cannot_hold_are_refused(tmp_path, name, type_, number):
    path = tmp_path / name
    text = TEXT_PLY.replace('float', type_) if name == 'a.ply' else TEXT_PCD + 'ascii\n'
    text = text.replace('SIZE 4\nTYPE F', f'SIZE 1\nTYPE {type_}')
    path.write_text(f'{text}9\n{number}\n')
    with pytest.raises(FileFormatError, match=r'could not convert|integer via a float'):
        (ply if name == 'a.ply' else pcd).read_points(path)


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
