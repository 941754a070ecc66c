# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper replay``: a bag into map.ply, map.png and summary.json.

The files are written when the whole bag is mapped, each whole or not at all; summary.json comes
last, so where it is new the others are. A replay that maps nothing is refused, for an empty map
looks like a result.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
import sys
import time
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from surfel_mapper.io.bag import BagReader
    from surfel_mapper.offline.replay import PoseTopics
    from surfel_mapper.pipeline import Mapper

SUMMARY = 'Map the clouds of a bag and write the map, a picture and figures.'

EXAMPLE = 'surfel-mapper replay street.mcap --topic /points --config vehicle.yaml --output street/'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'bag', type=Path, metavar='BAG', help='rosbag2 directory, .mcap, .db3 or ROS 1 .bag'
    )
    parser.add_argument('--topic', help='PointCloud2 topic (the only one, if there is one)')
    parser.add_argument('--pose-topic', help='topic of the poses (/tf, /odom or /pose)')
    parser.add_argument('--config', type=Path, metavar='FILE', help='YAML file of settings')
    parser.add_argument(
        '--filters',
        metavar='FILE',
        help='YAML file of a filter chain, as libpointmatcher has them (see `surfel-mapper '
        'filters`); FILE#key: the list under a key of it',
    )
    parser.add_argument(
        '--output', type=Path, metavar='DIR', help='directory to write to (BAG_surfels)'
    )
    parser.add_argument(
        '--window',
        action='store_true',
        help="let scans leave the map by the configuration's window, as the node does",
    )
    parser.add_argument(
        '--align',
        action='store_true',
        help='move the scans in the end to where they agree with each other; keeps all points '
        'in memory until then',
    )
    parser.add_argument(
        '--poses-out', type=Path, metavar='FILE', help='write the poses of the scans as TUM text'
    )
    parser.add_argument('--json', action='store_true', help='print the summary as JSON')


def run(args: argparse.Namespace) -> int:
    """Map a bag and report."""
    from surfel_mapper.config import load_config
    from surfel_mapper.io.bag import BagReader
    from surfel_mapper.io.bag_topics import CLOUD
    from surfel_mapper.io.heap import keep_freed_memory
    from surfel_mapper.io.trajectory import write_tum
    from surfel_mapper.offline.replay import ALL_SCANS, load_start, pose_topics, poses_now
    from surfel_mapper.pipeline import Mapper

    config = load_config(args.config)
    if args.filters is not None:
        config = config.replace({'filters': args.filters})
    if args.align:
        config = config.replace({'window.keep_points': True})
    mapper = Mapper(config if args.window else config.replace(ALL_SCANS))
    load_start(mapper)
    output = output_directory(args.bag, args.output)
    with BagReader(args.bag) as reader:
        topic = reader.topics.choose(CLOUD, args.topic)
        poses = pose_topics(reader.topics, mapper.config, args.pose_topic)
        keep_freed_memory()  # the clouds: 2 ms less for each of 4 MB
        mapper.warm_up()
        start = time.perf_counter()
        stamps_ns, trajectory = map_bag(reader, mapper, topic, poses)
        source = {
            'bag': str(args.bag),
            'topic': topic,
            'pose_topics': [*poses.kinds, *poses.static],
            'recorded_s': (reader.end_ns - reader.start_ns) / 1e9,
            'replay_s': time.perf_counter() - start,
            'window': args.window,
        }
    refuse_empty(args.bag, topic, mapper)
    if args.align:
        source['alignment'] = mapper.align().summary()
    trajectory = poses_now(mapper, stamps_ns, trajectory)
    if args.poses_out is not None:
        write_tum(args.poses_out, stamps_ns, trajectory)
    summary = {**source, **mapper.summary(), 'settings': mapper.config.to_mapping()}
    write(output, args.bag, mapper, trajectory[:, :3, 3], summary)
    print(json.dumps(summary) if args.json else report(summary, output))
    return 0


def output_directory(bag: Path, wanted: Path | None) -> Path:
    """Return where to write; refuse what cannot be a directory before the work begins."""
    from surfel_mapper.errors import FileFormatError

    name = bag.resolve().stem if bag.is_file() else bag.resolve().name
    directory = wanted or Path(f'{name}_surfels')
    absolute = directory.absolute()
    nearest = next(path for path in (absolute, *absolute.parents) if path.exists())
    if not nearest.is_dir():
        raise FileFormatError(f'{directory}: {nearest} is a file, expected a directory')
    if not os.access(nearest, os.W_OK):
        raise FileFormatError(f'{directory}: no permission to write in {nearest}')
    return directory


def map_bag(
    reader: BagReader, mapper: Mapper, topic: str, poses: PoseTopics
) -> tuple[list[int], npt.NDArray[np.float64]]:
    """Map all clouds of a topic with a progress bar; return stamps and poses, (S, 4, 4)."""
    import numpy as np
    from tqdm import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

    from surfel_mapper.offline.replay import replay

    stamps_ns, trajectory = [], []
    total = reader.topics.num_messages([topic])
    hidden = not sys.stderr.isatty()
    with logging_redirect_tqdm(), tqdm(total=total, unit='scan', disable=hidden) as bar:
        for update in replay(reader, mapper, topic, poses):
            stamps_ns.append(update.stamp_ns)
            trajectory.append(update.T_fixed_sensor)
            bar.update(mapper.counters.received - bar.n)
        bar.update(mapper.counters.received - bar.n)
    return stamps_ns, np.array(trajectory).reshape(-1, 4, 4)


def refuse_empty(bag: Path, topic: str, mapper: Mapper) -> None:
    """Raise if no scan was mapped, with the causes."""
    from surfel_mapper.errors import BagError

    counters = mapper.counters
    if not (counters.mapped or counters.localised):
        raise BagError(
            f'{bag}: none of {counters.received} clouds of {topic} was mapped '
            f'({causes(counters.dropped)}); `surfel-mapper info {bag}` shows what poses it has'
        )


def write(
    output: Path,
    bag: Path,
    mapper: Mapper,
    trajectory: npt.NDArray[np.float64],
    summary: dict[str, Any],
) -> None:
    """Write the map, its picture and the summary."""
    from surfel_mapper.io.files import replace_file
    from surfel_mapper.io.ply import write_surfels
    from surfel_mapper.viz.picture import draw_map

    output.mkdir(parents=True, exist_ok=True)
    surfels = mapper.map.surfels(mapper.config.map.min_points)
    write_surfels(output / 'map.ply', surfels)
    title = (
        f'{bag.resolve().name}: {summary["scans"]["mapped"]} scans, '
        f'{rounded(summary["points"])} points, '
        f'{len(surfels)} surfels in voxels of {mapper.map.voxel_size_m:g} m'
    )
    draw_map(surfels, output / 'map.png', title, trajectory=trajectory)
    with replace_file(output / 'summary.json') as file:
        file.write((json.dumps(summary, indent=2) + '\n').encode())
