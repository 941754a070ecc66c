# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ScanSpool: the points of scans in a temporary file, so that a drive of any length can be moved.

A full scan of 131,072 points takes 1.6 MB of disk (3.1 MB if it was deskewed, which computes in
double precision) and some 200 bytes of memory. Points are written column by column, as the kernels
take them, and read back with the same bits. The file has no name and vanishes with the process.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import os
from pathlib import Path
import tempfile
from threading import Lock
from typing import Any
import weakref

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FileFormatError


class ScanSpool:
    """
    Points and columns of scans, by number.

    Parameters
    ----------
    directory : str or Path
        Where the file is made; empty: the directory of temporary files.

    Raises
    ------
    FileFormatError
        If no file can be made there, or, later, it cannot be written or read.

    """

    def __init__(self, directory: str | Path = '') -> None:
        self._directory = str(directory) or tempfile.gettempdir()
        self._offsets: list[dict[str, int]] = []
        self._lock = Lock()
        with self._refusing('no file for the points of scans'):
            self._file = tempfile.TemporaryFile(dir=self._directory)  # noqa: SIM115  kept open
        weakref.finalize(self, self._file.close)

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self._offsets)

    def append(self, points: npt.NDArray[Any], columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """
        Add a scan: points (N, 3), float32 or float64, and columns (N,).

        A scan that cannot be written, as the disk is full, is not added.
        """
        offsets = {}
        with self._refusing(f'the points of scan {len(self)} cannot be written'), self._lock:
            for name, array in {'': np.asarray(points).T, **columns}.items():
                offsets[name] = self._file.seek(0, os.SEEK_END)
                np.save(self._file, np.ascontiguousarray(array), allow_pickle=False)
            self._file.flush()
        self._offsets.append(offsets)

    def points(self, number: int) -> npt.NDArray[Any]:
        """Return the points of a scan, (N, 3), in Fortran order."""
        return self._read(self._offsets[number]['']).T

    def columns(self, number: int) -> dict[str, npt.NDArray[Any]]:
        """Return the columns of a scan."""
        offsets = self._offsets[number]
        return {name: self._read(offset) for name, offset in offsets.items() if name}

    def clear(self) -> None:
        """Forget all scans and free the disk."""
        self._file.truncate(0)
        self._offsets.clear()

    def _read(self, offset: int) -> npt.NDArray[Any]:
        """Return the array at an offset of the file."""
        with self._refusing('points of scans cannot be read'), self._lock:
            self._file.seek(offset)
            array: npt.NDArray[Any] = np.load(self._file, allow_pickle=False)
            return array

    @contextmanager
    def _refusing(self, problem: str) -> Iterator[None]:
        """Name the directory in errors of the system, and of arrays that are cut off."""
        try:
            yield
        except (OSError, ValueError) as error:
            raise FileFormatError(
                f'{self._directory}: {problem}: {getattr(error, "strerror", None) or error}; '
                'loops.directory names another disk'
            ) from error
