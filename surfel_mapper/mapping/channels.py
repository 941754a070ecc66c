# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Channels: intensity and colour of points as integers, so that a map sums them exactly.

Intensity is quantised once to 1/256 (sensors give 8 or 16 bits, or reflectivities up to some
thousands); colours are integers from 0 to 255. nan counts as 0.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

RGB = ('red', 'green', 'blue')

COLOURS = (RGB, tuple(f'diffuse_{name}' for name in RGB), ('r', 'g', 'b'))
"""Names of the channels of a colour in three columns, in lower case."""

CHANNELS = {'intensity': ('intensity',), 'rgb': RGB}
"""Columns of a scan that a map can sum, and the channels of each."""

UNITS = {'intensity': 256.0, 'red': 1.0, 'green': 1.0, 'blue': 1.0}
"""Integer steps per unit of each channel."""

LARGEST = float(2**31 - 256)
"""Quantised values are clipped to this magnitude, so that 2^31 of them fit into an int64."""


def channel_names(columns: tuple[str, ...]) -> tuple[str, ...]:
    """
    Return the channels of columns, in order.

    Raises
    ------
    ValueError
        If a map cannot sum a column.

    """
    is_several = isinstance(columns, (tuple, list))
    unknown = [name for name in columns if name not in [*CHANNELS]] if is_several else [columns]
    if unknown:
        raise ValueError(f'columns: {unknown[0]!r:.60}, expected some of {list(CHANNELS)}')
    return tuple(channel for name in columns for channel in CHANNELS[name])


def missing_columns(columns: Mapping[str, npt.NDArray[Any]], names: tuple[str, ...]) -> list[str]:
    """Return the named columns that are missing; ``rgba`` or r, g, b can replace ``rgb``."""
    is_coloured = 'rgba' in columns or three_channels(columns)
    return [n for n in names if n not in columns and not (n == 'rgb' and is_coloured)]


def summed_columns(
    columns: Mapping[str, npt.NDArray[Any]], names: tuple[str, ...]
) -> dict[str, npt.NDArray[Any]]:
    """Return the named columns, none of them missing; any colour takes the name ``rgb``."""
    return {name: summed_column(columns, name) for name in names}


def summed_column(columns: Mapping[str, npt.NDArray[Any]], name: str) -> npt.NDArray[Any]:
    """Return a named column that is not missing; ``rgb`` may be in other columns."""
    if name in columns:
        return columns[name]
    return columns['rgba'] if 'rgba' in columns else joined(columns, three_channels(columns))


def three_channels(columns: Collection[str]) -> list[str]:
    """Return the columns red, green and blue of a colour in three columns; empty without."""
    names = {name.lower(): name for name in columns}
    triple: Collection[str] = next((triple for triple in COLOURS if names.keys() >= {*triple}), ())
    return [names[name] for name in triple]


def joined(columns: Mapping[str, npt.NDArray[Any]], names: list[str]) -> npt.NDArray[np.uint8]:
    """Return three channels as bytes (N, 3): floats up to 1 times 255, the upper of 16 bits."""
    channels = np.stack([columns[name] for name in names], axis=1)
    if channels.dtype == np.uint8:
        return channels
    values = np.nan_to_num(channels.astype(np.float64))
    top = values.max(initial=0.0)
    if top > 255.0:
        values = np.floor(values / 256.0)
    elif top <= 1.01 and channels.dtype.kind == 'f':
        values = 255.0 * values
    return np.rint(np.clip(values, 0.0, 255.0)).astype(np.uint8)


def quantised(
    columns: Mapping[str, npt.NDArray[Any]], names: tuple[str, ...], num_points: int
) -> npt.NDArray[np.int32]:
    """
    Return the channels of the named columns as integers, (N, C) int32.

    Parameters
    ----------
    columns : mapping of str to (N,) array
        ``intensity``: numbers. ``rgb``: three bytes packed into float32 or uint32, as in PCL and
        RViz, or an (N, 3) array of 0 to 255 with any further columns; ``rgba`` can replace it,
        or the three columns r, g, b or red, green, blue.
    names : tuple of str
        Columns to quantise.
    num_points : int
        N.

    Raises
    ------
    ValueError
        If a column is missing, of another length or of another shape.

    """
    if not isinstance(columns, Mapping):
        raise TypeError(
            f'columns: a {type(columns).__name__}, expected arrays by name: {", ".join(names)}'
        )
    channels = []
    for name in names:
        column = checked_channels(columns, name, num_points)
        channels.append(_unpacked(column) if name == 'rgb' else _fixed(column))
    return np.ascontiguousarray(np.concatenate(channels, axis=1))


def checked_channels(
    columns: Mapping[str, npt.NDArray[Any]], name: str, num_points: int
) -> npt.NDArray[Any]:
    """Return a named column; raise ValueError if ``quantised`` cannot take it."""
    if missing_columns(columns, (name,)):
        raise ValueError(f'column {name}: missing, expected one row for {num_points} points')
    column = np.asarray(summed_column(columns, name))
    if len(column) != num_points:
        raise ValueError(
            f'column {name}: of length {len(column)}, expected one row for {num_points} points'
        )
    is_rgb = name == 'rgb'
    if column.ndim != 1 and not (is_rgb and column.ndim == 2 and column.shape[1] >= 3):
        expected = f'({num_points},) packed, or ({num_points}, 3)' if is_rgb else (num_points,)
        raise ValueError(f'column {name}: shape {column.shape}, expected {expected}')
    return column


def means(
    sums: npt.NDArray[np.int64], count: npt.NDArray[np.int64], names: tuple[str, ...]
) -> dict[str, npt.NDArray[np.float64]]:
    """Return the mean of every channel, (K,) float64 each, from sums (K, C) and counts (K,)."""
    return {name: sums[:, channel] / (count * UNITS[name]) for channel, name in enumerate(names)}


def _fixed(column: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    most = LARGEST / UNITS['intensity']
    values = np.clip(np.nan_to_num(column.astype(np.float64), nan=0.0), -most, most)
    return np.rint(values * UNITS['intensity']).astype(np.int32).reshape(-1, 1)


def _unpacked(column: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    if column.ndim == 2:
        return np.asarray(np.rint(np.clip(np.nan_to_num(column[:, :3]), 0, 255)), np.int32)
    is_float = column.dtype.kind == 'f' and column.dtype.itemsize == 4  # of either byte order
    packed = np.ascontiguousarray(column, np.float32 if is_float else np.uint32)
    bits = packed.view(np.uint32)
    return np.stack([(bits >> 16) & 255, (bits >> 8) & 255, bits & 255], axis=1).astype(np.int32)
