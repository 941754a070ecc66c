# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper node``: the live map, as ``ros2 run surfel_mapper node``.

SIGINT and SIGTERM end it alike, with exit code 0, at any time from its start on.
"""

from __future__ import annotations

import argparse
import signal
from typing import Any

from surfel_mapper.cli.ros import loading_ros

SUMMARY = 'Map clouds live from ROS 2 topics.'

EXAMPLE = 'surfel-mapper node --ros-args --params-file my.yaml -r points:=/lidar/points'

SIGNALS = (signal.SIGINT, signal.SIGTERM)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments: none but those for ROS, which are cut off before."""
    parser.usage = 'surfel-mapper node [-h] [--ros-args ...]'


def run(args: argparse.Namespace) -> int:
    """Run the node until it is told to end."""
    before = {number: signal.signal(number, interrupt) for number in SIGNALS}
    try:
        with loading_ros():
            from surfel_mapper.ros.running import run_node
        run_node(args.ros_args)
    except KeyboardInterrupt:
        pass
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) is interrupt:  # not interrupted: we go on
                signal.signal(number, handler)
    return 0


def interrupt(*_: Any) -> None:
    """
    Raise KeyboardInterrupt, and ignore all signals that follow.

    A terminal and a launch file both send one; the second would cut short what the first began.
    """
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt
