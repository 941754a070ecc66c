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

import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.text_table import read_lines

if TYPE_CHECKING:
    from surfel_mapper.tsdf.mesh import Mesh


def read_obj(path: str | Path) -> Mesh:
    """
    Return the polygons of an OBJ file as triangles, without colours.

    Raises
    ------
    FileFormatError
        If the file cannot be read, or has no faces of known vertices.

    """
    from surfel_mapper.tsdf.mesh import Mesh

    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    lines = read_lines(path)
    for number, text in zip(lines.numbers, lines.texts, strict=True):
        kind, *words = text.split()
        try:
            if kind == 'v':
                vertices.append(position(words))
            elif kind == 'f':
                triangles += polygon(words, len(vertices))
        except ValueError as error:
            raise FileFormatError(f'{path}: line {number} is damaged: {error}') from error
    corners = np.array(triangles, np.int64).reshape(-1, 3)
    if not len(corners) or corners.min() < 0 or corners.max() >= len(vertices):
        raise FileFormatError(f'{path}: no faces of its {len(vertices)} vertices')
    return Mesh(
        vertices=np.array(vertices),
        triangles=corners.astype(np.int32),
        colors=np.empty((0, 3), np.uint8),
    )


def position(words: list[str]) -> list[float]:
    """Return the position of a vertex; raise ValueError if it has none."""
    if len(words) < 3:
        raise ValueError(f'{len(words)} numbers, expected 3')
    return [float(word) for word in words[:3]]


def polygon(words: list[str], num_vertices: int) -> list[tuple[int, int, int]]:
    """Return the triangles of a polygon; raise ValueError if a corner is no whole number."""
    numbers = [int(word.partition('/')[0]) for word in words]
    corners = [number - 1 if number > 0 else num_vertices + number for number in numbers]
    if any(abs(corner) >= 2**31 for corner in corners):
        raise ValueError('a corner is no vertex')
    return [(corners[0], *pair) for pair in itertools.pairwise(corners[1:])]
