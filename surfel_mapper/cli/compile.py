# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``surfel-mapper compile``: compile kernels once, so that no later run waits for them.

For robots, images and environments when they are built. Kernels are kept beside the package, or in
NUMBA_CACHE_DIR.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import tempfile

from surfel_mapper.cli._output import show_lines
from surfel_mapper.cli._verbosity import add_verbosity
from surfel_mapper.compilation import PROGRESS, run_stages

SUMMARY = 'Compile all kernels, or those of a configuration, once on a machine.'

EXAMPLE = 'surfel-mapper compile --config my.yaml'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        '--config',
        type=Path,
        metavar='FILE',
        help='YAML file of settings: compile what a node with them needs (default: everything)',
    )
    add_verbosity(parser)


def run(args: argparse.Namespace) -> int:
    """Compile, and report how many kernels that were."""
    with tempfile.TemporaryDirectory(prefix='surfel_mapper-') as directory:
        if args.config is None:
            from surfel_mapper.offline.compiling import SmallDrive

            stages = SmallDrive(Path(directory)).stages()
        else:
            from surfel_mapper.config import load_config
            from surfel_mapper.pipeline import Mapper
            from surfel_mapper.pipeline.warm_up import node_stages

            stages = node_stages(Mapper(load_config(args.config)))
        run_stages(stages)
    num, seconds = PROGRESS.num_kernels, PROGRESS.seconds
    show_lines(f'kernels compiled {num}   {seconds:.1f} s' if num else 'all kernels are compiled')
    return 0
