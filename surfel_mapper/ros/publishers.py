# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The publishers of a topic, and why a subscription cannot hear them.

A topic may have publishers of another type, which the graph lists too: they send nothing to a
subscription, so their quality of service does not matter. Fast DDS uses shared memory between
processes of one machine, and cannot open that of another user: publishers match, and are silent.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
import pwd
import re
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from surfel_mapper.messages.converters import converter

SHARED_MEMORY = Path('/dev/shm')

PORT = re.compile('fastrtps_port([0-9]+)')
"""Shared memory in which a participant of Fast DDS is told of messages, by its port."""

FIRST_PORT, PORTS_OF_DOMAIN = 7400, 250
"""Ports of domain 0, and their number in each domain; from the RTPS specification."""

UNHEARD = {
    'reliability': (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE),
    'durability': (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL),
}
"""Policy offered by a publisher that a subscription with the second one does not hear."""


def type_name(message: Any) -> str:
    """Return the name of the type of a message class."""
    return f'{message.__module__.partition(".")[0]}/msg/{message.__name__}'


def publishers_of(node: Node, topic: str, message: Any) -> list[TopicEndpointInfo]:
    """Return the publishers of a topic that send messages of a class."""
    kind = type_name(message)
    endpoints = node.get_publishers_info_by_topic(topic)
    return [publisher for publisher in endpoints if publisher.topic_type == kind]


def full_name(publisher: TopicEndpointInfo) -> str:
    """Return the name of the node of a publisher."""
    return f'{publisher.node_namespace.rstrip("/")}/{publisher.node_name}'


def of_other_types(node: Node, topic: str, message: Any) -> str:
    """Return the publishers of a topic that send messages of another class; empty if none."""
    expected = publishers_of(node, topic, message)
    texts = {
        f'{full_name(publisher)} publishes {with_converter(publisher.topic_type)} there'
        for publisher in node.get_publishers_info_by_topic(topic)
        if publisher not in expected
    }
    return f'{", ".join(sorted(texts))}, expected {type_name(message)}' if texts else ''


def with_converter(kind: str) -> str:
    """Return the name of a type, and the program that makes PointCloud2 of it, if there is one."""
    program = converter(kind)
    return f'{kind} (to convert: {program})' if program else kind


def other_users(domain_id: int, user_id: int) -> str:
    """Return the other users with participants of Fast DDS in a domain of this machine."""
    first = FIRST_PORT + PORTS_OF_DOMAIN * domain_id
    ids = set()
    for path in SHARED_MEMORY.glob('fastrtps_port*'):
        match = PORT.fullmatch(path.name)
        if match and first <= int(match[1]) < first + PORTS_OF_DOMAIN:
            with suppress(OSError):  # gone
                ids.add(path.stat().st_uid)
    return ', '.join(map(user_name, sorted(ids - {user_id})))


def user_name(user_id: int) -> str:
    """Return the name of a user, or the number without one."""
    try:
        return pwd.getpwuid(user_id).pw_name
    except KeyError:
        return str(user_id)


def override(topic: str, policy: str) -> str:
    """Return the name of the parameter that sets a policy of a subscription."""
    return f'qos_overrides.{topic}.subscription.{policy}'


def is_overridden(node: Node, topic: str, policy: str) -> bool:
    """Return whether the user has set a policy of a subscription."""
    return override(topic, policy) in node._parameter_overrides


def mismatch(node: Node, topic: str, message: Any, qos: QoSProfile) -> str:
    """
    Return which publisher a subscription cannot hear, and the remedy; empty if it hears all.

    Reliability counts only if the user has set it, since it follows the publishers otherwise.
    """
    for publisher in publishers_of(node, topic, message):
        name = full_name(publisher)
        for policy, (offered, wanted) in UNHEARD.items():
            policies = getattr(publisher.qos_profile, policy), getattr(qos, policy)
            if policies != (offered, wanted):
                continue
            offer, wish = offered.name.lower(), wanted.name.lower()
            if is_overridden(node, topic, policy):
                return (
                    f'{name} publishes {offer}, but {override(topic, policy)} is {wish}, so that '
                    'its messages do not arrive; remove this setting'
                )
            if policy != 'reliability':
                return f'{name} publishes {offer}, expected {wish}: its messages do not arrive'
    return ''
