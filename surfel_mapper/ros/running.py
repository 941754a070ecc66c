# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Running the node as a process, from its arguments to its exit.

The executor runs in a thread of its own, since the main thread cannot hear a
signal while it waits inside the middleware.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager
import signal
import threading
from typing import Any

from rclpy.executors import SingleThreadedExecutor

from surfel_mapper.io.heap import keep_freed_memory
from surfel_mapper.ros.context import context
from surfel_mapper.ros.logs import logging_to
from surfel_mapper.ros.node import MapperNode


def run_node(ros_args: Sequence[str]) -> None:
    """
    Run the node until SIGINT or SIGTERM.

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
    try:
        with interruptible(), context(ros_args):
            node = MapperNode()
            try:
                with logging_to(node.get_logger()):
                    live(node)
            finally:
                node.destroy_node()
    except KeyboardInterrupt:
        pass  # the usual way to end


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


@contextmanager
def interruptible() -> Iterator[None]:
    """
    Let the first SIGINT or SIGTERM of a with-block raise KeyboardInterrupt.

    Those that follow are ignored: a terminal and a launch file both send one, and the second
    would cut the end short that the first began.
    """

    def interrupt(*_: Any) -> None:
        for number in signals:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    signals = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, interrupt) for number in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
