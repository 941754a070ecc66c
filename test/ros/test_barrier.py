# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of callbacks, that nothing expects, are counted and logged, and the node goes on."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from nav_msgs.srv import LoadMap
from rclpy.qos import QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger

from surfel_mapper.config import Config
from surfel_mapper.errors import BagError
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.drops import INTERNAL
from surfel_mapper.ros import services
from surfel_mapper.ros.base_node import steady_timer
from surfel_mapper.ros.line_logger import LineLogger
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.services import Services
from surfel_mapper.ros.subscription_executor import SubscriptionExecutor


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


def test_a_map_whose_reader_fails_is_refused_and_counted(peer, monkeypatch):
    """An OverflowError by a file in the directory of maps ended the node."""
    mapper = Mapper(Config())
    thread = MappingThread(mapper, pytest.fail)
    thread.start(lambda update: None)
    monkeypatch.setattr(services, 'load_map', lambda mapper, url: int(float('inf')))
    monkeypatch.setattr(services, 'save_map', fail)
    Services(peer.node, mapper, thread, SimpleNamespace(expire=lambda: None))
    load = peer.node.create_client(LoadMap, '/peer/load_map')
    save = peer.node.create_client(Trigger, '/peer/save_map')
    peer.spin_until(lambda: load.service_is_ready() and save.service_is_ready())

    answer = peer.result(load.call_async(LoadMap.Request(map_url='map')))
    assert answer.result == LoadMap.Response.RESULT_UNDEFINED_FAILURE
    answer = peer.result(save.call_async(Trigger.Request()))
    assert not answer.success
    assert answer.message == 'MemoryError: no room'
    thread.stop()
    assert mapper.counters.messages_ignored == {INTERNAL: 2}


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
