# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Saving and loading a TSDF: a loaded map continues as if it had never stopped.

Blocks are written in the order of their index, so that equal maps give equal bytes. Files are not
trusted: blocks must be unique, distances within the truncation, weights not negative.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import ExitStack
import math
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import FileFormatError, MapLimitError, refusing
from surfel_mapper.files.atomic import cannot_write
from surfel_mapper.files.state import load_state, save_state
from surfel_mapper.tsdf.blocks import block_index, block_keys, BlockMap, Blocks

KIND = 'tsdf'
SHAPE = (
    'voxel_size_m',
    'voxels_per_side',
    'truncation_m',
    'color',
    'tracking',
    'semantics',
    'votes_per_voxel',
)
"""Settings that must be equal in a configuration and a file."""

ARRAYS = {
    'index': np.int64,
    'stamp_ns': np.int64,
    'field': np.float32,
    'color': np.float32,
    'votes': np.float32,
    'stamps': np.int64,
}

CHANNELS = ('field', 'color', 'votes', 'stamps')
"""The arrays of voxels; those that a map does not have are without rows."""


def save_tsdf(path: str | Path, blocks: BlockMap, *, compress: bool = False) -> None:
    """
    Write a TSDF to a file.

    Parameters
    ----------
    path : str or Path
        The file, usually with the extension npz; written atomically.
    blocks : BlockMap
        The map.
    compress : bool
        Compress: smaller and slower.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    save_state(path, *tsdf_content(blocks), compress=compress)


def tsdf_content(blocks: BlockMap) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """Return copies of the arrays of a TSDF, and its attributes, for save_state."""
    rows = blocks.rows()
    rows = rows[np.argsort(block_keys(blocks.index(rows)))]
    content = blocks.copied(rows)
    return {name: getattr(content, name) for name in ARRAYS}, attributes_of(blocks.config)


def save_tsdf_parts(
    path: str | Path, config: TsdfConfig, parts: Callable[[], Iterable[Blocks]]
) -> None:
    """
    Write a TSDF that may be larger than memory: the same file as save_tsdf writes.

    The voxels are collected in a file without a name beside the target, which then takes as much
    of the disk as the target itself; in memory are one part and 40 bytes a block.

    Parameters
    ----------
    path : str or Path
        As for save_tsdf.
    config : TsdfConfig
        Settings of the map.
    parts : callable
        Returns the blocks in parts, each block once; called twice.

    Raises
    ------
    FileFormatError
        If the file cannot be written, or the parts not be read.

    """
    found = [np.empty(0, np.int64), *(block_keys(part.index) for part in parts())]
    keys = np.sort(np.concatenate(found))
    empty = BlockMap(config)
    try:  # outside of the stack: to close a file writes the rest of its buffer
        with ExitStack() as files:
            channels = {
                name: Channel(
                    files, Path(path).parent, getattr(empty, name).shape[1:], ARRAYS[name]
                )
                for name in CHANNELS
                if len(getattr(empty, name))
            }
            stamp_ns = np.empty(len(keys), np.int64)
            for part in parts():
                place = np.searchsorted(keys, block_keys(part.index))
                stamp_ns[place] = part.stamp_ns
                for name, channel in channels.items():
                    channel.write(place, getattr(part, name))
            arrays = {'index': block_index(keys), 'stamp_ns': stamp_ns}
            for name in CHANNELS:
                missing = np.empty((0, *getattr(empty, name).shape[1:]), ARRAYS[name])
                arrays[name] = channels[name].read(len(keys)) if name in channels else missing
            save_state(path, arrays, attributes_of(config))
    except OSError as error:
        raise cannot_write(path, error) from error


class Channel:
    """
    Rows of an array in a file without a name, which ends with a stack of contexts.

    Parameters
    ----------
    files : ExitStack
        Closes the file.
    directory : Path
        Directory of the file.
    shape, dtype
        Of a row.

    """

    def __init__(self, files: ExitStack, directory: Path, shape: tuple[int, ...], dtype: type):
        file = TemporaryFile(dir=directory)  # noqa: SIM115 - the stack closes it
        self._file = files.enter_context(file)
        self._shape, self._dtype = shape, np.dtype(dtype)

    def write(self, place: npt.NDArray[np.int64], rows: npt.NDArray[Any]) -> None:
        """Write rows (R, ...) at their places (R,)."""
        size = math.prod(self._shape) * self._dtype.itemsize
        for first, row in zip(place.tolist(), rows, strict=True):
            self._file.seek(first * size)
            self._file.write(np.ascontiguousarray(row).data)

    def read(self, count: int) -> npt.NDArray[Any]:
        """Return all rows, (count, ...), read from the file as they are used."""
        self._file.flush()
        if not count:
            return np.empty((0, *self._shape), self._dtype)
        return np.memmap(self._file, self._dtype, 'r', shape=(count, *self._shape))


def attributes_of(config: TsdfConfig) -> dict[str, Any]:
    """Return the attributes of the file of a map."""
    return {'kind': KIND, **{name: getattr(config, name) for name in SHAPE}}


def load_tsdf(path: str | Path, config: TsdfConfig) -> BlockMap:
    """
    Return a saved TSDF.

    Parameters
    ----------
    path : str or Path
        A file that save_tsdf wrote.
    config : TsdfConfig
        Settings of the loaded map; those that shape its arrays (SHAPE) must equal the file's.

    Raises
    ------
    FileFormatError
        If the file cannot be read, is damaged, of another kind or version, or of another voxel
        size, block, truncation or channels.
    MapLimitError
        If the map does not fit into max_blocks.

    """
    arrays, attributes = load_state(path)
    if attributes.get('kind') != KIND:
        raise FileFormatError(f'{path}: contains {attributes.get("kind")!r}, expected a {KIND}')
    for name in SHAPE:
        found, wanted = attributes.get(name), getattr(config, name)
        if found != wanted:
            raise FileFormatError(
                f'{path}: {name} {found}, expected layers.tsdf.{name} = {wanted}'
            )
    blocks = BlockMap(config)
    with refusing(path, FileFormatError):
        content = checked(blocks, arrays)
    if config.max_blocks and len(content) > config.max_blocks:
        raise MapLimitError(
            f'{path}: {len(content)} blocks, expected at most layers.tsdf.max_blocks = '
            f'{config.max_blocks}'
        )
    blocks.insert(content)
    return blocks


def checked(blocks: BlockMap, arrays: dict[str, npt.NDArray[Any]]) -> Blocks:
    """Return the content of a file; raise ValueError if it is impossible."""
    count = len(arrays['index'])
    if unknown := sorted({*arrays} - {*ARRAYS}):
        raise ValueError(f'unknown arrays {unknown}')
    for name, dtype in ARRAYS.items():
        array, channel = arrays[name], getattr(blocks, name, None)
        shape: tuple[int, ...] = (count, 3) if name == 'index' else (count,)
        if name in CHANNELS and channel is not None:
            shape = (count * (len(channel) > 0), *channel.shape[1:])
        if array.shape != shape or array.dtype != dtype:
            raise ValueError(f'{name}: {array.dtype} {array.shape}, expected {shape}')
    keys = block_keys(arrays['index'])
    if (keys < 0).any() or len(np.unique(keys)) < count:
        raise ValueError('a block occurs twice, or is out of range')
    distance, weight = arrays['field'][:, 0], arrays['field'][:, 1]
    limit = np.float32(blocks.config.truncation_m * (1.0 + 1e-6))
    if not (np.abs(distance) <= limit).all():
        raise ValueError('distances beyond the truncation')
    if not ((weight >= 0.0) & (weight < np.inf)).all():
        raise ValueError('weights negative or not finite')
    for name in ('color', 'votes'):
        if not ((arrays[name] >= 0.0) & (arrays[name] < np.inf)).all():
            raise ValueError(f'{name}: negative or not finite')
    return Blocks(**{name: arrays[name] for name in ARRAYS})
