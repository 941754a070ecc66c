# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Blocks of a distance field that have left its window, kept on disk while the program runs.

They are collected, and written in files by region, a cube of REGION blocks a side, so that a long
drive can be read region by region. The files are in a directory of the archive's own, which is
removed with it. A block that leaves several times is there several times, in that order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
import weakref

import numpy as np

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.atomic import make_directory
from surfel_mapper.files.state import load_state, save_state
from surfel_mapper.tsdf.blocks import Blocks

CHUNK = 4096
"""Blocks collected until they are written: 16 MiB of distances and weights."""

REGION = 32
"""Blocks along the edge of a region: 51 m with voxels of 0.2 m, at most 134 MB."""

Region = tuple[int, int, int]
Edit = Callable[[Blocks], Blocks]


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
            make_directory(parent)
            self._directory = Path(mkdtemp(prefix='tsdf-', dir=parent))
        except (FileFormatError, OSError) as error:
            raise FileFormatError(f'layers.tsdf.archive_directory: {error}') from error
        weakref.finalize(self, rmtree, self._directory, ignore_errors=True)
        self._files: dict[Region, list[tuple[int, Path]]] = {}
        self._waiting: list[tuple[int, Blocks]] = []
        self._edits: list[tuple[int, Edit]] = []
        self._num_waiting = self._num_written = self._number = 0
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
        self._waiting.append((self._number, blocks))
        self._number += 1
        self._num_waiting += len(blocks)
        self.num_blocks += len(blocks)
        if self._num_waiting >= CHUNK:
            self._flush()

    def edit(self, change: Edit) -> None:
        """Change the blocks added so far; it is applied to copies whenever they are read."""
        self._edits.append((self._number, change))

    def regions(self) -> set[Region]:
        """Return the regions that have blocks."""
        found = set(self._files)
        for _, blocks in self._waiting:
            found.update(map(tuple, np.unique(blocks.index // REGION, axis=0).tolist()))
        return found

    def region(self, region: Region) -> Iterator[Blocks]:
        """Iterate over the blocks of a region, oldest first; a part may have one several times."""
        for number, path in self._files.get(region, ()):
            arrays, _ = load_state(path)
            yield self._edited(number, Blocks(**arrays))
        for number, blocks in self._waiting:
            inside = np.flatnonzero((blocks.index // REGION == region).all(axis=1))
            if len(inside):
                yield self._edited(number, blocks.part(inside))

    def __iter__(self) -> Iterator[Blocks]:
        """Iterate over the content, region by region."""
        for region in sorted(self.regions()):
            yield from self.region(region)

    def clear(self) -> None:
        """Forget all blocks."""
        for files in self._files.values():
            for _, path in files:
                path.unlink(missing_ok=True)
        self._files, self._waiting, self._edits = {}, [], []
        self._num_waiting = self.num_blocks = 0

    def _edited(self, number: int, blocks: Blocks) -> Blocks:
        """Return blocks with the changes made since they were added."""
        for first, change in self._edits:
            if number < first:
                blocks = change(blocks)
        return blocks

    def _flush(self) -> None:
        """Write the blocks that wait, in a file a region and edit."""
        while self._waiting:
            number, _ = self._waiting[0]
            together = [part for n, part in self._waiting if not self._is_edited(number, n)]
            self._write(number, joined(together))
            del self._waiting[: len(together)]
        self._num_waiting = 0

    def _is_edited(self, number: int, later: int) -> bool:
        """Return whether blocks were changed after one number and before a later."""
        return any(number < first <= later for first, _ in self._edits)

    def _write(self, number: int, blocks: Blocks) -> None:
        """Write blocks into a file for each of their regions, all or none."""
        regions, place = np.unique(blocks.index // REGION, axis=0, return_inverse=True)
        written: list[tuple[Region, Path]] = []
        try:
            for k, (x, y, z) in enumerate(regions.tolist()):
                arrays = blocks.part(np.flatnonzero(place.reshape(-1) == k))
                path = self._directory / f'{self._num_written:06d}.npz'
                written.append(((x, y, z), path))
                self._num_written += 1
                save_state(path, vars(arrays), {'kind': 'tsdf archive'}, lasting=False)
        except FileFormatError:
            for _, path in written:
                path.unlink(missing_ok=True)
            raise
        for region, path in written:
            self._files.setdefault(region, []).append((number, path))


def joined(parts: list[Blocks]) -> Blocks:
    """Return the blocks of some parts together."""
    arrays = {
        one.name: np.concatenate([getattr(part, one.name) for part in parts])
        for one in fields(Blocks)
    }
    return Blocks(**arrays)
