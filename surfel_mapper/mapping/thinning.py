# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Some of many voxels, evenly spread and always the same ones."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.kernels.thinning import mix_keys


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
    mixed = np.empty(len(key), np.uint64)
    mix_keys(key, mixed)
    return smallest(mixed, number)


def smallest(mixed: npt.NDArray[np.uint64], number: int) -> npt.NDArray[np.int64]:
    """Return the places of so many smallest hashes, in order; all of fewer."""
    if len(mixed) <= number:
        return np.arange(len(mixed))
    return np.sort(np.argpartition(mixed, number - 1)[:number])
