# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The subscriptions to poses, and the choice of ``pose.source: auto``.

With auto, transforms, odometry and poses are all read, and kept here until the first cloud is
there and a source is chosen. The scans wait meanwhile. Then the poses of the chosen source go to
the mapping thread, before the scans, and the other subscriptions end.

``check`` runs in the thread of the subscriptions, as do all callbacks, so nothing is locked.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
import time
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from surfel_mapper.config import Config
from surfel_mapper.errors import DependencyError, PoseError
from surfel_mapper.messages.poses import ODOMETRY, POSE, raw_poses, StampedPose, TF
from surfel_mapper.poses import (
    AUTO,
    choose_source,
    has_chain,
    MAX_EDGES,
    PoseCandidate,
    SourceChoice,
    without_chain,
)
from surfel_mapper.ros.base_node import BaseNode
from surfel_mapper.ros.clock_watch import ClockWatch
from surfel_mapper.ros.mapping_thread import MappingThread, MAX_POSES
from surfel_mapper.ros.subscription_executor import SubscriptionExecutor
from surfel_mapper.ros.topic_search import TopicSearch

POSES = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)

STATIC_TRANSFORMS = QoSProfile(
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)

STATIC_TOPIC, TREE_TOPIC = '/tf_static', '/tf'

TREE_S = 1.0
"""
Time after the first cloud before odometry or poses are chosen, s. A tree of transforms is chosen
at once; at the usual 10 Hz and more it is complete within this time.
"""

HOW_TO_CHOOSE = 'to choose another: -p pose.source:=tf, odometry or pose, at the start'


class PoseInputs:
    """
    The subscriptions of a node to poses.

    Parameters
    ----------
    node : BaseNode
        The node that subscribes.
    config : Config
        Its stages pose and frames are used.
    thread : MappingThread
        Takes the poses.
    subscriptions : SubscriptionExecutor
        Takes the messages.
    clocks : ClockWatch
        Gets the stamps of poses, and gives times to those without.
    on_choice : callable
        Called with the source that auto takes, once its poses are in the queue of the thread.

    Attributes
    ----------
    choice : SourceChoice or None
        The source that auto has taken; None before, and if another source is configured.

    Raises
    ------
    DependencyError
        If ``pose.source`` is tf and tf2_msgs is not installed.

    """

    def __init__(
        self,
        node: BaseNode,
        config: Config,
        thread: MappingThread,
        subscriptions: SubscriptionExecutor,
        clocks: ClockWatch,
        on_choice: Callable[[SourceChoice], object],
    ) -> None:
        if config.pose.source == TF:
            transform_message()
        self.choice: SourceChoice | None = None
        self._node = node
        self._config = config
        self._thread = thread
        self._subscriptions = subscriptions
        self._clocks = clocks
        self._on_choice = on_choice
        self._odometry = TopicSearch(node, 'odom', Odometry)
        self._pose = TopicSearch(node, 'pose', PoseStamped, PoseWithCovarianceStamped)
        self._pose_message = PoseStamped
        self._waiting: dict[str, deque[StampedPose]] = {}  # by topic, until the choice
        self._static: dict[str, StampedPose] = {}  # by child
        self._missing = ''
        self._frame_id = ''
        self._first_cloud_s: float | None = None

    def subscribe(self) -> None:
        """Subscribe to the poses of the source; with auto, to those of all until it has chosen."""
        self._first_cloud_s = None
        self._waiting.clear()
        if self.is_choosing:
            self._subscribe_all()
            return
        source = self._config.pose.source if self.choice is None else self.choice.source
        if source in (ODOMETRY, POSE):
            name = source if source == POSE else 'odom'
            self._subscribe(source, name if self.choice is None else self.choice.topic)
        elif source == TF:
            self._subscribe(TF, STATIC_TOPIC)
            self._subscribe(TF, TREE_TOPIC)
        if source in (ODOMETRY, POSE, 'registration') and not self._config.frames.base_to_sensor:
            self._subscribe_static()

    @property
    def is_choosing(self) -> bool:
        """Whether auto has not chosen yet."""
        return self._config.pose.source == AUTO and self.choice is None

    @property
    def is_looking(self) -> bool:
        """Whether auto has not chosen yet, or poses have no publisher yet."""
        waits = self._config.pose.source == POSE and not self._pose.has_publisher
        return self.is_choosing or waits

    @property
    def source(self) -> str:
        """The present source of the poses, or that none is chosen yet."""
        if self.choice is not None:
            return self.choice.source
        return 'not chosen yet' if self.is_choosing else self._config.pose.source

    @property
    def reason(self) -> str:
        """Why the source was taken; until auto has chosen, the reasons against all."""
        if self.choice is not None:
            return self.choice.reason
        return self._missing if self.is_choosing else 'configured'

    @property
    def warning(self) -> str:
        """Which poses are missing, and the remedy; empty if the source is there or configured."""
        if self.choice is not None:
            is_last = self.choice.source == 'registration'
            return f'{self.choice}; {HOW_TO_CHOOSE}' if is_last else ''
        if not self.is_choosing or self._waited_s < self._config.pose.registration_after_s:
            return ''
        return (
            f'scans wait: {self._missing}; map.origin needs poses, so that registration is not '
            f'taken; {HOW_TO_CHOOSE}'
        )

    def mount_changes(self, changes: str) -> str:
        """Return changes of mounts with the nodes that publish them; empty if there are none."""
        return (
            f'{changes} until ~/clear ({self._subscriptions.eager_publishers()})'
            if changes
            else ''
        )

    def note_cloud(self, frame_id: str) -> None:
        """Take the frame of the first cloud; the waits begin with it."""
        if self._first_cloud_s is None and self.is_choosing:
            self._frame_id, self._first_cloud_s = frame_id, time.monotonic()

    def check(self) -> None:
        """Choose a source, if it is time and one is there; read poses with the type they have."""
        if not self.is_looking:
            return
        self._pose.look()
        if self._pose.message is not self._pose_message:
            self._pose_message = self._pose.message
            self._subscriptions.unsubscribe(self._pose.topic)
            self._subscribe(POSE, self._pose.topic)
        if not self.is_choosing:
            return
        self._odometry.look()
        alternative = self._odometry.only_alternative
        if alternative and alternative not in self._waiting:
            self._subscribe(ODOMETRY, alternative)
        choice, waited_s = choose_source(self._candidates()), self._waited_s
        self._missing = choice.reason
        is_due = waited_s >= (TREE_S if choice.topic else self._config.pose.registration_after_s)
        may_register = not self._config.map.origin
        if self._first_cloud_s is not None and (
            choice.source == TF or (is_due and (choice.topic or may_register))
        ):
            self._take(choice)

    @property
    def _waited_s(self) -> float:
        """Time since the first cloud, s; 0 without one."""
        return 0.0 if self._first_cloud_s is None else time.monotonic() - self._first_cloud_s

    def _candidates(self) -> list[PoseCandidate]:
        """Return the sources, each with its topic or the reason against it."""
        odometry, topic = self._odometry, self._odometry.only_alternative
        argument = odometry.argument(topic) if topic else ''
        missing = '' if topic else odometry.missing
        return [
            PoseCandidate(TF, TREE_TOPIC, self._missing_tree()),
            PoseCandidate(ODOMETRY, topic or odometry.topic, missing, argument),
            PoseCandidate(POSE, self._pose.topic, self._pose.missing),
        ]

    def _missing_tree(self) -> str:
        """Return why the tree of transforms has no pose of the clouds; empty if it has."""
        if TREE_TOPIC not in self._waiting:
            return 'tf2_msgs is not installed'
        if not self._waiting[TREE_TOPIC] and not self._static:
            return f'no transforms on {TREE_TOPIC} and {STATIC_TOPIC}'
        return self._missing_chain(self._waiting[TREE_TOPIC])

    def _missing_chain(self, poses: Sequence[StampedPose]) -> str:
        """Return that poses and static transforms do not lead to the clouds; empty if they do."""
        frames = self._config.frames
        parents = {pose.child: pose.parent for pose in (*self._static.values(), *poses)}
        if frames.mount_of(self._frame_id) and self._frame_id != frames.base:
            parents[self._frame_id] = frames.base
        is_there = has_chain(parents, frames.fixed, self._frame_id)
        return '' if is_there else without_chain(frames.fixed, [self._frame_id])

    def _take(self, choice: SourceChoice) -> None:
        """Hand the poses of a source to the mapping thread, and stop reading those of others."""
        self.choice = choice
        log = self._node.get_logger()
        if self.warning:
            wait_s = self._config.pose.registration_after_s
            log.warning(f'no poses within {wait_s:g} s of the first cloud: {self.warning}')
        else:
            log.info(str(choice))
        poses = self._waiting.get(choice.topic, deque())
        if choice.topic and not poses:
            log.warning(f'{choice.topic}: no message yet, scans wait for its poses')
        elif poses and (missing := self._missing_chain(poses)):
            parent, child, fixed = poses[-1].parent, poses[-1].child, self._config.frames.fixed
            remedy = f'set frames.base_to_sensor, the pose of the sensor in {child}'
            if parent == child:
                remedy = f'the poses are of {child} in itself'
            elif parent != fixed:
                remedy = f'the poses are in {parent}: set frames.fixed: {parent}'
            log.warning(f'{missing}: {remedy}')
        for topic in (*self._waiting, STATIC_TOPIC):
            if not self._reads(topic, choice):
                self._subscriptions.unsubscribe(topic)
        if self._reads(STATIC_TOPIC, choice):
            self._put_static()
        self._thread.put_poses(poses)
        self._waiting.clear()
        self._on_choice(choice)

    def _put_static(self) -> None:
        """Hand on the static transforms; mounts of the configuration are in the mapper already."""
        frames = self._config.frames
        mounted = {self._frame_id, *frames.sensors} if frames.base_to_sensor else set()
        transforms = [pose for pose in self._static.values() if pose.child not in mounted]
        self._thread.put_poses(transforms, static=True)

    def _reads(self, topic: str, choice: SourceChoice) -> bool:
        """Return whether a topic is read with a source; mounts come from static transforms."""
        if topic == STATIC_TOPIC:
            return choice.source == TF or not self._config.frames.base_to_sensor
        return topic == choice.topic

    def _subscribe_all(self) -> None:
        """Subscribe to the poses of all sources."""
        topics = {POSE: self._pose.topic, ODOMETRY: self._odometry.topic}
        try:
            transform_message()
        except DependencyError:
            pass  # the reason of the choice says so
        else:
            self._subscribe(TF, STATIC_TOPIC)
            topics[TF] = TREE_TOPIC
        for kind, topic in topics.items():
            self._subscribe(kind, topic)

    def _subscribe_static(self) -> None:
        """Subscribe to /tf_static for the mounting poses of sensors."""
        try:
            self._subscribe(TF, STATIC_TOPIC)
        except DependencyError:
            self._node.get_logger().warning(
                'tf2_msgs is not installed, so /tf_static is not read: clouds have to be in '
                f'{self._config.frames.base}, or set frames.base_to_sensor'
            )

    def _subscribe(self, kind: str, topic: str) -> None:
        """Subscribe to poses or transforms."""
        messages = {ODOMETRY: Odometry, POSE: self._pose_message}
        message = messages.get(kind) or transform_message()
        qos = STATIC_TRANSFORMS if topic == STATIC_TOPIC else POSES
        if self.is_choosing and topic != STATIC_TOPIC:
            self._waiting.setdefault(topic, deque(maxlen=MAX_POSES))
        on_pose = partial(self._on_pose, kind, topic, self._node.resolve_topic_name(topic))
        self._subscriptions.subscribe(message, topic, on_pose, qos, eager=True, raw=True)

    def _on_pose(self, kind: str, topic: str, full_name: str, raw: bytes) -> None:
        try:
            poses = raw_poses(kind, raw, self._config.frames.base, full_name)
        except PoseError as error:
            self._thread.refuse_pose(str(error))
            return
        is_static = topic == STATIC_TOPIC
        if not is_static:
            poses = self._stamped(poses, full_name)
        if not self.is_choosing:
            self._thread.put_poses(poses, static=is_static)
        elif is_static:
            self._static.update((pose.child, pose) for pose in poses)
            while len(self._static) > MAX_EDGES:  # the buffer of the mapper holds no more
                self._static.popitem()
        else:
            self._waiting[topic].extend(poses)

    def _stamped(self, poses: list[StampedPose], topic: str) -> list[StampedPose]:
        """Return poses with the time of their arrival if their stamp is 0; note the others."""
        if not self.is_choosing:
            self._clocks.note_poses(topic, [pose.stamp_ns for pose in poses if pose.stamp_ns])
        if all(pose.stamp_ns for pose in poses):
            return poses
        now_ns = self._clocks.arrival_ns(topic)
        return [pose if pose.stamp_ns else pose._replace(stamp_ns=now_ns) for pose in poses]


def transform_message() -> Any:
    """
    Return the class tf2_msgs/TFMessage.

    Raises
    ------
    DependencyError
        If it is not installed; the message has the command and the alternatives.

    """
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError as error:
        raise DependencyError(
            'pose.source tf needs the package tf2_msgs, which is not installed: '
            '`sudo apt install ros-jazzy-tf2-msgs`. PyPI has no such package; with ROS from '
            'there use pose.source odometry or pose, and frames.base_to_sensor'
        ) from error
    return TFMessage
