# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper replay``: a bag, or a folder of scans, into a map, its picture and summary.json.

Ctrl-C or SIGTERM ends the recording early, and the scans mapped until then are written; Ctrl-C
pressed again ends at once. Several bags, --workers and --scheduler map parts that are added up.

Exit code 3: done, but the recording is cut off and --strict was given. 4: done, but the map is in
doubt: less than 95 % of the scans are in it, registration could not place some scans, or their
surroundings seem to move along. The last lines say which, with counts by cause.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import json
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

from surfel_mapper.arguments import is_unit
from surfel_mapper.cli._arguments import (
    add_bin_columns,
    add_formats,
    add_overwrite,
    add_workers,
    APART,
    CUT,
    INTERRUPTED,
    positive_float,
    positive_int,
    seconds,
    UsageError,
)
from surfel_mapper.cli._display import add_open, open_file
from surfel_mapper.cli._output import printable, show_lines
from surfel_mapper.cli._progress import stopped_by_interrupt
from surfel_mapper.cli._settings import add_settings, configured
from surfel_mapper.cli._verbosity import add_verbosity, shown_progress
from surfel_mapper.errors import MapError
from surfel_mapper.layers import formats as layer_formats
from surfel_mapper.offline.options import known_formats, MAP_FORMATS, ReplayOptions
from surfel_mapper.offline.request import Request
from surfel_mapper.offline.summary import as_text, uncertain_text

if TYPE_CHECKING:
    from surfel_mapper.config import Config

SUMMARY = 'Map a bag, or a folder of scans, and write the map, a picture and figures.'

EXAMPLE = 'surfel-mapper replay street.mcap --config my.yaml --voxel-size 0.2 -o street/ --open'

LARGEST_OFFSET_S = 1e10
"""Limit of an offset of clocks, s: the bound of input.time_offset_s."""

ONE_PROCESS = ('window', 'align', 'view', 'rrd')
"""Options that ask for all scans in order, in one process."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add(
        'bags',
        nargs='+',
        type=Path,
        metavar='BAG',
        help='rosbag2 directory, .mcap, .db3, ROS 1 .bag; directory or file of scans: .ply, .pcd, '
        '.bin, .las, text, .npy, .e57, ... (docs/formats.md); .pcap of an Ouster lidar',
    )
    add_settings(parser, 'YAML file of settings')
    add(
        '--filters',
        metavar='FILE',
        help='YAML file of a filter chain, as libpointmatcher has them (see `surfel-mapper '
        'filters`); FILE#key: the list under a key of it',
    )
    add_input_arguments(parser)
    add_output_arguments(parser)
    add_workers(parser)
    add_verbosity(parser)


def add_input_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options for input."""
    group = parser.add_argument_group('input')
    add = group.add_argument
    add(
        '--topic',
        action='append',
        default=[],
        help='PointCloud2 topic (default: the only one of the bag); repeatable',
    )
    add(
        '--mount',
        action='append',
        default=[],
        type=mount,
        metavar='TOPIC=X,Y,Z,QX,QY,QZ,QW',
        help='pose of the sensor of a topic in frames.base, m; repeatable',
    )
    add_pose_arguments(add)
    add('--start', type=seconds, default=0.0, metavar='S', help='leave out the first S seconds')
    add('--duration', type=positive_float, default=math.inf, metavar='S', help='map S seconds')
    add('--every', type=positive_int, default=1, metavar='N', help='map one cloud of every N')
    add_bin_columns(group)
    add(
        '--window',
        action='store_true',
        help="let scans leave the map by the configuration's window, as the node does",
    )
    add(
        '--align',
        action=argparse.BooleanOptionalAction,
        help='close loops, and align all scans with each other at the end; the latter keeps all '
        'points in memory (default: loops only, if poses come from registration)',
    )


def add_pose_arguments(add: Callable[..., argparse.Action]) -> None:
    """Declare the options for transforms, poses and clocks."""
    add('--pose-topic', metavar='TOPIC', help='topic of the poses (/tf, /odom or /pose)')
    add(
        '--static-topic',
        action='append',
        default=[],
        metavar='TOPIC',
        help='topic of static transforms (default: every tf_static in the namespaces of the '
        'clouds and poses); repeatable',
    )
    add(
        '--poses-from',
        choices=('auto', 'tf', 'odometry', 'pose', 'file', 'registration', 'identity'),
        help='source of the poses (default: pose.source of the configuration); auto is the first '
        'of tf, odometry, pose that the recording has, else registration',
    )
    add(
        '--poses',
        type=Path,
        metavar='FILE',
        help='file of poses of frames.base instead; without times, they belong to scans by number',
    )
    add(
        '--poses-format',
        choices=('tum', 'kitti', 'csv', 'g2o'),
        help='its format (default: recognised by its first line)',
    )
    add(
        '--time-offset',
        action='append',
        default=[],
        type=time_offset,
        metavar='[TOPIC=]S',
        help='add S seconds to the stamps of the clouds, of a topic or of all '
        '(input.time_offset_s), whose clock differs from that of the poses; repeatable',
    )


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options for output."""
    group = parser.add_argument_group('output')
    add = group.add_argument
    add('-o', '--output', type=Path, metavar='DIR', help='directory to write to (BAG_surfels)')
    add_overwrite(group)
    names = (*MAP_FORMATS, *layer_formats())
    add_formats(group, names, ReplayOptions().formats, known_formats)
    add(
        '--adaptive',
        dest='settings',
        action='append_const',
        const=('publish.adaptive', True),
        help='write adaptive surfels to map.ply, map.pcd and the bag of normals: of the largest '
        'cells whose points lie on one plane',
    )
    add('--poses-out', type=Path, metavar='FILE', help='write the poses of the scans as TUM text')
    add(
        '--truth',
        type=Path,
        metavar='FILE',
        help='true poses of the sensor, a file or a simulated bag; states the errors of the poses',
    )
    add('--view', action='store_true', help='show the map in rerun while it grows')
    add('--rrd', type=Path, metavar='FILE', help='write the content of --view to a file')
    add_open(group, 'report.html')
    add('--json', action='store_true', help='print the summary as JSON')
    add('--strict', action='store_true', help='exit with 3 if the bag is cut off or damaged')


def mount(text: str) -> tuple[str, tuple[float, ...]]:
    """Return topic and pose of TOPIC=X,Y,Z,QX,QY,QZ,QW."""
    topic, _, pose = text.partition('=')
    try:
        numbers = tuple(float(number) for number in pose.split(','))
    except ValueError:
        numbers = ()
    if not topic or len(numbers) != 7 or not is_unit(numbers[3:]):
        raise argparse.ArgumentTypeError(
            f'{text!r}, expected TOPIC=X,Y,Z,QX,QY,QZ,QW with a quaternion of norm 1'
        )
    return topic, numbers


def time_offset(text: str) -> tuple[str, float]:
    """Return topic and seconds of TOPIC=S; an empty topic stands for all."""
    topic, _, number = text.rpartition('=')
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not abs(value) <= LARGEST_OFFSET_S:
        raise argparse.ArgumentTypeError(f'{text!r}, expected seconds, or TOPIC=SECONDS')
    return topic, value


def run(args: argparse.Namespace) -> int:
    """Map one recording or many, and report."""
    if (args.poses_from == 'file') != (args.poses is not None) and args.poses_from is not None:
        poses = 'no --poses' if args.poses is None else f'--poses {args.poses}'
        raise UsageError(
            f'--poses-from {args.poses_from} and {poses}: expected both `--poses-from file` and '
            '`--poses FILE` for a file of poses, else no --poses'
        )
    is_many = len(args.bags) > 1 or args.workers is not None or args.scheduler is not None
    with stopped_by_interrupt() as stopped:
        with shown_progress(args, 'recorded second' if is_many else 'scan') as show:
            options = {'progress': show, 'stopped': stopped}
            try:
                result = replay_many(args, options) if is_many else replay_one(args, options)
            except MapError:
                if stopped():  # before a scan was mapped
                    raise KeyboardInterrupt from None
                raise
        summary = result.summary
        written = printable([str(path) for path in result.written])
        show_lines(json.dumps(summary) if args.json else as_text(printable(summary), written))
        if summary['interrupted']:
            return INTERRUPTED
        if stopped():  # while files were written
            raise KeyboardInterrupt
    if args.open:
        open_file(next(path for path in result.written if path.name == 'report.html'))
    if uncertain := uncertain_text(summary):
        show_lines(f'surfel-mapper: {uncertain}', to_stderr=True)
        return APART
    return CUT if args.strict and summary['cut'] else 0


def replay_one(args: argparse.Namespace, options: dict[str, Any]) -> Any:
    """Map a recording in this process."""
    from surfel_mapper.offline.replay import replay

    request, config = request_of(args, args.bags[0]), with_filters(args)
    chosen = replay_options(args)
    return replay(request, output=args.output, config=config, options=chosen, **options)


def replay_options(args: argparse.Namespace) -> ReplayOptions:
    """Return the options of a replay that the arguments ask for."""
    names = ('window', 'align', 'poses_out', 'truth', 'view', 'rrd', 'overwrite')
    formats = args.formats or ReplayOptions().formats
    return ReplayOptions(formats=formats, **{name: getattr(args, name) for name in names})


def replay_many(args: argparse.Namespace, options: dict[str, Any]) -> Any:
    """Map recordings into one map, with the workers that were asked for."""
    from surfel_mapper.cluster.replay import replay_bags
    from surfel_mapper.offline.outputs import output_directory
    from surfel_mapper.offline.replay import all_scans

    refused = [name for name in ONE_PROCESS if getattr(args, name)]
    if refused:
        raise UsageError(
            f'--{refused[0]}: not with several bags, --workers or --scheduler, where no process '
            'maps all scans in order'
        )
    config = with_filters(args).replace(all_scans())
    output = output_directory(args.bags[0], args.output)
    return replay_bags(
        [request_of(args, bag) for bag in args.bags],
        config,
        output,
        workers=args.workers,
        scheduler=args.scheduler,
        options=replay_options(args),
        **options,
    )


def with_filters(args: argparse.Namespace) -> Config:
    """Return the configuration that the arguments ask for, with its filters."""
    config = configured(args)
    for topic, value in args.time_offset:
        config = config if topic else config.replace({'input.time_offset_s': value})
    return config if args.filters is None else config.replace({'filters': args.filters})


def request_of(args: argparse.Namespace, bag: Path) -> Request:
    """Return the part of a bag that the arguments ask for."""
    return Request(
        path=bag,
        topics=tuple(args.topic),
        pose_topic=args.pose_topic,
        static_topics=tuple(args.static_topic),
        poses=args.poses,
        poses_format=args.poses_format,
        poses_from=args.poses_from,
        mounts=dict(args.mount),
        time_offsets={topic: value for topic, value in args.time_offset if topic},
        start_s=args.start,
        duration_s=args.duration,
        every=args.every,
        bin_columns=args.bin_columns,
    )
