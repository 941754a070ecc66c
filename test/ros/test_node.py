# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The node as a process: inputs, outputs, faulty clouds, parameters, and signals, over DDS."""

from __future__ import annotations

from array import array
from importlib.util import find_spec
import signal

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool

from surfel_mapper.cli.main import main
from surfel_mapper.files.ply import read_points
from surfel_mapper.mapping.surfels import surfel_columns
from surfel_mapper.messages.pointcloud2 import to_scan
from test.ros.driving import ARGUMENTS, drive, mapped, PERIOD_NS, send
from test.ros.live import (
    cloud,
    LATCHED,
    odometry,
    room,
    START_NS,
)


def assert_equal_columns(message, surfels):
    """Check that a cloud holds these surfels, in any order."""
    scan, expected = to_scan(message), surfel_columns(surfels)
    found = {**dict(zip('xyz', scan.points.T, strict=True)), **scan.columns}
    assert list(found) == list(expected)
    order = np.lexsort((found['z'], found['y'], found['x']))
    expected_order = np.lexsort((expected['z'], expected['y'], expected['x']))
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name][order], values[expected_order], name)


def test_the_outputs_equal_those_of_a_mapper_without_ros(start, peer, tmp_path):
    node = start('node', *ARGUMENTS, '-p', f'output.directory:={tmp_path / "maps"}')
    changed = peer.collect(PointCloud2, '/surfel_mapper/changed')
    normals = peer.collect(PointCloud2, '/surfel_mapper/normals', LATCHED)
    peer.advertise('/odom', '/points')
    messages = drive(6)
    updates, mapper = mapped(messages)

    send(peer, messages)
    peer.spin_until(lambda: len(changed) == len(updates))
    saved = peer.call('save_map')

    assert saved.success, saved.message
    digest = mapper.map.digest()
    surfels = mapper.map.surfels(mapper.config.map.min_points)
    path = tmp_path / 'maps' / 'map.ply'
    assert saved.message == (
        f'{path} and .npz: {len(surfels):,} surfels of 3 scans (6 received), digest {digest}'
    )
    assert len(read_points(path)['x']) == len(surfels)

    for message, update in zip(changed, updates, strict=True):
        assert to_scan(message).stamp_ns == update.stamp_ns
        assert message.header.frame_id == 'odom'
        assert_equal_columns(message, update.changed)
    last_ns = updates[-1].stamp_ns
    peer.spin_until(lambda: normals and to_scan(normals[-1]).stamp_ns == last_ns)
    assert_equal_columns(normals[-1], surfels)
    late = peer.collect(PointCloud2, '/surfel_mapper/normals', LATCHED)
    peer.spin_until(lambda: late)
    assert late[0] == normals[-1]

    assert node.stop(signal.SIGTERM) == 0
    assert f'mapped 6, gated 0, dropped: none; surfels {len(surfels)}, digest {digest}' in (
        node.output
    )
    assert 'Traceback' not in node.output


def bad_clouds(stamp_ns):
    """Return invalid clouds, one of each kind, with the cause of their drop."""
    points = room(seed=1)

    def made(points=points, **changes):
        message = cloud(stamp_ns, points)
        for name, value in changes.items():
            setattr(message, name, value)
        return message

    no_z, unknown_type, no_frame = made(), made(), made()
    del no_z.fields[2]
    unknown_type.fields[1].datatype = 9
    no_frame.header.frame_id = ''
    return [
        ('bad_cloud', no_z),
        ('bad_cloud', unknown_type),
        ('bad_cloud', made(point_step=10)),
        ('bad_cloud', made(data=array('B', bytes(100)))),
        ('bad_cloud', made(data=array('B'))),
        ('empty_frame_id', no_frame),
        ('no_points', made(points[:0])),
        ('no_valid_points', made(np.full_like(points, np.nan))),
        ('no_valid_points', made(np.full_like(points, np.inf))),
        ('map_limit', made(points + np.float32(1e9))),
    ]


def test_bad_clouds_are_counted_and_valid_ones_mapped(start, peer):
    node = start('node', *ARGUMENTS)
    peer.advertise('/odom', '/points')
    causes = [cause for cause, _ in bad_clouds(START_NS)]
    good = drive(len(causes))
    for number, pair in enumerate(good):
        stamp_ns = START_NS + number * PERIOD_NS + PERIOD_NS // 2
        _, bad = bad_clouds(stamp_ns)[number]
        send(peer, [pair, (bad, odometry(stamp_ns, (0.2 * number, 0.0, 0.0)))])
        if number % 5 == 4:  # a subscription keeps 20 clouds
            peer.diagnosis({'scans.received': 2 * number + 2})

    _, values = peer.diagnosis({'scans.received': 2 * len(causes)})

    dropped = {key: int(value) for key, value in values.items() if '.dropped.' in key}
    assert dropped == {f'scans.dropped.{cause}': causes.count(cause) for cause in causes}
    assert values['scans.mapped'] == str(len(good))
    assert node.output.count('[WARN]') >= len(set(causes))
    assert node.stop() == 0


def test_clear_empties_the_map_and_pause_drops_clouds(start, peer):
    node = start('node', *ARGUMENTS)
    peer.advertise('/odom', '/points')
    messages = drive(4)
    send(peer, messages[:2])
    peer.diagnosis({'scans.mapped': 2})

    answer = peer.call('clear')
    assert answer.success
    assert 'of 2 scans' in answer.message
    assert peer.diagnosis()[1]['voxels'] == '0'

    assert peer.call('pause', SetBool, SetBool.Request(data=True)).success
    send(peer, messages[2:3])
    peer.diagnosis({'scans.dropped.paused': 1})
    assert peer.call('pause', SetBool, SetBool.Request(data=False)).success
    send(peer, messages[3:])
    _, values = peer.diagnosis({'scans.mapped': 3})
    assert values['window_scans'] == '1'
    assert node.is_running()


@pytest.mark.parametrize(
    ('arguments', 'messages'),
    [
        (['-p', 'window.max_scan:=5'], ['window.max_scan', 'did you mean window.max_scans?']),
        (['-p', 'map.voxel_size_m:=0.0'], ['map.voxel_size_m: 0, expected a value in']),
        (['-p', 'map.mode:=frozen'], ['map.load: empty, expected a map to freeze']),
        (['-p', 'use_sim_time:=maybe'], ['use_sim_time']),
        (['--params-file', 'nowhere.yaml'], ['nowhere.yaml']),
        (['--nonsense'], ['--nonsense']),
        (
            ['-p', 'pose.source:=identity', '-p', 'qos_overrides./points.subscription.depth:=x'],
            ['qos_overrides./points.subscription'],
        ),
    ],
)
def test_invalid_arguments_end_the_node_with_a_message(domain, capfd, arguments, messages):
    assert main(['node', '--ros-args', *arguments]) == 1
    said = capfd.readouterr().err
    for message in messages:
        assert message in said
    assert 'surfel-mapper node: ' in said


def test_a_parameter_file_without_node_name_is_refused_with_a_remedy(domain, capfd, tmp_path):
    (tmp_path / 'my.yaml').write_text('map: {voxel_size_m: 1.0}\n', encoding='utf-8')
    assert main(['node', '--ros-args', '--params-file', str(tmp_path / 'my.yaml')]) == 1
    said = capfd.readouterr().err
    assert 'my.yaml' in said
    assert 'put the settings below /**: and ros__parameters:' in said


@pytest.mark.skipif(find_spec('tf2_msgs') is not None, reason='tf2_msgs is installed')
def test_a_missing_tf2_msgs_ends_the_node_with_the_install_command(domain, capfd):
    assert main(['node', '--ros-args', '-p', 'pose.source:=tf']) == 1
    assert 'sudo apt install ros-jazzy-tf2-msgs' in capfd.readouterr().err


@pytest.mark.parametrize(
    ('number', 'when'), [(signal.SIGINT, 'loading kernels'), (signal.SIGTERM, 'ready:')]
)
def test_a_signal_ends_the_node_cleanly_at_any_time(start, number, when):
    node = start('node', *ARGUMENTS)
    node.wait_for_output(when)
    assert node.stop(number) == 0
    assert 'Traceback' not in node.output
    if when == 'ready:':
        assert 'scans received 0, mapped 0' in node.output
        assert node.output.count('digest') == 1
