# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
RecordingFile: an .rrd file that rerun writes, whole or not at all.

rerun writes to a pipe, and a thread copies the bytes to a temporary file that takes its name at
the end. Without it a full disk ended the recording in the middle, and rerun (0.41) waited for its
writer for ever, in flush and at the end of the process.
"""

from __future__ import annotations

from contextlib import ExitStack
import os
from pathlib import Path
import threading

from surfel_mapper.files.atomic import cannot_write, replace_file


class RecordingFile:
    """
    A file whose bytes come through a pipe.

    Parameters
    ----------
    path : str or Path
        The file; see replace_file.

    Attributes
    ----------
    pipe : str
        Path by which to open the end of the pipe that is written to.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """

    def __init__(self, path: str | Path) -> None:
        self._path = path
        self._error: OSError | None = None
        self._closing = ExitStack()
        self._file = self._closing.enter_context(replace_file(path))
        self._reading, self._writing = os.pipe()
        self.pipe = f'/dev/fd/{self._writing}'
        self._thread = threading.Thread(target=self._copy, daemon=True)
        self._thread.start()

    def _copy(self) -> None:
        """Copy bytes until all writers have closed the pipe; after an error, drop them."""
        with open(self._reading, 'rb', buffering=0) as pipe:
            while content := pipe.read(1 << 16):
                try:
                    if self._error is None:
                        self._file.write(content)
                        self._file.flush()
                except OSError as error:
                    self._error = error

    def check(self) -> None:
        """Raise FileFormatError if something could not be written."""
        if self._error is not None:
            raise cannot_write(self._path, self._error)

    def close(self, error: BaseException | None = None) -> None:
        """
        Give the file its name when the writers have closed the pipe; with an error, remove it.

        Raises
        ------
        FileFormatError
            If it could not be written.

        """
        os.close(self._writing)
        self._thread.join()
        if error is not None:
            self._closing.__exit__(type(error), error, None)
            return
        with self._closing:
            self.check()
