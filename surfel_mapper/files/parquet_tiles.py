# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Parts of a map as Parquet: those of one shard, and the tiles of a map that no process holds whole.

A tile is a square of 256 voxels a side in i and j, with everything above and below: 128 m at
0.5 m. Its file is one that write_map writes, so read_map reads it, and all tiles together are a
dataset partitioned by tile: ``tile_i=3/tile_j=-2/surfels.parquet``. Within it a row group holds
32 voxels in i. Side by side the tiles of one tile_i are then sorted by voxel 32 voxels at a time,
and that is how the digest of the whole map is taken with little memory.

The file of a shard has a row group for every tile that it touches, of the moments alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby
import json
from pathlib import Path
import re
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.files.parquet import (
    attributes_of,
    Columns,
    fill,
    import_pyarrow,
    INDEX,
    int64_column,
    map_columns,
    map_of,
    METADATA,
    moment_names,
    PRODUCTS,
    read_attributes,
    SUMS,
    VIEWS,
)
from surfel_mapper.mapping.channels import channel_names
from surfel_mapper.mapping.moments import digest_of, pack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap

TILE_BITS = 8
"""A tile is 2^8 voxels wide."""

BLOCK_BITS = 5
"""A row group of a tile holds 2^5 voxels in i."""

FILE = 'surfels.parquet'

TILE_PATH = re.compile(r'tile_i=(-?\d+)/tile_j=(-?\d+)/' + re.escape(FILE))

ROWS_READ = 1 << 18
"""So many rows are read at a time where a file is cut into tiles, or a digest taken."""


KIND = ('voxel_size_m', 'level', 'columns')
"""What maps that add up have in common."""


class Tile(NamedTuple):
    """A square of voxels: their indices shifted right by TILE_BITS."""

    i: int
    j: int

    @property
    def path(self) -> Path:
        """Where its file is in a dataset."""
        return Path(f'tile_i={self.i}', f'tile_j={self.j}', FILE)


class Part(NamedTuple):
    """A row group of a file: a tile, or what a shard has of it."""

    path: str
    groups: tuple[int, ...]
    num_voxels: int


def tiles_in(directory: str | Path) -> dict[Tile, Path]:
    """Return the files of a dataset by tile."""
    found = {}
    for path in sorted(Path(directory).glob(f'tile_i=*/tile_j=*/{FILE}')):
        match = TILE_PATH.fullmatch(path.relative_to(directory).as_posix())
        if match:
            found[Tile(int(match[1]), int(match[2]))] = path
    return found


def write_shard(path: str | Path, surfel_map: SurfelMap) -> dict[Tile, Part]:
    """Write a map with a row group for every tile, whole or not at all; return where each is."""
    columns = map_columns(surfel_map, derived=False)
    tile = np.stack([columns['i'], columns['j']], axis=1) >> TILE_BITS
    order = np.lexsort((tile[:, 1], tile[:, 0]))
    bounds = np.flatnonzero(np.diff(tile[order], axis=0, prepend=tile[order[:1]] - 1).any(axis=1))
    rows = np.split(order, bounds[1:]) if len(order) else []
    # to be read once, and thrown away: without a digest, packed quickly, not forced to the disk
    with replace_file(path, lasting=False) as file:
        _write(file, attributes_of(surfel_map, digest=False), columns, rows, 'lz4')
    return {
        Tile(*(int(value) for value in tile[part[0]])): Part(str(path), (group,), len(part))
        for group, part in enumerate(rows)
    }


def write_tile(path: str | Path, surfel_map: SurfelMap) -> None:
    """Write the map of one tile, whole or not at all; the directories are made."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    columns = map_columns(surfel_map)
    block = columns['i'] >> BLOCK_BITS
    rows = np.split(np.arange(len(block)), _starts(block)[1:])
    with replace_file(path) as file:
        _write(file, attributes_of(surfel_map), columns, rows, 'zstd')


def read_part(part: Part) -> SurfelMap:
    """
    Return the map in some row groups of a file.

    Raises
    ------
    FileFormatError
        If they cannot be read, or are not what was written.

    """
    with _opened(part.path) as (content, attributes):
        surfel_map = map_of(attributes, None, part.path)
        names = moment_names(surfel_map)
        for group in part.groups:
            table = content.read_row_group(group, columns=list(names), use_threads=False)
            fill(surfel_map, {name: int64_column(table, name) for name in names}, part.path)
    return surfel_map


def tile_part(path: str | Path) -> Part:
    """Return a whole file as a part."""
    with _opened(path) as (content, _):
        metadata = content.metadata
        return Part(str(path), tuple(range(metadata.num_row_groups)), metadata.num_rows)


def split_map(path: str | Path) -> Iterator[SurfelMap]:
    """Yield the map in a Parquet file piece by piece, so that it need not fit into memory."""
    with _opened(path) as (content, attributes):
        names = moment_names(map_of(attributes, None, path))
        for batch in content.iter_batches(ROWS_READ, columns=list(names)):
            surfel_map = map_of(attributes, None, path)
            fill(surfel_map, {name: int64_column(batch, name) for name in names}, path)
            yield surfel_map


def kind_of(path: str | Path) -> dict[str, Any]:
    """Return what maps that add up have in common; see KIND."""
    with _opened(path) as (_, attributes):
        return {name: attributes[name] for name in KIND}


def dataset_digest(directory: str | Path) -> str:
    """
    Return the digest of the map in a dataset; the map is never in memory as a whole.

    Raises
    ------
    FileFormatError
        If a file cannot be read, or the files are not of one map.

    """
    tiles = tiles_in(directory)
    if not tiles:
        raise FileFormatError(f'{directory}: no tiles of a map (tile_i=*/tile_j=*/{FILE})')
    kinds: dict[str, str | Path] = {}
    num_voxels = 0
    for path in tiles.values():
        with _opened(path) as (content, attributes):
            num_voxels += content.metadata.num_rows
            kinds.setdefault(json.dumps({name: attributes[name] for name in KIND}), path)
    if len(kinds) > 1:
        raise FileFormatError(f'{directory}: tiles of different maps: {kinds}')
    kind = json.loads(next(iter(kinds)))
    columns = tuple(kind['columns'])
    names = {
        'key': (),
        'count': ('num_points',),
        'total': SUMS,
        'product': PRODUCTS,
        'view': VIEWS,
        'channels': tuple(f'sum_{name}' for name in channel_names(columns)),
    }

    def parts(array: str) -> Iterator[npt.NDArray[np.int64]]:
        for _, row in groupby(sorted(tiles), key=lambda tile: tile.i):
            yield from _slices([tiles[tile] for tile in row], names[array])

    return digest_of(kind['voxel_size_m'], kind['level'], num_voxels, columns, parts)


def _slices(paths: Sequence[Path], names: tuple[str, ...]) -> Iterator[npt.NDArray[np.int64]]:
    """
    Yield columns of tiles that lie side by side, sorted by voxel; without names, the keys.

    Each tile is sorted, and all of them have their places in j in order, so that of several
    tiles only i is to be looked at.
    """
    footers = {}
    blocks: dict[int, list[tuple[Path, int]]] = {}
    for path in paths:
        with _opened(path) as (content, _):
            footers[path] = content.metadata
        for group in range(footers[path].num_row_groups):
            first = footers[path].row_group(group).column(0).statistics.min
            blocks.setdefault(first >> BLOCK_BITS, []).append((path, group))
    wanted = ('i', *names) if names else INDEX
    for batch in _batches(blocks, footers):
        stacked = np.concatenate(
            [_columns(p, footers[p], batch[p], wanted) for p in paths if p in batch]
        )
        if len(batch) > 1:
            stacked = stacked[np.argsort(stacked[:, 0], kind='stable')]
        yield stacked[:, 1:] if names else pack_keys(stacked)


def _batches(
    blocks: Mapping[int, list[tuple[Path, int]]], footers: Mapping[Path, Any]
) -> Iterator[dict[Path, list[int]]]:
    """Yield row groups by file, whole blocks in order, of ROWS_READ rows or little more."""
    batch: dict[Path, list[int]] = {}
    num_rows = 0
    for block in sorted(blocks):
        if num_rows >= ROWS_READ:
            yield batch
            batch, num_rows = {}, 0
        for path, group in blocks[block]:
            batch.setdefault(path, []).append(group)
            num_rows += footers[path].row_group(group).num_rows
    if batch:
        yield batch


def _columns(
    path: Path, footer: Any, groups: list[int], names: tuple[str, ...]
) -> npt.NDArray[np.int64]:
    """Return columns of some row groups, (K, C)."""
    with _opened(path, footer) as (content, _):
        table = content.read_row_groups(groups, columns=list(names), use_threads=False)
        return np.stack([int64_column(table, name) for name in names], axis=1)


def _write(
    file: BinaryIO,
    attributes: Mapping[str, Any],
    columns: Columns,
    groups: Sequence[npt.NDArray[np.int64]],
    compression: str,
) -> None:
    """Write a file with row groups of the given rows."""
    arrow, parquet = import_pyarrow()
    table = arrow.table(columns)
    schema = table.schema.with_metadata({METADATA: json.dumps(attributes)})
    with parquet.ParquetWriter(
        file, schema, compression=compression, use_dictionary=False, write_statistics=['i']
    ) as writer:
        for rows in groups:
            writer.write_table(table.take(rows), row_group_size=max(len(rows), 1))


def _starts(values: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return the rows where a value differs from the one before, the first included."""
    return np.flatnonzero(np.diff(values, prepend=values[:1] - 1))


@contextmanager
def _opened(path: str | Path, footer: Any = None) -> Iterator[tuple[Any, dict[str, Any]]]:
    """
    Open a file that we wrote; whatever goes wrong while it is open names it.

    Give its ``metadata`` as the footer where it is known, which takes a quarter of the time.
    """
    arrow, parquet = import_pyarrow()
    try:
        with open(path, 'rb') as file, parquet.ParquetFile(file, metadata=footer) as content:
            known = footer is not None
            stated = {} if known else read_attributes(path, content.schema_arrow.metadata or {})
            yield content, stated
    except FileFormatError:
        raise
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be read: {error.strerror or error}') from error
    except (arrow.ArrowException, ValueError, LookupError, TypeError, AttributeError) as error:
        raise FileFormatError(f'{path}: damaged, or not what was written: {error}') from error
