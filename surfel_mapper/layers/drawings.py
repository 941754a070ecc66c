# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Shapes and tables by which a layer describes its pictures, without a library that draws.

A module of its own because viz and layers share it. Coordinates are in the frame of the map, in
metres, colours (K, 3) in [0, 1].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:  # a map without a distance field does not load its kernels
    from surfel_mapper.tsdf.mesh import Mesh

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MeshDrawing:
    """
    Triangles.

    Attributes
    ----------
    name : str
        Path in the viewer, below the map: ``mesh``, ``models/patches``. Drawings whose paths
        begin alike are shown together in the report.
    mesh : Mesh
        The triangles, with colours or without.

    """

    name: str
    mesh: Mesh


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RingsDrawing:
    """
    Closed lines, each with a colour and a label.

    Attributes
    ----------
    name : str
        See MeshDrawing.
    rings : sequence of (M, 3) float64
        Corners; the last is joined to the first.
    colors : (K, 3) float64
    labels : sequence of str

    """

    name: str
    rings: Sequence[Array]
    colors: Array
    labels: Sequence[str]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EllipsoidsDrawing:
    """
    Ellipsoids.

    Attributes
    ----------
    name : str
        See MeshDrawing.
    centers : (K, 3) float64
    half_sizes_m : (K, 3) float64
    R_map_axes : (K, 3, 3) float64
        Directions of the half axes, as columns.
    color : tuple of float
        Colour of all ellipsoids.
    weights : (K,) int64
        If a viewer limits the number, the ellipsoids of largest weight are drawn.

    """

    name: str
    centers: Array
    half_sizes_m: Array
    R_map_axes: npt.NDArray[np.float64]
    color: tuple[float, ...]
    weights: npt.NDArray[np.int64]


Drawing = MeshDrawing | RingsDrawing | EllipsoidsDrawing


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PointsPicture:
    """
    A cloud, and shapes that stand for it, side by side and seen from the same place.

    Attributes
    ----------
    file_name : str
        Name of the PNG file that a replay writes.
    points : (N, 3) float64
        The cloud, coloured by the distance from the viewer.
    drawings : sequence of Drawing
        Shapes, filled, shaded and outlined.
    titles : str, str
        Titles of cloud and shapes.
    viewpoint : (3,) float64

    """

    file_name: str
    points: Array
    drawings: Sequence[Drawing]
    titles: tuple[str, str]
    viewpoint: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """
    A table of a report.

    Attributes
    ----------
    titles : sequence of str
        Titles of the columns.
    num_texts : int
        Columns, from the left, that hold text; the others hold numbers, set to the right.
    rows : sequence of sequence of str
    colors : (R, 3) float64
        Colour of the swatch before each row.

    """

    titles: Sequence[str]
    num_texts: int
    rows: Sequence[Sequence[str]]
    colors: Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """
    A section of a report; all texts are plain, to be escaped.

    Attributes
    ----------
    title : str
    figures : mapping of str to str
        Figures, as text, by name.
    picture : PointsPicture, optional
    table : Table, optional
    note : str
        Text below the table.

    """

    title: str
    figures: Mapping[str, str] = field(default_factory=dict)
    picture: PointsPicture | None = None
    table: Table | None = None
    note: str = ''
