# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Search of the graph for a topic of another name, if the default one has no publisher.

Drivers name their topics as they like, and a robot often has one lidar and one odometry. Topics
that mapping nodes publish are left out: a map is not an input.
"""

from __future__ import annotations

from typing import Any

from rclpy.node import Node

from surfel_mapper.ros.publishers import publishers_of

MARK = 'clear_polygon'
"""Private topic that every mapping node subscribes to, by which they are recognised."""


class TopicSearch:
    """
    A topic by its name, and those of the same type that others publish.

    Parameters
    ----------
    node : Node
        The node that reads it.
    name : str
        Its name before remapping, such as points.
    message : type
        Class of its messages.

    Attributes
    ----------
    topic : str
        Its full name.
    has_publisher : bool
        Whether it had a publisher when ``look`` was called last.
    alternatives : list of str
        Topics of its type with a publisher, as ``look`` saw them; none if it has one itself.

    """

    def __init__(self, node: Node, name: str, message: Any) -> None:
        self._node = node
        self._name = name
        self._message = message
        self.topic = str(node.resolve_topic_name(name))
        self.has_publisher = False
        self.alternatives: list[str] = []

    def look(self) -> None:
        """Look at the graph."""
        self.has_publisher = bool(publishers_of(self._node, self.topic, self._message))
        self.alternatives = [] if self.has_publisher else self._published_elsewhere()

    @property
    def only_alternative(self) -> str:
        """
        The only other topic of the type, to be read instead.

        Empty if there are several, if the user has remapped the topic, or if it is outside the
        namespace of the node: it is another robot's then.
        """
        namespace = self._node.get_namespace().rstrip('/')
        is_only = len(self.alternatives) == 1 and self.alternatives[0].startswith(f'{namespace}/')
        return self.alternatives[0] if is_only and not self._is_remapped else ''

    @property
    def _is_remapped(self) -> bool:
        """Whether the user has given the topic another name."""
        return self.topic != str(self._node.resolve_topic_name(self._name, only_expand=True))

    @property
    def missing(self) -> str:
        """The lack of a publisher, with the arguments that read other topics; empty if none."""
        if self.has_publisher:
            return ''
        arguments = ' or '.join(map(self.argument, self.alternatives))
        return f'no publisher of {self.topic}{f"; choose with {arguments}" if arguments else ""}'

    def argument(self, topic: str) -> str:
        """Return the argument of the node that reads another topic."""
        return f'-r {self._name}:={topic}'

    def _published_elsewhere(self) -> list[str]:
        """Return the topics of the type that have a publisher other than mapping nodes."""
        graph = self._node.get_topic_names_and_types()
        marks = {topic for topic, _ in graph if topic.endswith(f'/{MARK}')}
        return sorted(topic for topic, _ in graph if self._is_input(topic, marks))

    def _is_input(self, topic: str, marks: set[str]) -> bool:
        """Return whether a topic has a publisher of the type that is no mapping node."""
        return any(
            f'{publisher.node_namespace.rstrip("/")}/{publisher.node_name}/{MARK}' not in marks
            for publisher in publishers_of(self._node, topic, self._message)
        )
