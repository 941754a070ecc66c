# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
``replay`` of several bags, or with several processes: one map of them all, in tiles.

The map is a Parquet dataset, ``map/tile_i=*/tile_j=*/surfels.parquet``; picture and report show
a part of its surfels. All bags have to be in one fixed frame.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
import json
from pathlib import Path
import time
from typing import Any, TYPE_CHECKING

from surfel_mapper.cli.progress import finished_first, progress, stopped_by_interrupt
from surfel_mapper.cli.replay_report import report, rounded
from surfel_mapper.errors import ConfigError, MapError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from surfel_mapper.cluster.running import Mapped, TiledMap
    from surfel_mapper.config import Config
    from surfel_mapper.offline.recording import Request

CUT, INTERRUPTED = 3, 130
"""Exit codes: a recording ends too early and --strict was given; Ctrl-C ended it."""

ONE_PROCESS = ('window', 'align', 'poses_out', 'truth', 'view', 'rrd', 'formats')
"""Options that ask for the whole map, or all scans in order, in one process."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare who does the work."""
    add = parser.add_argument_group('many bags, many processes').add_argument
    add('--workers', type=positive, metavar='N', help='map with so many processes')
    add('--scheduler', metavar='ADDRESS', help='map on the workers of a Dask scheduler, tcp://...')


def positive(text: str) -> int:
    """Return a number of one or more."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f'{text!r}, expected a whole number of 1 or more')
    return int(text)


def is_wanted(args: argparse.Namespace) -> bool:
    """Return whether the arguments ask for a map in tiles."""
    return len(args.bags) > 1 or args.workers is not None or args.scheduler is not None


def run(
    args: argparse.Namespace, config: Config, requests: Sequence[Request], output: Path
) -> int:
    """Map all recordings and report."""
    from surfel_mapper.cluster.engines import begin_workers, engine

    refuse_options(args)
    began = time.perf_counter()
    if args.workers is not None and args.scheduler is None:
        begin_workers()  # they load what they need while this process does the same
    from surfel_mapper.cluster.running import map_bags
    from surfel_mapper.cluster.shards import cut, shard_length_s

    lengths_s, cuts = surveyed(requests, config)
    recorded_s = sum(lengths_s)
    with engine(args.workers, args.scheduler) as running, stopped_by_interrupt() as stopped:
        shard_s = shard_length_s(recorded_s, running.num_workers)
        shards = [shard for request in requests for shard in cut(request, config, shard_s)]
        try:
            with two_stages('replay', recorded_s, 'recorded second') as on_done:
                mapped = map_bags(shards, running, output, on_done, stopped)
        except MapError:
            if stopped():  # before anything was mapped
                raise KeyboardInterrupt from None
            raise
        workers = running.num_workers
    summary = {
        'bag': str(requests[0].path) if len(requests) == 1 else f'{len(requests)} bags',
        'bags': [str(request.path) for request in requests],
        'recorded_s': recorded_s,
        'replay_s': time.perf_counter() - began,
        'interrupted': mapped.interrupted,
        'cut': cuts,
        **mapped.counts(),
        **described(mapped.map),
        'workers': workers,
        'shards': len(mapped.results),
        'shards_repeated': mapped.repeated,
        'peak_memory_mb': memory(mapped),
        'core_s': core_s(mapped),
        'settings': config.to_mapping(),
    }
    with nullcontext() if mapped.interrupted else finished_first():
        written = write_overview(output, summary, mapped.map, mapped.places)
        print(json.dumps(summary) if args.json else report(summary, written))
    if mapped.interrupted:
        return INTERRUPTED
    return CUT if args.strict and cuts else 0


def refuse_options(args: argparse.Namespace) -> None:
    """Refuse options that only a single process can follow."""
    given = [name for name in ONE_PROCESS if getattr(args, name)]
    if given:
        raise ConfigError(
            f'--{given[0].replace("_", "-")}: not with several bags, --workers or --scheduler, '
            'where no process holds the whole map'
        )


def surveyed(requests: Sequence[Request], config: Config) -> tuple[list[float], list[str]]:
    """Return how long recordings are, s, and what of them ends too early."""
    from surfel_mapper.offline.recording import open_recording

    lengths_s: list[float] = []
    cuts: list[str] = []
    for request in requests:
        with open_recording(request, config) as recording:
            lengths_s.append(recording.recorded_s)
            cuts += recording.cuts
    return lengths_s, cuts


@contextmanager
def two_stages(verb: str, total: float, unit: str) -> Iterator[Callable[[str, float], None]]:
    """Give a function to be told what got done; only mapping is counted, merging is quick."""
    done = 0.0
    with progress(verb, round(total), unit) as show:

        def on_done(kind: str, amount: float) -> None:
            nonlocal done
            if kind == 'map' or total == 0.0:
                done += amount
                show(round(done))

        yield on_done


def described(tiled: TiledMap) -> dict[str, Any]:
    """Return what a map in tiles is, for a summary."""
    return {
        'voxels': tiled.voxels,
        'surfels': tiled.surfels,
        'tiles': tiled.tiles,
        'bytes': tiled.nbytes,
        'voxel_size_m': tiled.voxel_size_m,
        'digest': tiled.digest,
    }


def memory(mapped: Mapped) -> dict[str, int]:
    """Return the most memory that a process had which mapped, and which merged."""
    return {
        'mapping': max(result.peak_bytes for result in mapped.results) // 10**6,
        'merging': mapped.map.peak_bytes // 10**6,
    }


def core_s(mapped: Mapped) -> dict[str, float]:
    """Return how long processors took to map and to merge, s."""
    mapping = sum(result.core_s for result in mapped.results)
    return {'mapping': round(mapping, 1), 'merging': round(mapped.map.core_s, 1)}


def write_overview(
    output: Path,
    summary: dict[str, Any],
    tiled: TiledMap,
    places: npt.NDArray[np.float64] | None,
) -> list[Path]:
    """Write picture, report and summary of a map in tiles; return what is there."""
    from surfel_mapper.files.atomic import write_json
    from surfel_mapper.viz.picture import draw_map
    from surfel_mapper.viz.report import write_report

    picture, page, figures = (output / n for n in ('map.png', 'report.html', 'summary.json'))
    title = (
        f'{Path(summary["bag"]).name}: {rounded(summary["points"])} points, '
        f'{tiled.surfels} surfels in voxels of {tiled.voxel_size_m:g} m, {tiled.tiles} tiles'
    )
    draw_map(tiled.sample, picture, title)
    write_report(page, title, summary, tiled.sample, picture=picture)
    write_json(figures, summary)
    return [tiled.directory, picture, page, figures]
