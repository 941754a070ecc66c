# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper resample``: a cloud sampled from the models in a file."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from surfel_mapper.cli._arguments import add_overwrite, positive_float
from surfel_mapper.cli._output import show_lines
from surfel_mapper.cli._verbosity import add_verbosity

SUMMARY = 'Sample a cloud from the models in a file of `extract` or `replay`.'

EXAMPLE = 'surfel-mapper resample models/models.smm --spacing 0.02 --output cloud.ply'

BYTES_PER_SAMPLE = 200
"""Memory that a sample takes while it is drawn, bytes."""

FAR_M = 1000.0
"""Coordinates from this on are written as float64; float32 has steps of 0.06 mm there."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('models', type=Path, metavar='FILE', help='models.smm')
    parser.add_argument(
        '--spacing',
        type=positive_float,
        metavar='M',
        help='distance of the points on planes and surfaces, m (the voxel size of the models)',
    )
    parser.add_argument(
        '--seed', type=int, default=0, help='of the points of Gaussians (%(default)s)'
    )
    parser.add_argument(
        '-o', '--output', type=Path, required=True, metavar='OUT', help='.ply or .pcd to write'
    )
    add_overwrite(parser)
    parser.add_argument('--json', action='store_true', help='print the numbers as JSON')
    add_verbosity(parser)


def run(args: argparse.Namespace) -> int:
    """Read models, write points, report."""
    from surfel_mapper.errors import FileFormatError
    from surfel_mapper.files.atomic import check_free
    from surfel_mapper.files.scan_files import WRITERS
    from surfel_mapper.memory import machine_bytes
    from surfel_mapper.models import read

    suffix = args.output.suffix.lower()
    if suffix not in WRITERS:
        raise FileFormatError(f'{args.output}: expected a file ending in {" or ".join(WRITERS)}')
    check_free(args.output, args.overwrite)
    model = read(args.models)
    number = model.num_samples(args.spacing)
    if number * BYTES_PER_SAMPLE > machine_bytes() // 2:
        raise FileFormatError(
            f'{args.models}: {number} points at this spacing, more than fit into the memory; '
            'expected a larger --spacing'
        )
    points = model.resample(args.spacing, args.seed)
    dtype = np.float32 if np.abs(points).max(initial=0.0) < FAR_M else np.float64
    WRITERS[suffix](args.output, dict(zip('xyz', points.T.astype(dtype), strict=True)))
    content = {
        'planes': len(model.planes),
        'surfaces': len(model.surfaces),
        'gaussians': len(model.gaussians),
        'points': len(points),
    }
    show_lines(json.dumps(content) if args.json else report(content))
    return 0


def report(content: dict[str, int]) -> str:
    """Return the numbers as a line of text."""
    return (
        f'planes {content["planes"]}   surfaces {content["surfaces"]}   '
        f'Gaussians {content["gaussians"]}   points {content["points"]}'
    )
