# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Many bags into one map, on the processes of this machine or the workers of a Dask scheduler.

    pip install 'surfel_mapper[cluster]'
    python examples/dask_run.py monday.mcap tuesday.mcap --output city/ --workers 2
    python examples/dask_run.py /shelf/*.mcap --output /shelf/city/ --scheduler tcp://head:8786

``surfel-mapper replay BAG... --workers 2`` does the same; this script is a start for programs that
use the result. The digest is that of a single process, however the work is distributed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from surfel_mapper import load_config
from surfel_mapper.cluster.map_reduce import map_bags
from surfel_mapper.cluster.shards import cut
from surfel_mapper.cluster.workers import open_workers
from surfel_mapper.offline.request import Request


def main() -> None:
    """Map bags."""
    parser = argparse.ArgumentParser(description=str(__doc__).strip().partition('\n')[0])
    parser.add_argument('bags', nargs='+', type=Path)
    parser.add_argument('--output', required=True, type=Path, metavar='DIR')
    parser.add_argument('--config', type=Path, metavar='FILE')
    parser.add_argument('--shard', type=float, default=30.0, metavar='S', help='s of recording')
    who = parser.add_mutually_exclusive_group()
    who.add_argument('--workers', type=int, metavar='N', help='processes of this machine')
    who.add_argument('--scheduler', metavar='ADDRESS', help='of a Dask scheduler')
    args = parser.parse_args()

    config = load_config(args.config)
    bags = [cut(Request(path=bag), config, args.shard) for bag in args.bags]
    with open_workers(args.workers, args.scheduler) as workers:
        mapped = map_bags(bags, workers)
    surfel_map = mapped.mapper.map
    args.output.mkdir(parents=True, exist_ok=True)
    digest = surfel_map.save(args.output / 'map.npz')
    print(
        f'{mapped.num_shards} shards, {surfel_map.num_points} points, '
        f'{surfel_map.num_surfels(config.map.min_points)} surfels\ndigest {digest}'
    )


if __name__ == '__main__':  # worker processes import this file
    main()
