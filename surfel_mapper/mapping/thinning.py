# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Some of many voxels, evenly spread and always the same ones."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def thinned(key: npt.NDArray[np.int64], number: int) -> npt.NDArray[np.int64]:
    """
    Return the rows of so many voxels, evenly spread and in order; all rows of fewer.

    They are those of the smallest hashes, so that a voxel chosen stays chosen while the map
    grows: any rule that looks at rows would choose others every time.

    Parameters
    ----------
    key : (K,) int64
        Voxel indices, packed.
    number : int
        How many.

    """
    if len(key) <= number:
        return np.arange(len(key))
    mixed = key.astype(np.uint64)
    for _ in range(2):
        mixed *= np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio, odd
        mixed ^= mixed >> np.uint64(29)
    mixed *= np.uint64(0x9E3779B97F4A7C15)
    return np.sort(np.argpartition(mixed, number - 1)[:number])
