# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Inputs made by hand that ended the process, hung, escaped as another error or were believed."""

from __future__ import annotations

from dataclasses import replace
import hashlib
import io
import json
from pathlib import Path
import struct
import subprocess
import sys
import threading
import time
from types import SimpleNamespace
import zipfile

import numpy as np
from PIL import Image
import pytest
import yaml

from surfel_mapper.bags import decoders
from surfel_mapper.bags import reader as bag_reader
from surfel_mapper.bags.paths import files_of, stated_counts
from surfel_mapper.cli.main import main
from surfel_mapper.config import Config, load_config, parse_yaml, TsdfConfig
from surfel_mapper.counters import Counters, OTHERS
from surfel_mapper.errors import (
    BagError,
    CloudFormatError,
    ConfigError,
    FileFormatError,
    MapError,
    MAX_LINE,
    one_line,
    PoseError,
    refusing,
)
from surfel_mapper.files.atomic import by_number
from surfel_mapper.files.map_state import load_map, load_moments, save_map, window_stamps_ns
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.files.tsdf_state import load_tsdf
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import WindowedScan
from surfel_mapper.messages.cdr import MAX_FRAME_NAME
from surfel_mapper.messages.compressed_image import unpacked
from surfel_mapper.messages.pointcloud2 import cloud_bytes, from_columns, parse_cloud
from surfel_mapper.messages.poses import raw_poses
from surfel_mapper.offline.datasets import nuscenes
from surfel_mapper.simulation.world import World
from test import extras
from test.bags.recorded import drive, ROS1, write_ros1
from test.bags.records import record, text
from test.fuzz import corpus

TIMEOUT_S = 120


@pytest.fixture
def saved(tmp_path):
    """Return the path of a map with one scan in its window."""
    surfel_map = SurfelMap(0.5)
    moments = surfel_map.add(np.random.default_rng(0).normal(size=(500, 3)))
    scan = WindowedScan(
        moments=moments, stamp_ns=5, T_map_sensor=np.eye(4), points=np.zeros((2, 3))
    )
    path = tmp_path / 'map.npz'
    save_map(path, surfel_map, [scan])
    return path


def changed(path, *, arrays=None, attributes=None, header=None):
    """Write a map again with other arrays, attributes or header of the keys, and its hash."""
    with zipfile.ZipFile(path) as archive:
        manifest = json.loads(archive.read('manifest.json'))
        found = {
            entry['name']: np.load(io.BytesIO(archive.read(f'{entry["name"]}.npy')))
            for entry in manifest['arrays']
        }
    found.update(arrays or {})
    manifest['attributes'].update(attributes or {})
    manifest['arrays'] = [
        {'name': name, 'dtype': array.dtype.str, 'shape': array.shape}
        for name, array in found.items()
    ]
    del manifest['sha256']
    content = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode())
    for array in found.values():
        content.update(array.tobytes())
    manifest['sha256'] = content.hexdigest()
    with zipfile.ZipFile(path, 'w') as archive:
        archive.writestr('manifest.json', json.dumps(manifest))
        for name, array in found.items():
            stream = io.BytesIO()
            np.lib.format.write_array(stream, array)
            data = stream.getvalue()
            if header and name == 'map.key':
                text = header.encode() + b' ' * (-(len(header) + 11) % 64) + b'\n'
                data = b'\x93NUMPY\x01\x00' + struct.pack('<H', len(text)) + text + data[128:]
            archive.writestr(f'{name}.npy', data)


@pytest.mark.parametrize(
    'header',
    [
        "{'descr': ('<i8', 'fortran",
        '(' * 5000,
        '-' * 9000 + '1',
        "{'descr': '<i8', 'fortran_order': False, 'shape': (1" + '0' * 4000 + ',)}',
        "{'descr': '|O', 'fortran_order': False, 'shape': (5,), }",
        "{'descr': [('a','<i8')], 'fortran_order': False, 'shape': (5,), }",
        "{'descr': '<i8', 'fortran_order': False, 'shape': (-5,), }",
        "{'descr': '<i8', 'fortran_order': True, 'shape': (5,), }",
    ],
    ids=['cut', 'brackets', 'signs', 'digits', 'objects', 'fields', 'negative', 'columns'],
)
def test_headers_of_arrays_are_not_evaluated(saved, header):
    """NumPy parses them as Python: TokenError, MemoryError and a fifth of a second came of it."""
    changed(saved, header=header)
    for read in (load_map, load_moments, window_stamps_ns):
        start_s = time.thread_time()
        with pytest.raises(FileFormatError, match=r'map\.npz: damaged') as caught:
            read(saved)
        assert time.thread_time() - start_s < 0.1
        assert len(str(caught.value)) <= MAX_LINE


@pytest.mark.parametrize(
    'arrays',
    [
        {'scans.stamp_ns': np.array([np.inf])},
        {'scans.stamp_ns': np.array([np.nan])},
        {'scans.stamp_ns': np.array([5.5])},
        {'scans.stamp_ns': np.array([[5]])},
        {'scans.stamp_ns': np.array(5)},
        {'scans.stamp_ns': np.array([-5])},
        {'scans.stamp_ns': np.array([2**64 - 1], np.uint64)},
        {'scans.pose': np.stack([np.eye(4)] * 3)},
        {'scans.pose': np.eye(4, dtype=np.float32)[None]},
    ],
    ids=['inf', 'nan', 'fraction', 'table', 'number', 'negative', 'unsigned', 'three', 'float32'],
)
def test_stamps_and_poses_of_a_window_are_checked(saved, arrays):
    changed(saved, arrays=arrays)
    for read in (load_map, load_moments, window_stamps_ns):
        with pytest.raises(FileFormatError, match=r'map\.npz: damaged'):
            read(saved)


@pytest.mark.parametrize(
    'points',
    [
        np.ones((5, 7), bool),
        np.ones((5, 3), np.int64),
        np.zeros((5, 3), np.float16),
        np.full((5, 3), np.nan),
        np.array(3.0),
    ],
    ids=['booleans', 'integers', 'float16', 'nan', 'number'],
)
def test_points_of_a_window_are_checked(saved, points):
    """They were believed, and failed when the window was aligned."""
    changed(saved, arrays={'scan0.points': points})
    for read in (load_map, load_moments):
        with pytest.raises(FileFormatError, match='points of scan 0'):
            read(saved)


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('voxel_size_m', 10**400),
        ('level', 10**400),
        ('origin_m', [10**400, 0, 0]),
        ('columns', 5),
        ('kind', 'x' * 1_000_000),
    ],
)
def test_attributes_that_no_map_has_are_refused_in_a_short_line(saved, name, value):
    changed(saved, attributes={name: value})
    for read in (load_map, load_moments):
        with pytest.raises(FileFormatError, match=r'map\.npz') as caught:
            read(saved)
        assert len(str(caught.value)) <= MAX_LINE


def test_a_changed_map_of_the_same_content_is_read(saved):
    """The helper above writes valid files."""
    digest = load_map(saved)[0].digest()
    changed(saved)
    surfel_map, scans = load_map(saved)
    assert surfel_map.digest() == digest
    assert window_stamps_ns(saved) == [scan.stamp_ns for scan in scans] == [5]


@pytest.mark.parametrize('error', [OverflowError('x'), MemoryError(), AttributeError('a\nb')])
def test_any_exception_of_a_parser_becomes_an_error_of_its_reader(error):
    expected = pytest.raises(FileFormatError, match=f'a.npz: damaged: {type(error).__name__}')
    with expected as caught, refusing('a.npz', FileFormatError):
        raise error
    assert caught.value.__cause__ is error
    assert '\n' not in str(caught.value)


def test_a_long_line_keeps_its_ends():
    line = one_line('begin\n' + 'x' * 10_000_000 + '\x1b[31mend')
    assert len(line) <= MAX_LINE
    assert line.startswith('begin\\n')
    assert line.endswith('\\x1b[31mend')
    assert '10000014 characters' in line


@pytest.fixture
def laz(tmp_path):
    """Return the path of a LAZ file of 100 points, and its content."""
    laspy = pytest.importorskip('laspy')
    data = laspy.LasData(laspy.LasHeader(point_format=3, version='1.4'))
    data.x = data.y = data.z = np.arange(100.0)
    path = tmp_path / 'a.laz'
    data.write(str(path))
    return path, bytearray(path.read_bytes())


def start_of_points(content):
    return struct.unpack_from('<I', content, 96)[0]


@pytest.mark.parametrize('number', [2**32 - 1, 2**28, 1000])
def test_a_laz_that_states_other_chunks_is_refused(laz, number):
    """Lazrs allocated 69 GB for 2^32 chunks and ended the process by SIGABRT."""
    path, content = laz
    (table,) = struct.unpack_from('<q', content, start_of_points(content))
    struct.pack_into('<I', content, table + 4, number)
    path.write_bytes(content)
    read = (
        'import sys\nfrom surfel_mapper.errors import FileFormatError\n'
        'from surfel_mapper.files.scan_files import read_scan\n'
        'try: read_scan(sys.argv[1])\n'
        'except FileFormatError as error: print(error)\n'
    )
    done = subprocess.run(
        [sys.executable, '-c', read, str(path)],
        capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert f'{number} chunks of points at byte {table} of {len(content)}' in done.stdout


def test_a_laz_of_large_chunks_is_read(laz):
    """Decoders of many threads allocate a chunk of the size stated, here 110 GB."""
    path, content = laz
    place = content.index(b'laszip encoded') + 64
    assert struct.unpack_from('<I', content, place) == (50_000,)
    struct.pack_into('<I', content, place, 3_271_607_120)
    path.write_bytes(content)
    points, _ = read_scan(path)
    np.testing.assert_allclose(points[:, 0], np.arange(100.0), atol=0.005)


@pytest.mark.parametrize(
    ('at', 'code', 'number', 'problem'),
    [
        (131, '<d', 0.0, 'units'),
        (139, '<d', np.nan, 'units'),
        (155, '<d', np.inf, 'offsets'),
        (247, '<Q', 0, '0 points'),
        (96, '<I', 300, r'points from byte 300|items of 0 bytes in points'),
        (96, '<I', 2**31, r'points from byte 2147483648|at byte 0 of|in points of'),
    ],
    ids=['unit', 'nan', 'offset', 'count', 'begin', 'end'],
)
@pytest.mark.parametrize('suffix', ['.las', '.laz'])
def test_numbers_in_the_header_of_las_that_cannot_be_are_refused(
    laz, tmp_path, suffix, at, code, number, problem
):
    """Points of nan, points all in one place, or no points, were taken for the content."""
    laspy = pytest.importorskip('laspy')
    path = tmp_path / f'b{suffix}'
    laspy.read(str(laz[0])).write(str(path))
    content = bytearray(path.read_bytes())
    struct.pack_into(code, content, at, number)
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=problem):
        read_scan(path)


def test_a_jpeg_of_a_thousand_scans_is_refused_before_decoding():
    """Each scan of 23 bytes passes over all pixels: 76 kB took over a minute."""
    stream = io.BytesIO()
    Image.new('RGB', (2000, 2000)).save(stream, 'JPEG', progressive=True)
    content = stream.getvalue()
    message = SimpleNamespace(header=None, format='rgb8; jpeg compressed bgr8', data=content)
    assert unpacked(message, 'color', exact=False).width == 2000
    last = content[content.rfind(b'\xff\xda') : -2]
    message.data = content[:-2] + 1000 * last + content[-2:]
    start_s = time.thread_time()
    with pytest.raises(CloudFormatError, match='a JPEG of 1010 scans, expected at most 32'):
        unpacked(message, 'color', exact=False)
    assert time.thread_time() - start_s < 0.1


def test_names_of_frames_are_limited():
    """10,000 frames are kept, and 128 are counted: names of 10 MB would fill the memory."""
    columns = dict.fromkeys('xyz', np.zeros(1, np.float32))
    for size, is_valid in ((MAX_FRAME_NAME, True), (MAX_FRAME_NAME + 1, False)):
        raw = cloud_bytes(from_columns(columns), stamp_ns=1, frame_id='f' * size)
        pose = pose_bytes('odom', 'f' * size)
        if is_valid:
            assert parse_cloud(raw).header.frame_id == 'f' * size
            assert raw_poses('odometry', pose, 'base_link', 'odom')[0].child == 'f' * size
            continue
        with pytest.raises(CloudFormatError, match=r'frame .* of 257 characters'):
            parse_cloud(raw)
        with pytest.raises(PoseError, match=r'frame .* of 257 characters'):
            raw_poses('odometry', pose, 'base_link', 'odom')


def test_drops_of_frames_with_endless_names_are_counted_together():
    counters = Counters()
    for number in range(3):
        counters.drop('bad_cloud', f'{number}' * 1_000_000)
    assert counters.dropped_by_frame == {OTHERS: {'bad_cloud': 3}}


def pose_bytes(parent, child):
    """Return the first part of a nav_msgs/Odometry, up to its pose."""
    from surfel_mapper.messages.cdr import MessageWriter, write_header

    writer = MessageWriter()
    write_header(writer, 1, parent)
    writer.string(child)
    writer.numbers('d', 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    return writer.join()


@pytest.mark.parametrize(
    'value',
    [
        '!!int ""',
        '!!float ""',
        '!!bool maybe',
        '!!timestamp yesterday',
        '!!binary "x"',
        '!!omap [1]',
        '!!python/object/apply:os.system ["false"]',
        '9' * 4299,
    ],
    ids=['int', 'float', 'bool', 'time', 'binary', 'omap', 'python', 'digits'],
)
def test_yaml_tags_of_other_values_are_refused(tmp_path, value):
    """PyYAML raised IndexError, KeyError and AttributeError; so did settings and metadata.yaml."""
    path = tmp_path / 'metadata.yaml'
    path.write_text(f'map: {{voxel_size_m: {value}}}')
    with pytest.raises(ConfigError):
        load_config(path)
    with pytest.raises(BagError, match='not the metadata'):
        files_of(tmp_path)


@pytest.mark.parametrize(
    ('text', 'problem'),
    [
        ('topics_with_message_count: [{topic_metadata: {name: /a}, message_count: .inf}]', 'inf'),
        (f'relative_file_paths: [{"a" * 5000}.mcap]', 'is missing'),
    ],
    ids=['count', 'name'],
)
def test_metadata_of_impossible_numbers_and_names_is_refused(tmp_path, text, problem):
    path = tmp_path / 'metadata.yaml'
    path.write_text(f'rosbag2_bagfile_information: {{{text}}}')
    with pytest.raises(BagError, match=problem):
        (stated_counts if 'count' in text else files_of)(tmp_path)


def test_json_of_a_world_that_is_nested_too_deeply_is_refused(tmp_path):
    path = tmp_path / 'world.json'
    path.write_text('[' * 100_000)
    with pytest.raises(FileFormatError, match=r'world\.json: damaged: RecursionError'):
        World.load(path)
    path.write_text(json.dumps({'format': 'x'}))
    with pytest.raises(FileFormatError, match=r'world\.json: '):
        World.load(path)


def test_tables_of_nuscenes_with_numbers_of_any_size_are_refused(tmp_path):
    scan = tmp_path / 'samples' / 'LIDAR_TOP' / 'a__1.pcd.bin'
    scan.parent.mkdir(parents=True)
    scan.write_bytes(bytes(20))
    row = {'token': 'a', 'rotation': [10**400, 0, 0, 0], 'translation': [0, 0, 0]}
    data = {'filename': scan.name, 'ego_pose_token': 'a', 'calibrated_sensor_token': 'a'}
    for name, found in (('sample_data', data), ('ego_pose', row), ('calibrated_sensor', row)):
        path = tmp_path / 'v1.0-mini' / f'{name}.json'
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps([found]))
    with pytest.raises(FileFormatError, match='not those of nuScenes: OverflowError'):
        nuscenes(tmp_path)


@pytest.mark.parametrize('name', ['map.other', 'scan1.key', 'map.points', 'x'])
def test_arrays_that_no_map_has_are_refused(saved, name):
    changed(saved, arrays={name: np.zeros(3)})
    for read in (load_map, load_moments, window_stamps_ns):
        with pytest.raises(FileFormatError, match=rf"unknown arrays \['{name}'\]"):
            read(saved)


def test_arrays_that_no_distance_field_has_are_refused(tmp_path):
    path = tmp_path / 'tsdf.npz'
    path.write_bytes(corpus.tsdf())
    load_tsdf(path, TsdfConfig())
    changed(path, arrays={'other': np.zeros(3)})
    with pytest.raises(FileFormatError, match=r"unknown arrays \['other'\]"):
        load_tsdf(path, TsdfConfig())


def test_two_members_of_one_name_are_refused(saved):
    with zipfile.ZipFile(saved, 'a') as archive, pytest.warns(UserWarning, match='Duplicate'):
        archive.writestr('map.key.npy', b'')
    with pytest.raises(FileFormatError, match='a member occurs twice'):
        load_map(saved)


def test_columns_that_no_map_has_are_refused(tmp_path):
    parquet = extras.load('pyarrow.parquet')
    from surfel_mapper.files.parquet import read_map, read_moments

    path = tmp_path / 'map.parquet'
    path.write_bytes(corpus.parquet()[0])
    table = parquet.read_table(path)
    parquet.write_table(table.append_column('other', table['i']), path)
    for read in (read_map, read_moments):
        with pytest.raises(FileFormatError, match=r"unknown columns \['other'\]"):
            read(path)


@pytest.mark.parametrize('far_m', [1e300, -2e9, np.nan, np.inf])
def test_poses_beyond_any_place_are_refused(saved, far_m):
    """1e300 m passed as a rigid transform."""
    pose = np.eye(4)
    pose[1, 3] = far_m
    changed(saved, arrays={'scans.pose': pose[None]})
    with pytest.raises(FileFormatError, match='expected a rigid transform'):
        load_map(saved)
    with pytest.raises(ValueError, match='expected a rigid transform'):
        SurfelMap(0.5).reduce(np.zeros((5, 3)), pose)


@pytest.mark.parametrize(
    ('name', 'text'),
    [
        ('a.pcd', '{head}SIZE 4 4 4\nTYPE F F F\nPOINTS 1_0\nDATA ascii\n' + '1 2 3\n' * 10),
        ('a.pcd', '{head}SIZE 4 4 4\nTYPE F F F\nPOINTS 1\nDATA ascii\n1 2 3_0\n'),
        ('a.ply', '{head}element vertex 1_0\n{xyz}' + '1 2 3\n' * 10),
        ('a.ply', '{head}element vertex 1\n{xyz}1 2 3_0\n'),
        ('a.ply', '{head}element vertex \u0661\n{xyz}1 2 3\n'),
    ],
)
def test_numbers_that_only_python_reads_are_no_numbers(tmp_path, name, text):
    """Python's int and float read 1_0 as ten."""
    path = tmp_path / name
    head = 'FIELDS x y z\n' if name == 'a.pcd' else 'ply\nformat ascii 1.0\n'
    xyz = ''.join(f'property float {axis}\n' for axis in 'xyz') + 'end_header\n'
    path.write_text(text.replace('{head}', head).replace('{xyz}', xyz), encoding='utf-8')
    with pytest.raises(FileFormatError):
        read_scan(path)


@pytest.mark.parametrize(
    'pose', ['1.0 1_0 0 0 0 0 0 1', '1_0.0 1 0 0 0 0 0 1', '\u0661 1 0 0 0 0 0 1']
)
def test_poses_of_numbers_that_only_python_reads_are_refused(tmp_path, pose):
    path = tmp_path / 'a.tum'
    path.write_text(f'{pose}\n', encoding='utf-8')
    with pytest.raises(FileFormatError, match=r'a\.tum'):
        read_trajectory(path)


def test_settings_of_numbers_that_only_python_reads_are_refused(capsys):
    for origin in ('1_0 0 0', '\u0661 0 0', '1 2', '1 2 3 4', '1 2 x'):
        with pytest.raises(ConfigError, match=r'map\.origin'):
            Config.from_mapping({'map.origin': origin})
    for arguments in (
        ['replay', 'a', '--every', '1_0'],
        ['simulate', 'street', '--speed', '1_0'],
        ['simulate', 'street', '--seed', '1_0'],
    ):
        with pytest.raises(SystemExit):
            main(arguments)
        assert '1_0' in capsys.readouterr().err


def test_metadata_of_too_many_files_is_refused_before_a_path_is_made(tmp_path):
    """It took 1.4 s for 50,000."""
    names = ''.join(f'    - a{number}.mcap\n' for number in range(50_000))
    text = f'rosbag2_bagfile_information:\n  relative_file_paths:\n{names}'
    (tmp_path / 'metadata.yaml').write_text(text)
    with pytest.raises(BagError, match='50000 files, expected at most 10000'):
        files_of(tmp_path)


@pytest.mark.parametrize(
    ('text', 'problem'),
    [
        ('a: {b: &x {c: 1}, d: *x}', None),
        ('a: *x', 'unknown alias'),
        ('? [1]\n: 2', 'no text'),
        ('a: 1\n---\nb: 2', 'more than one document'),
        ('&x [*x]', 'inside of an anchored node'),
        ('', None),
    ],
)
def test_yaml_as_text_equals_that_of_pyyaml_or_is_refused(text, problem):
    if problem is None:
        assert parse_yaml(text, as_text=True) == yaml.load(text, yaml.BaseLoader)
        return
    with pytest.raises(ValueError, match=problem):
        parse_yaml(text, as_text=True)


def test_names_of_files_with_digits_of_unicode_are_sorted():
    """str.isdigit holds for superscripts, which int refuses."""
    names = [Path(name) for name in ('1\u00b2', '\u00b2', '10', '2', '\u0661')]
    assert [path.name for path in sorted(names, key=by_number)] == [
        '\u0661',
        '1\u00b2',
        '2',
        '10',
        '\u00b2',
    ]


def test_names_with_an_end_of_line_stay_on_their_line(tmp_path, capsys):
    folder = tmp_path / 'a\nforged: line'
    folder.mkdir()
    np.zeros((3, 4), np.float32).tofile(folder / '1.bin')
    assert main(['info', str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert r'a\nforged: line: scans in files' in lines[0]
    assert not any(line.startswith('forged') for line in lines)


def taken(count):
    """Return changes of moments by name, each of which no map may take."""
    wide, twice = np.zeros((count, 7), np.int64), np.zeros(count, np.int64)
    return {
        'key': [np.zeros((1, count), np.int64), np.zeros(count - 1, np.int64), twice, None],
        'count': [np.zeros(count), np.ones(3, np.int32), -np.ones(count, np.int32)],
        'total': [np.zeros((2, 3), np.int32), np.zeros(count, np.int32), wide],
        'product': [wide, np.zeros((count, 6), '>i8'), np.zeros((count, 6), np.uint64)],
        'view': [np.zeros((count, 3)), np.zeros((1, 3), np.int16), wide],
        'channels': [np.zeros((2, 0), np.int64), np.zeros((count, 1), np.int64)],
    }


def test_moments_of_other_shapes_and_types_are_refused_before_a_kernel_reads_them():
    """Short arrays were read past their end, negative counts removed, and a voxel added twice."""
    surfel_map = SurfelMap(0.5)
    moments = surfel_map.add(np.random.default_rng(0).normal(size=(500, 3)))
    digest = surfel_map.digest()
    for name, arrays in taken(len(moments)).items():
        for array in arrays:
            for change in (surfel_map.insert, surfel_map.remove):
                with pytest.raises((MapError, TypeError, ValueError)):  # the last by ScanMoments
                    change(replace(moments, **{name: array}))
    doubled = replace(moments.select(np.repeat(np.arange(len(moments)), 2)))
    with pytest.raises(MapError, match='a voxel occurs twice'):
        surfel_map.insert(doubled)
    assert surfel_map.digest() == digest


@pytest.mark.parametrize('rows', [[-1], [10**6], [2**31 - 1], [0.5], [[0]], ['x']])
def test_rows_beyond_the_table_are_refused(rows):
    """They were read from other memory."""
    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.zeros((5, 3)))
    for read in (surfel_map.surfels_of, surfel_map.covariances_of, surfel_map.keys_of):
        with pytest.raises(IndexError, match='rows'):
            read(np.array(rows))


@pytest.mark.parametrize('value', [np.nan, -1.0, -np.inf, 'x', None, 1j, [1, 2]])
@pytest.mark.parametrize('name', ['min_range_m', 'max_range_m'])
def test_ranges_that_are_no_numbers_are_refused(name, value):
    with pytest.raises(ValueError, match='min_range_m'):
        SurfelMap(0.5).reduce(np.zeros((5, 3)), **{name: value})


def test_ranges_whose_square_is_infinite_are_no_limit():
    moments = SurfelMap(0.5).reduce(np.ones((5, 3)), max_range_m=1e200)
    assert moments.num_points == 5


def test_names_of_topics_are_checked_a_few_times_however_many_there_are(tmp_path, monkeypatch):
    """Each was compared with all others to know if it is latched: 65,535 took hours."""
    names = range(1000)
    channels = b''.join(
        record(4, struct.pack('<HH', n, 1) + text(b'/t%d' % n) + text(b'cdr') + bytes(4))
        for n in names
    )
    schema = record(3, struct.pack('<H', 1) + text(b'a/msg/A') + text(b'ros2msg') + text(b''))
    message = record(5, struct.pack('<HIQQ', 1, 0, 5, 5))
    path = tmp_path / 'a.mcap'
    head = b'\x89MCAP0\r\n' + record(1, text(b'ros2') + text(b''))
    path.write_bytes(head + schema + channels + message)
    calls = []
    monkeypatch.setattr(bag_reader, 'has_legal_names', lambda c: not calls.append(c))
    with bag_reader.BagReader(path) as reader:
        assert len([*reader.topics]) == len(names)
        assert not any(reader.is_latched(topic.name) for topic in reader.topics)
    assert 0 < len(calls) < 10 * len(names)


def test_a_state_is_read_without_threads(saved, monkeypatch):
    """A thread that could not allocate ended without a word, and the reader waited for it."""
    monkeypatch.setattr(threading.Thread, 'start', lambda self: pytest.fail('a thread'))
    load_map(saved)


@pytest.mark.parametrize(
    'nested',
    ['nav_msgs/Odometry a', 'B[] a', 'B[60000] a', 'C[60000] a', 'C[200] a\nC[801] b'],
)
def test_definitions_of_ros1_without_bounds_are_refused(nested):
    """Nested arrays of nothing, 60,000 by 60,000, were read for hours; 2^31 filled the memory."""
    rule = '\n' + '=' * 80 + '\nMSG: nav_msgs/'
    text = f'{nested}{rule}B\nuint8[0] x{rule}C\nuint8 x'
    definition = SimpleNamespace(data=text)
    with pytest.raises(ValueError, match='values'):
        decoders.ros1_types(SimpleNamespace(msgdef=definition, msgtype='nav_msgs/msg/Odometry'))
    definition.data = f'C[200] a\nC[800] b{rule}C\nuint8 x'
    decoders.ros1_types(SimpleNamespace(msgdef=definition, msgtype='nav_msgs/msg/Odometry'))


@pytest.mark.parametrize('definition', [b'string x\n' * 100_000, b'string x\n' * 2])
def test_definitions_of_ros1_are_parsed_once_and_up_to_a_size(tmp_path, monkeypatch, definition):
    """Each message parsed one that is wrong again, 5 s for 900 kB; so did 5 kB of bz2."""
    entries = drive(store=ROS1)
    path = write_ros1(tmp_path / 'a.bag', entries)
    parsed = []
    types = decoders.ros1_types

    def counted(connection):
        parsed.append(connection)
        wrong = SimpleNamespace(data=definition.decode())
        return types(SimpleNamespace(msgdef=wrong, msgtype=connection.msgtype))

    monkeypatch.setattr(decoders, 'ros1_types', counted)
    with bag_reader.BagReader(path) as reader:
        for message in reader.messages(['/odom']):
            with pytest.raises(BagError, match='no nav_msgs/msg/Odometry: '):
                reader.decode(message)
    assert len(parsed) == 1
