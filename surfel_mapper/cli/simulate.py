# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper simulate``: a lidar drives through known surfaces, recorded as a bag."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from surfel_mapper.cli._arguments import (
    add_overwrite,
    positive_float,
    positive_int,
    UsageError,
)
from surfel_mapper.cli._output import show_lines
from surfel_mapper.cli._verbosity import add_verbosity
from surfel_mapper.compilation import clock
from surfel_mapper.errors import ConfigError, escaped
from surfel_mapper.offline.summary import rounded

if TYPE_CHECKING:
    from surfel_mapper.simulation import Simulation

SUMMARY = 'Simulate a lidar driving through a world with known surfaces; record it as a bag.'

EXAMPLE = 'surfel-mapper simulate street --output street --scans 100 --noise 0.02'

SPARE_M = 20.0
"""Length of the street beyond the drive, m."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments; the defaults of the lidar are those of simulation.Lidar."""
    add = parser.add_argument
    add('world', choices=['street'], help='a street canyon, turned and tilted off the grid')
    add('-o', '--output', required=True, metavar='DIR', help='directory of the bag')
    add_overwrite(parser)
    add('--storage', choices=['mcap', 'sqlite3'], default='mcap', help='format (%(default)s)')
    length = parser.add_mutually_exclusive_group()
    length.add_argument(
        '--scans', type=positive_int, default=100, metavar='N', help='number (%(default)s)'
    )
    length.add_argument(
        '--duration', type=positive_float, metavar='S', help='s, instead of --scans'
    )
    add('--speed', type=float, default=5.0, metavar='V', help='of the vehicle, m/s (%(default)s)')
    add('--beams', type=int, default=64, metavar='N', help='beams of the lidar (%(default)s)')
    add('--columns', type=int, default=2048, metavar='N', help='columns a turn (%(default)s)')
    add('--rate', type=float, default=10.0, metavar='F', help='scan rate, Hz (%(default)s)')
    add('--noise', type=float, default=0.0, metavar='M', help='sigma of range, m (%(default)s)')
    add('--max-range', type=float, default=100.0, metavar='M', help='m (%(default)s)')
    add('--seed', type=int, default=0, metavar='N', help='of street and noise (%(default)s)')
    add('--rolling', action='store_true', help='the vehicle moves while the lidar turns')
    add('--json', action='store_true', help='report as JSON')
    add_verbosity(parser)


def run(args: argparse.Namespace) -> int:
    """Simulate and record a drive, and report the counts."""
    from tqdm import tqdm

    from surfel_mapper.files.atomic import check_free
    from surfel_mapper.scan import Scan
    from surfel_mapper.simulation import record

    check_free(Path(args.output), args.overwrite)  # the writer would name the full path
    try:
        simulation = simulation_of(args)
    except ConfigError as error:  # the options are its only settings
        raise UsageError(str(error)) from error
    returns = 0
    begin = clock()
    bar = tqdm(
        total=simulation.num_scans, unit='scan', disable=args.quiet or not sys.stderr.isatty()
    )

    def count(scan: Scan) -> None:
        nonlocal returns
        returns += int((scan.columns['surface'] >= 0).sum())
        bar.update()

    with bar:
        record(
            simulation,
            args.output,
            storage=args.storage,
            overwrite=args.overwrite,
            on_scan=count,
        )
    report = {
        'output': args.output,
        'scans': simulation.num_scans,
        'points': simulation.num_scans * args.beams * args.columns,
        'returns': returns,
        'distance_m': round(args.speed * simulation.num_scans / args.rate, 3),
        'seconds': round(clock() - begin, 1),
    }
    text = (
        f'{escaped(str(args.output))}: scans {report["scans"]}   '
        f'points {rounded(report["points"])} ({rounded(returns)} returns)   '
        f'{report["distance_m"]:g} m   {report["seconds"]} s'
    )
    show_lines(json.dumps(report) if args.json else text)
    return 0


def simulation_of(args: argparse.Namespace) -> Simulation:
    """Return the simulation that the arguments ask for."""
    from surfel_mapper.simulation import Drive, Lidar, Simulation, World
    from surfel_mapper.simulation.street import street_pose

    lidar = Lidar(
        beams=args.beams,
        columns=args.columns,
        rate_hz=args.rate,
        range_noise_m=args.noise,
        max_range_m=args.max_range,
        seed=args.seed,
    )
    drive = Drive(start=tuple(street_pose()), speed_m_s=args.speed)
    num_scans = args.scans
    if args.duration is not None:
        num_scans = max(round(args.duration * lidar.rate_hz), 1)
    length_m = max(args.speed * num_scans / lidar.rate_hz, 0.0) + SPARE_M
    world = World.street(seed=args.seed, length_m=length_m)
    return Simulation(world, lidar, drive, num_scans=num_scans, rolling=args.rolling)
