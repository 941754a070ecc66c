# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LazyColumns: what is left of columns, taken when somebody asks.

A cloud brings intensity, ring and time, mostly to no end: nothing but the coordinates is mapped.
Each of them costs as much to pick from the bytes of the message as the coordinates cost to filter
(0.3 ms for 131,072 points), and that at every filter of a chain.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


class LazyColumns(Mapping[str, Array]):
    """
    Columns of some rows of others, and further ones.

    Parameters
    ----------
    base : mapping of str to array
        The others; not changed as long as this is in use.
    rows : (K,) int, optional
        The rows wanted; None: all.
    num_rows : int
        How many these are.
    own : mapping of str to (K, ...) array
        Further columns, in place of those of the same name.

    """

    __slots__ = ('_base', '_own', '_rows', 'num_rows')

    def __init__(
        self,
        base: Mapping[str, Array],
        rows: npt.NDArray[np.int64] | None,
        num_rows: int,
        own: Mapping[str, Array] | None = None,
    ) -> None:
        """Take nothing yet."""
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
        """Return whether there is such a column, without taking it."""
        return name in self._own or name in self._base

    def __iter__(self) -> Iterator[str]:
        """Yield the names: those of the base, then further ones."""
        yield from self._base
        yield from (name for name in self._own if name not in self._base)

    def __len__(self) -> int:
        """Return the number of columns."""
        return sum(1 for _ in self)

    def _origin(self, name: str) -> tuple[Array, npt.NDArray[np.int64] | None]:
        """Return the array that a column is part of, and which rows; None: it is all of it."""
        if name in self._own:
            return self._own[name], None
        if not isinstance(self._base, LazyColumns):
            return self._base[name], self._rows
        column, rows = self._base._origin(name)
        if self._rows is None or rows is None:
            return column, rows if self._rows is None else self._rows
        return column, rows[self._rows]
