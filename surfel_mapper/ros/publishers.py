# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The publishers of a topic, and those that a subscription cannot hear because of its QoS.

A topic may have publishers of another type, which the graph lists too: they send nothing to a
subscription, so their quality of service does not matter.
"""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

UNHEARD = {
    'reliability': (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE),
    'durability': (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL),
}
"""Policy offered by a publisher that a subscription with the second one does not hear."""


def publishers_of(node: Node, topic: str, message: Any) -> list[TopicEndpointInfo]:
    """Return the publishers of a topic that send messages of a class."""
    package = message.__module__.partition('.')[0]
    kind = f'{package}/msg/{message.__name__}'
    found = node.get_publishers_info_by_topic(topic)
    return [publisher for publisher in found if publisher.topic_type == kind]


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
        name = f'{publisher.node_namespace.rstrip("/")}/{publisher.node_name}'
        for policy, (offered, wanted) in UNHEARD.items():
            found = getattr(publisher.qos_profile, policy), getattr(qos, policy)
            if found != (offered, wanted):
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
