# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Parts of a map as Parquet: shards, and the tiles of a map larger than the memory.

A tile is a column of 256 x 256 voxels in i and j: 128 m at 0.5 m. Its file has the format of
write_map, so read_map reads it, and all tiles together are a dataset partitioned by tile:
``tile_i=3/tile_j=-2/surfels.parquet``. A row group has 32 voxels in i, so the tiles of one tile_i
can be merged in the order of voxels 32 voxels at a time, which is how the digest of the whole map
is computed with little memory.

The file of a shard has a row group for every tile that it touches, with the moments only.

Shards and tiles are one module because they share the schema, the opening and the row groups.
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

from surfel_mapper.budget import open_regular, stated_limit
from surfel_mapper.errors import FileFormatError, MapError
from surfel_mapper.files.atomic import make_directory, replace_file
from surfel_mapper.files.parquet import (
    attributes_of,
    check_size,
    Columns,
    encodings,
    fill,
    FOOTER_LIMITS,
    import_pyarrow,
    INDEX,
    int64_column,
    map_columns,
    map_of,
    METADATA,
    moment_names,
    PRODUCTS,
    read_attributes,
    read_map,
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
"""Number of rows read at a time to split a file into tiles, or to compute a digest."""


KIND = ('voxel_size_m', 'level', 'columns')
"""Attributes that must be equal in maps that are merged."""


class Tile(NamedTuple):
    """A square of voxels: their indices shifted right by TILE_BITS."""

    i: int
    j: int

    @property
    def path(self) -> Path:
        """Path of its file in a dataset."""
        return Path(f'tile_i={self.i}', f'tile_j={self.j}', FILE)


class Part(NamedTuple):
    """Row groups of a file: a tile, or the part of it in a shard."""

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


def dataset_in(directory: str | Path) -> Path | None:
    """Return the dataset of tiles that a directory is, or has as ``map``; None without one."""
    both = (Path(directory) / 'map', Path(directory))
    return next((each for each in both if tiles_in(each)), None)


def read_tiles(directory: str | Path, *, voxel_size_m: float | None = None) -> SurfelMap:
    """
    Return the map in a dataset of tiles, whole in memory, exactly as written.

    Raises
    ------
    FileFormatError
        If there are no tiles, or one cannot be read, is damaged, or of another kind or voxel size.
    DependencyError
        If pyarrow is not installed.

    """
    found: SurfelMap | None = None
    for path in tiles_in(directory).values():
        tile = read_map(path, voxel_size_m=voxel_size_m)
        if found is None:
            found = tile
            continue
        try:
            found.merge(tile)
        except MapError as error:
            raise FileFormatError(f'{path}: {error}') from error
    if found is None:
        raise FileFormatError(f'{directory}: no tiles of a map in this directory')
    return found


def write_shard(path: str | Path, surfel_map: SurfelMap) -> dict[Tile, Part]:
    """Write a map with a row group for every tile, atomically; return the part of each tile."""
    columns = map_columns(surfel_map, derived=False)
    tile = np.stack([columns['i'], columns['j']], axis=1) >> TILE_BITS
    order = np.lexsort((tile[:, 1], tile[:, 0]))
    bounds = np.flatnonzero(np.diff(tile[order], axis=0, prepend=tile[order[:1]] - 1).any(axis=1))
    rows = np.split(order, bounds[1:]) if len(order) else []
    # a temporary file, read once: without a digest, with fast compression and no fsync
    with replace_file(path, lasting=False) as file:
        _write(file, attributes_of(surfel_map, digest=False), columns, rows, 'lz4')
    return {
        Tile(*(int(value) for value in tile[part[0]])): Part(str(path), (group,), len(part))
        for group, part in enumerate(rows)
    }


def write_tile(path: str | Path, surfel_map: SurfelMap) -> None:
    """Write the map of one tile, atomically; missing directories are created."""
    make_directory(Path(path).parent)
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
        If they cannot be read or are damaged.

    """
    with _opened(part.path) as (content, attributes):
        surfel_map = map_of(attributes, None, part.path)
        names = moment_names(surfel_map)
        check_size(content, names, part.path, Path(part.path).stat().st_size, part.groups)
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
    """Yield the map in a Parquet file in parts, so that it need not fit into memory."""
    with _opened(path) as (content, attributes):
        names = moment_names(map_of(attributes, None, path))
        for group in range(content.metadata.num_row_groups):
            check_size(content, names, path, Path(path).stat().st_size, [group])
        for batch in content.iter_batches(ROWS_READ, columns=list(names)):
            surfel_map = map_of(attributes, None, path)
            fill(surfel_map, {name: int64_column(batch, name) for name in names}, path)
            yield surfel_map


def kind_of(path: str | Path) -> dict[str, Any]:
    """Return the attributes that must be equal in maps that are merged; see KIND."""
    with _opened(path) as (_, attributes):
        return {name: attributes[name] for name in KIND}


def origin_of(path: str | Path) -> tuple[float, ...]:
    """Return the origin of the map in a file, x y z in m."""
    with _opened(path) as (_, attributes):
        return tuple(map_of(attributes, None, path).origin_m.tolist())


def dataset_digest(directory: str | Path) -> str:
    """
    Return the digest of the map in a dataset, without loading the whole map.

    Raises
    ------
    FileFormatError
        If a file cannot be read, or the files belong to different maps.

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
    Yield columns of the tiles of one tile_i, sorted by voxel; without names, the keys.

    Each tile is sorted and the tiles are in the order of j, so a stable sort by i merges them.
    """
    footers = {}
    blocks: dict[int, list[tuple[Path, int]]] = {}
    for path in paths:
        with _opened(path) as (content, _):
            footers[path] = content.metadata
        for group in range(footers[path].num_row_groups):
            first = _least_i(path, footers[path], group)
            blocks.setdefault(first >> BLOCK_BITS, []).append((path, group))
    wanted = ('i', *names) if names else INDEX
    for batch in _batches(blocks, footers):
        stacked = np.concatenate(
            [_columns(p, footers[p], batch[p], wanted) for p in paths if p in batch]
        )
        if len(batch) > 1:
            stacked = stacked[np.argsort(stacked[:, 0], kind='stable')]
        yield stacked[:, 1:] if names else pack_keys(stacked)


def _least_i(path: Path, footer: Any, group: int) -> int:
    """Return the least i of a row group as its footer states it."""
    try:
        return int(footer.row_group(group).column(0).statistics.min)
    except Exception as error:  # pyarrow parses it here, and raises RuntimeError too
        raise FileFormatError(
            f'{path}: row group {group} does not state its smallest i: {error}'
        ) from error


def _batches(
    blocks: Mapping[int, list[tuple[Path, int]]], footers: Mapping[Path, Any]
) -> Iterator[dict[Path, list[int]]]:
    """Yield row groups by file, complete blocks in order, of about ROWS_READ rows."""
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
    """Write a file with a row group for each array of rows."""
    arrow, parquet = import_pyarrow()
    table = arrow.table(columns)
    schema = table.schema.with_metadata({METADATA: json.dumps(attributes)})
    with parquet.ParquetWriter(
        file, schema, compression=compression, write_statistics=['i'], **encodings(columns)
    ) as writer:
        for rows in groups:
            writer.write_table(table.take(rows), row_group_size=max(len(rows), 1))


def _starts(values: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return the first row and the rows whose value differs from the one before."""
    return np.flatnonzero(np.diff(values, prepend=values[:1] - 1))


@contextmanager
def _opened(path: str | Path, footer: Any = None) -> Iterator[tuple[Any, dict[str, Any]]]:
    """
    Open a file of this package; errors in the block become FileFormatErrors that name it.

    Passing the footer, if known, takes a quarter of the time.
    """
    _, parquet = import_pyarrow()
    stated_limit()  # a wrong one is no damage of the file
    try:
        with (
            open_regular(path) as file,
            parquet.ParquetFile(file, metadata=footer, **FOOTER_LIMITS) as content,
        ):
            known = footer is not None
            stated = {} if known else read_attributes(path, content.schema_arrow.metadata or {})
            yield content, stated
    except FileFormatError:
        raise
    except OSError as error:
        raise FileFormatError(f'{path}: cannot be read: {error.strerror or error}') from error
    except Exception as error:  # of pyarrow, and of attributes of any size and type
        raise FileFormatError(f'{path}: damaged, or of another program: {error}') from error
