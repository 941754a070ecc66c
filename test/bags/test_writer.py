# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags are written atomically, replace only bags, and read back the same."""

import os

import numpy as np
import pytest

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.bags.writer import BagWriter
from surfel_mapper.errors import BagError
from surfel_mapper.messages.pointcloud2 import from_columns, to_scan
from surfel_mapper.messages.poses import StampedPose

POSE = StampedPose('odom', 'base_link', 5_000_000_007, (1.0, 2.0, 3.0), (0.0, 0.6, 0.0, 0.8))
CLOUD = from_columns({name: np.arange(3.0, dtype=np.float32) + i for i, name in enumerate('xyz')})


def write_some(path, **options):
    with BagWriter(path, **options) as bag:
        bag.write_transform('/tf_static', 10, POSE, latched=True)
        bag.write_odometry('/odom', 20, POSE)
        bag.write_cloud('/points', 30, 29, 'lidar', CLOUD)


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_written_messages_are_read_back(storage, tmp_path):
    write_some(tmp_path / 'bag', storage=storage)
    with BagReader(tmp_path / 'bag') as reader:
        messages = list(reader.messages())
        (tree, odometry, cloud) = (reader.decode(message) for message in messages)
    assert [(m.topic, m.record_ns) for m in messages] == [
        ('/tf_static', 10),
        ('/odom', 20),
        ('/points', 30),
    ]
    turn = tree.transforms[0].transform.rotation
    assert (turn.x, turn.y, turn.z, turn.w) == (0.0, 0.6, 0.0, 0.8)
    assert (odometry.header.stamp.sec, odometry.header.stamp.nanosec) == (5, 7)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ('odom', 'base_link')
    assert odometry.pose.pose.position.z == 3.0
    scan = to_scan(cloud)
    assert (scan.stamp_ns, scan.frame_id) == (29, 'lidar')
    assert scan.points.tolist() == [[0, 1, 2], [1, 2, 3], [2, 3, 4]]


def test_raw_messages_are_written_unchanged(tmp_path):
    raw = b'\x00\x01\x00\x00' + (3).to_bytes(4, 'little') + b'hi\x00'
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/text', 'std_msgs/msg/String', 1, raw)
    with BagReader(tmp_path / 'bag') as reader:
        (message,) = reader.messages()
        assert bytes(message.raw) == raw
        assert reader.decode(message).data == 'hi'


def test_a_type_outside_of_jazzy_needs_its_definition(tmp_path):
    says = r'bag: /a: my_msgs/msg/A without a definition'
    with pytest.raises(BagError, match=says), BagWriter(tmp_path / 'bag') as bag:
        bag.write('/a', 'my_msgs/msg/A', 1, b'\x00\x01\x00\x00\x05')
    assert list(tmp_path.iterdir()) == []


def test_the_files_carry_the_name_of_the_bag_and_others_may_join_them(tmp_path):
    with BagWriter(tmp_path / 'deep' / 'street') as bag:
        (bag.directory / 'note.txt').write_text('here')
        bag.write_odometry('/odom', 1, POSE)
        assert not bag.path.exists()
    assert bag.directory == tmp_path / 'deep' / 'street'
    names = sorted(path.name for path in bag.path.iterdir())
    assert names == ['metadata.yaml', 'note.txt', 'street.mcap']
    assert os.stat(bag.path).st_mode & 0o777 == 0o755
    assert [path.name for path in (tmp_path / 'deep').iterdir()] == ['street']


@pytest.mark.parametrize('error', [RuntimeError, KeyboardInterrupt])
def test_an_error_leaves_no_files(error, tmp_path):
    def fail(bag):
        bag.write_odometry('/odom', 1, POSE)
        raise error

    with pytest.raises(error), BagWriter(tmp_path / 'bag') as bag:
        fail(bag)
    assert list(tmp_path.iterdir()) == []


def test_a_bag_is_replaced_only_on_request_and_only_at_the_end(tmp_path):
    path = tmp_path / 'bag'
    write_some(path)
    with pytest.raises(BagError, match='has files in it; expected a new or empty directory'):
        BagWriter(path)
    with BagWriter(path, overwrite=True) as bag:
        bag.write('/text', 'std_msgs/msg/String', 1, b'\x00\x01\x00\x00\x01\x00\x00\x00\x00')
        with BagReader(path) as old:
            assert {topic.name for topic in old.topics} == {'/tf_static', '/odom', '/points'}
    with BagReader(path) as new:
        assert [topic.name for topic in new.topics] == ['/text']
    assert [entry.name for entry in tmp_path.iterdir()] == ['bag']


@pytest.mark.parametrize('overwrite', [False, True])
def test_an_empty_directory_becomes_the_bag(tmp_path, overwrite):
    (tmp_path / 'bag').mkdir()
    write_some(tmp_path / 'bag', overwrite=overwrite)
    assert (tmp_path / 'bag' / 'metadata.yaml').exists()
    assert [entry.name for entry in tmp_path.iterdir()] == ['bag']


def test_paths_that_are_not_bags_are_never_overwritten(tmp_path):
    home, file, link = tmp_path / 'home', tmp_path / 'file', tmp_path / 'link'
    home.mkdir()
    (home / 'thesis.tex').write_text('years of work')
    file.write_text('a file')
    write_some(tmp_path / 'bag')
    link.symlink_to(tmp_path / 'bag')
    for path, says in ((home, 'not a bag to overwrite'), (file, 'not a dir'), (link, 'not a dir')):
        with pytest.raises(BagError, match=says):
            BagWriter(path, overwrite=True)
    assert (home / 'thesis.tex').read_text() == 'years of work'
    assert link.is_symlink()


def test_an_unknown_storage_is_refused(tmp_path):
    with pytest.raises(BagError, match="'rosbag1': expected mcap or sqlite3"):
        BagWriter(tmp_path / 'bag', 'rosbag1')


def test_a_path_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(BagError, match=r'file/bag: cannot be written'):
        write_some(tmp_path / 'file' / 'bag')


def test_a_bag_with_other_files_is_not_overwritten(tmp_path):
    path = tmp_path / 'bag'
    write_some(path)
    for name in ('bag_0.mcap.zstd', 'bag.db3-wal', 'simulation.json', 'world.json'):
        (path / name).touch()
    BagWriter(path, overwrite=True)
    (path / 'thesis.tex').write_text('years of work')

    with pytest.raises(BagError, match=r'thesis\.tex in it is no file of a bag'):
        BagWriter(path, overwrite=True)
    (path / 'thesis.tex').unlink()
    (path / 'more.mcap').mkdir()
    with pytest.raises(BagError, match=r'more\.mcap in it is no file of a bag'):
        BagWriter(path, overwrite=True)
