# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A map looked at along an axis: which way its axes run, and where on an image things are.

A surfel is drawn as what it is, a disc seen at an angle: an ellipse, so walls become lines from
above. What faces away from the viewer is left out, because it would hide what matters: from
above the ceiling of a hall, from the side its near wall. The rest is painted from far to near.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.surfels import Surfels

Array = npt.NDArray[np.float64]

Discs = tuple[Array, npt.NDArray[np.float32]]
"""Discs and their colours, 0 to 255, as paint_discs takes them."""

FACING_AWAY = -0.2
"""A surfel is left out where the cosine between normal and direction to the viewer is below."""

EDGE_ON = 0.18
"""A disc seen edge-on is drawn this thick, by its radius."""

THINNEST_PX = 0.5
"""Half of what no disc is drawn thinner than, so that there is a pixel in it."""

TICK_COLUMNS, TICK_ROWS = 160, 70
"""Room for a number at a tick, px."""

GRID = 229.5
LINE, LINE_PX = (214, 39, 40), 2.7
"""Grey of the grid; colour and width of the trajectory."""

MOST_DOTS = 200_000
"""A line of any length is drawn by at most so many dots."""


@dataclass(frozen=True, slots=True)
class View:
    """One way to look at the map: the axes to the right, up and towards the viewer."""

    right: int
    up: int
    near: int
    signs: tuple[int, int, int]
    """-1 where the axis of the map runs the other way."""

    def seen(self, vectors: Array) -> Array:
        """Return the components of (K, 3) vectors to the right, up and towards the viewer."""
        columns = vectors.T[[self.right, self.up, self.near]]
        seen: Array = columns * np.array(self.signs, np.float64)[:, None]
        return seen


@dataclass(frozen=True, slots=True)
class Frame:
    """A view of the map on pixels: the corner at its upper left, as ``View.seen`` has it."""

    view: View
    left: float
    top: float
    width: int
    height: int
    px_per_m: float

    @classmethod
    def of(cls, view: View, box: tuple[Array, Array], px_per_m: float) -> Frame:
        """Return the frame that shows a box."""
        low, high = (view.seen(corner[None])[:2, 0] for corner in box)
        width, height = (max(round(abs(side) * px_per_m), 1) for side in high - low)
        return cls(view, low[0], max(low[1], high[1]), width, height, px_per_m)

    def placed(self, positions: Array) -> Array:
        """Return the columns and rows of (K, 3) positions, (K, 2)."""
        right, up, _ = self.view.seen(positions)
        return np.column_stack([right - self.left, self.top - up]) * self.px_per_m - 0.5

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Where the axes of the map end: at the left and the right, below and above."""
        right = self.left + self.width / self.px_per_m
        bottom = self.top - self.height / self.px_per_m
        across, up, _ = self.view.signs
        return (across * self.left, across * right), (up * bottom, up * self.top)

    def ticks(self) -> tuple[Array, Array]:
        """Return round numbers of metres along either axis of the map."""
        from matplotlib.ticker import MaxNLocator

        found = []
        rooms = (self.width // TICK_COLUMNS, self.height // TICK_ROWS)
        for ends, number in zip(self.bounds, rooms, strict=True):
            values = np.asarray(MaxNLocator(max(number, 1)).tick_values(min(ends), max(ends)))
            found.append(values[(values >= min(ends)) & (values <= max(ends))])
        return found[0], found[1]

    def gridded(self) -> npt.NDArray[np.float32]:
        """Return a white image with lines at the ticks, (H, W, 3)."""
        image = np.full((self.height, self.width, 3), 255.0, np.float32)
        (along, up), (across, upwards, _) = self.ticks(), self.view.signs
        columns = np.rint((across * along - self.left) * self.px_per_m - 0.5).astype(np.int64)
        rows = np.rint((self.top - upwards * up) * self.px_per_m - 0.5).astype(np.int64)
        image[:, columns.clip(0, self.width - 1)] = GRID
        image[rows.clip(0, self.height - 1)] = GRID
        return image

    def discs(self, surfels: Surfels, half_m: Array) -> Discs:
        """Return the surfels that face the viewer from far to near, each of half a length."""
        from matplotlib import colormaps

        normal_right, normal_up, facing = self.view.seen(surfels.normal)
        order = np.argsort(self.view.seen(surfels.position)[2], kind='stable')
        order = order[facing[order] > FACING_AWAY]
        half = self.px_per_m * half_m[order]
        thin = half * np.maximum(np.abs(facing[order]), EDGE_ON)
        # across the normal; rows go down
        angle = np.arctan2(normal_right, normal_up)[order]
        sizes = np.maximum(np.column_stack([half, thin]), THINNEST_PX)
        discs = np.column_stack([self.placed(surfels.position[order]), sizes, angle])
        colours = 255.0 * colormaps['viridis'](surfels.planarity[order])[:, :3]
        return discs, colours.astype(np.float32)

    def line(self, positions: Array) -> Discs:
        """Return a line through (S, 3) positions as discs, one for each pixel of its way."""
        places = self.placed(positions)
        steps = np.hypot(*np.diff(places, axis=0).T)
        way = np.concatenate([[0.0], np.cumsum(steps)])[: len(places)]
        at = np.linspace(0.0, way[-1], min(round(way[-1]) + 1, MOST_DOTS)) if len(way) else way
        discs = np.zeros((len(at), 5))
        discs[:, 0], discs[:, 1] = (np.interp(at, way, axis) for axis in places.T)
        discs[:, 2:4] = 0.5 * LINE_PX
        return discs, np.tile(np.array(LINE, np.float32), (len(at), 1))
