# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Run the node, from the arguments to the exit.

The executor runs in a thread of its own, because the main thread cannot handle a signal while it
waits inside the middleware.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import threading

from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.task import Future

from surfel_mapper.errors import ConfigError
from surfel_mapper.memory import keep_freed_memory, share_freed_memory
from surfel_mapper.ros.context import context, explain, logging_to
from surfel_mapper.ros.main_thread import Signals
from surfel_mapper.ros.node import MapperNode
from surfel_mapper.threads import real_time_threads


def run_node(ros_args: Sequence[str], signals: Signals) -> None:
    """
    Run the node until KeyboardInterrupt, which is the usual way to end it and is raised again.

    Parameters
    ----------
    ros_args : sequence of str
        The command line from --ros-args on, that included.
    signals : Signals
        The installed signal handlers.

    Raises
    ------
    SurfelMapperError
        If the node cannot start.

    """
    keep_freed_memory()
    share_freed_memory()
    with context(ros_args):
        node = create_node()
        try:
            with logging_to(node.get_logger()), executing(node):
                run_tasks(node, signals)
        finally:
            node.destroy_node()


def create_node() -> MapperNode:
    """
    Create the node; the middleware starts its threads, and refuses here if it lacks security.

    Its threads come before all others, so that they receive clouds while scans are mapped.
    """
    try:
        with real_time_threads():
            return MapperNode()
    except rclpy_implementation.RCLError as error:
        raise ConfigError(f'ROS cannot make the node: {explain(error)}') from error


def run_tasks(node: MapperNode, signals: Signals) -> None:
    """Start the node if ``autostart`` is set, then make transitions until a signal or an error."""
    try:
        if node.autostart:
            node.start()
        else:
            node.get_logger().info('autostart is false: waits for the transition configure')
        node.tasks.run(signals.check)
    finally:
        node.tasks.close()
        node.end()


@contextmanager
def executing(node: MapperNode) -> Iterator[None]:
    """Run the callbacks of a node in a thread, in a with-block."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    stopping: Future[None] = Future()

    def spin() -> None:
        try:
            executor.spin_until_future_complete(stopping)
        except BaseException as error:
            node.tasks.fail(error)

    thread = threading.Thread(target=spin, name='executor', daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopping.set_result(None)
        thread.join()
        executor.shutdown()
