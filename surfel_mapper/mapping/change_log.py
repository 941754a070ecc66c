# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which rows of a map its latest versions changed.

Asking for what changed since a version would otherwise look at every row there is. The log is
bounded: whoever asks for more than it holds is told so, and looks at all rows.
"""

from __future__ import annotations

from collections import deque
from itertools import takewhile

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.kernels.surfels import rows_changed_at

Rows = npt.NDArray[np.int32]

LEAST = 1 << 18
"""At least so many changes are remembered, so that asking for the latest ones is quick."""


class ChangeLog:
    """
    Rows by version, the latest ones.

    Parameters
    ----------
    version : int
        Of the map when the log begins.

    """

    def __init__(self, version: int) -> None:
        """Begin with no changes."""
        self._entries: deque[tuple[int, Rows]] = deque()
        self._num_rows = 0
        self._start = version

    def add(self, version: int, rows: Rows, num_voxels: int) -> None:
        """Remember the rows that a version changed; forget the oldest beyond a bound."""
        if not len(rows):
            return
        self._entries.append((version, rows))
        self._num_rows += len(rows)
        while self._num_rows > max(LEAST, num_voxels):
            self._start, forgotten = self._entries.popleft()
            self._num_rows -= len(forgotten)

    def since(
        self, version: int, slab: npt.NDArray[np.int64], min_points: int
    ) -> npt.NDArray[np.int32] | None:
        """
        Return the rows changed after a version that hold at least so many points, each once.

        Those of 0 points have been emptied. None where the log does not reach back so far.
        """
        if version < self._start:
            return None
        entries = takewhile(lambda entry: entry[0] > version, reversed(self._entries))
        parts = [rows_changed_at(slab, rows, at, min_points) for at, rows in entries]
        return np.concatenate(parts) if parts else np.empty(0, np.int32)
