# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Replay: a recording into a map, its picture, a report and figures, in this process.

Outputs are checked before the first scan. The files are written when the whole recording is
mapped, the map before everything that may fail after it; a viewer that fails ends alone. A replay
that maps nothing is an error, because an empty map looks like a result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack, suppress
from dataclasses import dataclass
from functools import partial
import logging
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from surfel_mapper.arguments import as_path, check_kind
from surfel_mapper.bags.writer import BagWriter
from surfel_mapper.compilation import clock, PROGRESS
from surfel_mapper.config import Config, load_config
from surfel_mapper.errors import BagError, ConfigError, MapError
from surfel_mapper.evaluation.trajectory_errors import compare
from surfel_mapper.evaluation.truth import true_poses
from surfel_mapper.files.atomic import check_free, finite_or_none, make_directory
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.window import SETTINGS
from surfel_mapper.memory import keep_freed_memory
from surfel_mapper.offline.motion_clock import MotionClock
from surfel_mapper.offline.normals_bag import NormalsBag
from surfel_mapper.offline.options import BAG, known_formats, MAP_FORMATS, ReplayOptions
from surfel_mapper.offline.outputs import (
    check_formats,
    check_layer_formats,
    check_writable,
    output_directory,
    ScanTrajectory,
    write_files,
    write_maps,
)
from surfel_mapper.offline.recording import open_recording, Recording
from surfel_mapper.offline.request import Request
from surfel_mapper.offline.summary import causes_text, uncertain_text
from surfel_mapper.pipeline import Mapper, Update
from surfel_mapper.pipeline.checkpoints import load_start
from surfel_mapper.viz.history import History
from surfel_mapper.viz.server import import_rerun
from surfel_mapper.viz.viewer import Viewer

SAME_TIME_NS = 10_000_000
"""A pose is compared with a true pose at most 10 ms apart."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class ReplayResult:
    """
    Map and figures of a replay.

    Attributes
    ----------
    mapper : Mapper
        Holds the map, ``mapper.map``, and the window.
    trajectory : ScanTrajectory
        Stamps and poses of the mapped scans.
    summary : dict of str
        The content of summary.json.
    written : list of Path
        The files of the map, picture, report and summary.

    """

    mapper: Mapper
    trajectory: ScanTrajectory
    summary: dict[str, Any]
    written: list[Path]


def replay(
    path: str | Path | Request,
    *,
    output: str | Path | None = None,
    config: Config | str | Path | None = None,
    options: ReplayOptions | None = None,
    progress: Callable[[int, int], object] = lambda done, total: None,
    stopped: Callable[[], bool] = lambda: False,
) -> ReplayResult:
    """
    Map a bag or a folder of scans and write the map, a picture, a report and a summary.

    The same as ``surfel-mapper replay`` with one recording. Six parameters, because the first
    three suffice for most calls.

    Parameters
    ----------
    path : str, Path or Request
        The recording; a Request also chooses topics, poses and a part of it.
    output : str or Path, optional
        Directory to write to; without, the name of the recording followed by _surfels, in the
        working directory.
    config : Config, str or Path, optional
        The configuration, or its YAML file; without, the defaults.
    options : ReplayOptions, optional
        Window, alignment, formats, truth, viewer, and whether to overwrite files.
    progress : callable
        Called with the numbers of scans received and expected after every mapped scan.
    stopped : callable
        Asked before every message; once it returns True, the map of the scans so far is written
        and the summary says ``interrupted``.

    Returns
    -------
    ReplayResult

    Raises
    ------
    BagError
        If the recording cannot be read, lacks topics or poses, or none of its scans was mapped.
    ConfigError
        If a setting or an option is wrong.
    FileFormatError
        If a file cannot be read or written, or the output exists and may not be overwritten.
    MapError
        If it was stopped before any scan was mapped.

    Examples
    --------
    >>> from surfel_mapper.simulation import Lidar, record, Simulation, World
    >>> street = Simulation(World.street(length_m=50.0), Lidar(beams=16, columns=360), num_scans=5)
    >>> bag = record(street, 'drive')
    >>> result = replay('drive', output='mapped')
    >>> result.summary['scans']['mapped'], [path.name for path in result.written][:2]
    (5, ['map.ply', 'map.npz'])

    """
    options = ReplayOptions() if options is None else options
    check_kind('options', options, ReplayOptions)
    check_kind('progress', progress, Callable)  # type: ignore[arg-type]
    request = path if isinstance(path, Request) else Request(path=as_path(path))
    settings = configured(config, options)
    directory = output_directory(
        request.path, None if output is None else as_path(output, 'output')
    )
    check_outputs(directory, options)
    keep_freed_memory()  # saves 2 ms for each cloud of 4 MB
    with no_empty_directory(directory), open_recording(request, settings) as recording:
        _log.info('%s: poses from %s', request.path, recording.describe()['poses_from'])
        mapper = started_mapper(with_loops(recording.config, options, directory))
        mapper.outcomes, mapper.pose_source = [], recording.describe()['poses_from']
        history, motion_clock = History(), MotionClock(mapper, recording)
        with listeners(directory, options, mapper) as listening:
            listen: dict[str, Sequence[Callable[[Update], object]]] = {
                **({'clocks': [motion_clock.add]} if motion_clock.is_used else {}),
                'record': [partial(history.add, mapper), *listening],
            }
            mapper.derives = bool(listening)  # the files hold the surfels of the end
            start_s = clock()
            trajectory, was_stopped = mapped(recording, mapper, listen, progress, stopped)
            refuse_empty(recording, mapper, was_stopped)
            with write_first(partial(write_maps, directory, options.formats, mapper, trajectory)):
                aligned = align(mapper, options)
            replay_s = clock() - start_s
            _log.info('mapped %d scans in %.1f s', mapper.counters.mapped, replay_s)
            trajectory.follow_alignment(mapper)
            history.move(trajectory.positions)
            write_maps(directory, options.formats, mapper, trajectory, window=options.window)
            mapper.finish_layers()
        figures = {
            **recording.describe(),
            'clock_offsets': motion_clock.offsets(),
            'pose_doubt': motion_clock.doubt,
            'recorded_s': recording.recorded_s,
            'replay_s': replay_s,
            'compile_s': PROGRESS.seconds,
            'window': options.window,
            'interrupted': was_stopped,
            'cut': list(recording.cuts),
            **aligned,
            **pose_errors(options.truth, trajectory),
            **mapper.summary(),
            'settings': mapper.config.to_mapping(),
            'settings_set': changed_settings(config),
        }
        summary = finite_or_none(figures)
    if options.poses_out is not None:
        trajectory.write(options.poses_out)
    written = write_files(directory, options.formats, mapper, trajectory, summary, history)
    _log.info('wrote %s', ', '.join(map(str, written)))
    return ReplayResult(mapper, trajectory, summary, written)


def map_recording(
    path: str | Path,
    *,
    voxel_size_m: float | None = None,
    bin_columns: int | None = None,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> SurfelMap:
    """
    Return the map of all scans of a recording, as ``replay`` makes it by default; write nothing.

    Parameters
    ----------
    path : str or Path
        A bag, or a folder of scans.
    voxel_size_m : float, optional
        Edge of the voxels, m; without, 0.5, and 0.08 for depth images.
    bin_columns : int, optional
        Number of columns of .bin files; without, that which fits their values.
    progress : callable
        Called with the numbers of scans received and expected after every mapped scan.

    Raises
    ------
    BagError
        If the recording cannot be read, lacks topics or poses, or none of its scans was mapped.

    """
    options = ReplayOptions()
    request = Request(path=Path(path), bin_columns=bin_columns)
    with (
        TemporaryDirectory(prefix='surfel_mapper-') as scratch,
        open_recording(request, configured(None, options)) as recording,
    ):
        config = recording.config
        if voxel_size_m is not None:
            config = config.replace({'map.voxel_size_m': voxel_size_m})
        mapper = started_mapper(with_loops(config, options, Path(scratch)))
        mapper.derives = False
        mapped(recording, mapper, {}, progress, lambda: False)
        refuse_empty(recording, mapper, was_stopped=False)
        align(mapper, options)
        figures = {**recording.describe(), **mapper.summary()}
        _log.info(
            '%s: %d scans mapped, voxels of %g m, poses from %s',
            *(path, mapper.counters.mapped, mapper.map.voxel_size_m, figures['poses_from']),
        )
        if uncertain := uncertain_text(figures):
            _log.warning('%s: %s', path, uncertain.replace('\n', '; '))
        return mapper.map


def changed_settings(config: Config | str | Path | None) -> list[str]:
    """Return the names of the settings that a configuration changes."""
    chosen = config if isinstance(config, Config) else load_config(config)
    default = Config().to_mapping()
    return [name for name, value in chosen.to_mapping().items() if value != default[name]]


def configured(config: Config | str | Path | None, options: ReplayOptions) -> Config:
    """Return the configuration for a replay with some options, after checking their formats."""
    if config is not None and not isinstance(config, (Config, str, Path)):
        raise ConfigError(
            f'config: a {type(config).__name__}, expected a Config or the path of a YAML file; '
            'Config.from_mapping(settings) takes a dict'
        )
    settings = config if isinstance(config, Config) else load_config(config)
    formats = known_formats()
    unknown = [name for name in options.formats if name not in formats]
    if unknown:
        raise ConfigError(f'formats: {unknown[0]!r}, expected some of {", ".join(formats)}')
    check_layer_formats(options.formats, settings)
    if options.align:
        settings = settings.replace({'window.keep_points': True})
    return settings if options.window else settings.replace(all_scans())


def all_scans() -> dict[str, Any]:
    """Return the settings with which no scan leaves the map: no limit of the window."""
    return {**{f'window.{name}': 0 for name in SETTINGS}, 'map.max_bytes': 0}


@contextmanager
def no_empty_directory(directory: Path) -> Iterator[None]:
    """Remove a directory that was made in the block if an error leaves it empty."""
    was_there = directory.exists()
    try:
        yield
    except BaseException:
        if not was_there:
            with suppress(OSError):  # it has files, or was not made
                directory.rmdir()
        raise


def with_loops(config: Config, options: ReplayOptions, directory: Path) -> Config:
    """Return the configuration with loops if they are wanted, and points in the directory."""
    is_wanted = options.align or (options.align is None and config.pose.source == 'registration')
    can_move = not options.window and config.map.mode != 'frozen' and not config.map.load
    if not (is_wanted and can_move):
        return config
    make_directory(directory)
    kept_in = config.loops.directory or str(directory)
    return config.replace({'loops.enabled': True, 'loops.directory': kept_in})


def align(mapper: Mapper, options: ReplayOptions) -> dict[str, Any]:
    """Close loops and align the scans, as far as asked for; return both for the summary."""
    done: dict[str, Any] = {}
    if mapper.loops is not None and len(mapper.loops) > 1:
        done['loops'] = mapper.close_loops().summary()
    if options.align:
        done['alignment'] = mapper.align().summary()
    return done


def started_mapper(config: Config) -> Mapper:
    """Return a mapper with compiled kernels and the map that ``map.load`` names, if any."""
    mapper = Mapper(config)
    load_start(mapper)
    mapper.warm_up()
    return mapper


def check_outputs(directory: Path, options: ReplayOptions) -> None:
    """Raise if an output cannot be written, shown or compared, before the first scan."""
    check_free(directory, options.overwrite)
    check_formats(options.formats, directory)
    for path in (options.poses_out, options.rrd):
        if path is not None:
            check_writable(path)
            check_free(path, options.overwrite)
    if options.view or options.rrd is not None:
        import_rerun()
    if options.truth is not None:
        check_truth(options.truth)


@contextmanager
def write_first(write: Callable[[], None]) -> Iterator[None]:
    """Write the map if a block fails, and then raise its error."""
    try:
        yield
    except Exception:  # MemoryError too
        write()
        raise


@contextmanager
def listeners(
    directory: Path, options: ReplayOptions, mapper: Mapper
) -> Iterator[list[Callable[[Update], None]]]:
    """Open the bag of normals and the viewers that were asked for; yield their callbacks."""
    with ExitStack() as files:
        callbacks = viewers(options, mapper, files)
        if BAG not in options.formats:
            yield callbacks
            return
        bag, errors = normals_bag(directory, mapper, files), list[BagError]()

        def add(update: Update) -> None:
            try:
                if not errors:
                    bag.add(update)
            except BagError as error:
                _log.warning('%s; the rest is mapped without it', error)
                errors.append(error)

        yield [*callbacks, add]
        if errors:
            raise errors[0]  # the map is written by now
        bag.finish()


def viewers(
    options: ReplayOptions, mapper: Mapper, files: ExitStack
) -> list[Callable[[Update], None]]:
    """Return the callbacks of the rerun viewers that were asked for; closed with the files."""
    paths: list[Path | None] = [None] if options.view else []
    paths += [options.rrd] if options.rrd is not None else []
    if not paths:
        return []
    return [files.enter_context(shown(Viewer(mapper, path), path)) for path in paths]


@contextmanager
def shown(viewer: Viewer, path: Path | None) -> Iterator[Callable[[Update], None]]:
    """
    Yield the callback of a viewer; if the viewer fails, the replay goes on without it.

    A viewer is another program that may be closed, and rerun raises errors of many types.
    """
    name = 'the viewer' if path is None else str(path)
    failed: BaseException | None = None

    def add(update: Update) -> None:
        nonlocal failed
        if failed is not None:
            return
        try:
            viewer.add(update)
        except Exception as error:
            failed = error
            _log.warning('%s has failed, the replay goes on without it: %s', name, error)

    try:
        yield add
    except BaseException as error:
        failed = error
        raise
    finally:
        try:
            viewer.__exit__(failed and type(failed), failed, None)
        except Exception as error:
            _log.warning('%s could not be closed: %s', name, error)


def normals_bag(directory: Path, mapper: Mapper, files: ExitStack) -> NormalsBag:
    """Begin the bag of normals; it is complete when the files are closed, or does not exist."""
    writer = BagWriter(directory / MAP_FORMATS[BAG], overwrite=True)
    return NormalsBag(files.enter_context(writer), mapper)


def mapped(
    recording: Recording,
    mapper: Mapper,
    listen: Mapping[str, Sequence[Callable[[Update], object]]],
    progress: Callable[[int, int], object],
    stopped: Callable[[], bool],
) -> tuple[ScanTrajectory, bool]:
    """Map all scans, listeners timed by stage; return the poses, and whether it was stopped."""
    trajectory, total = ScanTrajectory(mapper), recording.num_scans
    for update in recording.replay(mapper, stopped):
        trajectory.add(update)
        for stage, callbacks in listen.items():
            with mapper.counters.timed(stage):
                for callback in callbacks:
                    callback(update)
        progress(mapper.counters.received, total)
    return trajectory, stopped()


def refuse_empty(recording: Recording, mapper: Mapper, was_stopped: bool) -> None:
    """Raise if no scan was mapped, with the causes, unless none has a place on a frozen map."""
    counters = mapper.counters
    if counters.mapped or counters.localised or {'apart', 'not_aligned'} & counters.dropped.keys():
        return
    description = recording.describe()
    if was_stopped:
        raise MapError(f'{description["bag"]}: stopped before a scan was mapped')
    of = f' of {", ".join(description["topics"])}' if 'topics' in description else ''
    look = f'; `surfel-mapper info {description["bag"]}` shows what poses it has'
    raise BagError(
        f'{description["bag"]}: none of {counters.received} clouds{of} was mapped '
        f'({causes_text(counters.dropped)}){look if "no_pose" in counters.dropped else ""}'
    )


def check_truth(truth: Path) -> None:
    """Raise if there are no true poses at a path, before hours of work."""
    true_poses(truth, np.zeros(1, np.int64))


def pose_errors(truth: Path | None, trajectory: ScanTrajectory) -> dict[str, Any]:
    """Return the errors of the poses for the summary; empty without truth."""
    if truth is None:
        return {}
    stamps_ns, poses = trajectory.by_time
    try:
        errors = compare(
            stamps_ns,
            poses,
            *true_poses(truth, stamps_ns),
            max_difference_ns=SAME_TIME_NS,
        )
    except ValueError as error:
        _log.warning('--truth %s: %s', truth, error)
        return {}
    return {'pose_errors': errors}
