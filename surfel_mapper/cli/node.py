# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper node``: the live map, as ``ros2 run surfel_mapper node``.

SIGINT and SIGTERM both end it with exit code 0, at any time after its start.
"""

from __future__ import annotations

import argparse

from surfel_mapper.cli._ros import loading_ros
from surfel_mapper.ros.main_thread import Signals

SUMMARY = 'Map clouds live from ROS 2 topics.'

EXAMPLE = 'surfel-mapper node --ros-args --params-file my.yaml -r points:=/lidar/points'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments: none but those for ROS, which are cut off before."""
    parser.usage = 'surfel-mapper node [-h] [--ros-args ...]'


def run(args: argparse.Namespace) -> int:
    """Run the node until a signal or a shutdown."""
    try:
        with Signals() as signals:
            with loading_ros():
                from surfel_mapper.ros.main import run_node
            run_node(args.ros_args, signals)
    except KeyboardInterrupt:
        pass
    return 0
