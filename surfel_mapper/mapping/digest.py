# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The digest of a map: what exactly is hashed, for maps in memory and maps in many files.

The arrays are hashed one after the other, each sorted by voxel, so that a map far larger than
the memory can be hashed too: whoever holds it yields every array in parts, in order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import hashlib
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

ARRAYS = ('key', 'count', 'total', 'product', 'view')
"""The arrays of ScanMoments in the order in which they are hashed."""


def digest_of(
    voxel_size_m: float,
    level: int,
    num_voxels: int,
    columns: tuple[str, ...],
    parts: Callable[[str], Iterable[npt.NDArray[Any]]],
) -> str:
    """
    Return the SHA-256 of the state of a map in hexadecimal.

    Parameters
    ----------
    voxel_size_m : float
        Edge of a voxel, m.
    level : int
        See SurfelMap.
    num_voxels : int
        Voxels of the whole map.
    columns : tuple of str
        What else it sums.
    parts : callable
        Given a name of ARRAYS, or ``channels``, yields that array, in as many parts as it likes:
        one row a voxel, sorted by key.

    Notes
    -----
    Of the text ``surfel map 1``, the voxel size as float64, level and number of voxels; then
    of all voxels the keys, the counts, the sums (x y z), the products (xx xy xz yy yz zz)
    and the sums of the views (x y z), array by array and sorted by key; where the map has
    columns, their names, a comma between each, and the sums of the channels. All numbers
    but the first are int64, all are little-endian. The key of voxel (i, j, k) is
    ((i + 2^20) 2^21 + (j + 2^20)) 2^21 + (k + 2^20).

    """
    state = hashlib.sha256(b'surfel map 1')
    state.update(struct.pack('<dqq', voxel_size_m, level, num_voxels))
    for name in ARRAYS:
        for part in parts(name):
            state.update(np.ascontiguousarray(part, dtype='<i8').data)
    if columns:
        state.update(','.join(columns).encode())
        for part in parts('channels'):
            state.update(np.ascontiguousarray(part, dtype='<i8').data)
    return state.hexdigest()
