# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Merged columns: one value for several points that a filter merges into one.

The kind of a column decides how its values are averaged:

- directions (normals): mean, then scaled to unit length; if opposite ones cancel, the first;
- labels, identities, eigenvectors: the first, because they have no mean;
- colours packed into one number: the mean of each channel;
- integers of 64 bits, which are times: the mean towards zero, exact and without overflow;
- other integers: the mean, rounded; booleans: true if at least half are;
- all others: the mean, in float64.

Sums run over the points in their order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import enum
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters.columns import Array, EIGEN_VECTORS, MATCHED_IDS, NORMALS
from surfel_mapper.scan import ComputedColumns


class Kind(enum.Enum):
    """The kind of a column, which decides how it is merged."""

    NUMBER = 'number'
    DIRECTION = 'direction'
    FIRST = 'first'
    COLOUR = 'colour'
    TIME = 'time'


KINDS = {
    NORMALS: Kind.DIRECTION,
    EIGEN_VECTORS: Kind.FIRST,
    MATCHED_IDS: Kind.FIRST,
    **dict.fromkeys(('rgb', 'rgba'), Kind.COLOUR),
    **dict.fromkeys(('label', 'labels', 'class', 'instance', 'object', 'id', 'tag'), Kind.FIRST),
    **dict.fromkeys(('classification', 'return_number', 'number_of_returns'), Kind.FIRST),  # LAS
    **dict.fromkeys(('ring', 'line', 'channel', 'laser_id', 'return_type'), Kind.FIRST),
}
"""Kind of columns by name; that of all others follows from their type."""


def kind_of(name: str, column: npt.NDArray[Any]) -> Kind:
    """Return the kind of a column."""
    if name in KINDS:
        return KINDS[name]
    if column.dtype.kind in 'fiub':
        return Kind.TIME if column.dtype in (np.int64, np.uint64) else Kind.NUMBER
    return Kind.FIRST


@dataclass(frozen=True, slots=True, eq=False)
class PointGroups:
    """
    Sets of points that are merged into one point each.

    Attributes
    ----------
    rows : (N,) int
        Group of every point, 0 to K - 1; no group is empty.
    first : (K,) int
        First point of every group.
    count : (K,) int
        Number of points in every group.

    """

    rows: npt.NDArray[Any]
    first: npt.NDArray[Any]
    count: npt.NDArray[Any]

    @classmethod
    def of(cls, rows: npt.NDArray[Any], number: int) -> PointGroups:
        """Return the groups from the group of every point and the number of groups."""
        first = np.full(number, len(rows), np.int64)
        np.minimum.at(first, rows, np.arange(len(rows)))
        return cls(rows, first, np.bincount(rows, minlength=number))


def merged_columns(
    columns: Mapping[str, Array],
    groups: PointGroups,
    *,
    average: bool = True,
    unit: bool = True,
) -> ComputedColumns:
    """
    Return the columns of merged points, (K,) or (K, C) each.

    Parameters
    ----------
    columns : mapping of str to (N, ...) array
        Columns of the points before merging.
    groups : PointGroups
        The points that are merged.
    average : bool
        Whether to average columns by their kind; false keeps those of the first point.
    unit : bool
        Whether mean directions are scaled to unit length.

    """

    def compute(name: str) -> Array:
        kind = kind_of(name, columns[name]) if average else Kind.FIRST
        if kind is Kind.DIRECTION and not unit:
            kind = Kind.NUMBER
        return merged(kind, columns[name], groups)

    return ComputedColumns(columns, compute, len(groups.first))


def merged(kind: Kind, column: Array, groups: PointGroups) -> Array:
    """Return one column merged by its kind, in its own dtype."""
    if kind is Kind.FIRST:
        return np.asarray(column[groups.first])
    if kind is Kind.TIME:
        return by_component(mean_time, column, groups)
    if kind is Kind.COLOUR and column.dtype.itemsize == 4 and column.ndim == 1:
        return mean_colour(column, groups)
    means = by_component(mean, column, groups)
    if kind is Kind.DIRECTION:
        lengths = np.sqrt((means * means).sum(axis=1, keepdims=True))
        defined = lengths > 1e-6  # the rounding of opposite float32 directions is smaller
        units = np.divide(means, lengths, out=means, where=defined)
        return np.asarray(np.where(defined, units, column[groups.first]), column.dtype)
    if column.dtype.kind in 'iu':
        means = np.rint(means)
    if column.dtype.kind == 'b':
        return np.asarray(means >= 0.5)
    return np.asarray(means.astype(column.dtype))


def by_component(average: Any, column: Array, groups: PointGroups) -> Array:
    """Return the averages of a column, component by component."""
    if column.ndim == 1:
        return np.asarray(average(column, groups))
    components = column.reshape(len(column), math.prod(column.shape[1:]))
    means = [average(components[:, i], groups) for i in range(components.shape[1])]
    shape = (len(groups.first), *column.shape[1:])
    return np.stack(means, axis=1).reshape(shape) if means else np.empty(shape, column.dtype)


def mean(values: Array, groups: PointGroups) -> npt.NDArray[np.float64]:
    """Return the means of values (N,), in float64."""
    total = np.bincount(groups.rows, weights=values, minlength=len(groups.first))
    return np.asarray(total / groups.count)


def mean_time(values: Array, groups: PointGroups) -> Array:
    """
    Return the means of 64-bit integers, rounded towards zero as in libpointmatcher.

    Their sum does not fit in 64 bits: seven stamps in ns since 1970 overflow. The upper and lower
    halves are summed separately, which is exact for up to 2^30 points.
    """
    upper, lower = np.zeros((2, len(groups.first)), values.dtype)
    np.add.at(upper, groups.rows, values >> 32)
    np.add.at(lower, groups.rows, values & 0xFFFFFFFF)
    count = groups.count.astype(values.dtype)
    whole, carry = np.divmod(upper, count)
    down, remainder = np.divmod((carry << 32) + lower, count)
    means = (whole << 32) + down
    return np.where((means < 0) & (remainder > 0), means + 1, means).astype(values.dtype)


def mean_colour(column: Array, groups: PointGroups) -> Array:
    """Return the mean colours of 32-bit values with one channel per byte."""
    channels = np.ascontiguousarray(column).view(np.uint8).reshape(-1, 4)
    means = np.stack([mean(channels[:, i], groups) for i in range(4)], axis=1)
    return np.rint(means).astype(np.uint8).view(column.dtype).reshape(-1)
