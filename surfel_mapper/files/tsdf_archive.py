# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Blocks of a distance field that have left its window, kept on disk while the program runs.

They are collected and written CHUNK at a time into a directory of the archive's own, which is
removed with it. A block that leaves several times is there several times.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
import weakref

import numpy as np

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.state import load_state, save_state
from surfel_mapper.tsdf.blocks import Blocks

CHUNK = 4096
"""Blocks of a file: 16 MiB of distances and weights."""


class BlockArchive:
    """
    An archive of blocks.

    Parameters
    ----------
    directory : str or Path
        Where its own directory is made.

    Raises
    ------
    FileFormatError
        If that is not possible.

    """

    def __init__(self, directory: str | Path) -> None:
        parent = Path(directory).expanduser()
        try:
            parent.mkdir(parents=True, exist_ok=True)
            self._directory = Path(mkdtemp(prefix='tsdf-', dir=parent))
        except OSError as error:
            raise FileFormatError(f'layers.tsdf.archive_directory: {error}') from error
        weakref.finalize(self, rmtree, self._directory, ignore_errors=True)
        self._files: list[Path] = []
        self._waiting: list[Blocks] = []
        self._num_waiting = 0
        self.num_blocks = 0

    def add(self, blocks: Blocks) -> None:
        """
        Keep blocks.

        Raises
        ------
        FileFormatError
            If a file cannot be written; the blocks are kept in memory, and tried again.

        """
        if not len(blocks):
            return
        self._waiting.append(blocks)
        self._num_waiting += len(blocks)
        self.num_blocks += len(blocks)
        if self._num_waiting >= CHUNK:
            self._flush()

    def __iter__(self) -> Iterator[Blocks]:
        """Iterate over the content, oldest first; a part may have a block several times."""
        for path in self._files:
            arrays, _ = load_state(path)
            yield Blocks(**arrays)
        yield from list(self._waiting)

    def clear(self) -> None:
        """Forget all blocks."""
        for path in self._files:
            path.unlink(missing_ok=True)
        self._files, self._waiting = [], []
        self._num_waiting = self.num_blocks = 0

    def _flush(self) -> None:
        arrays = {
            one.name: np.concatenate([getattr(part, one.name) for part in self._waiting])
            for one in fields(Blocks)
        }
        path = self._directory / f'{len(self._files):06d}.npz'
        save_state(path, arrays, {'kind': 'tsdf archive'})
        self._files.append(path)
        self._waiting, self._num_waiting = [], 0
