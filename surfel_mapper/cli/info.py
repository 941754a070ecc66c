# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper info``: topics, rates and poses of a bag, and settings for a replay of it.

Of a folder or a file of scans: their number, times and columns. Both state the source of poses
that a replay without settings takes.
"""

from __future__ import annotations

import argparse
import dataclasses
from datetime import datetime, timezone
import itertools
import json
from pathlib import Path
import shlex
from typing import Any, TYPE_CHECKING

from surfel_mapper.cli._arguments import add_bin_columns, CUT
from surfel_mapper.cli._output import printable, show_lines
from surfel_mapper.cli._verbosity import add_verbosity, shown_progress
from surfel_mapper.errors import counted, escaped

if TYPE_CHECKING:
    from surfel_mapper.bags.reader import BagReader
    from surfel_mapper.offline.survey import Offer, Survey

SUMMARY = (
    'Show the topics and poses of a bag or folder of scans, or the settings of node and replay.'
)

AT_ONCE_NS = 1_000_000
"""Record times nearer to the stamps are of a converter: a cloud takes longer to arrive, ns."""

EXAMPLE = 'surfel-mapper info street.mcap'

CHOICE = ('poses_from', 'poses_reason', 'deskewed', 'deskew_reason')
"""Names in the summary of a replay that state the source of its poses."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(
        'bag',
        type=Path,
        metavar='BAG',
        nargs='?',
        help='rosbag2 directory, .mcap, .db3, ROS 1 .bag, or directory or file of scans',
    )
    source.add_argument(
        '--parameters', action='store_true', help='print all settings of node and replay instead'
    )
    add_bin_columns(parser)
    parser.add_argument('--json', action='store_true', help='print as JSON')
    parser.add_argument(
        '--strict', action='store_true', help='exit with 3 if the bag is cut off or damaged'
    )
    add_verbosity(parser)


def run(args: argparse.Namespace) -> int:
    """Survey a bag and report, or print the settings."""
    if args.parameters:
        from surfel_mapper.config import settings_table

        print(settings_table(), end='')
        return 0
    from surfel_mapper.bags.reader import BagReader
    from surfel_mapper.offline.scan_folder import is_scans
    from surfel_mapper.offline.survey import offers, survey, surveyed_topics

    if is_scans(args.bag):
        content = folder_content(args.bag, args.bin_columns)
        show_lines(json.dumps(content) if args.json else folder_report(printable(content)))
        return 0
    with BagReader(args.bag) as reader:
        total = reader.topics.num_messages(surveyed_topics(reader))
        read = itertools.count(1)
        with shown_progress(args, 'message') as show:
            surveyed = survey(reader, lambda: show(next(read), total))
        made = offers(surveyed)
        content = {**as_mapping(reader, surveyed, made), 'replay': chosen(reader)}
    show_lines(json.dumps(content) if args.json else report(printable(content), made))
    return CUT if args.strict and content['cut'] else 0


def as_mapping(reader: BagReader, survey: Survey, made: list[Offer]) -> dict[str, Any]:
    """Return the survey as plain values."""
    from surfel_mapper.offline.clocks import clock_offsets

    clouds = reader.topics.of_type(*reader.topics.clouds)
    leads_ns = itertools.chain.from_iterable(survey.leads_ns.get(name, []) for name in clouds)
    return {
        'bag': str(reader.path),
        'format': 'ROS 1' if reader.is_ros1 else 'ROS 2',
        'start_ns': reader.start_ns,
        'seconds': (reader.end_ns - reader.start_ns) / 1e9,
        'topics': [
            {
                'topic': name,
                'type': summary.topic.type,
                'messages': summary.topic.count,
                'rate_hz': summary.rate_hz,
                'frames': summary.frames,
            }
            for name, summary in survey.topics.items()
        ],
        'undecodable': survey.undecodable,
        'cut': list(reader.cuts),
        'poses': [dataclasses.asdict(offer) for offer in made],
        'clock_offsets': [
            {**dataclasses.asdict(clock), 'text': str(clock)}
            for clock in clock_offsets(survey, clouds)
        ],
        'record_times_are_stamps': all(abs(lead) < AT_ONCE_NS for lead in leads_ns),
    }


def report(content: dict[str, Any], made: list[Offer]) -> str:
    """Return the survey for people."""
    start = datetime.fromtimestamp(content['start_ns'] / 1e9, timezone.utc)
    messages = sum(topic['messages'] for topic in content['topics'])
    lines = [
        f'{content["bag"]}: {content["format"]}, from {start:%Y-%m-%d %H:%M:%S} UTC, '
        f'{content["seconds"]:.1f} s, {counted(messages, "message")}',
        *table(content['topics']),
    ]
    lines += [f'damaged: {cut}' for cut in content['cut']]
    if content['undecodable']:
        lines.append(f'damaged: {counted(content["undecodable"], "message")} of clouds or poses')
    lines += [f'clocks: {clock["text"]}' for clock in content['clock_offsets']]
    if made and content['record_times_are_stamps'] and not content['clock_offsets']:
        lines.append(
            'clocks: record times are the stamps and show no offset of clouds from poses; replay '
            'measures it by the motion'
        )
    is_choice = len({offer.clouds for offer in made}) > 1
    for clouds in dict.fromkeys(offer.clouds for offer in made):
        with_a_pose = f'clouds of {clouds} with a pose, and the settings for --config:'
        lines += ['', escaped(with_a_pose)]
        for offer in made:
            lines += offered(offer, is_choice) if offer.clouds == clouds else []
    if not made and 'refused' not in content['replay']:
        lines += ['', 'no poses; if the clouds are in a fixed frame, use --poses-from identity']
    return '\n'.join([*lines, '', replay_line(content['replay'], Path(content['bag']))])


def replay_line(replay: dict[str, Any], path: Path) -> str:
    """Return the source of poses of a replay and its command, or why it is refused."""
    if 'refused' in replay:
        return f'a replay without options is refused: {replay["refused"]}'
    deskewed = ', deskewed' if replay['deskewed'] else ''
    why = f': {replay["poses_reason"]}' if replay['poses_reason'] else ''
    line = f'replay takes poses from {replay["poses_from"]}{deskewed}{why}'
    if replay['deskew_reason']:
        line += f'\nnot deskewed: {replay["deskew_reason"]}'
    name = path.resolve().name.split('.')[0]
    return f'{line}\n  surfel-mapper replay {shlex.quote(str(path))} --output {name}_map'


def chosen(reader: BagReader) -> dict[str, Any]:
    """Return the source of poses for a replay without settings, or why that is refused."""
    from surfel_mapper.config import Config
    from surfel_mapper.errors import BagError
    from surfel_mapper.offline.bag_recording import BagRecording
    from surfel_mapper.offline.request import Request

    try:
        recording = BagRecording(reader, Request(path=reader.path), Config(), None)
    except BagError as error:  # several topics of clouds, or none: a topic has to be named
        return {'refused': str(error)}
    description = recording.describe()
    return {name: description[name] for name in CHOICE}


def folder_content(path: Path, bin_columns: int | None) -> dict[str, Any]:
    """Return the number, times and columns of scans in files as plain values."""
    from surfel_mapper.config import Config
    from surfel_mapper.errors import FileFormatError
    from surfel_mapper.offline.request import Request
    from surfel_mapper.offline.scan_folder import ScanFolder

    folder = ScanFolder(Request(path=path, bin_columns=bin_columns), Config(), None)
    first = folder.first_scan()
    if first is None:
        raise FileFormatError(folder.first_error)
    description = folder.describe()
    return {
        'bag': str(path),
        'format': folder.format,
        'scans': len(folder.files),
        'seconds': folder.recorded_s,
        'times_from': description['times_from'],
        'points': len(first),
        'columns': sorted(first.columns),
        'damaged': [folder.first_error] if folder.first_error else [],
        'replay': {name: description[name] for name in CHOICE},
    }


def folder_report(content: dict[str, Any]) -> str:
    """Return the figures of scans in files as lines of text."""
    columns = ', '.join(content['columns']) or 'none'
    damaged = ''.join(f'damaged: {error}\n' for error in content['damaged'])
    read = 'first scan that can be read' if damaged else 'first scan'
    times = content['times_from'].replace('none: ', 'none in the files, taken as ')
    return (
        f'{content["bag"]}: {content["format"]}, {counted(content["scans"], "scan")}, '
        f'{content["seconds"]:.1f} s; times: {times}\n'
        f'  {read}: {counted(content["points"], "point")}; further columns: {columns}\n{damaged}\n'
        f'{replay_line(content["replay"], Path(content["bag"]))}'
    )


def table(topics: list[dict[str, Any]]) -> list[str]:
    """Return one line a topic, in columns."""
    rows = [
        (
            topic['topic'],
            topic['type'],
            str(topic['messages']),
            '-' if topic['rate_hz'] is None else f'{topic["rate_hz"]:.1f} Hz',
            ', '.join(topic['frames']),
        )
        for topic in topics
    ]
    width = [max(len(row[column]) for row in rows) for column in range(4)]
    return [
        f'  {row[0]:{width[0]}}  {row[1]:{width[1]}}  {row[2]:>{width[2]}}  '
        f'{row[3]:>{width[3]}}  {row[4]}'.rstrip()
        for row in rows
    ]


def offered(offer: Offer, is_choice: bool) -> list[str]:
    """Return the number of clouds with a pose from a source, and how to use it."""
    import yaml

    from surfel_mapper.config import Config

    default = Config().to_mapping()
    stages: dict[str, dict[str, Any]] = {}
    for name, value in offer.settings.items():
        if value and (value != default[name] or name == 'pose.source'):
            stage, _, key = name.partition('.')
            stages.setdefault(stage, {})[key] = value
    text = yaml.safe_dump(stages, default_flow_style=None, sort_keys=False, width=1000)
    fixed = offer.settings['frames.fixed']
    options = f' (--topic {offer.clouds} --pose-topic {offer.poses})' if is_choice else ''
    lines = [f'  {offer.poses}: {offer.covered} of {offer.total}, in the frame {fixed}{options}']
    if offer.missing:
        lines.append(f'    {offer.missing}')
    return [*map(escaped, lines), *(f'      {line}' for line in text.splitlines())]
