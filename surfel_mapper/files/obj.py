# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Polygons of OBJ files as triangles, a piece of the file at a time.

A line is ``v x y z`` or ``f`` and the corners of a polygon, a vertex each, perhaps with those of
its texture and normal after a slash; other lines are not read. Vertices count from 1, below zero
from the last one before the line.

On its own because model_files.py only writes.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.budget import Budget
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.text_lines import num_columns, read_lines, TextLines
from surfel_mapper.files.text_table import real, reals

if TYPE_CHECKING:
    from surfel_mapper.tsdf.mesh import Mesh

Whole = npt.NDArray[np.int64]

MAX_VERTICES = 2**31
"""Numbers of vertices have 32 bits in a mesh."""


def read_obj(path: str | Path) -> Mesh:
    """
    Return the polygons of an OBJ file as triangles, without colours.

    Raises
    ------
    FileFormatError
        If the file cannot be read, or has no faces of known vertices.

    """
    from surfel_mapper.tsdf.mesh import Mesh

    vertices: list[npt.NDArray[np.float64]] = [np.empty((0, 3))]
    triangles: list[npt.NDArray[np.int32]] = [np.empty((0, 3), np.int32)]
    known = 0
    budget = Budget.of_file(path, FileFormatError)
    with budget.clock():
        for lines in read_lines(path, budget):
            table = Words(lines)
            is_vertex = table.kinds == b'v'
            before = known + np.cumsum(is_vertex)
            vertices.append(table.vertices(np.flatnonzero(is_vertex)))
            triangles.append(table.triangles(np.flatnonzero(table.kinds == b'f'), before))
            known = int(before[-1])
    found = np.concatenate(triangles)
    if not len(found) or found.min() < 0 or found.max() >= known:
        raise FileFormatError(f'{path}: no faces of its {known} vertices')
    return Mesh(
        vertices=np.concatenate(vertices), triangles=found, colors=np.empty((0, 3), np.uint8)
    )


class Words:
    """
    The words of lines.

    Attributes
    ----------
    kinds : (L,) object
        The first word of each line.

    """

    def __init__(self, lines: TextLines) -> None:
        self._lines = lines
        self._words = np.array(lines.text.split(), object)
        self._number = num_columns(lines.text, None)
        self._begin = np.cumsum(self._number) - self._number
        self.kinds = self._words[self._begin]

    def vertices(self, at: Whole) -> npt.NDArray[np.float64]:
        """Return the positions in the lines at (V,), (V, 3)."""
        short = at[self._number[at] < 4]
        if len(short):
            raise self._damaged(short[0], f'{self._number[short[0]] - 1} numbers, expected 3')
        places = self._begin[at][:, None] + np.arange(1, 4)
        return self._numbers(places.ravel(), np.repeat(at, 3)).reshape(-1, 3)

    def triangles(self, at: Whole, before: Whole) -> npt.NDArray[np.int32]:
        """Return the corners of triangles, (T, 3), of the polygons in the lines at (F,)."""
        num_corners = self._number[at] - 1
        first = np.cumsum(num_corners) - num_corners
        of_line = np.repeat(at, num_corners)
        places = np.arange(len(of_line)) + np.repeat(self._begin[at] + 1 - first, num_corners)
        number = self._numbers(places, of_line)
        odd = np.flatnonzero(~(np.abs(number) < MAX_VERTICES) | (np.trunc(number) != number))
        if len(odd):
            text = self._words[places[odd[0]]].decode()
            raise self._damaged(of_line[odd[0]], f'{text!r} is no vertex')
        corner = np.where(number > 0, number - 1, before[of_line] + number).astype(np.int64)
        num_fans = np.maximum(num_corners - 2, 0)
        start = np.repeat(first, num_fans)
        step = np.arange(len(start)) - np.repeat(np.cumsum(num_fans) - num_fans, num_fans)
        fans = np.stack([start, start + step + 1, start + step + 2], axis=1)
        found = corner[fans]
        return np.where(found < MAX_VERTICES, found, -1).astype(np.int32)

    def _numbers(self, places: Whole, of_line: Whole) -> npt.NDArray[np.float64]:
        """Return the numbers before the slashes in words at (W,), of a line each."""
        words = [word.partition(b'/')[0] for word in self._words[places].tolist()]
        try:
            if b'_' in b' '.join(words):  # Python reads 1_0
                raise ValueError('a _ among the numbers')
            return reals(words)
        except ValueError:
            for word, line in zip(words, of_line.tolist(), strict=True):
                try:
                    real(word)
                except ValueError as error:
                    raise self._damaged(line, str(error)) from error
            raise

    def _damaged(self, line: int, problem: str) -> FileFormatError:
        return FileFormatError(
            f'{self._lines.path}: line {self._lines.numbers[line]} is damaged: {problem}'
        )
