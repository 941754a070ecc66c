# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Columns of a scan: their names, the selection of rows, and their fields in a cloud or a file.

A descriptor of libpointmatcher is a column of the same name, so chains that name one run as they
are. A descriptor of one row is a column (N,), one of C rows a column (N, C). libpointmatcher's
times are ordinary columns here. Clouds often carry the normal as three fields; ``with_normals``
turns these into ``normals``.

Columns are picked lazily. A cloud carries intensity, ring and time, mostly unused: only the
coordinates are mapped. Picking one column from the bytes of the message takes twice as long as
filtering the coordinates (0.3 ms for 131,072 points), and that at every filter of a chain. The
columns of points that a filter merges are in merging.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.scan import Scan

Array = npt.NDArray[Any]

NORMALS = 'normals'
"""(N, 3) unit normals."""
OBSERVATION_DIRECTIONS = 'observationDirections'
"""(N, 3) from the point to the sensor, m, not unit length."""
DENSITIES = 'densities'
"""(N,) points per m^3 about the point."""
EIGEN_VALUES = 'eigValues'
"""(N, 3) of the covariance about the point, m^2, ascending."""
EIGEN_VECTORS = 'eigVectors'
"""(N, 9) unit eigenvectors of eigValues, one after another."""
INCIDENCE_ANGLES = 'incidenceAngles'
"""(N,) angle between normal and direction to the sensor, rad."""
MATCHED_IDS = 'matchedIds'
"""(N, K) indices of neighbours."""
MEAN_DISTS = 'meanDists'
"""(N,) mean distance to the neighbours, m."""
SENSOR_NOISE = 'simpleSensorNoise'
"""(N,) noise radius of the sensor, m."""

NORMAL_FIELDS = ('normal_x', 'normal_y', 'normal_z')
"""Fields of the normal in a PointCloud2."""


def with_normals(scan: Scan) -> Scan:
    """Return the scan with the column ``normals`` if it has the normal as three fields only."""
    if NORMALS in scan.columns or any(name not in scan.columns for name in NORMAL_FIELDS):
        return scan
    normals = np.column_stack([scan.columns[name] for name in NORMAL_FIELDS])
    kept = {k: v for k, v in scan.columns.items() if k not in NORMAL_FIELDS}
    return replace(scan, columns={**kept, NORMALS: normals})


class LazyColumns(Mapping[str, Array]):
    """
    Some rows of other columns, taken when first read, and further columns.

    Parameters
    ----------
    base : mapping of str to array
        Columns to take rows from; must not change while this is in use.
    rows : (K,) int, optional
        Rows to take; None: all.
    num_rows : int
        Number of rows.
    own : mapping of str to (K, ...) array
        Further columns; they replace those of the same name.

    """

    __slots__ = ('_base', '_own', '_rows', 'num_rows')

    def __init__(
        self,
        base: Mapping[str, Array],
        rows: npt.NDArray[Any] | None,
        num_rows: int,
        own: Mapping[str, Array] | None = None,
    ) -> None:
        self._base = base
        self._rows = rows
        self._own = dict(own or {})
        self.num_rows = num_rows

    def __getitem__(self, name: str) -> Array:
        """Return a column, the same array every time."""
        if name not in self._own:
            column, rows = self._origin(name)
            self._own[name] = column if rows is None else np.take(column, rows, axis=0)
        return self._own[name]

    def __contains__(self, name: object) -> bool:
        """Return whether the column exists, without taking it."""
        return name in self._own or name in self._base

    def __iter__(self) -> Iterator[str]:
        """Yield the names: those of the base, then the further ones."""
        yield from self._base
        yield from (name for name in self._own if name not in self._base)

    def __len__(self) -> int:
        """Return the number of columns."""
        return sum(1 for _ in self)

    def _origin(self, name: str) -> tuple[Array, npt.NDArray[Any] | None]:
        """Return the array that holds a column, and its rows in it; None: all rows."""
        if name in self._own:
            return self._own[name], None
        if not isinstance(self._base, LazyColumns):
            return self._base[name], self._rows
        column, rows = self._base._origin(name)
        if self._rows is None or rows is None:
            return column, self._rows if rows is None else rows
        return column, rows[self._rows]


def as_fields(
    scan: Scan, *, is_flat: bool = False, has_int64: bool = False
) -> dict[str, npt.NDArray[Any]]:
    """
    Return the coordinates and columns of a scan as the fields of a cloud or a file.

    Parameters
    ----------
    scan : Scan
        Any scan.
    is_flat : bool
        Whether the target has no fields of several components: a column (N, C) becomes C fields,
        ``name_0`` to ``name_C-1``. ``normals`` always become normal_x, normal_y, normal_z, and
        ``rgb`` of three components red, green, blue.
    has_int64 : bool
        Whether the target has integers of 64 bits; if not, they become float64, exact up to 2^53
        and rounded to 256 for ns since 1970.

    Returns
    -------
    dict of str to (N,) or (N, C) array
        x, y, z first. Booleans become uint8, and a name that is taken already is left out.

    """
    fields = {name: np.asarray(scan.points[:, axis]) for axis, name in enumerate('xyz')}
    for name in scan.columns:
        column = scan.columns[name].reshape(len(scan), math.prod(scan.columns[name].shape[1:]))
        if column.dtype.kind == 'b':
            column = column.astype(np.uint8)
        if column.dtype in (np.int64, np.uint64) and not has_int64:
            column = column.astype(np.float64)
        if column.dtype.kind not in 'fiu':
            continue
        names = component_names(name, column.shape[1])
        if scan.columns[name].ndim == 1:
            fields.setdefault(name, column[:, 0])
        elif is_flat or names != [f'{name}_{i}' for i in range(column.shape[1])]:
            for i, component in enumerate(names):
                fields.setdefault(component, column[:, i])
        elif column.shape[1]:
            fields.setdefault(name, column)
    return fields


def component_names(name: str, number: int) -> list[str]:
    """Return the names of the components of a column as single fields."""
    if name == NORMALS and number == 3:
        return list(NORMAL_FIELDS)
    if name == 'rgb' and number == 3:
        return ['red', 'green', 'blue']
    return [f'{name}_{i}' for i in range(number)]
