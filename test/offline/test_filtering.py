# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The verb filter and filter_clouds: files, folders and bags, with all columns."""

from __future__ import annotations

import json
from pathlib import Path
import re

from mcap.writer import Writer
import numpy as np
import pytest
from rosbags import rosbag2
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.bags.writer import BagWriter
from surfel_mapper.cli.main import main
from surfel_mapper.errors import BagError, FileFormatError, FilterError
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.scan_files import read_scan
from surfel_mapper.filters import Chain
from surfel_mapper.messages.pointcloud2 import from_columns, to_scan
from surfel_mapper.messages.poses import StampedPose
from surfel_mapper.offline.filtering import filter_clouds
from test.bags.recorded import CLOUD, drive, ROS1, ROS2, write_ros1
from test.offline.test_depth_folders import SIZE, tum, WALL_M

CHAIN = '- range_limit: {min_m: 1}\n- surface_normal: {num_neighbours: 5}\n'

STAMPS = [10**18, 10**18 + 10**8, 10**18 + 2 * 10**8]


def columns_of(number=200, seed=1):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3.0, 3.0, (number, 3)).astype(np.float32)
    columns = dict(zip('xyz', points.T, strict=True))
    columns['intensity'] = rng.uniform(0.0, 255.0, number).astype(np.float32)
    columns['ring'] = rng.integers(0, 64, number).astype(np.uint16)
    return columns


def expected(columns, text=CHAIN, stamp_ns=0):
    """Return the points and rings that a chain leaves."""
    points = np.stack([columns[name] for name in 'xyz'], axis=1)
    scan = Chain.from_yaml(text).apply(points)
    far = (points.astype(np.float64) ** 2).sum(axis=1) >= 1.0
    return scan, columns['ring'][far]


@pytest.mark.parametrize('source', ['scan.ply', 'scan.pcd'])
@pytest.mark.parametrize('target', ['out.ply', 'new/out.pcd'])
def test_a_file_is_filtered_with_all_its_columns(tmp_path, source, target):
    columns = columns_of()
    (ply if source.endswith('ply') else pcd).write_points(tmp_path / source, columns)
    done = filter_clouds(Chain.from_yaml(CHAIN), [tmp_path / source], tmp_path / target)
    points, found = read_scan(tmp_path / target)
    scan, rings = expected(columns)
    np.testing.assert_array_equal(points, scan.points)
    np.testing.assert_array_equal(found['ring'], rings)
    normals = np.stack([found[f'normal_{axis}'] for axis in 'xyz'], axis=1)
    np.testing.assert_array_equal(normals, scan.columns['normals'])
    assert (done.scans, done.points_in, done.points_out) == (1, 200, len(points))
    assert [*done.filters] == ['1 range_limit', '2 surface_normal']


def test_a_folder_gives_a_folder(tmp_path):
    (tmp_path / 'in').mkdir()
    for i in range(3):
        ply.write_points(tmp_path / f'in/scan{i}.ply', columns_of(seed=i))
    raw = np.stack([columns_of(seed=9)[n] for n in (*'xyz', 'intensity')], axis=1)
    raw.astype('<f4').tofile(tmp_path / 'in/scan3.bin')
    counts = []
    done = filter_clouds(
        Chain.from_yaml(CHAIN),
        [tmp_path / 'in'],
        tmp_path / 'out',
        show=lambda number, of: counts.append((number, of)),
    )
    assert [path.name for path in done.outputs] == [f'scan{i}.ply' for i in range(4)]
    assert counts == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert 'intensity' in read_scan(tmp_path / 'out/scan3.ply')[1]


@pytest.mark.parametrize(
    ('files', 'inputs', 'target'),
    [
        (('one/000000.pcd', 'two/000000.pcd'), ('one', 'two'), '000000.pcd'),
        (('in/a.bin', 'in/a.ply'), ('in',), 'a.ply'),
        (('in/a.ply', 'b.ply'), ('in', 'b.ply', 'in/a.ply'), 'a.ply'),
    ],
)
def test_inputs_with_the_same_output_are_refused_before_any_is_written(
    tmp_path, monkeypatch, files, inputs, target
):
    monkeypatch.chdir(tmp_path)
    for name in files:
        Path(name).parent.mkdir(exist_ok=True)
        if name.endswith('.bin'):
            np.ones((5, 4), '<f4').tofile(name)
        else:
            (ply if name.endswith('ply') else pcd).write_points(name, columns_of())
    first, second = files if len(inputs) < 3 else ('in/a.ply', 'in/a.ply')
    says = f'{first}, {second}: expected an output for each, both would be out/{target}; '
    with pytest.raises(FileFormatError, match=re.escape(says)):
        filter_clouds(Chain.from_yaml(CHAIN), inputs, 'out', overwrite=True)
    assert not Path('out').exists()


@pytest.fixture
def bag(tmp_path):
    """A bag of three clouds with poses between them; the second has no column ring."""
    with BagWriter(tmp_path / 'bag') as writer:
        for i, stamp_ns in enumerate(STAMPS):
            columns = columns_of(seed=i)
            if i == 1:
                del columns['ring']
            pose = StampedPose('odom', 'base_link', stamp_ns, np.zeros(3), (0, 0, 0, 1))
            writer.write_odometry('/odom', stamp_ns, pose)
            cloud = from_columns(columns)
            writer.write_cloud('/points', stamp_ns + 1, stamp_ns, 'lidar', cloud)
    return tmp_path / 'bag'


def test_a_bag_is_filtered_and_keeps_its_other_messages(tmp_path, bag):
    done = filter_clouds(Chain.from_yaml(CHAIN), [bag], tmp_path / 'out')
    with BagReader(bag) as before, BagReader(tmp_path / 'out') as after:
        originals, found = list(before.messages()), list(after.messages())
        order = [(m.topic, m.record_ns) for m in originals]
        assert [(m.topic, m.record_ns) for m in found] == order
        for one, other in zip(originals, found, strict=True):
            if one.topic == '/odom':
                assert bytes(one.raw) == bytes(other.raw)
        scans = [to_scan(after.decode(m)) for m in found if m.topic == '/points']
    assert [scan.stamp_ns for scan in scans] == STAMPS
    assert {scan.frame_id for scan in scans} == {'lidar'}
    scan, rings = expected(columns_of(seed=2))
    np.testing.assert_array_equal(scans[2].points, scan.points)
    np.testing.assert_array_equal(scans[2].columns['ring'], rings)
    np.testing.assert_array_equal(scans[2].columns['normal_z'], scan.columns['normals'][:, 2])
    assert (done.scans, done.refused) == (3, 0)


def test_a_ros_1_bag_becomes_a_bag_of_its_filtered_clouds(tmp_path, caplog):
    entries = drive(ROS1)
    write_ros1(tmp_path / 'drive.bag', entries, 'BZ2')
    done = filter_clouds(
        Chain.from_yaml('- range_limit: {max_m: 3}'), [tmp_path / 'drive.bag'], tmp_path / 'out'
    )
    clouds = [message for topic, _, _, message in entries if topic == '/points']
    assert (done.scans, done.refused) == (len(clouds), 0)
    assert 'a ROS 1 bag; only its clouds are written' in caplog.text
    with BagReader(tmp_path / 'out') as after:
        assert [topic.name for topic in after.topics] == ['/points']
        scans = [to_scan(after.decode(message)) for message in after.messages()]
    for scan, cloud in zip(scans, clouds, strict=True):
        rows = np.frombuffer(cloud.data.tobytes(), '<f4').reshape(-1, 4)
        near = rows[np.linalg.norm(rows[:, :3].astype(np.float64), axis=1) <= 3.0]
        assert 0 < len(near) < len(rows)
        np.testing.assert_array_equal(scan.points, near[:, :3])
        np.testing.assert_array_equal(scan.columns['intensity'], near[:, 3])
        stamp = cloud.header.stamp
        assert scan.stamp_ns == stamp.sec * 10**9 + stamp.nanosec
        assert scan.frame_id == cloud.header.frame_id


LIVOX = 'livox_ros_driver2/msg/CustomMsg'

POINT = """uint32 offset_time  # ns
float32 x
uint8 line
"""

AS_MSG = f"""std_msgs/Header header
CustomPoint[] points
{'=' * 80}
MSG: livox_ros_driver2/CustomPoint
{POINT}"""

AS_IDL = f"""{'=' * 80}
IDL: {LIVOX}
module livox_ros_driver2 {{ module msg {{ struct CustomMsg {{ unsigned long line; }}; }}; }};
"""

LIVOX_RAWS = [b'\x00\x01\x00\x00' + bytes([number]) * 40 for number in range(5)]


RECORDED = 'RIHS01_' + '0123456789abcdef' * 4
"""A hash other than that of the definition: it is copied, or else computed."""


def write_livox(path, storage):
    """Write the clouds of the drive and messages of Livox, as rosbags does."""
    plugin = rosbag2.StoragePlugin[storage.upper()]
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
        points = writer.add_connection('/points', CLOUD, typestore=ROS2)
        livox = writer.add_connection('/livox', LIVOX, msgdef=AS_MSG, rihs01=RECORDED)
        for _, type_, record_ns, message in clouds_of_the_drive():
            writer.write(points, record_ns, ROS2.serialize_cdr(message, type_))
        for number, raw in enumerate(LIVOX_RAWS):
            writer.write(livox, drive()[0][2] + number, raw)
    return path


def write_mcap(path, encoding='ros2msg', definition=''):
    """Write the clouds of the drive, messages of Livox and a log in JSON, as recorders do."""
    with open(path, 'wb') as stream:
        writer = Writer(stream)
        writer.start('ros2')
        points = writer.register_channel(
            '/points', 'cdr', writer.register_schema(CLOUD, 'ros2msg', b'')
        )
        livox = writer.register_channel(
            '/livox',
            'cdr',
            writer.register_schema(LIVOX, encoding, definition.encode()),
        )
        log = writer.register_channel(
            '/log', 'json', writer.register_schema('foxglove.Log', 'jsonschema', b'{}')
        )
        for _, type_, ns, message in clouds_of_the_drive():
            writer.add_message(points, ns, ROS2.serialize_cdr(message, type_), ns)
            writer.add_message(log, ns, b'{}', ns)
        for number, raw in enumerate(LIVOX_RAWS):
            writer.add_message(livox, drive()[0][2] + number, raw, 0)
        writer.finish()
    return path


def clouds_of_the_drive():
    return [entry for entry in drive() if entry[0] == '/points']


@pytest.mark.parametrize(
    ('write', 'definition', 'hashed'),
    [
        (lambda path: write_livox(path / 'bag', 'sqlite3'), AS_MSG, None),
        (lambda path: write_livox(path / 'bag', 'mcap'), AS_MSG, AS_MSG),
        (lambda path: write_mcap(path / 'a.mcap', 'ros2idl', AS_IDL), AS_IDL, 'uint32 line'),
    ],
    ids=['sqlite3', 'mcap', 'mcap of IDL'],
)
def test_messages_of_other_types_are_copied_with_their_definition(
    tmp_path, write, definition, hashed
):
    filter_clouds(Chain.from_yaml(CHAIN), [write(tmp_path)], tmp_path / 'out')
    store, digest = get_typestore(Stores.ROS2_JAZZY), RECORDED
    if hashed:
        store.register(get_types_from_msg(hashed, LIVOX))
        digest = store.hash_rihs01(LIVOX)
    with rosbag2.Reader(tmp_path / 'out') as reader:
        (livox,) = (each for each in reader.connections if each.topic == '/livox')
        assert livox.msgtype == LIVOX
        assert livox.msgdef.data == definition
        assert livox.digest == digest
        assert [raw for *_, raw in reader.messages([livox])] == LIVOX_RAWS


def test_scans_that_a_filter_refuses_are_left_out_and_counted(tmp_path, bag, caplog):
    chain = Chain.from_yaml('- label_mask: {labels: [1], column_name: ring}')
    done = filter_clouds(chain, [bag], tmp_path / 'out')
    assert (done.scans, done.refused) == (2, 1)
    assert "needs the column 'ring'" in caplog.text
    with BagReader(tmp_path / 'out') as after:
        assert sum(m.topic == '/points' for m in after.messages()) == 2


def test_wrong_inputs_and_outputs_are_refused_by_name(tmp_path, bag):
    chain = Chain.from_yaml(CHAIN)
    ply.write_points(tmp_path / 'a.ply', columns_of())
    with pytest.raises(FileFormatError, match=r'out\.bin: expected a file ending in \.ply or'):
        filter_clouds(chain, [tmp_path / 'a.ply'], tmp_path / 'out.bin')
    with pytest.raises(FileFormatError, match=r'a\.ply: exists'):
        filter_clouds(chain, [tmp_path / 'a.ply'], tmp_path / 'a.ply')
    with pytest.raises(BagError, match=r'no topic /rear; PointCloud2 topics: /points'):
        filter_clouds(chain, [bag], tmp_path / 'out', topics=['/rear'])
    (tmp_path / 'empty').mkdir()
    with pytest.raises(FileFormatError, match='empty: no bag, no scans'):
        filter_clouds(chain, [tmp_path / 'empty'], tmp_path / 'out')
    with pytest.raises(FilterError, match=r'a\.ply: filter 1 shadow: needs the column'):
        filter_clouds(Chain.from_yaml('- shadow'), [tmp_path / 'a.ply'], tmp_path / 'b.ply')
    assert not (tmp_path / 'b.ply').exists()


def test_the_verb_reports_every_filter(tmp_path, capsys):
    columns = columns_of()
    columns['x'][:3] = np.nan
    ply.write_points(tmp_path / 'scan.ply', columns)
    (tmp_path / 'chain.yaml').write_text('- body_box\n- voxel_grid: {min_points: 1}\n')
    (tmp_path / 'config.yaml').write_text('frames: {base_to_sensor: [0, 0, 9, 0, 0, 0, 1]}\n')
    files = [str(tmp_path / name) for name in ('chain.yaml', 'scan.ply')]
    command = ['filter', *files, '--output', str(tmp_path / 'out.ply')]
    assert main(command) == 1
    assert 'set frames.base_to_sensor' in capsys.readouterr().err
    command += ['--config', str(tmp_path / 'config.yaml')]
    assert main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith('scans 1   points 200 -> ')
    assert [line.split()[:2] for line in lines[1:]] == [['1', 'body_box'], ['2', 'voxel_grid']]
    assert main([*command, '--json', '--overwrite']) == 0
    content = json.loads(capsys.readouterr().out)
    assert content['filters']['1 body_box']['points_in'] == 200
    assert content['outputs'] == [str(tmp_path / 'out.ply')]


def test_folders_of_data_sets_and_depth_images_give_a_file_for_each_scan(tmp_path, capsys):
    tum(tmp_path / 'frames')
    chain = Chain.from_list(['remove_nan'])
    done = filter_clouds(chain, [tmp_path / 'frames'], tmp_path / 'out')
    names = sorted(path.name for path in (tmp_path / 'frames' / 'depth').iterdir())
    assert [path.name for path in done.outputs] == [name[:-4] + '.ply' for name in names]
    points, _ = read_scan(done.outputs[0])
    assert len(points) == SIZE[0] * SIZE[1] - 2  # two pixels have no depth
    assert np.asarray(points)[:, 2] == pytest.approx(WALL_M)
