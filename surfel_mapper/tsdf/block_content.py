# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What blocks hold outside of a map, and the keys by which a map finds them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.kernels.layout import INDEX_BITS, INDEX_MASK, INDEX_OFFSET

Int64 = npt.NDArray[np.int64]
Float32 = npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """
    Content of some blocks, taken out of a map or about to be put into one.

    Attributes
    ----------
    index : (K, 3) int64
        Which blocks.
    stamp_ns : (K,) int64
        Stamp of the last change of each.
    field, color, votes, stamps
        As in BlockMap, one row a block.

    """

    index: Int64
    stamp_ns: Int64
    field: Float32
    color: Float32
    votes: Float32
    stamps: Int64

    def __len__(self) -> int:
        """Return how many blocks."""
        return len(self.index)


def some(array: npt.NDArray[Any], rows: Int64) -> Any:
    """Return a copy of some rows, or of none where the channel is not kept."""
    return array[rows] if len(array) else array.copy()


def block_keys(index: npt.NDArray[Any]) -> Int64:
    """Return the keys of blocks, (...,) int64; -1 for an index beyond 20 bits."""
    place = index.astype(np.int64) + INDEX_OFFSET
    within = ((place >= 0) & (place <= INDEX_MASK)).all(axis=-1)
    x, y, z = (place[..., axis] for axis in range(3))
    keys: Int64 = np.where(within, x << 2 * INDEX_BITS | y << INDEX_BITS | z, -1)
    return keys


def block_index(keys: Int64) -> Int64:
    """Return the blocks that keys stand for, (..., 3) int64."""
    shifts = np.array([2 * INDEX_BITS, INDEX_BITS, 0])
    index: Int64 = (keys[..., None] >> shifts & INDEX_MASK) - INDEX_OFFSET
    return index
