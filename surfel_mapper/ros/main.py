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
from functools import partial
import threading

from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation

from surfel_mapper.errors import ConfigError
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.ros.context import context, explain, logging_to
from surfel_mapper.ros.main_thread import Signals
from surfel_mapper.ros.node import MapperNode
from surfel_mapper.ros.parameters import unread_files
from surfel_mapper.ros.turns import take_turns
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
    with context(ros_args):
        node = create_node(ros_args)
        try:
            for text in unread_files(ros_args, node.get_name()):
                node.get_logger().warning(text)
            with logging_to(node.get_logger()), executing(node):
                run_tasks(node, signals)
        finally:
            node.destroy_node()


def create_node(ros_args: Sequence[str] = ()) -> MapperNode:
    """
    Create the node; the middleware starts its threads, and refuses here if it lacks security.

    Its threads come before all others, so that they receive clouds while scans are mapped.
    """
    try:
        with real_time_threads():
            return MapperNode(ros_args)
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
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    stopping = threading.Event()

    def turn() -> bool:
        if stopping.is_set():
            return False
        executor.spin_once()
        return True

    def spin() -> None:
        try:
            take_turns(turn, partial(node.report_failure, 'a turn of the executor'))
        except BaseException as error:
            node.tasks.fail(error)

    thread = threading.Thread(target=spin, name='executor', daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        executor.create_task(stopping.is_set)  # a turn of its own, which ends the wait
        thread.join()
        executor.shutdown()
