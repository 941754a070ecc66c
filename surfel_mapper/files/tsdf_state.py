# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Saving and loading a TSDF: a loaded map continues as if it had never stopped.

Blocks are written in the order of their index, so that equal maps give equal bytes. Files are not
trusted: blocks must be unique, distances within the truncation, weights not negative.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import TsdfConfig
from surfel_mapper.errors import FileFormatError, refusing
from surfel_mapper.files.state import load_state, save_state
from surfel_mapper.tsdf.blocks import block_keys, BlockMap, Blocks

KIND = 'tsdf'
SHAPE = (
    'voxel_size_m',
    'voxels_per_side',
    'truncation_m',
    'color',
    'semantics',
)
"""Settings that must be equal in a configuration and a file."""

ARRAYS = {
    'index': np.int64,
    'stamp_ns': np.int64,
    'field': np.float32,
    'color': np.float32,
    'votes': np.float32,
}

CHANNELS = ('field', 'color', 'votes')
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
    arrays = {name: getattr(content, name) for name in ARRAYS}
    return arrays, attributes_of(blocks.config)


def attributes_of(config: TsdfConfig) -> dict[str, Any]:
    """Return the attributes of the file of a map."""
    shape = {name: shape_value(config, name) for name in SHAPE}
    return {'kind': KIND, **shape}


def shape_value(config: TsdfConfig, name: str) -> Any:
    """Return a setting that shapes the arrays; the truncation that holds if none is set."""
    return config.tau_m if name == 'truncation_m' else getattr(config, name)


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

    """
    arrays, attributes = load_state(path)
    if attributes.get('kind') != KIND:
        raise FileFormatError(f'{path}: contains {attributes.get("kind")!r}, expected a {KIND}')
    for name in SHAPE:
        value, wanted = attributes.get(name), shape_value(config, name)
        if value != wanted:
            raise FileFormatError(
                f'{path}: {name} {value}, expected layers.tsdf.{name} = {wanted}'
            )
    blocks = BlockMap(config)
    with refusing(path):
        content = checked(blocks, arrays)
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
    limit = np.float32(blocks.config.tau_m * (1.0 + 1e-6))
    if not (np.abs(distance) <= limit).all():
        raise ValueError('distances beyond the truncation')
    if not ((weight >= 0.0) & (weight < np.inf)).all():
        raise ValueError('weights negative or not finite')
    for name in ('color', 'votes'):
        if not ((arrays[name] >= 0.0) & (arrays[name] < np.inf)).all():
            raise ValueError(f'{name}: negative or not finite')
    return Blocks(**{name: arrays[name] for name in ARRAYS})
