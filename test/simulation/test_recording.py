# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A recorded simulation, read back by rosbags: the same points, poses, times and truth."""

from itertools import pairwise
import json

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores

from surfel_mapper.errors import BagError, FileFormatError
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.simulation import Lidar, load_simulation, record, Simulation, World

NUM_SCANS = 4


def small_simulation(**options):
    lidar = Lidar(beams=16, columns=128, rate_hz=options.pop('rate_hz', 10.0))
    street = World.street(seed=0, length_m=20.0)
    return Simulation(street, lidar, num_scans=NUM_SCANS, **options)


def read(path):
    """Return (topic, record_ns, message) of all messages, in the order they are played."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        return [
            (connection.topic, record_ns, reader.deserialize(raw, connection.msgtype))
            for connection, record_ns, raw in reader.messages()
        ]


def of_topic(messages, topic):
    return [(record_ns, message) for name, record_ns, message in messages if name == topic]


def stamp_ns(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def numbers(message):
    return [getattr(message, name) for name in ('x', 'y', 'z', 'w') if hasattr(message, name)]


@pytest.fixture(scope='module')
def simulation():
    return small_simulation()


@pytest.fixture(scope='module', params=['mcap', 'sqlite3'])
def bag(request, simulation, tmp_path_factory):
    path = tmp_path_factory.mktemp(request.param) / 'street'
    record(simulation, path, storage=request.param)
    return path


def test_the_clouds_are_the_scans(bag, simulation):
    clouds = of_topic(read(bag), '/points')
    assert len(clouds) == NUM_SCANS
    for (_, message), scan in zip(clouds, simulation.scans(), strict=True):
        assert (message.height, message.width, message.point_step) == (16, 128, 32)
        assert message.header.frame_id == 'lidar'
        assert not message.is_dense
        fields = [(f.name, f.offset, f.datatype, f.count) for f in message.fields]
        assert fields == [
            ('x', 0, 7, 1),
            ('y', 4, 7, 1),
            ('z', 8, 7, 1),
            ('intensity', 16, 7, 1),
            ('ring', 20, 4, 1),
            ('time', 24, 7, 1),
        ]
        found = to_scan(message)
        assert found.stamp_ns == scan.stamp_ns
        np.testing.assert_array_equal(found.points, scan.points)
        for name in ('intensity', 'ring', 'time'):
            np.testing.assert_array_equal(found.columns[name], scan.columns[name])


def test_odometry_and_tf_are_the_poses_of_the_drive_to_the_last_bit(bag, simulation):
    messages = read(bag)
    odometry, tf = of_topic(messages, '/odom'), of_topic(messages, '/tf')
    assert len(odometry) == len(tf) > 40
    for (record_ns, message), (_, tree) in zip(odometry, tf, strict=True):
        (transform,) = tree.transforms
        assert stamp_ns(message) == stamp_ns(transform) == record_ns
        frames = [(m.header.frame_id, m.child_frame_id) for m in (message, transform)]
        assert frames == [('odom', 'base_link')] * 2
        pose = message.pose.pose
        for xyz, q_xyzw in (
            (numbers(pose.position), numbers(pose.orientation)),
            (numbers(transform.transform.translation), numbers(transform.transform.rotation)),
        ):
            expected = simulation.drive.T_odom_base(record_ns)
            np.testing.assert_array_equal(pose_matrix(xyz, q_xyzw), expected)


def test_the_mounting_is_latched_in_tf_static(bag, simulation):
    ((_, message),) = of_topic(read(bag), '/tf_static')
    (transform,) = message.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ('base_link', 'lidar')
    where = transform.transform
    found = [*numbers(where.translation), *numbers(where.rotation)]
    assert found == list(simulation.drive.base_to_sensor)
    with AnyReader([bag]) as reader:
        (connection,) = (c for c in reader.connections if c.topic == '/tf_static')
        (profile,) = connection.ext.offered_qos_profiles
        assert profile.durability.name == 'TRANSIENT_LOCAL'


@pytest.mark.parametrize('rate_hz', [10.0, 7.0])
def test_times_are_those_of_a_real_recording(rate_hz, tmp_path):
    simulation = small_simulation(rate_hz=rate_hz)
    record(simulation, tmp_path / 'street')
    messages = read(tmp_path / 'street')

    assert [topic for topic, _, _ in messages[:3]] == ['/tf_static', '/odom', '/tf']
    assert all(before[1] <= after[1] for before, after in pairwise(messages))
    poses = [record_ns for record_ns, _ in of_topic(messages, '/odom')]
    assert max(after - before for before, after in pairwise(poses)) <= 10_000_000
    assert len(set(poses)) == len(poses)
    clouds = of_topic(messages, '/points')
    turn_ns = 1e9 / rate_hz
    for record_ns, message in clouds:
        assert stamp_ns(message) in poses  # a pose at the stamp itself
        assert 0 < record_ns - stamp_ns(message) - turn_ns < 5e6
        assert poses[-1] >= stamp_ns(message) + turn_ns - 1  # also for the last column


def test_the_simulation_of_a_bag_is_restored(bag, simulation):
    again = load_simulation(bag)
    assert again.world.primitives == simulation.world.primitives
    assert (again.lidar, again.drive) == (simulation.lidar, simulation.drive)
    assert (again.num_scans, again.rolling) == (NUM_SCANS, False)
    np.testing.assert_array_equal(again.scan(2).points, simulation.scan(2).points)


def test_progress_is_reported_scan_by_scan(tmp_path):
    stamps = []
    simulation = small_simulation()
    record(simulation, tmp_path / 'street', on_scan=lambda scan: stamps.append(scan.stamp_ns))
    assert stamps == [simulation.stamp_ns(number) for number in range(NUM_SCANS)]


def test_existing_bag_is_kept_and_an_interrupted_recording_leaves_nothing(tmp_path):
    simulation = small_simulation()
    record(simulation, tmp_path / 'street')
    before = read(tmp_path / 'street')
    with pytest.raises(BagError, match='street: has files in it'):
        record(simulation, tmp_path / 'street')

    def interrupt(scan):
        raise KeyboardInterrupt

    for name in ('street', 'other'):
        with pytest.raises(KeyboardInterrupt):
            record(simulation, tmp_path / name, overwrite=True, on_scan=interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ['street']
    assert len(read(tmp_path / 'street')) == len(before)


def test_a_bag_without_its_description_is_refused_by_name(bag, tmp_path):
    World([]).save(tmp_path / 'world.json')
    for directory, file in ((tmp_path.parent / 'none', 'world'), (tmp_path, 'simulation')):
        with pytest.raises(FileFormatError, match=f'{file}.json: cannot be read'):
            load_simulation(directory)
    description = json.loads((bag / 'simulation.json').read_text())
    description['lidar']['beams'] = 0
    (tmp_path / 'simulation.json').write_text(json.dumps(description))
    with pytest.raises(FileFormatError, match='beams: 0'):
        load_simulation(tmp_path)
