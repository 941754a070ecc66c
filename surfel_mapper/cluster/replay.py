# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Replay of several bags, or with several processes: one map of them all, in tiles.

The map is a Parquet dataset, ``map/tile_i=*/tile_j=*/surfels.parquet``; picture and report show
tiles of many surfels by larger voxels. All bags have to be in one fixed frame; those without poses
are brought into that of the first (common_frame.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
import time
from typing import Any, TYPE_CHECKING

from surfel_mapper.cluster.executors import never, open_executor, start_forkserver
from surfel_mapper.config import AUTO
from surfel_mapper.errors import BagError, ConfigError, MapError
from surfel_mapper.files.atomic import check_free
from surfel_mapper.offline.request import Request

if TYPE_CHECKING:
    from surfel_mapper.cluster.common_frame import CommonFrame
    from surfel_mapper.cluster.executors import Executor
    from surfel_mapper.cluster.map_reduce import MapReduceResult
    from surfel_mapper.cluster.tiles import OnDone
    from surfel_mapper.config import Config


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShelfResult:
    """
    Map and figures of a replay of several bags.

    Attributes
    ----------
    mapped : MapReduceResult
        The map in tiles, and the results of the shards.
    summary : dict of str
        The content of summary.json.
    written : list of Path
        The dataset of tiles, trajectory, picture, report and summary.

    """

    mapped: MapReduceResult
    summary: dict[str, Any]
    written: list[Path]


def replay_bags(
    requests: Sequence[Request],
    config: Config,
    output: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    align: bool | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], object] = lambda done, total: None,
    stopped: Callable[[], bool] = never,
) -> ShelfResult:
    """
    Map recordings into one map in tiles and write it, with a picture, a report and a summary.

    The same as ``surfel-mapper replay`` with several bags or with ``--workers``; nine parameters
    because the first three suffice for most calls.

    Parameters
    ----------
    requests : sequence of Request
        The recordings.
    config : Config
        The configuration; all scans stay in the map.
    output : Path
        Directory to write to.
    workers : int, optional
        Number of processes on this machine; without, this process does the work.
    scheduler : str, optional
        Address of a Dask scheduler instead.
    align : bool, optional
        As ``ReplayOptions.align``, for each recording that is registered; False: no loops.
    overwrite : bool
        As ``ReplayOptions.overwrite``.
    progress : callable
        Called with the seconds of recordings that are mapped, and all.
    stopped : callable
        Asked again and again; once it returns True, no more shards are begun, and the summary
        says ``interrupted``.

    Returns
    -------
    ShelfResult

    Raises
    ------
    MapError
        If no scan was mapped.
    BagError, ConfigError, FileFormatError
        If a recording cannot be read, a setting cannot be followed, or a file not written.
    ClusterError, DependencyError
        If workers cannot be reached or are lost, or Dask is not installed.

    """
    began = time.perf_counter()
    check_origin(config)
    check_free(output, overwrite)
    if workers is not None and scheduler is None:
        start_forkserver()  # they load their modules while this process loads its own
    found = surveyed(requests, config)
    is_registered = check_one_kind(found)
    # a recording that is registered is read twice
    recorded_s, done_s = sum(each.recorded_s for each in found), 0.0
    total_s = (1 + is_registered) * recorded_s

    def on_done(kind: str, amount: float) -> None:
        nonlocal done_s
        if kind == 'map' or recorded_s == 0.0:  # merging takes little of the time
            done_s += amount
            progress(round(done_s), round(total_s))

    surveyed_s = time.perf_counter()
    with open_executor(workers, scheduler) as executor:
        started_s = time.perf_counter()
        jobs, frame = [(each.request, config) for each in found], None
        if is_registered:
            frame = registered(found, config, output, align, executor, on_done, stopped)
            jobs = [(each.request, each.config) for each in frame.placed]
        registered_s = time.perf_counter()
        mapped = mapped_together(jobs, recorded_s, executor, output, on_done, stopped)
        mapped_s = time.perf_counter()
        num_workers = executor.num_workers
    ended_s = time.perf_counter()
    summary = {
        'bag': str(requests[0].path) if len(requests) == 1 else f'{len(requests)} bags',
        'bags': [str(request.path) for request in requests],
        'recorded_s': recorded_s,
        'replay_s': ended_s - began,
        'wall_s': {
            'survey': surveyed_s - began,
            'start': started_s - surveyed_s,
            **({} if frame is None else {'register': registered_s - started_s}),
            'map': mapped_s - registered_s - mapped.merge_s,
            'merge': mapped.merge_s,
            'stop': ended_s - mapped_s,
        },
        'interrupted': mapped.interrupted,
        'cut': [cut for each in found for cut in each.cuts],
        **mapped.counts(),
        **mapped.map.summary(),
        **({} if frame is None else frame.summary(mapped.counts()['scans'])),
        'workers': num_workers,
        **shares_of_work(mapped),
        'settings': config.to_mapping(),
    }
    return ShelfResult(
        mapped=mapped, summary=summary, written=write_overview(output, summary, mapped)
    )


def check_origin(config: Config) -> None:
    """Raise ConfigError if parts of a map would choose their origins themselves."""
    if config.map.origin == AUTO:
        raise ConfigError(
            'map.origin: auto, expected x y z with several recordings or workers: parts of a map '
            'would find different ones'
        )


def mapped_together(
    jobs: Sequence[tuple[Request, Config]],
    recorded_s: float,
    executor: Executor,
    output: Path,
    on_done: OnDone,
    stopped: Callable[[], bool],
) -> MapReduceResult:
    """Map recordings in one frame, each cut into shards, into one dataset of tiles."""
    from surfel_mapper.cluster.map_reduce import map_bags
    from surfel_mapper.cluster.shards import cut, shard_length_s

    shard_s = shard_length_s(recorded_s, executor.num_workers)
    shards = [shard for request, config in jobs for shard in cut(request, config, shard_s)]
    return map_bags(shards, executor, output, on_done, stopped)


def shares_of_work(mapped: MapReduceResult) -> dict[str, Any]:
    """Return the number of shards, and memory and processor time of mapping and merging."""
    results, merged = mapped.results, mapped.map
    return {
        'shards': len(results),
        'shards_repeated': mapped.repeated,
        'peak_memory_mb': {
            'mapping': max(result.peak_bytes for result in results) // 10**6,
            'merging': merged.peak_bytes // 10**6,
        },
        'core_s': {
            'mapping': round(sum(result.core_s for result in results), 1),
            'merging': round(merged.core_s, 1),
        },
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Surveyed:
    """Source of poses, duration and cut files of a recording that is not mapped yet."""

    request: Request
    recorded_s: float
    cuts: list[str]
    poses_from: str


def surveyed(requests: Sequence[Request], config: Config) -> list[Surveyed]:
    """Return duration, s, source of poses, and files that end too early, of each recording."""
    from surfel_mapper.offline.recording import open_recording

    found = []
    for request in requests:
        with open_recording(request, config) as recording:
            found.append(
                Surveyed(
                    request=request,
                    recorded_s=recording.recorded_s,
                    cuts=list(recording.cuts),
                    poses_from=str(recording.describe()['poses_from']),
                )
            )
    return found


def check_one_kind(found: Sequence[Surveyed]) -> bool:
    """Return whether the recordings have to be registered; raise BagError if only some have."""
    without = [each for each in found if each.poses_from == 'registration']
    others = [each for each in found if each.poses_from != 'registration']
    if without and others:
        raise BagError(
            f'{without[0].request.path} has no poses, but {others[0].request.path} has, from '
            f'{others[0].poses_from}; expected all or none, or --poses-from registration for all'
        )
    return bool(without)


def registered(
    found: Sequence[Surveyed],
    config: Config,
    output: Path,
    align: bool | None,
    executor: Executor,
    on_done: OnDone,
    stopped: Callable[[], bool],
) -> CommonFrame:
    """Register each recording alone, and place them on each other."""
    from surfel_mapper.cluster.common_frame import in_one_frame, register
    from surfel_mapper.cluster.shards import absolute

    tasks = [
        (absolute(each.request), config, output.absolute() / f'registered_{number}', align)
        for number, each in enumerate(found, start=1)
    ]
    done = {}
    for number, result in executor.run(register, tasks, stopped):
        done[number] = result
        on_done('map', found[number].recorded_s)
    if len(done) < len(tasks):
        raise MapError('stopped before all recordings were registered')
    return in_one_frame([done[number] for number in range(len(tasks))])


def write_overview(output: Path, summary: dict[str, Any], mapped: MapReduceResult) -> list[Path]:
    """Write trajectory, picture, report and summary of a map in tiles; return what was written."""
    from surfel_mapper.files.atomic import write_json
    from surfel_mapper.files.trajectory import TRAJECTORY, write_tum
    from surfel_mapper.offline.summary import rounded
    from surfel_mapper.viz.picture import draw_map
    from surfel_mapper.viz.report import write_report

    tiled = mapped.map
    picture, page, figures = (output / n for n in ('map.png', 'report.html', 'summary.json'))
    stamps_ns, poses = mapped.trajectory()
    poses[:, :3, 3] += tiled.origin_m
    write_tum(output / TRAJECTORY, stamps_ns, poses)
    title = (
        f'{Path(summary["bag"]).name}: {rounded(summary["points"])} points, '
        f'{tiled.surfels:,} surfels in voxels of {tiled.voxel_size_m:g} m, {tiled.tiles} tiles'
    )
    draw_map(tiled.drawn, picture, title, origin_m=summary['origin_m'])
    write_report(page, title, summary, tiled.sample, picture=picture, drawn=tiled.drawn)
    write_json(figures, summary)
    return [tiled.directory, output / TRAJECTORY, picture, page, figures]
