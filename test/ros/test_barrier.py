# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of callbacks, that nothing expects, are counted and logged, and the node goes on."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from nav_msgs.srv import LoadMap
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger

from surfel_mapper.config import Config
from surfel_mapper.errors import BagError, ConfigError
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.drops import INTERNAL
from surfel_mapper.ros import map_files, services
from surfel_mapper.ros.base_node import BaseNode, steady_timer
from surfel_mapper.ros.context import context
from surfel_mapper.ros.line_logger import LineLogger
from surfel_mapper.ros.main import executing
from surfel_mapper.ros.main_thread import TaskQueue
from surfel_mapper.ros.map_files import MapWriter
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.services import Services
from surfel_mapper.ros.subscription_executor import SubscriptionExecutor
from surfel_mapper.ros.turns import take_turns


def fail(*_):
    raise MemoryError('no\nroom')


@pytest.fixture
def peer(guarded_peer):
    return guarded_peer


@pytest.fixture
def failures(peer, monkeypatch):
    """Return the list of failures that the node of the peer reports."""
    found = []
    monkeypatch.setattr(
        peer.node, 'report_failure', lambda task, error: found.append((task, type(error)))
    )
    return found


def test_a_timer_that_fails_is_called_again(peer, failures):
    steady_timer(peer.node, 100.0, fail)
    peer.spin_until(lambda: len(failures) > 2)
    assert set(failures) == {('a timer', MemoryError)}


def test_a_subscription_that_fails_takes_the_next_message(peer, failures):
    peer.node.create_subscription(String, '/words', fail, 10)
    publisher = peer.node.create_publisher(String, '/words', 10)
    peer.spin_until(publisher.get_subscription_count)
    for _ in range(2):
        publisher.publish(String(data='a'))
    peer.spin_until(lambda: len(failures) == 2)
    assert set(failures) == {('a message on /words', MemoryError)}


def test_a_callback_that_fails_in_the_thread_of_subscriptions_does_not_end_it(peer, failures):
    ends = []
    executor = SubscriptionExecutor(peer.node, ends.append)
    executor.subscribe(String, '/words', fail, QoSProfile(depth=10))
    executor.start()
    publisher = peer.node.create_publisher(String, '/words', 10)
    peer.spin_until(publisher.get_subscription_count)
    for _ in range(2):
        publisher.publish(String(data='a'))
    peer.spin_until(lambda: len(failures) == 2)
    executor.stop()
    assert not ends
    assert set(failures) == {('a message on /words', MemoryError)}


def test_a_service_that_fails_refuses_the_request(peer, failures):
    async def wait_and_fail(request, response):
        fail()

    for name, callback in (('/now', fail), ('/later', wait_and_fail)):
        peer.node.create_service(Trigger, name, callback)
        client = peer.node.create_client(Trigger, name)
        peer.spin_until(client.service_is_ready)
        answer = peer.result(client.call_async(Trigger.Request()))
        assert not answer.success
        assert answer.message == 'MemoryError: no room'
        assert failures.pop() == (f'a request to {name}', MemoryError)


def test_a_parameter_whose_callback_fails_is_refused(peer, failures):
    peer.node.declare_parameter('a', 1)
    peer.node.add_on_set_parameters_callback(fail)
    client = AsyncParameterClient(peer.node, '/peer')
    peer.spin_until(client.services_are_ready)
    (answer,) = peer.result(client.set_parameters([Parameter('a', value=2)])).results
    assert not answer.successful
    assert answer.reason == 'MemoryError: no room'
    assert peer.node.get_parameter('a').value == 1
    assert [kind for _, kind in failures] == [MemoryError]


def test_a_request_of_more_than_500_parameters_is_refused(peer, failures):
    """20,000 unknown names took 14 s, in which no other request was answered."""
    client = AsyncParameterClient(peer.node, 'peer')
    peer.spin_until(client.services_are_ready)
    many = [Parameter(f'p{n}', value=n) for n in range(501)]
    results = peer.result(client.set_parameters(many)).results
    assert {(result.successful, result.reason) for result in results} == {
        (False, 'ConfigError: 501 parameters, expected at most 500')
    }
    whole = peer.result(client.set_parameters_atomically(many)).result
    assert whole.reason == 'ConfigError: 501 parameters, expected at most 500'
    assert not peer.result(client.list_parameters(['use_sim_time'] * 501, 1)).result.names
    assert failures == [
        ('a request to peer/set_parameters', ConfigError),
        ('a request to peer/set_parameters_atomically', ConfigError),
        ('a request to peer/list_parameters', ConfigError),
    ]
    assert peer.result(client.list_parameters(['use_sim_time'], 1)).result.names


def test_an_error_outside_of_our_callbacks_does_not_end_the_executor(peer, monkeypatch):
    """A request to a service of rclpy's own, as ~/get_state, that failed ended the node."""
    node = BaseNode('node', context=peer.node.context)
    node.tasks, reported = TaskQueue(), []
    monkeypatch.setattr(node, 'report_failure', lambda task, error: reported.append((task, error)))
    Node.create_service(node, Trigger, '/unguarded', fail)
    node.create_service(Trigger, '/answers', lambda request, response: response)
    clients = [peer.node.create_client(Trigger, name) for name in ('/unguarded', '/answers')]
    peer.spin_until(lambda: all(client.service_is_ready() for client in clients))
    with executing(node):
        for number in range(1, 4):
            clients[0].call_async(Trigger.Request())
            peer.spin_until(lambda number=number: len(reported) == number)
        peer.result(clients[1].call_async(Trigger.Request()))
    node.destroy_node()
    assert {(task, type(error)) for task, error in reported} == {
        ('a turn of the executor', MemoryError)
    }
    assert not node.tasks.has_failed


def test_a_graph_that_cannot_be_read_does_not_end_the_thread_of_subscriptions(peer, failures):
    ends, words = [], []
    executor = SubscriptionExecutor(peer.node, ends.append)
    executor.subscribe(String, '/words', words.append, QoSProfile(depth=10))
    read = peer.node.get_publishers_info_by_topic
    peer.node.get_publishers_info_by_topic = lambda topic: fail() if not failures else read(topic)
    executor.start()
    publisher = peer.node.create_publisher(String, '/words', 10)
    peer.spin_until(lambda: failures and publisher.get_subscription_count())
    publisher.publish(String(data='a'))
    peer.spin_until(lambda: words)
    executor.stop()
    assert not ends
    assert failures == [('a turn of subscriptions', MemoryError)]


def test_turns_go_on_until_ten_in_a_row_have_failed():
    outcomes, reported = [*'xxxxxxxxx.xxxxxxxxxx'], []

    def turn():
        if outcomes.pop(0) == 'x':
            raise MemoryError(len(outcomes))
        return True

    with pytest.raises(MemoryError, match=r'^0$'):
        take_turns(turn, lambda error: reported.append(int(str(error))))
    assert reported == [*range(19, 10, -1), *range(9, 0, -1)]


def test_a_report_that_fails_is_reported_in_its_turn():
    reports = []

    def report(error):
        reports.append(str(error))
        if len(reports) == 1:
            raise MemoryError('of the report')

    turns = iter([True, False])
    take_turns(lambda: fail() if not reports else next(turns), report)
    assert reports == ['no\nroom', 'of the report']


def test_a_map_whose_reader_fails_is_refused_and_counted(peer, monkeypatch):
    """An OverflowError by a file in the directory of maps ended the node."""
    mapper = Mapper(Config())
    thread = MappingThread(mapper, pytest.fail)
    thread.start(lambda update: None)
    monkeypatch.setattr(services, 'load_map', lambda mapper, url: int(float('inf')))
    monkeypatch.setattr(map_files, 'copied_map', fail)
    writer = MapWriter(mapper, thread)
    Services(peer.node, mapper, thread, SimpleNamespace(expire=lambda: None), writer)
    load = peer.node.create_client(LoadMap, '/peer/load_map')
    save = peer.node.create_client(Trigger, '/peer/save_map')
    peer.spin_until(lambda: load.service_is_ready() and save.service_is_ready())

    answer = peer.result(load.call_async(LoadMap.Request(map_url='map')))
    assert answer.result == LoadMap.Response.RESULT_UNDEFINED_FAILURE
    answer = peer.result(save.call_async(Trigger.Request()))
    assert not answer.success
    assert answer.message == 'MemoryError: no room'
    thread.stop()
    writer.close()
    assert mapper.counters.messages_ignored == {INTERNAL: 2}


def test_arguments_for_ros_that_are_no_text_are_refused(domain):
    """Names of files may be any bytes; rclpy raised a UnicodeEncodeError."""
    arguments = ['--ros-args', '--params-file', '/no\udcff\n']
    expected = pytest.raises(ConfigError, match='arguments after --ros-args: ')
    with expected as refused, context(arguments):
        pass
    assert str(refused.value).isprintable()


def test_the_log_of_a_node_has_one_line_for_each_message(peer, monkeypatch):
    """A map_url or the frame of a polygon with a line break forged a line of the log."""
    logged = []
    parent = LineLogger.__mro__[1]
    monkeypatch.setattr(parent, 'log', lambda self, text, severity, **_: logged.append(text))
    log = peer.node.get_logger()
    log.info('cleared the polygon in frame a\n[FATAL] forged\x1b[31m')
    log.error(str(BagError('b\nc')))
    log.warning('x' * 10_000_000)
    assert logged[:2] == [
        'cleared the polygon in frame a\\n[FATAL] forged\\x1b[31m',
        'b\\nc',
    ]
    assert len(logged[2]) < 5000


def test_a_logger_takes_messages_of_every_severity_from_anywhere(peer):
    """Rclpy refuses two severities from one line of code, and sees the lines of callers."""
    log = peer.node.get_logger()
    assert log.info('a')
    assert log.warning('b', throttle_duration_sec=100.0)
    for text in ('c', 'd'):
        assert log.error(text, throttle_duration_sec=100.0) == (text == 'c')
