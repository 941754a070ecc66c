# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
From shards or finished maps to one map in tiles.

The tiles are written to a directory beside the one wanted, which takes its name when all is
done, so that an earlier map is there, whole, until then.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from itertools import islice
from pathlib import Path
import secrets
import shutil
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.cluster.engines import Engine, never
from surfel_mapper.cluster.merging import (
    DATASET,
    gathered,
    merge_tile,
    Parts,
    parts_of_map,
    TileTask,
)
from surfel_mapper.cluster.shard_run import OnDone, ShardRun
from surfel_mapper.cluster.shards import Shard, ShardResult
from surfel_mapper.errors import FileFormatError, MapError
from surfel_mapper.files.parquet_tiles import dataset_digest, kind_of, Part, Tile, tiles_in
from surfel_mapper.mapping.surfels import Surfels

SAMPLE = 100_000
"""About so many surfels are sent back for pictures."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TiledMap:
    """
    A map in tiles.

    Attributes
    ----------
    directory : Path
        The dataset.
    voxel_size_m : float
    digest : str
        Equal to SurfelMap.digest of the same map.
    voxels, points, surfels, tiles, nbytes : int
        What it holds; the last are the bytes of its files.
    core_s : float
        Time of processors that merging took, without the digest.
    sample : Surfels
        Some of its surfels, for pictures.
    peak_bytes : int
        The most memory that a process had which merged.

    """

    directory: Path
    voxel_size_m: float
    digest: str
    voxels: int
    points: int
    surfels: int
    tiles: int
    nbytes: int
    core_s: float
    sample: Surfels
    peak_bytes: int

    def summary(self) -> dict[str, Any]:
        """Return the figures of the map for summary.json."""
        return {
            'voxels': self.voxels,
            'surfels': self.surfels,
            'tiles': self.tiles,
            'bytes': self.nbytes,
            'voxel_size_m': self.voxel_size_m,
            'digest': self.digest,
        }


@dataclass(slots=True, kw_only=True)
class Mapped:
    """
    What became of all shards.

    Attributes
    ----------
    map : TiledMap
    results : list of ShardResult
        In the order of the shards.
    repeated : int
        Shards that were mapped again because they had begun too late.
    interrupted : bool
        Whether shards are missing because it was stopped.

    """

    map: TiledMap
    results: list[ShardResult]
    repeated: int
    interrupted: bool

    @property
    def places(self) -> npt.NDArray[np.float64]:
        """Where the sensor was, (P, 3) m."""
        return np.concatenate([np.empty((0, 3)), *(result.places for result in self.results)])

    def counts(self) -> dict[str, Any]:
        """Return the counts of all shards together, as Counters.summary has them."""
        total: dict[str, Any] = {}
        for result in self.results:
            total = added(total, result.counts)
        return total


def map_bags(
    shards: Sequence[Shard],
    engine: Engine,
    directory: Path,
    on_done: OnDone = lambda kind, amount: None,
    stopped: Callable[[], bool] = never,
) -> Mapped:
    """
    Map shards into a dataset of tiles.

    Parameters
    ----------
    shards : sequence of Shard
        All of each bag, in order.
    engine : Engine
        Who does the work.
    directory : Path
        The output directory; the tiles are in ``map`` inside it.
    on_done : callable
        For progress.
    stopped : callable
        Asked again and again whether to map no more shards than those under way.

    Raises
    ------
    MapError
        If no scan was mapped, or a voxel would hold too many points.
    BagError, FileFormatError, ClusterError
        If a bag cannot be read, a file cannot be written, or the workers are lost.

    """
    with work_directory(directory) as work:
        run = ShardRun(list(shards), engine, work, on_done)
        is_whole = run.all(stopped)
        results = run.ordered()
        parts = gathered(result.parts for result in results)
        tiled = merge(parts, engine, directory, shards[0].config.map.min_points, on_done)
    return Mapped(map=tiled, results=results, repeated=run.repeated, interrupted=not is_whole)


def merge_maps(
    sources: Sequence[str | Path],
    engine: Engine,
    directory: Path,
    min_points: int,
    on_done: OnDone = lambda kind, amount: None,
) -> TiledMap:
    """Merge finished maps into a dataset of tiles in ``map`` inside a directory; see map_bags."""
    with work_directory(directory) as work:
        found: list[dict[Tile, Part]] = []
        kinds: dict[str | Path, dict[str, Any]] = {}
        for number, source in enumerate(sources):
            place = work / str(number)
            place.mkdir()
            parts = parts_of_map(source, place)
            for part in islice((part for tiles in parts for part in tiles.values()), 1):
                kinds[source] = kind_of(part.path)
            found += parts
        check_alike(kinds)
        return merge(gathered(found), engine, directory, min_points, on_done)


def check_alike(kinds: Mapping[str | Path, Mapping[str, Any]]) -> None:
    """Refuse maps that do not add up, before the work."""
    (first, expected), *others = kinds.items() or [(None, {})]
    for source, kind in others:
        for name, value in kind.items():
            if value != expected[name]:
                raise MapError(
                    f'{source}: {name} {value}, expected {expected[name]} as in {first}'
                )


def merge(
    parts: Parts, engine: Engine, directory: Path, min_points: int, on_done: OnDone
) -> TiledMap:
    """Make every tile, take the digest, and give the dataset its name."""
    if not parts:
        raise MapError('no scan was mapped')
    share = min(SAMPLE / sum(part.num_voxels for found in parts.values() for part in found), 1.0)
    fresh = directory.resolve() / f'.{DATASET}-{secrets.token_hex(8)}.part'
    tasks = [
        TileTask(
            parts=tuple(found), path=str(fresh / tile.path), min_points=min_points, share=share
        )
        for tile, found in sorted(parts.items())
    ]
    try:
        done = dict(_done(engine.run(merge_tile, tasks), on_done))
        tiles = [done[number] for number in range(len(tasks))]
        ((_, digest),) = engine.run(dataset_digest, [str(fresh)])
        take_name(fresh, directory / DATASET)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return TiledMap(
        directory=directory / DATASET,
        voxel_size_m=tiles[0].voxel_size_m,
        digest=digest,
        voxels=sum(tile.voxels for tile in tiles),
        points=sum(tile.points for tile in tiles),
        surfels=sum(tile.surfels for tile in tiles),
        tiles=len(tiles),
        nbytes=sum(path.stat().st_size for path in tiles_in(directory / DATASET).values()),
        core_s=sum(tile.core_s for tile in tiles),
        sample=joined([tile.sample for tile in tiles]),
        peak_bytes=max(tile.peak_bytes for tile in tiles),
    )


def take_name(fresh: Path, wanted: Path) -> None:
    """Give a finished dataset its name; what had it before is removed."""
    old = wanted.with_name(f'.{wanted.name}-{secrets.token_hex(8)}.old')
    try:
        if wanted.exists():
            wanted.rename(old)
        fresh.rename(wanted)
    except OSError as error:
        raise FileFormatError(f'{wanted}: cannot be written: {error.strerror}') from error
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def work_directory(directory: Path) -> Iterator[Path]:
    """Give a directory for parts inside the output directory, and remove it at the end."""
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
    """Return whether a path in a dataset is one that a dataset has."""
    return path.is_dir() and path.name.startswith('tile_i=')


def joined(parts: Sequence[Surfels]) -> Surfels:
    """Return the surfels of all parts."""
    names = [each.name for each in fields(Surfels) if each.name != 'channels']
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    channels = {
        name: np.concatenate([part.channels[name] for part in parts]) for name in parts[0].channels
    }
    return Surfels(**columns, channels=channels)


def added(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """Return counts added up; of the times of stages, the larger."""
    total = dict(first)
    for name, value in second.items():
        if isinstance(value, dict):
            total[name] = added(total.get(name, {}), value)
        elif name in ('median', 'p99'):
            total[name] = max(total.get(name, 0.0), value)
        else:
            total[name] = total.get(name, 0) + value
    return total


def _done(results: Iterator[Any], on_done: OnDone) -> Iterator[Any]:
    for result in results:
        on_done('merge', 1.0)
        yield result
