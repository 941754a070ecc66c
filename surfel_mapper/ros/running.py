# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Running the node, from its arguments to its end.

The executor runs in a thread of its own, since the main thread cannot hear a
signal while it waits inside the middleware.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
import threading

from rclpy.executors import SingleThreadedExecutor

from surfel_mapper.io.heap import keep_freed_memory
from surfel_mapper.ros.context import context
from surfel_mapper.ros.logs import logging_to
from surfel_mapper.ros.node import MapperNode


def run_node(ros_args: Sequence[str]) -> None:
    """
    Run the node until KeyboardInterrupt, which is the usual way to end and raised again.

    Parameters
    ----------
    ros_args : sequence of str
        What follows --ros-args on the command line, that included.

    Raises
    ------
    SurfelMapperError
        If the node cannot start.

    """
    keep_freed_memory()
    with context(ros_args):
        node = MapperNode()
        try:
            with logging_to(node.get_logger()):
                live(node)
        finally:
            node.destroy_node()


def live(node: MapperNode) -> None:
    """Run a node from its start until it is interrupted or fails."""
    node.configure()
    try:
        node.activate()
        spin(node)
    finally:
        node.deactivate()
        node.close()


def spin(node: MapperNode) -> None:
    """Execute the callbacks of a node until it is interrupted or fails."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    stopping = threading.Event()

    def work() -> None:
        while not stopping.is_set():
            executor.spin_once()

    with ThreadPoolExecutor(1, 'executor') as pool:
        working = pool.submit(work)
        try:
            wait([working, node.failure], return_when=FIRST_COMPLETED)
        finally:
            stopping.set()
            executor.create_task(stopping.is_set)  # any task ends the wait inside
    executor.shutdown()
    for future in (working, node.failure):
        if future.done():
            future.result()
