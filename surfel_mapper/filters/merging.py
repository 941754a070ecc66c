# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Make one point of several: what becomes of their columns.

columns.py says how a column of each kind is averaged. Sums run over the points in their order and
in float64, or exactly in integers.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters.columns import Kind, kind_of

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """
    Which points become one.

    Attributes
    ----------
    rows : (N,) int
        The group of every point, 0 to K - 1; every group has a point.
    first : (K,) int
        The first point of every group.
    count : (K,) int
        Points in every group.

    """

    rows: npt.NDArray[Any]
    first: npt.NDArray[Any]
    count: npt.NDArray[Any]

    @classmethod
    def of(cls, rows: npt.NDArray[Any], number: int) -> Groups:
        """Return the groups from the group of every point and the number of groups."""
        first = np.full(number, len(rows), np.int64)
        np.minimum.at(first, rows, np.arange(len(rows)))
        return cls(rows, first, np.bincount(rows, minlength=number))


class MergedColumns(Mapping[str, Array]):
    """
    The columns of the points that groups of points become, (K,) or (K, C) each.

    Each is made when it is first asked for: most never are (lazy_columns.py).

    Parameters
    ----------
    columns : mapping of str to (N, ...) array
        Of the points before.
    groups : Groups
        Which of them become one.
    average : bool
        Whether to average columns by their kind; else those of the first point are kept.
    unit : bool
        Whether mean directions get unit length again; else they are shorter where they differ.

    """

    __slots__ = ('_average', '_columns', '_groups', '_made', '_unit', 'num_rows')

    def __init__(
        self,
        columns: Mapping[str, Array],
        groups: Groups,
        *,
        average: bool = True,
        unit: bool = True,
    ) -> None:
        """Make nothing yet."""
        self._columns = columns
        self._groups = groups
        self._average = average
        self._unit = unit
        self._made: dict[str, Array] = {}
        self.num_rows = len(groups.first)

    def __getitem__(self, name: str) -> Array:
        """Return a column, the same array every time."""
        if name not in self._made:
            column = self._columns[name]
            self._made[name] = merged(self._kind(name, column), column, self._groups)
        return self._made[name]

    def __contains__(self, name: object) -> bool:
        """Return whether there is such a column, without making it."""
        return name in self._columns

    def __iter__(self) -> Iterator[str]:
        """Yield the names."""
        return iter(self._columns)

    def __len__(self) -> int:
        """Return the number of columns."""
        return len(self._columns)

    def _kind(self, name: str, column: Array) -> Kind:
        """Return how a column is merged."""
        kind = kind_of(name, column) if self._average else Kind.FIRST
        return Kind.NUMBER if kind is Kind.DIRECTION and not self._unit else kind


def merged(kind: Kind, column: Array, groups: Groups) -> Array:
    """Return one column, averaged as its kind asks, in the type that it has."""
    if kind is Kind.FIRST:
        return np.asarray(column[groups.first])
    if kind is Kind.TIME:
        return by_component(mean_time, column, groups)
    if kind is Kind.COLOUR:
        return mean_colour(column, groups)
    means = by_component(mean, column, groups)
    if kind is Kind.DIRECTION:
        lengths = np.sqrt((means * means).sum(axis=1, keepdims=True))
        defined = lengths > 1e-6  # rounding of opposite float32 directions leaves less
        units = np.divide(means, lengths, out=means, where=defined)
        return np.asarray(np.where(defined, units, column[groups.first]), column.dtype)
    if column.dtype.kind in 'iu':
        means = np.rint(means)
    if column.dtype.kind == 'b':
        return np.asarray(means >= 0.5)
    return np.asarray(means.astype(column.dtype))


def by_component(average: Any, column: Array, groups: Groups) -> Array:
    """Return the averages of a column, of each of its components if it has several."""
    if column.ndim == 1:
        return np.asarray(average(column, groups))
    parts = column.reshape(len(column), math.prod(column.shape[1:]))
    means = [average(parts[:, i], groups) for i in range(parts.shape[1])]
    shape = (len(groups.first), *column.shape[1:])
    return np.stack(means, axis=1).reshape(shape) if means else np.empty(shape, column.dtype)


def mean(values: Array, groups: Groups) -> npt.NDArray[np.float64]:
    """Return the means of values (N,), in float64."""
    total = np.bincount(groups.rows, weights=values, minlength=len(groups.first))
    return np.asarray(total / groups.count)


def mean_time(values: Array, groups: Groups) -> Array:
    """
    Return the means of 64-bit integers, towards zero as libpointmatcher has it.

    Their sum does not fit: seven stamps in ns since 1970 overflow. The upper and the lower half
    of each are summed apart, which holds for 2^30 points.
    """
    upper, lower = np.zeros((2, len(groups.first)), values.dtype)
    np.add.at(upper, groups.rows, values >> 32)
    np.add.at(lower, groups.rows, values & 0xFFFFFFFF)
    count = groups.count.astype(values.dtype)
    whole, rest = np.divmod(upper, count)
    down, left = np.divmod((rest << 32) + lower, count)
    means = (whole << 32) + down
    return np.where((means < 0) & (left > 0), means + 1, means).astype(values.dtype)


def mean_colour(column: Array, groups: Groups) -> Array:
    """Return the mean colours of numbers of 32 bits, a channel in each byte."""
    if column.dtype.itemsize != 4 or column.ndim != 1:
        return by_component(mean, column, groups).astype(column.dtype)
    channels = np.ascontiguousarray(column).view(np.uint8).reshape(-1, 4)
    means = np.stack([mean(channels[:, i], groups) for i in range(4)], axis=1)
    return np.rint(means).astype(np.uint8).view(column.dtype).reshape(-1)
