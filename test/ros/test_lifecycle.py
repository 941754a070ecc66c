# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The life cycle of a node, driven over DDS as by ``ros2 lifecycle``."""

from __future__ import annotations

from contextlib import suppress
import signal

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.srv import LoadMap
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from surfel_mapper.errors import ConfigError, FileFormatError
from surfel_mapper.files.map_state import load_map
from surfel_mapper.messages.pointcloud2 import to_scan
from surfel_mapper.ros.context import context
from surfel_mapper.ros.main import create_node, executing
from test.ros.driving import ARGUMENTS, arguments, drive, mapped, send
from test.ros.live import ALL, LATCHED, NODE, RVIZ

STATES = ('unconfigured', 'inactive', 'active', 'finalized')
WAITING = [*ARGUMENTS, '-p', 'autostart:=false']


def transit(peer, label='', number=0):
    """Request a transition by name or number; return whether it succeeded."""
    request = ChangeState.Request(transition=Transition(label=label, id=number))
    return peer.call('change_state', ChangeState, request).success


def state(peer):
    return peer.call('get_state', GetState).current_state.label


def test_the_lifecycle_runs_through_all_states(start, peer):
    node = start('node', *WAITING)
    events = peer.collect(TransitionEvent, f'{NODE}/transition_event', RVIZ)
    assert state(peer) == 'unconfigured'
    status, values = peer.diagnosis({'state': 'unconfigured'})
    assert (status.level, status.message) == (b'\0', 'unconfigured')
    assert peer.node.count_publishers(f'{NODE}/normals') == 0

    assert transit(peer, 'configure')
    assert state(peer) == 'inactive'
    assert 'kernels ready after' in node.output
    assert peer.node.count_subscribers('/points') == 0

    assert transit(peer, 'activate')
    messages = drive(4)
    peer.advertise('/odom', '/points')
    send(peer, messages[:2])
    peer.diagnosis({'state': 'active', 'scans.mapped': 2})

    assert transit(peer, 'deactivate')
    peer.spin_until(lambda: peer.node.count_subscribers('/points') == 0)
    send(peer, messages[2:3])
    _, values = peer.diagnosis({'state': 'inactive'})
    assert (values['scans.received'], values['window_scans']) == ('2', '2')

    assert transit(peer, 'activate')
    peer.wait_until_read('/odom', '/points')
    send(peer, messages[3:])
    _, values = peer.diagnosis({'state': 'active', 'scans.mapped': 3})
    assert values['window_scans'] == '3'

    assert transit(peer, 'deactivate')
    assert transit(peer, 'cleanup')
    assert state(peer) == 'unconfigured'
    _, mapper = mapped([*messages[:2], messages[3]])
    assert 'mapped 3, gated 0, dropped: none; surfels ' in node.output
    assert f'digest {mapper.map.digest()}' in node.output
    peer.spin_until(lambda: peer.node.count_publishers(f'{NODE}/normals') == 0)

    assert transit(peer, 'configure')
    assert peer.diagnosis({'state': 'inactive'})[1]['voxels'] == '0'
    assert transit(peer, 'shutdown')
    assert state(peer) == 'finalized'
    assert node.is_running()
    goals = [event.goal_state.label for event in events]
    assert [goal for goal in goals if goal in STATES] == [
        *('inactive', 'active', 'inactive', 'active', 'inactive', 'unconfigured', 'inactive'),
        'finalized',
    ]
    assert node.stop() == 0
    assert 'Traceback' not in node.output


def test_an_impossible_transition_is_refused(start, peer):
    node = start('node', *WAITING)
    assert not transit(peer, 'activate')
    assert not transit(peer, 'nonsense')
    assert not transit(peer, number=Transition.TRANSITION_DEACTIVATE)
    assert state(peer) == 'unconfigured'
    for name in ('activate', 'nonsense', str(Transition.TRANSITION_DEACTIVATE)):
        assert f'transition {name} refused: not possible while unconfigured' in node.output
    assert not transit(peer, '\x1b[31mred\nforged')
    assert r'transition \x1b[31mred\nforged refused' in node.output
    assert '\x1b' not in node.output
    assert not any(line.startswith('forged') for line in node.output.splitlines())
    assert transit(peer, 'configure')
    assert transit(peer, 'activate')
    assert node.stop(signal.SIGTERM) == 0


def test_a_failed_transition_states_the_reason_and_keeps_the_state(start, peer):
    node = start('node', *WAITING, '-p', 'qos_overrides./points.subscription.depth:=x')
    assert transit(peer, 'configure')
    assert not transit(peer, 'activate')
    assert 'refused: qos_overrides./points.subscription' in node.output
    assert state(peer) == 'inactive'
    assert peer.node.count_subscribers('/points') == 0
    assert node.stop() == 0


def test_settings_changed_before_configure_are_used(start, peer):
    start('node', *WAITING)
    client = peer.parameters()
    changed = client.set_parameters([Parameter('window.max_scans', value=2)])
    assert peer.result(changed).results[0].successful
    assert transit(peer, 'configure')
    assert transit(peer, 'activate')
    peer.advertise('/odom', '/points')
    send(peer, drive(3))
    _, values = peer.diagnosis({'scans.mapped': 3})
    assert values['window_scans'] == '2'


def test_a_wrong_limit_of_inputs_is_refused_before_any_cloud_comes(domain, monkeypatch):
    monkeypatch.setenv('SURFEL_MAPPER_MAX_BYTES', '4G')
    with context(WAITING):
        node = create_node()
        with executing(node):
            with pytest.raises(ConfigError, match="SURFEL_MAPPER_MAX_BYTES: '4G'"):
                node.start()
            assert node.state == 'unconfigured'
            monkeypatch.delenv('SURFEL_MAPPER_MAX_BYTES')
            node.start()
            assert node.state == 'active'
            node.end()
        node.destroy_node()


@pytest.mark.parametrize('how', ['signal', 'shutdown'])
def test_the_map_is_saved_on_shutdown_if_configured(start, peer, tmp_path, how):
    folder = tmp_path / 'maps'
    node = start(
        *('node', *ARGUMENTS, '-p', 'output.save_on_shutdown:=true'),
        *('-p', f'output.directory:={folder}'),
    )
    peer.advertise('/odom', '/points')
    messages = drive(3)
    send(peer, messages)
    peer.diagnosis({'scans.mapped': 3})
    if how == 'shutdown':
        assert transit(peer, 'shutdown')
        assert f'saved {folder / "map.ply"} and .npz' in node.output
    assert node.stop() == 0
    assert node.output.count('saved ') == 1
    _, mapper = mapped(messages)
    assert load_map(folder / 'map.npz')[0].digest() == mapper.map.digest()


def test_late_subscribers_get_the_present_map_of_an_inactive_node(start, peer, tmp_path):
    """No timer publishes then, so the map as it was at some time before had been kept."""
    seldom = {'publish.normals_rate_hz': 1e-3, 'publish.markers_rate_hz': 1e-3}
    start('node', *arguments(**seldom, **{'output.directory': tmp_path / 'maps'}))
    peer.advertise('/odom', '/points')
    markers = peer.collect(MarkerArray, f'{NODE}/markers', LATCHED)
    messages = drive(2)
    send(peer, messages)
    number = len(mapped(messages)[1].map.surfels(5))

    def check(expected):
        late = peer.collect(PointCloud2, f'{NODE}/normals', LATCHED)
        peer.spin_until(lambda: late)
        assert [len(to_scan(message)) for message in late] == [expected]

    assert transit(peer, 'deactivate')
    check(number)
    peer.spin_until(lambda: len(markers) == 1)
    assert peer.call('save_map').success
    assert peer.call('clear').success
    check(0)
    peer.spin_until(lambda: len(markers) == 2)
    answer = peer.call('load_map', LoadMap, LoadMap.Request())
    assert answer.result == LoadMap.Response.RESULT_SUCCESS
    check(number)


def test_a_node_that_is_killed_continues_from_its_checkpoint(start, peer, tmp_path):
    places = {'output.directory': tmp_path / 'maps', 'output.checkpoint_s': 0.001}
    first = start('node', *arguments(**places))
    peer.advertise('/odom', '/points')
    changed = peer.collect(PointCloud2, f'{NODE}/changed', ALL)
    messages = drive(3)
    send(peer, messages)
    peer.spin_until(lambda: len(changed) == 3)
    _, mapper = mapped(messages)

    def is_saved():
        with suppress(FileFormatError):  # absent while the one before gets its name
            saved, _ = load_map(tmp_path / 'maps' / 'map.checkpoint.npz')
            return saved.digest() == mapper.map.digest()
        return False

    peer.spin_until(is_saved)
    first.kill()

    second = start('node', *arguments(**places, **{'map.load': 'latest'}))
    peer.diagnosis({'state': 'active', 'scans.mapped': 0, 'window_scans': 3})
    assert f'map.checkpoint.npz, digest {mapper.map.digest()}' in second.output
