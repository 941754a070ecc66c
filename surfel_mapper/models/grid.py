# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The part of its plane that a patch covers: cells, and cuts of the boundary cells.

A cut is one byte, in 1/255 of the pitch (2/255 for the triangle), rounded down, so that no point
that the patch was fitted to lies outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.kernels.grid import find_covered, find_covered_squares

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """
    Cells over the plane of a patch, in its frame.

    Attributes
    ----------
    pitch_m : float
        Edge of a cell.
    origin : (2,) float64, m
        Lowest corner of cell (0, 0).
    filled : (Nx, Ny) bool
        Cells that hold points.
    rim : (Nx, Ny) bool
        Boundary cells: filled, with an empty 4-neighbour; cells beyond the grid are empty.
    corner : (Nx, Ny) uint8
        The cut corner of a boundary cell: 1 for its high x, 2 for its high y.
    cuts : (Nx, Ny, 3) uint8
        Cut strips along x and y in 1/255 of the pitch, triangle in 2/255.

    """

    pitch_m: float
    origin: Array
    filled: npt.NDArray[np.bool_]
    rim: npt.NDArray[np.bool_]
    corner: npt.NDArray[np.uint8]
    cuts: npt.NDArray[np.uint8]

    @property
    def _cells(self) -> tuple[npt.NDArray[Any], ...]:
        """The tables, as the kernels take them."""
        return self.filled, self.rim, self.corner, self.cuts

    def contains(self, xy: Array) -> npt.NDArray[np.bool_]:
        """Return which (M, 2) locations in the frame of the patch are covered, (M,) bool."""
        inside = np.empty(len(xy), np.bool_)
        find_covered(xy, self._cells, self.pitch_m, self.origin, inside)
        return inside

    def samples(self, step_m: float) -> Array:
        """Return covered locations (M, 2) at about this spacing, m."""
        per_side = max(round(self.pitch_m / step_m), 1)
        inner = np.argwhere(np.ones((per_side, per_side))) + 0.5
        cells = np.argwhere(self.filled)
        xy: Array = (cells[:, None] + inner / per_side).reshape(-1, 2)
        xy = self.origin + xy * self.pitch_m
        kept: Array = xy[self.contains(xy)]
        return kept

    def mask(self, per_side: int) -> npt.NDArray[np.bool_]:
        """Return which squares are covered at their centre; per_side^2 squares a cell."""
        covered = np.empty(per_side * np.array(self.filled.shape), np.bool_)
        find_covered_squares(per_side, self._cells, self.pitch_m, self.origin, covered)
        return covered

    def area_m2(self, per_side: int = 16) -> float:
        """Return the covered area, m^2, from per_side^2 samples a cell."""
        step_m = self.pitch_m / per_side
        return float(len(self.samples(step_m)) * step_m**2)

    @property
    def size_bytes(self) -> int:
        """Bytes when packed: header, two bits a cell, two bits and three bytes a boundary cell."""
        cuts = int(self.rim.sum())
        return 16 + 2 * -(-self.filled.size // 8) + 3 * cuts + -(-cuts // 4)


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """The cells of all patches, one row each; see models/kernels/grid.py."""

    pitches: Array
    origins: Array
    sizes: Indices
    first: Indices
    sums: Array
    rim: npt.NDArray[np.bool_]
    corner: npt.NDArray[np.uint8]
    cuts: npt.NDArray[np.uint8]

    def of(self, patch: int) -> slice:
        """Return the rows of a patch."""
        begin, (x, y) = int(self.first[patch]), self.sizes[patch].tolist()
        return slice(begin, begin + x * y)

    def grids(self) -> list[Grid]:
        """Return the coverage of every patch; copies, as a view would keep the cells of all."""
        filled = self.sums[:, 3] > 0.0
        rows = zip(self.first.tolist(), self.sizes.tolist(), strict=True)
        spans = [(low, low + x * y, (x, y)) for low, (x, y) in rows]
        return [
            Grid(
                pitch_m=pitch_m,
                origin=origin,
                filled=filled[low:high].reshape(shape).copy(),
                rim=self.rim[low:high].reshape(shape).copy(),
                corner=self.corner[low:high].reshape(shape).copy(),
                cuts=self.cuts[low:high].reshape(*shape, 3).copy(),
            )
            for pitch_m, origin, (low, high, shape) in zip(
                self.pitches.tolist(), self.origins, spans, strict=True
            )
        ]
