# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The node in a ROS graph: names and types, QoS changes, simulated time, parameters."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from test.ros.driving import ARGUMENTS, drive, mapped, PERIOD_NS, send
from test.ros.fault_table import fault
from test.ros.live import cloud, NODE, odometry, room, stamp, START_NS

TOPICS = {
    'normals': 'sensor_msgs/msg/PointCloud2',
    'changed': 'sensor_msgs/msg/PointCloud2',
    'markers': 'visualization_msgs/msg/MarkerArray',
    'transition_event': 'lifecycle_msgs/msg/TransitionEvent',
    'clear_polygon': 'geometry_msgs/msg/PolygonStamped',
}
SERVICES = {
    'clear': 'std_srvs/srv/Trigger',
    'clear_box': 'std_srvs/srv/Trigger',
    'clear_radius': 'std_srvs/srv/Trigger',
    'save_map': 'std_srvs/srv/Trigger',
    'load_map': 'nav_msgs/srv/LoadMap',
    'pause': 'std_srvs/srv/SetBool',
    'change_state': 'lifecycle_msgs/srv/ChangeState',
    'get_state': 'lifecycle_msgs/srv/GetState',
    'set_parameters': 'rcl_interfaces/srv/SetParameters',
}


def test_topics_and_services_have_the_documented_names_and_types(start, peer):
    start('node', *ARGUMENTS, '-r', '__ns:=/robot', '-r', '__node:=map', '-r', 'odom:=/odom')
    found = {}

    def is_complete():
        found.update(peer.node.get_topic_names_and_types())
        found.update(peer.node.get_service_names_and_types())
        expected = {f'/robot/map/{name}' for name in [*TOPICS, *SERVICES]}
        return {*expected, '/robot/points', '/odom', '/diagnostics'} <= set(found)

    peer.spin_until(is_complete, what=lambda: str(sorted(found)))
    for name, kind in {**TOPICS, **SERVICES}.items():
        assert found[f'/robot/map/{name}'] == [kind], name
    assert found['/robot/points'] == ['sensor_msgs/msg/PointCloud2']
    assert found['/odom'] == ['nav_msgs/msg/Odometry']
    assert found['/diagnostics'] == ['diagnostic_msgs/msg/DiagnosticArray']
    peer.spin_until(lambda: ('map', '/robot') in peer.node.get_node_names_and_namespaces())
    status, _ = peer.diagnosis({'normals': 'oriented'})
    assert (status.name, status.hardware_id) == ('robot/map: mapping', 'robot/map')


def test_reports_and_latencies_use_simulated_time(start, peer):
    start('node', *ARGUMENTS, '-p', 'use_sim_time:=true')
    clock = peer.node.create_publisher(Clock, '/clock', 10)
    peer.spin_until(clock.get_subscription_count)
    peer.advertise('/odom', '/points')
    reports = peer.collect(DiagnosticArray, '/diagnostics')

    def set_time(now_ns):
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(now_ns, 10**9)

        def is_heard():
            clock.publish(message)  # repeatedly: the node reads it as best effort
            return reports and reports[-1].header.stamp == message.clock

        peer.spin_until(is_heard, what=lambda: f'{reports[-1].header.stamp}, not {message.clock}')

    set_time(START_NS + 40_000_000)
    send(peer, drive(1))
    _, values = peer.diagnosis({'scans.mapped': 1})
    assert (values['latency_ms.median'], values['latency_ms.p99']) == ('40.0', '40.0')

    set_time(START_NS + PERIOD_NS + 60_000_000)
    send(peer, drive(2)[1:])
    _, values = peer.diagnosis({'scans.mapped': 2})
    assert values['latency_ms.median'] == '50.0'

    long_ago = START_NS - 10**11  # the simulation restarts
    set_time(long_ago)
    send(peer, [(cloud(long_ago, room(seed=5)), odometry(long_ago, (0, 0, 0)))])
    _, values = peer.diagnosis({'scans.mapped': 3})
    assert (values['resets'], values['window_scans']) == ('1', '1')


@fault(
    'a parameter set to a value of an unknown type',
    happens='the whole request is refused with the reason',
    counted='the answer of the service',
    lost='nothing',
)
@pytest.mark.parametrize('kind', [SetParameters, SetParametersAtomically])
def test_a_parameter_of_no_known_type_is_refused(start, peer, kind):
    node = start('node', *ARGUMENTS)
    name = 'set_parameters' if kind is SetParameters else 'set_parameters_atomically'
    fine = Parameter('window.max_scans', value=2).to_parameter_msg()
    wrong = ParameterMessage(name='map.min_points', value=ParameterValue(type=10))
    answer = peer.call(name, kind, kind.Request(parameters=[fine, wrong]))
    results = answer.results if kind is SetParameters else [answer.result] * 2
    reason = 'map.min_points: a value of type 10, expected 1 to 9'
    assert [(found.successful, found.reason) for found in results] == [(False, reason)] * 2
    answer = peer.call(name, kind, kind.Request(parameters=[fine]))
    assert all(r.successful for r in getattr(answer, 'results', None) or [answer.result])
    node.check()


def test_filters_change_while_running_and_bad_files_are_refused(start, peer, tmp_path):
    node = start('node', *ARGUMENTS, '-p', f'input.filters_directory:={tmp_path}')
    peer.advertise('/odom', '/points')
    client = peer.parameters()
    near, wrong = tmp_path / 'near.yaml', tmp_path / 'wrong.yaml'
    near.write_text('- MaxDistDataPointsFilter:\n    maxDist: 3.0\n', encoding='utf-8')
    wrong.write_text('- MaxDistDataPointFilter\n', encoding='utf-8')

    def change(path):
        found = client.set_parameters([Parameter('filters', value=str(path))])
        return peer.result(found).results[0]

    messages = drive(3)
    send(peer, messages[:1])
    peer.diagnosis({'scans.mapped': 1})
    for path, reason in (
        (tmp_path / 'nowhere.yaml', 'cannot be read'),
        (wrong, 'no valid chain of filters'),
    ):
        refused = change(path)
        assert not refused.successful
        assert reason in refused.reason
    assert change(near).successful
    send(peer, messages[1:2])
    _, values = peer.diagnosis({'scans.mapped': 2})
    left_out = int(values['points_left_out.filtered'])
    assert 1000 < left_out < 4000
    assert change('').successful
    send(peer, messages[2:])
    _, values = peer.diagnosis({'scans.mapped': 3})
    assert int(values['points_left_out.filtered']) == left_out
    assert 'Traceback' not in node.output


def test_limits_and_rates_change_while_running(start, peer):
    start('node', *ARGUMENTS, '-p', 'publish.normals_rate_hz:=0.0')
    peer.advertise('/odom', '/points')
    normals = peer.collect(PointCloud2, f'{NODE}/normals')
    client = peer.parameters()

    def change(**values):
        pairs = [Parameter(k.replace('__', '.'), value=v) for k, v in values.items()]
        return peer.result(client.set_parameters(pairs)).results

    send(peer, drive(2))
    peer.diagnosis({'scans.mapped': 2})
    assert normals == []
    assert change(publish__normals_rate_hz=20)[0].successful  # a whole number for a float
    peer.spin_until(lambda: normals)

    assert change(map__min_points=50)[0].successful
    expected = len(mapped(drive(2))[1].map.surfels(50))
    assert expected < normals[0].width
    peer.spin_until(lambda: normals[-1].width == expected)


def test_a_missing_pose_is_counted_by_frame_and_logged_with_a_remedy(start, peer):
    waits = ('-p', 'pose.max_wait_s:=0.05', '-p', 'pose.max_delay_s:=0.05')
    node = start('node', *ARGUMENTS, *waits)
    peer.advertise('/odom', '/points')
    (first, pose), (second, _) = drive(2)
    send(peer, [(first, pose)])
    other = cloud(START_NS + PERIOD_NS // 2, room(seed=3), 'elsewhere')
    peer.publish('/points', other)
    late = START_NS + 5 * PERIOD_NS
    stamp(second, late)
    peer.publish('/points', second)
    later = odometry(late + PERIOD_NS, (1.0, 0.0, 0.0))
    later.child_frame_id = 'nothing_known'
    peer.publish('/odom', later)

    _, values = peer.diagnosis({'scans.dropped.no_pose': 2})

    by_frame = {k: v for k, v in values.items() if k.startswith('scans.dropped_by_frame')}
    assert by_frame == {
        'scans.dropped_by_frame.elsewhere.no_pose': '1',
        'scans.dropped_by_frame.lidar.no_pose': '1',
    }
    dropped = next(line for line in node.output.splitlines() if 'elsewhere' in line)
    for said in ('scan on /points at', "in frame 'elsewhere' dropped: no pose", 'frames.fixed'):
        assert said in dropped
