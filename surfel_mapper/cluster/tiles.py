# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Reduce: parts of many maps into one map, tile by tile.

No process holds more than one tile and the part that it adds. The digest of the result is taken
by visiting the tiles in the order of their voxels. The tiles are written to a directory beside
the target, which takes its name when all are done; until then an earlier map stays whole.

One module: the work on a tile and the order of the tiles share the layout of the
directories.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
import logging
from pathlib import Path
import secrets
import shutil
import time
from typing import Any

import numpy as np

from surfel_mapper.cluster.executors import Executor
from surfel_mapper.cluster.shards import peak_bytes
from surfel_mapper.errors import FileFormatError, MapError, MapLimitError
from surfel_mapper.files.atomic import sync_directory
from surfel_mapper.files.latest_map import EXACT, map_in, TILES
from surfel_mapper.files.map_state import load_map, window_stamps_ns
from surfel_mapper.files.parquet_tiles import (
    dataset_digest,
    kind_of,
    origin_of,
    Part,
    read_part,
    split_map,
    Tile,
    TILE_BITS,
    tile_part,
    tiles_in,
    write_shard,
    write_tile,
)
from surfel_mapper.files.trajectory import read_trajectory, trajectory_beside
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import concatenated, Surfels

DATASET = TILES
"""Directory of the tiles inside the output directory of a replay."""

DRAWN = 75_000
"""Limit of the surfels returned for pictures; the view of a report takes 80,000."""

_log = logging.getLogger(__name__)

Parts = Mapping[Tile, list[Part]]

OnDone = Callable[[str, float], object]
"""Called with 'map' and seconds of a recording that are done, or 'merge' and tiles."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TileTask:
    """
    A tile to be made.

    Attributes
    ----------
    parts : tuple of Part
        The tile is their sum.
    path : str
        File to write.
    min_points : int
        Points that a voxel needs to count as a surfel.
    share : float
        Share of its surfels that is returned, for pictures and charts; 1: all.

    """

    parts: tuple[Part, ...]
    path: str
    min_points: int
    share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TileResult:
    """Figures of a tile, and surfels of it; see TiledMap."""

    voxel_size_m: float
    origin_m: tuple[float, ...]
    voxels: int
    points: int
    surfels: int
    core_s: float
    sample: Surfels
    drawn: Surfels
    peak_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class TiledMap:
    """
    A map in tiles.

    Attributes
    ----------
    directory : Path
        The dataset.
    voxel_size_m : float
    origin_m : tuple of 3 float
        Origin of the map in the fixed frame, m.
    digest : str
        Equal to SurfelMap.digest of the same map.
    voxels, points, surfels, tiles, nbytes : int
        Counts, and the size of its files in bytes.
    core_s : float
        Processor time of merging, s, without the digest.
    sample : Surfels
        Every n-th of its surfels, for histograms.
    drawn : Surfels
        For pictures: tiles with more surfels than their share by those of the exact coarser map.
    peak_bytes : int
        The most memory of a process that merged.

    """

    directory: Path
    voxel_size_m: float
    origin_m: tuple[float, ...]
    digest: str
    voxels: int
    points: int
    surfels: int
    tiles: int
    nbytes: int
    core_s: float
    sample: Surfels
    drawn: Surfels
    peak_bytes: int

    def summary(self) -> dict[str, Any]:
        """Return the figures of the map for summary.json."""
        return {
            'voxels': self.voxels,
            'surfels': self.surfels,
            'tiles': self.tiles,
            'bytes': self.nbytes,
            'voxel_size_m': self.voxel_size_m,
            'origin_m': list(self.origin_m),
            'digest': self.digest,
        }


def merge_tile(task: TileTask) -> TileResult:
    """
    Add up the parts of a tile and write it; runs on a worker.

    Raises
    ------
    MapError
        If the parts belong to maps of different kind.
    FileFormatError
        If a file cannot be read or written.

    """
    began_core = time.process_time()
    first, *others = task.parts
    surfel_map = read_part(first)
    for part in others:
        surfel_map.merge(read_part(part))
    write_tile(task.path, surfel_map)
    surfels = surfel_map.surfels(task.min_points)
    wanted = int(np.ceil(len(surfels) * task.share))
    rows = np.linspace(0, len(surfels) - 1, wanted).astype(np.int64)
    return TileResult(
        voxel_size_m=surfel_map.voxel_size_m,
        origin_m=tuple(surfel_map.origin_m.tolist()),
        voxels=surfel_map.num_voxels,
        points=surfel_map.num_points,
        surfels=len(surfels),
        core_s=time.process_time() - began_core,
        sample=surfels.select(rows),
        drawn=drawn_tile(surfel_map, surfels, task.min_points, wanted),
        peak_bytes=peak_bytes(),
    )


def drawn_tile(surfel_map: SurfelMap, surfels: Surfels, min_points: int, at_most: int) -> Surfels:
    """Return the surfels of the finest level with at most ``at_most``, else of the coarsest."""
    for level in range(1, TILE_BITS + 1):
        if len(surfels) <= at_most:
            break
        try:
            surfels = surfel_map.coarsen(level).surfels(min_points)
        except MapLimitError:  # a parked sensor: too many points for larger voxels
            break
    return surfels


def merge_maps(
    sources: Sequence[str | Path],
    executor: Executor,
    directory: Path,
    min_points: int,
    on_done: OnDone = lambda kind, amount: None,
) -> TiledMap:
    """
    Merge finished maps into a dataset of tiles.

    Parameters
    ----------
    sources : sequence of str or Path
        Output directories of a replay or a merge, datasets of tiles, or files, .parquet or .npz.
    executor : Executor
        Runs the tasks.
    directory : Path
        The output directory; the tiles are in ``map`` inside it.
    min_points : int
        Points that a voxel needs to count as a surfel, for the figures.
    on_done : callable
        Called after every tile.

    Raises
    ------
    MapError
        If the maps differ in voxel size or columns, or their origins are not a whole number of
        voxels apart.
    FileFormatError
        If a map cannot be read, or a file not written.

    Notes
    -----
    The result has the origin of the first map.

    """
    with work_directory(directory) as work:
        found: list[dict[Tile, Part]] = []
        kinds: dict[str | Path, dict[str, Any]] = {}
        origin_m: tuple[float, ...] | None = None
        for number, source in enumerate(sources):
            place = work / str(number)
            place.mkdir()
            parts = parts_of_map(source, place)
            for part in islice((part for tiles in parts for part in tiles.values()), 1):
                kinds[source] = kind_of(part.path)
                origin_m = origin_m or origin_of(part.path)
            found += at_origin(parts, origin_m, place)
        check_kinds(kinds)
        warn_of_repeated_scans(sources)
        return merge_parts(parts_by_tile(found), executor, directory, min_points, on_done)


def merge_parts(
    parts: Parts, executor: Executor, directory: Path, min_points: int, on_done: OnDone
) -> TiledMap:
    """Make every tile, take the digest, and give the dataset its name."""
    if not parts:
        raise MapError('no scan was mapped')
    share = min(DRAWN / sum(part.num_voxels for found in parts.values() for part in found), 1.0)
    fresh = directory.resolve() / f'.{DATASET}-{secrets.token_hex(8)}.part'
    tasks = [
        TileTask(
            parts=tuple(found), path=str(fresh / tile.path), min_points=min_points, share=share
        )
        for tile, found in sorted(parts.items())
    ]
    try:
        done = dict(_counted(executor.run(merge_tile, tasks), on_done))
        tiles = [done[number] for number in range(len(tasks))]
        ((_, digest),) = executor.run(dataset_digest, [str(fresh)])
        take_name(fresh, directory / DATASET)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return TiledMap(
        directory=directory / DATASET,
        voxel_size_m=tiles[0].voxel_size_m,
        origin_m=tiles[0].origin_m,
        digest=digest,
        voxels=sum(tile.voxels for tile in tiles),
        points=sum(tile.points for tile in tiles),
        surfels=sum(tile.surfels for tile in tiles),
        tiles=len(tiles),
        nbytes=sum(path.stat().st_size for path in tiles_in(directory / DATASET).values()),
        core_s=sum(tile.core_s for tile in tiles),
        sample=concatenated([tile.sample for tile in tiles]),
        drawn=concatenated([tile.drawn for tile in tiles]),
        peak_bytes=max(tile.peak_bytes for tile in tiles),
    )


def at_origin(
    parts: list[dict[Tile, Part]], origin_m: tuple[float, ...] | None, work: Path
) -> list[dict[Tile, Part]]:
    """Return the parts of a map, cut again if the map has another origin."""
    every = [part for tiles in parts for part in tiles.values()]
    if origin_m is None or not every or origin_of(every[0].path) == origin_m:
        return parts
    return [
        write_shard(work / f'moved-{number}.parquet', read_part(part).at_origin(origin_m))
        for number, part in enumerate(every)
    ]


def parts_by_tile(parts: Iterable[Mapping[Tile, Part]]) -> dict[Tile, list[Part]]:
    """Return parts by tile, in the order given."""
    found: dict[Tile, list[Part]] = {}
    for mapping in parts:
        for tile, part in mapping.items():
            found.setdefault(tile, []).append(part)
    return found


def parts_of_map(source: str | Path, work: Path) -> list[dict[Tile, Part]]:
    """
    Return the parts of a finished map; a map in a single file is cut into tiles first.

    Parameters
    ----------
    source : str or Path
        Output directory of a replay or a merge, a dataset of tiles, or a file, .parquet or .npz.
    work : Path
        Directory for the parts of a map that is cut.

    Raises
    ------
    FileFormatError
        If there is no map, or it cannot be read.

    """
    file = map_in(source, EXACT) or Path(source)
    tiles = tiles_in(file)
    if tiles:
        return [{tile: tile_part(path) for tile, path in tiles.items()}]
    if not file.is_file():
        raise FileFormatError(
            f'{source}: no map; expected {DATASET}/tile_i=*/tile_j=*/, or map.parquet or map.npz '
            'of surfel-mapper replay'
        )
    if file.suffix == '.npz':
        return [write_shard(work / 'piece.parquet', load_map(file)[0])]
    if file.suffix != '.parquet':
        raise FileFormatError(
            f'{file}: not an exact map; expected .npz or .parquet, or a directory'
        )
    return [
        write_shard(work / f'piece-{number}.parquet', piece)
        for number, piece in enumerate(split_map(file))
    ]


def check_kinds(kinds: Mapping[str | Path, Mapping[str, Any]]) -> None:
    """Raise if maps differ in voxel size or columns, before the work."""
    (first, expected), *others = kinds.items() or [(None, {})]
    for source, kind in others:
        for name, value in kind.items():
            if value != expected[name]:
                raise MapError(
                    f'{source}: {name} {value}, expected {expected[name]} as in {first}'
                )


def warn_of_repeated_scans(sources: Sequence[str | Path]) -> None:
    """Log a warning if two maps contain scans of equal stamps, by the trajectories beside them."""
    seen: dict[int, str | Path] = {}
    for source in sources:
        stamps_ns = stamps_of_map(Path(source))
        repeated = seen.keys() & stamps_ns
        if repeated:
            _log.warning(
                '%s: %d of its %d scans have stamps of scans in %s; the points of a drive that is '
                'merged twice count twice',
                source,
                len(repeated),
                len(stamps_ns),
                seen[min(repeated)],
            )
        seen |= dict.fromkeys(stamps_ns - seen.keys(), source)


def stamps_of_map(source: Path) -> set[int]:
    """Return the stamps of a map's scans, ns: of the trajectory beside it, or of its window."""
    path = trajectory_beside(source)
    if path is not None:
        stamps_ns = read_trajectory(path).stamp_ns
        return set() if stamps_ns is None else set(stamps_ns.tolist())
    file = map_in(source, EXACT) or source
    return set(window_stamps_ns(file)) if file.suffix == '.npz' and file.is_file() else set()


def take_name(fresh: Path, wanted: Path) -> None:
    """
    Rename a finished dataset to the name wanted; an earlier dataset of this name is removed.

    If that fails, or is interrupted before the name is taken, the earlier one has it again.
    """
    old = wanted.with_name(f'.{wanted.name}-{secrets.token_hex(8)}.old')
    try:
        for directory in (*fresh.iterdir(), fresh):  # those of the files are synced with them
            sync_directory(directory)
        try:
            if wanted.exists():
                wanted.rename(old)
            fresh.rename(wanted)
        except BaseException:
            if old.exists() and not wanted.exists():
                old.rename(wanted)
            raise
    except OSError as error:
        raise FileFormatError(f'{wanted}: cannot be written: {error.strerror}') from error
    with suppress(OSError):  # the new dataset has its name
        sync_directory(wanted.parent)
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def work_directory(directory: Path) -> Iterator[Path]:
    """Make a directory for parts inside the output directory, and remove it at the end."""
    wanted = directory / DATASET
    if wanted.exists() and not (wanted.is_dir() and all(map(is_tiles, wanted.iterdir()))):
        raise FileFormatError(f'{wanted}: holds something else, expected tiles of a map, or none')
    work = directory.resolve() / f'.shards-{secrets.token_hex(8)}.part'
    try:
        work.mkdir(parents=True)
    except OSError as error:
        raise FileFormatError(f'{work}: cannot be made: {error.strerror}') from error
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)


def is_tiles(path: Path) -> bool:
    """Return whether a path in a dataset is a directory of tiles."""
    return path.is_dir() and path.name.startswith('tile_i=')


def _counted(results: Iterator[Any], on_done: OnDone) -> Iterator[Any]:
    for result in results:
        on_done('merge', 1.0)
        yield result
