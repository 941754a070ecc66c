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
from sensor_msgs.msg import PointCloud2

from surfel_mapper.messages.converters import converter
from surfel_mapper.ros.publishers import full_name, publishers_of, with_converter

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
    messages : type
        Classes of its messages, the usual one first.

    Attributes
    ----------
    topic : str
        Its full name.
    message : type
        The class that it was published with when ``look`` was called last; else the first.
    has_publisher : bool
        Whether it had a publisher when ``look`` was called last.
    alternatives : list of str
        Topics of its type with a publisher, as ``look`` saw them; none if it has one itself.
    convertible : list of str
        Topics of other types that a program makes PointCloud2 of, with type and program.

    """

    def __init__(self, node: Node, name: str, *messages: Any) -> None:
        self._node = node
        self._name = name
        self._messages = messages
        self.message = messages[0]
        self.topic = str(node.resolve_topic_name(name))
        self.has_publisher = False
        self.alternatives: list[str] = []
        self.convertible: list[str] = []

    def look(self) -> None:
        """Look at the graph."""
        published = [
            message for message in self._messages if publishers_of(self._node, self.topic, message)
        ]
        self.message = (*published, self._messages[0])[0]
        self.has_publisher = bool(published)
        self.alternatives = [] if self.has_publisher else self._published_elsewhere()
        self.convertible = [] if self.has_publisher else self._convertible()

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
        choice = f'choose with {arguments}' if arguments else ''
        return '; '.join(
            filter(None, [f'no publisher of {self.topic}', choice, *self.convertible])
        )

    def argument(self, topic: str) -> str:
        """Return the argument of the node that reads another topic."""
        return f'-r {self._name}:={topic}'

    def _published_elsewhere(self) -> list[str]:
        """Return the topics of the type that have a publisher other than mapping nodes."""
        graph = self._node.get_topic_names_and_types()
        marks = {topic for topic, _ in graph if topic.endswith(f'/{MARK}')}
        return sorted(topic for topic, _ in graph if self._is_input(topic, marks))

    def _convertible(self) -> list[str]:
        """Return the topics of which a program makes clouds, if clouds are looked for."""
        if PointCloud2 not in self._messages:
            return []
        graph = self._node.get_topic_names_and_types()
        texts = (
            (topic, with_converter(kind))
            for topic, kinds in graph
            for kind in kinds
            if converter(kind)
        )
        return [f'{topic} has {text}' for topic, text in sorted(texts)]

    def _is_input(self, topic: str, marks: set[str]) -> bool:
        """Return whether a topic has a publisher of the type that is no mapping node."""
        return any(
            f'{full_name(publisher)}/{MARK}' not in marks
            for message in self._messages
            for publisher in publishers_of(self._node, topic, message)
        )
