# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of callbacks, that nothing expects, are counted and logged, and the node goes on."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')

from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from std_msgs.msg import String
from std_srvs.srv import Trigger

from surfel_mapper.errors import BagError
from surfel_mapper.ros.base_node import steady_timer
from surfel_mapper.ros.line_logger import LineLogger


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
        (False, '501 parameters, expected at most 500')
    }
    whole = peer.result(client.set_parameters_atomically(many)).result
    assert whole.reason == '501 parameters, expected at most 500'
    assert not peer.result(client.list_parameters(['use_sim_time'] * 501, 1)).result.names
    assert not failures
    assert peer.result(client.list_parameters(['use_sim_time'], 1)).result.names


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
