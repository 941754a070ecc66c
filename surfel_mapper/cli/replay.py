# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper replay``: a bag, or a folder of scans, into a map, its picture and summary.json.

The files are written when the whole recording is mapped, each whole or not at all; summary.json
comes last, so where it is new the others are. Ctrl-C ends the recording early: what was mapped is
written. A replay that maps nothing is refused, for an empty map looks like a result.

Exit code 3: done, but the recording is cut off and --strict was given.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from functools import partial
import json
import math
from pathlib import Path
import time
from typing import TYPE_CHECKING

from surfel_mapper.cli import replay_many
from surfel_mapper.cli.progress import finished_first, progress, stopped_by_interrupt
from surfel_mapper.cli.replay_files import (
    BAG,
    check_truth,
    DXF,
    FORMATS,
    Mapped,
    output_directory,
    pose_errors,
    write_files,
)
from surfel_mapper.cli.replay_report import causes, report

if TYPE_CHECKING:
    from surfel_mapper.config import Config
    from surfel_mapper.offline.normals_bag import NormalsBag
    from surfel_mapper.offline.recording import Recording, Request
    from surfel_mapper.pipeline import Mapper, Update

SUMMARY = 'Map a bag, or a folder of scans, and write the map, a picture and figures.'

EXAMPLE = 'surfel-mapper replay street.mcap --topic /points --config vehicle.yaml --output street/'

CUT, INTERRUPTED = replay_many.CUT, replay_many.INTERRUPTED
"""Exit codes: the recording ends too early and --strict was given; Ctrl-C was pressed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add = parser.add_argument
    add(
        'bags',
        nargs='+',
        type=Path,
        metavar='BAG',
        help='rosbag2 directory, .mcap, .db3, ROS 1 .bag, or directory of .ply, .pcd, .bin scans',
    )
    add('--config', type=Path, metavar='FILE', help='YAML file of settings')
    add(
        '--filters',
        metavar='FILE',
        help='YAML file of a filter chain, as libpointmatcher has them (see `surfel-mapper '
        'filters`); FILE#key: the list under a key of it',
    )
    add_input_arguments(parser)
    add_output_arguments(parser)
    replay_many.add_arguments(parser)


def add_input_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what is mapped."""
    add = parser.add_argument_group('what is mapped').add_argument
    add(
        '--topic',
        action='append',
        default=[],
        help='PointCloud2 topic (the only one, if there is one); repeatable',
    )
    add(
        '--mount',
        action='append',
        default=[],
        type=mount,
        metavar='TOPIC=X,Y,Z,QX,QY,QZ,QW',
        help='where the sensor of a topic sits on frames.base, m; repeatable',
    )
    add('--pose-topic', metavar='TOPIC', help='topic of the poses (/tf, /odom or /pose)')
    add('--poses', type=Path, metavar='FILE', help='file of poses of frames.base instead')
    add(
        '--poses-format',
        choices=('tum', 'kitti', 'csv'),
        help='its format (told by its first line)',
    )
    add('--start', type=float, default=0.0, metavar='S', help='leave out the first seconds')
    add('--duration', type=float, default=math.inf, metavar='S', help='map so many seconds')
    add('--every', type=int, default=1, metavar='N', help='map one cloud of every N')
    add(
        '--window',
        action='store_true',
        help="let scans leave the map by the configuration's window, as the node does",
    )
    add(
        '--align',
        action='store_true',
        help='move the scans in the end to where they agree with each other; keeps all points '
        'in memory until then',
    )


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what is written."""
    add = parser.add_argument_group('what is written').add_argument
    add('--output', type=Path, metavar='DIR', help='directory to write to (BAG_surfels)')
    add(
        '--formats',
        type=formats,
        metavar='LIST',
        help=f'of the map (dxf: of its models), with a comma between: {", ".join(FORMATS)} (ply)',
    )
    add('--poses-out', type=Path, metavar='FILE', help='write the poses of the scans as TUM text')
    add(
        '--truth',
        type=Path,
        metavar='FILE',
        help='state how far the poses are from those of this file or simulated bag, of the sensor',
    )
    add('--view', action='store_true', help='show it in rerun while it happens')
    add('--rrd', type=Path, metavar='FILE', help='write that to a file, for rerun to open')
    add('--json', action='store_true', help='print the summary as JSON')
    add('--strict', action='store_true', help='exit with 3 where the bag is cut off or damaged')


def mount(text: str) -> tuple[str, tuple[float, ...]]:
    """Return topic and pose of TOPIC=X,Y,Z,QX,QY,QZ,QW."""
    topic, _, pose = text.partition('=')
    try:
        numbers = tuple(float(number) for number in pose.split(','))
    except ValueError:
        numbers = ()
    if not topic or len(numbers) != 7 or abs(math.hypot(*numbers[3:]) - 1.0) > 1e-3:
        raise argparse.ArgumentTypeError(
            f'{text!r}, expected TOPIC=X,Y,Z,QX,QY,QZ,QW with a quaternion of norm 1'
        )
    return topic, numbers


def formats(text: str) -> tuple[str, ...]:
    """Return the formats of a list."""
    names = tuple(text.split(','))
    unknown = [name for name in names if name not in FORMATS]
    if unknown:
        raise argparse.ArgumentTypeError(f'{unknown[0]!r}, expected some of {", ".join(FORMATS)}')
    return names


def run(args: argparse.Namespace) -> int:
    """Map one recording or many, and report."""
    config = configured(args)
    output = output_directory(args.bags[0], args.output)
    requests = [request_of(args, bag) for bag in args.bags]
    if replay_many.is_wanted(args):
        return replay_many.run(args, config, requests, output)
    return map_one(args, config, requests[0], output)


def map_one(args: argparse.Namespace, config: Config, request: Request, output: Path) -> int:
    """Map a recording in this process and report."""
    from surfel_mapper.memory import keep_freed_memory
    from surfel_mapper.offline.recording import open_recording
    from surfel_mapper.offline.replay import load_start, poses_now
    from surfel_mapper.pipeline import Mapper
    from surfel_mapper.viz.history import History

    keep_freed_memory()  # the clouds: 2 ms less for each of 4 MB
    formats_wanted = args.formats or ('ply',)
    with open_recording(request, config) as recording, ExitStack() as files:
        mapper = Mapper(recording.config)
        load_start(mapper)
        mapper.warm_up()
        bag = normals_bag(output, mapper, files) if BAG in formats_wanted else None
        if args.truth is not None:
            check_truth(args.truth)
        history = History()
        listeners: list[Callable[[Update], None]] = [partial(history.add, mapper)]
        listeners += [*viewers(args, mapper, files), *([bag.add] if bag else [])]
        start = time.perf_counter()
        mapped, was_stopped = map_recording(recording, mapper, listeners)
        replay_s = time.perf_counter() - start
        refuse_empty(recording, mapper, was_stopped)
        aligned = {'alignment': mapper.align().summary()} if args.align else {}
        if mapper.models is not None:
            mapper.models.update()  # they follow at a period of their own, and no alignment
        mapped.poses = poses_now(mapper, mapped.stamps_ns, mapped.poses)
        if bag:
            bag.finish()
        summary = {
            **recording.describe(),
            'recorded_s': recording.recorded_s,
            'replay_s': replay_s,
            'window': args.window,
            'interrupted': was_stopped,
            'cut': list(recording.cuts),
            **aligned,
            **pose_errors(args.truth, mapped),
            **mapper.summary(),
            'settings': mapper.config.to_mapping(),
        }
    if args.poses_out is not None:
        mapped.write(args.poses_out)
    with nullcontext() if was_stopped else finished_first():
        written = write_files(output, formats_wanted, mapper, mapped, summary, history)
        print(json.dumps(summary) if args.json else report(summary, written))
    if was_stopped:
        return INTERRUPTED
    return CUT if args.strict and summary['cut'] else 0


def configured(args: argparse.Namespace) -> Config:
    """Return the configuration that the arguments ask for."""
    from surfel_mapper.config import load_config
    from surfel_mapper.errors import ConfigError
    from surfel_mapper.offline.replay import ALL_SCANS

    config = load_config(args.config)
    if args.filters is not None:
        config = config.replace({'filters': args.filters})
    if args.align:
        config = config.replace({'window.keep_points': True})
    if DXF in (args.formats or ()) and not config.models.enabled:
        raise ConfigError(
            '--formats dxf: planes and surfaces, expected layers.models.enabled: true in --config'
        )
    return config if args.window else config.replace(ALL_SCANS)


def request_of(args: argparse.Namespace, bag: Path) -> Request:
    """Return what the arguments ask to map."""
    from surfel_mapper.offline.recording import Request

    return Request(
        path=bag,
        topics=tuple(args.topic),
        pose_topic=args.pose_topic,
        poses=args.poses,
        poses_format=args.poses_format,
        mounts=dict(args.mount),
        start_s=args.start,
        duration_s=args.duration,
        every=args.every,
    )


def viewers(
    args: argparse.Namespace, mapper: Mapper, files: ExitStack
) -> list[Callable[[Update], None]]:
    """Return what shows a replay in rerun, as far as asked for; closed with the files."""
    paths: list[Path | None] = [*([None] if args.view else []), *([args.rrd] if args.rrd else [])]
    if not paths:
        return []
    from surfel_mapper.viz.viewer import Viewer

    return [files.enter_context(Viewer(mapper, path)).add for path in paths]


def normals_bag(output: Path, mapper: Mapper, files: ExitStack) -> NormalsBag:
    """Begin the bag of normals; it is whole when the files are closed, or not there."""
    from surfel_mapper.bags.writer import BagWriter
    from surfel_mapper.offline.normals_bag import NormalsBag

    writer = BagWriter(output / FORMATS[BAG], overwrite=True)
    return NormalsBag(files.enter_context(writer), mapper)


def map_recording(
    recording: Recording, mapper: Mapper, listeners: Sequence[Callable[[Update], None]]
) -> tuple[Mapped, bool]:
    """Map all scans, showing how far it is; return the poses, and whether Ctrl-C ended it."""
    mapped = Mapped()
    with (
        stopped_by_interrupt() as stopped,
        progress('replay', recording.num_scans, 'scan') as show,
    ):
        for update in recording.replay(mapper, stopped):
            mapped.add(update)
            for listen in listeners:
                listen(update)
            show(mapper.counters.received)
        return mapped, stopped()


def refuse_empty(recording: Recording, mapper: Mapper, was_stopped: bool) -> None:
    """Raise if no scan was mapped, with the causes."""
    from surfel_mapper.errors import BagError

    counters = mapper.counters
    if counters.mapped or counters.localised:
        return
    if was_stopped:
        raise KeyboardInterrupt
    found = recording.describe()
    of = f' of {", ".join(found["topics"])}' if 'topics' in found else ''
    look = f'; `surfel-mapper info {found["bag"]}` shows what poses it has'
    raise BagError(
        f'{found["bag"]}: none of {counters.received} clouds{of} was mapped '
        f'({causes(counters.dropped)}){look if "no_pose" in counters.dropped else ""}'
    )
