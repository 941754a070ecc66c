# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Runs of records of equal size in a chunk, read as a block.

A chunk is a chain of records: the place of each follows from the size of the one before it. A
hundred thousand small messages take 80 ms in Python. If their sizes are equal their heads are
rows of an array, and take 6 ms. It stands apart from both formats, which are read alike.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import numpy.typing as npt

from surfel_mapper.bags.bag_file import Index, INDEX_COLUMNS

RUN = 16
"""Records of equal size in a row after which the next ones are read as a block."""

CHECK_EVERY = 1024
"""Number of messages after which the budget is asked again, and limit of those in a block."""


def equal_heads(
    records: bytes | bytearray, at: int, stride: int, size: int
) -> npt.NDArray[np.uint8]:
    """
    Return the heads (M, size) of up to CHECK_EVERY records at equal distances.

    M is 0 if the records are smaller than heads.
    """
    number = min((len(records) - at) // stride, CHECK_EVERY) if stride >= size else 0
    found = np.frombuffer(records, np.uint8, number * stride, at)
    return found.reshape(number, stride)[:, :size]


def number_at(heads: npt.NDArray[np.uint8], at: int, kind: str) -> npt.NDArray[np.int64]:
    """Return the number of a type at an offset of each head, (M,); beyond int64 they wrap."""
    dtype = np.dtype(kind)
    found = np.ascontiguousarray(heads[:, at : at + dtype.itemsize]).view(dtype)
    return found[:, 0].astype(np.int64)


def are_known(ids: npt.NDArray[np.int64], known: Collection[int]) -> npt.NDArray[np.bool_]:
    """Return which connections are known, (M,)."""
    unknown = [key for key in np.unique(ids).tolist() if key not in known]
    return ~np.isin(ids, unknown)


def entries(
    record_ns: npt.NDArray[np.int64],
    ids: npt.NDArray[np.int64],
    number: int,
    place: tuple[int, int, int],
    alike: npt.NDArray[np.bool_],
) -> Index:
    """
    Return the entries of the records of a run up to the first that is not alike.

    ``place`` has the offset of the first message, the distance to the next, and the size.
    """
    count = len(alike) if alike.all() else int(alike.argmin())
    start, stride, size = place
    found = np.zeros((count, INDEX_COLUMNS), np.int64)
    found[:, 0], found[:, 1], found[:, 2] = record_ns[:count], ids[:count], number
    found[:, 3], found[:, 4] = start + stride * np.arange(count), size
    return found
