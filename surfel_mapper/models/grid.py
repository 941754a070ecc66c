# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The area of its plane that a patch covers: cells, and cuts of the boundary cells.

A cut is one byte, in 1/255 of the pitch (2/255 for the triangle), rounded down, so that no point
that the patch was fitted to lies outside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import Record
from surfel_mapper.models.kernels.coverage import box_patches, cut_rims, mark_rims, sum_cells

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

CUT_STEP = 16.0
"""Cuts are multiples of this byte: a sixteenth of a cell. Finer ones make files larger by 2 %."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Grid(Record):
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
    corner : (Nx, Ny) uint8
        The cut corner of a boundary cell: 1 for its high x, 2 for its high y.
    cuts : (Nx, Ny, 3) uint8
        Cut strips along x and y in 1/255 of the pitch, triangle in 2/255.

    """

    pitch_m: float
    origin: Array
    filled: npt.NDArray[np.bool_]
    corner: npt.NDArray[np.uint8]
    cuts: npt.NDArray[np.uint8]

    @property
    def rim(self) -> npt.NDArray[np.bool_]:
        """Boundary cells (Nx, Ny): filled, with an empty 4-neighbour or none."""
        wide = np.zeros(np.add(self.filled.shape, 2), np.bool_)
        wide[1:-1, 1:-1] = self.filled
        inner = wide[:-2, 1:-1] & wide[2:, 1:-1] & wide[1:-1, :-2] & wide[1:-1, 2:]
        rim: npt.NDArray[np.bool_] = self.filled & ~inner
        return rim

    def contains(self, xy: Array) -> npt.NDArray[np.bool_]:
        """Return which (M, 2) locations in the frame of the patch are covered, (M,) bool."""
        offset, shape = xy - self.origin, np.array(self.filled.shape)
        cell = np.floor(offset / self.pitch_m)
        # the last point of a grid may stand on its end
        cell = np.where(offset <= shape * self.pitch_m, np.minimum(cell, shape - 1), cell)
        inside = np.asarray(((cell >= 0) & (cell < shape)).all(axis=1), np.bool_)
        x, y = cell[inside].astype(np.int64).T
        inside[inside] = self.filled[x, y] & ~self._is_cut_off(offset[inside], x, y)
        return inside

    def _is_cut_off(self, offset: Array, x: Indices, y: Indices) -> npt.NDArray[np.bool_]:
        """Return which offsets (M, 2) from the origin, m, are cut off their cells."""
        corner, cuts = self.corner[x, y], self.cuts[x, y]
        from_x = np.abs(offset[:, 0] - (x + (corner & 1)) * self.pitch_m)
        from_y = np.abs(offset[:, 1] - (y + (corner >> 1)) * self.pitch_m)
        strip, triangle = self.pitch_m / 255.0, 2.0 * self.pitch_m / 255.0
        cut_off: npt.NDArray[np.bool_] = (
            (from_x < cuts[:, 0] * strip)
            | (from_y < cuts[:, 1] * strip)
            | (from_x + from_y < cuts[:, 2] * triangle)
        )
        return cut_off

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
        covered = self.filled.repeat(per_side, axis=0).repeat(per_side, axis=1)
        cells = np.argwhere(self.rim)  # only these are cut
        inner = np.argwhere(np.ones((per_side, per_side), np.bool_))
        squares = (per_side * cells[:, None] + inner).reshape(-1, 2)
        x, y = cells.repeat(per_side**2, axis=0).T
        offset = np.asarray((squares + 0.5) * (self.pitch_m / per_side), np.float64)
        covered[squares[:, 0], squares[:, 1]] = ~self._is_cut_off(offset, x, y)
        return covered

    def area_m2(self, per_side: int = 16) -> float:
        """Return the covered area, m^2, from per_side^2 samples a cell."""
        step_m = self.pitch_m / per_side
        return float(len(self.samples(step_m)) * step_m**2)


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """
    The cells of K patches, C rows, patch after patch, y within x.

    Attributes
    ----------
    pitches : (K,) float64, m
        Edge of the cells of each patch.
    origins : (K, 2) float64, m
        Lowest corner of the grid of each.
    sizes : (K, 2) int64
        Cells along x and y.
    first : (K,) int64
        First cell of each patch.
    sums : (C, 4) float64
        Sums of x, y and z of the points in each cell, and their number.
    points : tuple
        Points in the frames of their patches, (N, 3) float64, m, and the first of each, (K + 1,).
    corner, cuts : (C,) uint8, (C, 3) uint8
        See Grid.

    """

    pitches: Array
    origins: Array
    sizes: Indices
    first: Indices
    sums: Array
    points: tuple[Array, Indices]
    corner: npt.NDArray[np.uint8]
    cuts: npt.NDArray[np.uint8]

    @classmethod
    def around(
        cls,
        local: Array,
        patch: Indices,
        pitches: Array,
        margin_m: float | None,
        *,
        snapped: bool,
    ) -> Cells:
        """
        Return the cells that hold points, and cut the boundary cells.

        A boundary cell loses two strips and a triangle that hold no points, at the corner
        farthest from the mean of its points, unless the three other cells there hold points.

        Parameters
        ----------
        local : (N, 3) float64, m
            Points in the frames of their patches.
        patch : (N,) int64
            Patch of each point, ascending; each has points.
        pitches : (K,) float64, m
            Edges of the cells.
        margin_m : float or None
            Distance left between a cut and the points, m; None leaves boundary cells whole.
        snapped : bool
            Whether grids start at multiples of their pitch, else at the first point.

        """
        low, high = np.empty((2, len(pitches), 2))
        box_patches(local, patch, low, high)
        origins = np.floor(low / pitches[:, None]) * pitches[:, None] if snapped else low
        sizes = ((high - origins) / pitches[:, None]).astype(np.int64) + 1
        ends = sizes.prod(axis=1).cumsum()
        first, total = ends - sizes.prod(axis=1), int(ends[-1]) if len(ends) else 0
        grids, rows = (pitches, origins, sizes, first), np.empty(len(local), np.int64)
        sums: Array = np.zeros((total, 4))
        sum_cells(local, patch, grids, rows, sums)
        rim, surrounded = np.zeros((2, total), np.bool_)
        corner, cuts = np.zeros(total, np.uint8), np.zeros((total, 3), np.uint8)
        if margin_m is not None:
            mark_rims(grids, sums, rim, corner, surrounded)
            least = np.full((total, 3), np.inf)
            cut_rims(local, patch, rows, grids, rim, corner, least)
            cut = np.flatnonzero(rim & ~surrounded)
            steps = np.repeat(pitches, sizes.prod(axis=1))[cut, None] * (CUT_STEP / 255.0)
            free_m = least[cut] - margin_m * np.array([1.0, 1.0, np.sqrt(2.0)])
            number = np.floor(free_m / (steps * np.array([1.0, 1.0, 2.0])))
            cuts[cut] = np.clip(CUT_STEP * number, 0.0, 255.0).astype(np.uint8)
        points = local, np.searchsorted(patch, np.arange(len(pitches) + 1))
        return cls(pitches, origins, sizes, first, sums, points, corner, cuts)

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
                corner=self.corner[low:high].reshape(shape).copy(),
                cuts=self.cuts[low:high].reshape(*shape, 3).copy(),
            )
            for pitch_m, origin, (low, high, shape) in zip(
                self.pitches.tolist(), self.origins, spans, strict=True
            )
        ]
