# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Points as raw numbers, .bin: three to six float32 or float64 a point, which no header states.

KITTI has x y z intensity, others x y z, x y z intensity ring, or x y z red green blue. The width
is that at which the columns differ most from each other: of a wrong one each column mixes several
quantities. The measure is the mutual information of column and value, by bins of equal counts, and
without the bias of few values. Bits of the wrong type are numbers of all magnitudes.
"""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import open_regular
from surfel_mapper.errors import FileFormatError, refusing

WIDTHS = (4, 3, 5, 6)
"""Numbers of columns in the order of preference: KITTI's first."""

SAMPLED_FILES, SAMPLED_BYTES = 8, 960_000
"""Files that are looked into, and bytes of each, a whole number of points of every width."""

BINS = 16
"""Bins of the values; more need more points."""

ODD_SHARE = 0.02
"""Share of values, beyond ORDINARY, that points may have."""

ORDINARY = (1e-9, 1e7)
"""Magnitudes of coordinates, intensities, times; UTM northings are just below 1e7 m."""

CLEAR_NATS, FEW = 0.01, 10.0
"""Mutual information of two widths is equal if it differs by less, and FEW / number of values."""

KITTI, NUSCENES = 4, 5
"""Columns of the data sets that fix them."""


class RawLayout(NamedTuple):
    """Type and number of the columns of a point."""

    type_: np.dtype[Any]
    width: int

    @property
    def point_bytes(self) -> int:
        """Size of a point."""
        return self.type_.itemsize * self.width

    def __str__(self) -> str:
        """Return it in words."""
        return f'{self.width} {self.type_.name}'


FLOATS = RawLayout(np.dtype('<f4'), KITTI)


def raw_layout(files: Sequence[Path], columns: int | None = None) -> RawLayout:
    """
    Return the layout that the sizes and values of files agree on.

    Parameters
    ----------
    files : sequence of Path
        Scans of one sensor. One file, or one in ten, may be cut off.
    columns : int, optional
        Their number of columns, if it is known; without, nuScenes' ``.pcd.bin`` have 5.

    Raises
    ------
    FileFormatError
        If no layout fits.

    """
    is_nuscenes = all(file.name.lower().endswith('.pcd.bin') for file in files)
    widths = (columns,) if columns else (NUSCENES,) if is_nuscenes else WIDTHS
    sizes = [file.stat().st_size if file.is_file() else 0 for file in files]
    step = -(-len(files) // SAMPLED_FILES) or 1
    contents = [content for file in files[::step] if (content := first_bytes(file))]
    if not contents:
        return RawLayout(FLOATS.type_, widths[0])
    allowed = max(len(files) // 10, int(len(files) > 1))
    for type_ in ('<f4', '<f8'):
        layouts = [RawLayout(np.dtype(type_), width) for width in widths]
        fitting = [
            layout
            for layout in layouts
            if sum(size % layout.point_bytes > 0 for size in sizes) <= allowed
        ]
        values = [np.frombuffer(c, type_, len(c) // layouts[0].type_.itemsize) for c in contents]
        if fitting and is_ordinary(np.concatenate(values)) and not has_low_words(type_, values):
            return best(fitting, values) if len(widths) > 1 else fitting[0]
    stated = f'{columns} columns' if columns else f'{", ".join(map(str, sorted(widths)))} columns'
    raise FileFormatError(
        f'{files[0]}: {sizes[0]} bytes, expected points of {stated}, float32 or float64; state '
        'their number with --bin-columns, or convert them to .ply or .pcd'
    )


def first_bytes(file: Path) -> bytes:
    """Return the beginning of a file; nothing of one that cannot be read."""
    try:
        with open_regular(file) as opened:
            return opened.read(SAMPLED_BYTES)
    except OSError:
        return b''


def is_ordinary(values: npt.NDArray[Any]) -> bool:
    """Return whether nearly all values have the magnitudes of points, or are nan or inf."""
    with np.errstate(invalid='ignore'):  # signalling nan
        size = np.abs(values.astype(np.float64))
    low, high = ORDINARY
    is_odd = ((size < low) & (size > 0.0)) | ((size > high) & np.isfinite(size))
    return bool(is_odd.mean() < ODD_SHARE)


def has_low_words(type_: str, values: Sequence[npt.NDArray[Any]]) -> bool:
    """Return whether float32 are halves of round float64: nearly all of every second one are 0."""
    low, high = (np.concatenate([array[at::2] for array in values]) for at in (0, 1))
    return type_ == '<f4' and (low == 0.0).mean() > 0.9 and (high == 0.0).mean() < 0.5


def best(layouts: Sequence[RawLayout], values: Sequence[npt.NDArray[Any]]) -> RawLayout:
    """Return the layout that separates the columns; of equal ones KITTI's, or the narrowest."""
    scores, preferred = {}, None
    for layout in layouts:
        tables = [v[: len(v) // layout.width * layout.width] for v in values]
        table = np.concatenate([rows.reshape(-1, layout.width) for rows in tables])
        if layout.width == KITTI and (table[:, 3] >= 0.0).all():
            preferred = layout
        if layout.width != 6 or not repeats(table):
            scores[layout] = information(table)
    enough = max(scores.values(), default=0.0) - CLEAR_NATS - FEW / sum(map(len, values))
    equal = [layout for layout in layouts if scores.get(layout, -np.inf) >= enough]
    return preferred if preferred in equal else min(equal or layouts, key=lambda raw: raw.width)


def repeats(table: npt.NDArray[Any]) -> bool:
    """
    Return whether the last three of six columns are coordinates too, those of the next point.

    Two of the three have the same range or are near each other. Unit vectors are normals, and
    columns of whole numbers intensities, rings or colours.
    """
    finite = table[np.isfinite(table).all(axis=1)].astype(np.float64)
    first, second = finite[:, :3], finite[:, 3:]
    is_whole = (finite == np.rint(finite)).mean(axis=0) > 0.5
    is_normal = np.allclose((second**2).sum(axis=1), 1.0, atol=1e-3)
    if is_normal or (is_whole[3:].any() and not is_whole[:3].any()):
        return False
    (low, high), (other_low, other_high) = (
        np.quantile(columns, [0.02, 0.98], axis=0) for columns in (first, second)
    )
    extent = np.maximum(high, other_high) - np.minimum(low, other_low)
    overlap = np.minimum(high, other_high) - np.maximum(low, other_low)
    is_near = np.median(np.abs(first - second), axis=0) < 0.1 * extent
    return np.count_nonzero((overlap >= 0.5 * extent) | is_near) >= 2


def information(table: npt.NDArray[Any]) -> float:
    """Return the mutual information of column and binned value in nats, its bias subtracted."""
    flat = table[np.isfinite(table).all(axis=1)]
    if not len(flat):
        return 0.0
    edges = np.unique(np.quantile(flat, np.linspace(0.0, 1.0, BINS + 1)[1:-1]))
    bins = np.searchsorted(edges, flat) + BINS * (flat == np.rint(flat))  # ring numbers are whole
    counts = np.stack([np.bincount(column, minlength=2 * BINS) for column in bins.T])
    share = counts / counts.sum()
    apart = share.sum(axis=1, keepdims=True) * share.sum(axis=0, keepdims=True)
    some = share > 0.0
    used = np.count_nonzero(share.sum(axis=0))
    bias = (used - 1) * (table.shape[1] - 1) / (2.0 * counts.sum())
    return float((share[some] * np.log(share[some] / apart[some])).sum() - bias)


def read_raw(path: Path, layout: RawLayout) -> npt.NDArray[Any]:
    """
    Return the columns (N, C) of a file.

    Raises
    ------
    FileFormatError
        If it cannot be read, or has a part of a point.

    """
    with refusing(path), open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size % layout.point_bytes:
            raise FileFormatError(
                f'{path}: {size} bytes, expected {layout.point_bytes} for every point ({layout})'
            )
        return np.fromfile(file, layout.type_).reshape(-1, layout.width)
