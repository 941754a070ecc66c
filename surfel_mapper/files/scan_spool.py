# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
ScanSpool: the points of scans in a temporary file, so that a drive of any length can be moved.

A full scan of 131,072 points takes 1.6 MB of disk (3.1 MB if it was deskewed, which computes in
double precision) and some 200 bytes of memory. Points are written column by column, as the kernels
take them, and read back with the same bits. The file has no name and vanishes with the process.
"""

from __future__ import annotations

from collections.abc import Mapping
import os
from pathlib import Path
import tempfile
from typing import Any
import weakref

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import FileFormatError

Layout = tuple[int, tuple[int, ...], np.dtype[Any]]
"""Offset in the file, bytes; shape and type of an array."""


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
        If no file can be made there.

    """

    def __init__(self, directory: str | Path = '') -> None:
        self._directory = str(directory) or tempfile.gettempdir()
        try:
            self._file = tempfile.TemporaryFile(dir=self._directory)  # noqa: SIM115  kept open
        except OSError as error:
            raise FileFormatError(
                f'{self._directory}: no file for the points of scans: {error.strerror} '
                '(loops.directory)'
            ) from error
        weakref.finalize(self, self._file.close)
        self._size = 0
        self._layouts: list[dict[str, Layout]] = []

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self._layouts)

    @property
    def nbytes(self) -> int:
        """Size of the file, bytes."""
        return self._size

    def append(self, points: npt.NDArray[Any], columns: Mapping[str, npt.NDArray[Any]]) -> None:
        """
        Add a scan.

        Parameters
        ----------
        points : (N, 3) float32 or float64
            The points.
        columns : mapping of str to (N,) array
            Columns of the points.

        Raises
        ------
        FileFormatError
            If the disk is full; the scan is not added then.

        """
        start = self._size
        arrays = {'': np.asarray(points).T, **{f'.{n}': a for n, a in columns.items()}}
        try:
            self._file.seek(start)
            layout = {name: self._write(array) for name, array in arrays.items()}
        except OSError as error:
            self._size = start
            raise FileFormatError(
                f'{self._directory}: the points of scan {len(self)} cannot be written after '
                f'{start / 1e9:.1f} GB: {error.strerror}; loops.directory names another disk'
            ) from error
        self._layouts.append(layout)

    def points(self, number: int) -> npt.NDArray[Any]:
        """Return the points of a scan, (N, 3), in Fortran order."""
        array: npt.NDArray[Any] = self._read(self._layouts[number][''])
        return np.asarray(array.T)

    def columns(self, number: int) -> dict[str, npt.NDArray[Any]]:
        """Return the columns of a scan."""
        layout = self._layouts[number]
        return {name[1:]: self._read(entry) for name, entry in layout.items() if name}

    def clear(self) -> None:
        """Forget all scans and free the disk."""
        self._file.truncate(0)
        self._size = 0
        self._layouts.clear()

    def _write(self, array: npt.NDArray[Any]) -> Layout:
        data = np.ascontiguousarray(array)
        layout = (self._size, data.shape, data.dtype)
        self._file.write(data.data.cast('B') if data.size else b'')
        self._file.flush()
        self._size += data.nbytes
        return layout

    def _read(self, layout: Layout) -> npt.NDArray[Any]:
        offset, shape, dtype = layout
        array = np.empty(shape, dtype)
        if array.size:
            buffer = array.data.cast('B')
            done = 0
            while done < len(buffer):
                try:
                    num_read = os.preadv(self._file.fileno(), [buffer[done:]], offset + done)
                except OSError as error:
                    reason = f'{self._directory}: points of scans cannot be read: {error.strerror}'
                    raise FileFormatError(reason) from error
                if not num_read:
                    raise FileFormatError(
                        f'{self._directory}: the points of a scan end {len(buffer) - done} bytes '
                        'early; was the disk full?'
                    )
                done += num_read
        return array
