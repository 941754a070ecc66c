# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Running the node, from its arguments to its end.

The executor runs in a thread of its own, since the main thread cannot hear a
signal while it waits inside the middleware.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import threading

from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.task import Future

from surfel_mapper.errors import ConfigError
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.ros.context import context, reason
from surfel_mapper.ros.logs import logging_to
from surfel_mapper.ros.node import MapperNode
from surfel_mapper.ros.signals import Signals


def run_node(ros_args: Sequence[str], signals: Signals) -> None:
    """
    Run the node until KeyboardInterrupt, which is the usual way to end and raised again.

    Parameters
    ----------
    ros_args : sequence of str
        What follows --ros-args on the command line, that included.
    signals : Signals
        Those that interrupt.

    Raises
    ------
    SurfelMapperError
        If the node cannot start.

    """
    keep_freed_memory()
    with context(ros_args):
        node = made()
        try:
            with logging_to(node.get_logger()), executing(node):
                live(node, signals)
        finally:
            node.destroy_node()


def made() -> MapperNode:
    """Make the node; a middleware that cannot go as securely as it is told to refuses here."""
    try:
        return MapperNode()
    except rclpy_implementation.RCLError as error:
        raise ConfigError(f'ROS cannot make the node: {reason(error)}') from error


def live(node: MapperNode, signals: Signals) -> None:
    """Start a node, unless it is to be told when, and make transitions until it has to end."""
    try:
        if node.autostart:
            node.start()
        else:
            node.get_logger().info('autostart is false: waits for the transition configure')
        node.inbox.serve(signals.check)
    finally:
        node.inbox.close()
        node.end()


@contextmanager
def executing(node: MapperNode) -> Iterator[None]:
    """Execute the callbacks of a node in a thread, in a with-block."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    stopping: Future[None] = Future()

    def work() -> None:
        try:
            executor.spin_until_future_complete(stopping)
        except BaseException as error:
            node.inbox.fail(error)

    thread = threading.Thread(target=work, name='executor', daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopping.set_result(None)
        thread.join()
        executor.shutdown()
