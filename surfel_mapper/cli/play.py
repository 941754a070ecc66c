# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper play``: publish a bag over DDS on machines without ``ros2 bag play``.

Unlike that, it can wait for subscribers, and its shared memory is large enough for clouds.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from surfel_mapper.cli._arguments import positive_float, seconds
from surfel_mapper.cli._output import show_lines
from surfel_mapper.cli._verbosity import add_verbosity
from surfel_mapper.errors import escaped

SUMMARY = 'Publish the messages of a bag over DDS at the pace of their record times.'

EXAMPLE = 'surfel-mapper play street --rate 2 --wait-for /points /odom --ros-args -r /points:=/a'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add('bag', type=Path, metavar='BAG', help='rosbag2 directory, or a .mcap or .db3 file')
    add('--topics', nargs='+', metavar='T', help='play only these')
    add(
        '--rate',
        type=positive_float,
        default=1.0,
        metavar='R',
        help='playback speed, times real time (%(default)s)',
    )
    add('--loop', action='store_true', help='start again at the end')
    add('--clock', action='store_true', help='publish the record time on /clock')
    add(
        '--wait-for',
        nargs='+',
        default=[],
        metavar='T',
        help='wait for a subscriber of each of these before playing',
    )
    add(
        '--paced-by',
        metavar='T',
        help='publish a cloud only once the clouds before it are answered on this topic, such as '
        '/surfel_mapper/changed, so that a slow node drops none',
    )
    add(
        '--timeout',
        type=seconds,
        default=60.0,
        metavar='S',
        help='longest wait for subscribers and for an answer, s (%(default)s)',
    )
    add('--json', action='store_true', help='report as JSON')
    add_verbosity(parser)


def run(args: argparse.Namespace) -> int:
    """Play a bag and report the number of messages published."""
    from surfel_mapper.bags.reader import BagReader
    from surfel_mapper.cli._ros import loading_ros

    with BagReader(args.bag) as reader, loading_ros():
        from surfel_mapper.ros.player import play

        report = play(
            reader,
            args.topics,
            rate=args.rate,
            loop=args.loop,
            clock=args.clock,
            wait_for=args.wait_for,
            paced_by=args.paced_by,
            timeout_s=args.timeout,
            ros_args=args.ros_args,
        )
    for topic, reason in report['skipped'].items():
        show_lines(escaped(f'surfel-mapper play: {topic} skipped: {reason}'), to_stderr=True)
    counts = '   '.join(f'{topic} {number}' for topic, number in report['published'].items())
    text = f'published in {report["seconds"]:.1f} s: {counts}'
    show_lines(json.dumps(report) if args.json else escaped(text))
    return 0
