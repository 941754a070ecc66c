# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The arrays of the hash table of kernels/hashing.py, and how they grow.

Kernels work on the arrays and stop where there is no room; whoever called them makes room and
calls again. A table grows by segments, each of which splits on its own, so no step is long.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import MapLimitError
from surfel_mapper.kernels import hashing
from surfel_mapper.mapping.slab import Slab


class HashTable:
    """
    Key to row of a slab.

    Parameters
    ----------
    max_depth : int
        The directory has at most 2^max_depth entries.

    Attributes
    ----------
    state : (STATE,) int64
        The scalars that kernels write; see kernels/hashing.py.

    """

    def __init__(self, max_depth: int) -> None:
        """Make an empty table."""
        self._max_depth = max_depth
        self._buckets = Slab(1, hashing.SEGMENT)
        self._directory = np.zeros(1, np.int32)
        self._held = np.zeros(1, np.int32)
        self._local_depth = np.zeros(1, np.int8)
        self.state = np.zeros(hashing.STATE, np.int64)
        self.state[hashing.FREE_ROW] = -1
        self.state[hashing.SEGMENTS] = 1

    @property
    def arrays(self) -> tuple[npt.NDArray[Any], ...]:
        """Directory, buckets, held, local_depth, as the kernels take them."""
        buckets = self._buckets.array.reshape(-1)
        return self._directory, buckets, self._held, self._local_depth

    @property
    def num_keys(self) -> int:
        """Keys in the table."""
        return int(self.state[hashing.VOXELS])

    @property
    def rows_used(self) -> int:
        """Rows of the slab ever used; those from here on are untouched."""
        return int(self.state[hashing.ROWS_USED])

    @property
    def nbytes(self) -> int:
        """Bytes in use."""
        buckets = int(self.state[hashing.SEGMENTS]) * hashing.SEGMENT * 8
        return buckets + self._directory.nbytes + self._held.nbytes

    def lacks_row(self, num_rows: int) -> bool:
        """Return whether a slab of so many rows has none left for a new key."""
        return bool(self.state[hashing.FREE_ROW] < 0 and self.rows_used == num_rows)

    def grow(self) -> None:
        """
        Enlarge what kept a kernel from placing a key, rows of the slab apart.

        Raises
        ------
        MapLimitError
            If the table is as large as it may get, or there is no memory.

        """
        num_segments = len(self._held)
        if self.state[hashing.SEGMENTS] == num_segments:
            self._buckets.grow(2 * num_segments)
            self._held = np.append(self._held, np.zeros_like(self._held))
            self._local_depth = np.append(self._local_depth, np.zeros_like(self._local_depth))
        elif self.state[hashing.DEPTH] < self._max_depth:
            self._directory = np.repeat(self._directory, 2)
            self.state[hashing.DEPTH] += 1
        else:
            raise MapLimitError(f'{self.num_keys} keys: the hash table is full')
