# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Replay of several bags, or with several processes: one map of them all, in this process at the end.

Each layer needs all scans in order, so layers are left out. All bags need poses in one frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from surfel_mapper.cluster.map_reduce import map_bags, MappedBags
from surfel_mapper.cluster.shards import cut, shard_length_s
from surfel_mapper.cluster.workers import never, open_workers
from surfel_mapper.compilation import clock
from surfel_mapper.config import AUTO, Config
from surfel_mapper.errors import BagError, ConfigError
from surfel_mapper.files.atomic import check_free, finite_or_none
from surfel_mapper.offline.options import BAG, MAP_FORMATS, ReplayOptions
from surfel_mapper.offline.outputs import check_formats, ScanTrajectory, write_files, write_maps
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.replay import (
    all_scans,
    changed_settings,
    pose_errors,
    ReplayResult,
)
from surfel_mapper.offline.request import Request
from surfel_mapper.viz.history import History


def replay_bags(
    requests: Sequence[Request],
    config: Config,
    output: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    options: ReplayOptions | None = None,
    progress: Callable[[int, int], object] = lambda done, total: None,
    stopped: Callable[[], bool] = never,
) -> ReplayResult:
    """
    Map recordings into one map and write it, with a picture, a report and a summary.

    The same as ``surfel-mapper replay`` with several bags or with ``--workers``; eight parameters
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
    options : ReplayOptions, optional
        Formats of the map, poses_out, truth and overwrite.
    progress : callable
        Called with the seconds of recordings that are mapped, and all.
    stopped : callable
        Asked again and again; once it returns True, no more shards are begun, and the summary
        says ``interrupted``.

    Returns
    -------
    ReplayResult

    Raises
    ------
    MapError
        If no scan was mapped.
    BagError, ConfigError, FileFormatError
        If a recording cannot be read, a setting or option cannot be followed, or a file not
        written.
    ClusterError, DependencyError
        If workers cannot be reached or are lost, or Dask is not installed.

    """
    began = clock()
    options = ReplayOptions() if options is None else options
    check(config, options, output)
    surveys = [surveyed(request, config) for request in requests]
    recorded_s, done_s = sum(survey['recorded_s'] for survey in surveys), 0.0

    def on_done(seconds: float) -> None:
        nonlocal done_s
        done_s += seconds
        progress(round(done_s), round(recorded_s))

    times = {'survey': clock()}
    with open_workers(workers, scheduler) as pool:
        times['start'] = clock()
        shard_s = shard_length_s(recorded_s, pool.num_workers)
        shards = [cut(request, config, shard_s) for request in requests]
        mapped = map_bags(shards, pool, on_done, stopped)
        times['map'] = clock()
        num_workers = pool.num_workers
    times['stop'] = clock()
    summary = {
        'bag': str(requests[0].path) if len(requests) == 1 else f'{len(requests)} bags',
        'bags': [str(request.path) for request in requests],
        'recorded_s': recorded_s,
        'replay_s': times['stop'] - began,
        'wall_s': durations(began, times),
        'window': False,
        'interrupted': mapped.interrupted,
        'cut': [cut for survey in surveys for cut in survey['cut']],
        'clock_offsets': [offset for survey in surveys for offset in survey['clock_offsets']],
        **mapped.mapper.summary(),
        **mapped.counts,
        'workers': num_workers,
        'shards': mapped.num_shards,
        'shards_repeated': mapped.repeated,
        'core_s': round(mapped.core_s, 1),
        'settings': config.to_mapping(),
        'settings_set': [name for name in changed_settings(config) if name not in all_scans()],
    }
    return written(output, options, mapped, summary)


def durations(began: float, ends: dict[str, float]) -> dict[str, float]:
    """Return the durations of consecutive stages from their ends."""
    return {
        name: end - start
        for (name, end), start in zip(ends.items(), [began, *ends.values()][:-1], strict=True)
    }


def check(config: Config, options: ReplayOptions, output: Path) -> None:
    """Raise ConfigError for settings and options that need a single process."""
    if config.map.origin == AUTO:
        raise ConfigError(
            'map.origin: auto, expected x y z with several recordings or workers: parts of a map '
            'would find different ones'
        )
    for name in options.formats:
        if name not in MAP_FORMATS or name == BAG:
            raise ConfigError(
                f'formats: {name!r} needs one recording and a single process, expected some of '
                f'{", ".join(form for form in MAP_FORMATS if form != BAG)}'
            )
    check_free(output, options.overwrite)
    check_formats(options.formats, output)


def written(
    output: Path, options: ReplayOptions, mapped: MappedBags, summary: dict[str, Any]
) -> ReplayResult:
    """Write the files of a replay."""
    mapper = mapped.mapper
    mapper.outcomes = mapped.outcomes
    trajectory = ScanTrajectory(mapper)
    trajectory.stamps_ns, trajectory.poses = mapped.stamps_ns, mapped.poses
    write_maps(output, options.formats, mapper, trajectory)
    if options.poses_out is not None:
        trajectory.write(options.poses_out)
    summary = finite_or_none({**summary, **pose_errors(options.truth, trajectory)})
    history = History(mapped.stamps_ns, trajectory.positions)
    files = write_files(output, options.formats, mapper, trajectory, summary, history)
    return ReplayResult(mapper, trajectory, summary, files)


def surveyed(request: Request, config: Config) -> dict[str, Any]:
    """Return duration, cut files and clocks of a recording; raise BagError if it has no poses."""
    with open_recording(request, config) as recording:
        description = recording.describe()
        if description['poses_from'] == 'registration':
            raise BagError(
                f'{request.path}: no poses; several recordings, or workers, need poses in one '
                'frame; `surfel-mapper replay` maps it alone, with the '
                'poses of its scans in trajectory.tum'
            )
        return {
            'recorded_s': recording.recorded_s,
            'cut': list(recording.cuts),
            'clock_offsets': [
                {**offset, 'text': f'{request.path}: {offset["text"]}'}
                for offset in description.get('clock_offsets', [])
            ],
        }
