# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Surfels as discs: their sizes, colours and triangles, for pictures, the report and the viewer.

Normals vary little along a surface, so that floors, walls and cars are plain areas if discs are
shaded by normal and light. Planarity depends on how the voxels of the lattice cut a wall, and
gives stripes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import Record
from surfel_mapper.errors import ConfigError
from surfel_mapper.mapping.ages import ages_s, last_seen_ns
from surfel_mapper.mapping.surfels import QUALITY, Surfels
from surfel_mapper.mapping.window import WindowedScan

Array = npt.NDArray[np.float64]

COLUMNS = ('planarity', 'curvature', 'num_points', *QUALITY)
"""Columns of Surfels that discs have as values."""

COLOURINGS = ('normal', 'height', *COLUMNS, 'intensity', 'rgb', 'age')
"""Colours of discs: shaded by normal and light, or of a value."""

RGB = ('red', 'green', 'blue')

UNITS = {
    'height': 'm',
    'age': 's',
    'thickness': 'm',
    'normal_sigma': 'rad',
    'radius': 'm',
    'size': 'm',
}
"""Units of values; those of the others are none or unknown."""

LIGHT = np.array([-0.40, -0.55, 0.73])
"""Direction to the light, about of unit length: from above, the south and the west."""

AMBIENT, TINT = 0.45, 0.45
"""Share of the light that comes from all sides, and of the colour that depends on the normal."""

SPREAD = 1.25
"""
Radius of a drawn disc relative to ``Surfels.radius``: just enough that the discs of neighbouring
voxels full of points leave no gaps.
"""

BEYOND = 1.0
"""Values left out at either end of a colour map, per cent."""

CORNERS = 8
"""Corners of a disc; more are not seen at the size of a surfel."""

OUTER = 1.0 / np.cos(np.pi / CORNERS)
"""Radius of the corners of an octagon about a circle of radius 1."""

BEYOND_CELL = 1.0
"""Part of a disc that is drawn beyond its cell, relative to the smallest cell."""

GREY = 0.6
"""Colour of a disc whose value is not known."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DrawnDiscs(Record):
    """
    DrawnDiscs to be drawn.

    Attributes
    ----------
    position : (K, 3) float64, m
    normal : (K, 3) float64
        Of unit length.
    radius_m : (K,) float64
    values : mapping of str to (K,) array
        Further values, shown for a disc that is picked: planarity, num_points, intensity, ...
    grid_m : (3,) float64, m
        A corner of the voxel grid.

    """

    position: Array
    normal: Array
    radius_m: Array
    values: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)
    grid_m: Array = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def of(cls, surfels: Surfels, scans: Sequence[WindowedScan] = ()) -> DrawnDiscs:
        """Return the discs of surfels that have a normal, with their ages in a window of scans."""
        is_known = np.isfinite(surfels.planarity)
        values = {name: getattr(surfels, name) for name in COLUMNS} | dict(surfels.channels)
        if scans:
            newest_ns = max(scan.stamp_ns for scan in scans)
            values['age'] = ages_s(last_seen_ns(surfels.voxel_index, scans), newest_ns)
        return cls(
            surfels.position[is_known],
            surfels.normal[is_known],
            SPREAD * surfels.radius[is_known],
            {name: value[is_known] for name, value in values.items()},
        )

    def __len__(self) -> int:
        """Return the number of discs."""
        return len(self.position)

    def value(self, name: str) -> Array | None:
        """Return a value or the height of each disc, (K,); None without it."""
        values = self.position[:, 2] if name == 'height' else self.values.get(name)
        return None if values is None else np.asarray(values, np.float64)

    def select(self, rows: Any) -> DrawnDiscs:
        """Return selected discs: by a slice, a mask (K,) bool or row indices."""
        columns = (self.position[rows], self.normal[rows], self.radius_m[rows])
        values = {name: value[rows] for name, value in self.values.items()}
        return DrawnDiscs(*columns, values, self.grid_m)

    def cells(self) -> tuple[Array, Array]:
        """
        Return the corners of the cells, from the positions, (K, 3) m each, at which discs end.

        They are farther by BEYOND_CELL, and infinitely far if a size is unknown.
        """
        size_m = self.values.get('size')
        if size_m is None or not len(size_m) or not np.isfinite(size_m).all():
            unlimited = np.full_like(self.position, np.inf)
            return -unlimited, unlimited
        size_m = np.asarray(size_m, np.float64)[:, None]
        from_grid = self.position - self.grid_m
        beyond_m = BEYOND_CELL * size_m.min()
        low = np.floor(from_grid / size_m) * size_m - from_grid
        return low - beyond_m, low + size_m + beyond_m

    def triangles(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
        """
        Return octagons about the discs, which leave no gaps between neighbours.

        Their corners are (8 K, 3), m, pulled in to the cells; the numbers of those of each
        triangle (6 K, 3).
        """
        rows, axis = np.arange(len(self)), np.abs(self.normal).argmax(axis=1)
        facing = self.normal[rows, axis, None]
        turn = np.arange(CORNERS) * (2.0 * np.pi / CORNERS)
        away = np.zeros((len(self), CORNERS, 3))
        away[rows, :, (axis + 1) % 3] = np.cos(turn)
        away[rows, :, (axis + 2) % 3] = np.sin(turn) * np.sign(facing)
        away[rows, :, axis] = -np.einsum('kci,ki->kc', away, self.normal) / facing
        away *= (OUTER * self.radius_m)[:, None, None] / np.linalg.norm(away, axis=2)[..., None]
        low, high = self.cells()
        limit = np.where(away > 0.0, high[:, None], low[:, None])
        shares = np.abs(limit) / np.maximum(np.abs(away), 1e-9)
        away *= np.minimum(shares.min(axis=2), 1.0)[..., None]
        corners = (self.position[:, None] + away).astype(np.float32)
        first = CORNERS * np.arange(len(self), dtype=np.uint32)
        fan = np.array([[0, step, step + 1] for step in range(1, CORNERS - 1)], np.uint32)
        return corners.reshape(-1, 3), (first[:, None, None] + fan).reshape(-1, 3)


@dataclass(frozen=True, slots=True)
class Colouring:
    """
    Colours of discs by one value.

    Attributes
    ----------
    kind : str
        One of COLOURINGS.
    low, high : float
        Values at the ends of the colour map.

    """

    kind: str = 'normal'
    low: float = 0.0
    high: float = 1.0

    @classmethod
    def over(cls, kind: str, drawn: Sequence[DrawnDiscs]) -> Colouring:
        """
        Return a colouring whose ends fit the values of some discs.

        Raises
        ------
        ConfigError
            If there is no such colouring, or no disc has such a value.

        """
        if kind not in COLOURINGS:
            raise ConfigError(f'colouring {kind!r}, expected one of {", ".join(COLOURINGS)}')
        if kind in ('normal', 'planarity'):
            return cls(kind)
        name = RGB[0] if kind == 'rgb' else kind
        columns = [values for discs in drawn if (values := discs.value(name)) is not None]
        if not columns and any(map(len, drawn)):
            names = sorted({name for discs in drawn for name in discs.values})
            raise ConfigError(
                f'colouring {kind!r}: nothing shown has it; its values: {", ".join(names)}'
            )
        values = np.concatenate([np.empty(0), *columns])
        values = values[np.isfinite(values)]
        if kind == 'rgb' or not len(values):
            return cls(kind)
        low, high = np.percentile(values, [BEYOND, 100.0 - BEYOND])
        return cls(kind, float(low), float(max(high, low + 1e-9)))

    def of(self, discs: DrawnDiscs) -> npt.NDArray[np.uint8]:
        """Return the colours of discs, (K, 3)."""
        if self.kind == 'normal':
            return as_bytes(shaded(discs.normal))
        if self.kind == 'rgb' and RGB[0] in discs.values:
            return as_bytes(np.stack([discs.values[name] for name in RGB], axis=1) / 255.0)
        values = discs.value(self.kind)
        if values is None:
            return np.full((len(discs), 3), round(255.0 * GREY), np.uint8)
        return as_bytes(ramp((values - self.low) / (self.high - self.low)))


def shaded(normal: Array) -> Array:
    """Return the colours (K, 3), 0 to 1, of surfaces with these normals in the light."""
    base = (1.0 - TINT) * 0.88 + TINT * (0.5 + 0.5 * normal)
    lit = 0.5 + 0.5 * normal @ LIGHT  # also surfels that face away are not black
    return np.asarray(np.clip(base * (AMBIENT + (1.0 - AMBIENT) * lit)[..., None], 0.0, 1.0))


def ramp(values: Array) -> Array:
    """Return the colours (K, 3), 0 to 1, of values in [0, 1]; grey for nan."""
    from matplotlib import colormaps

    colours = np.asarray(colormaps['viridis'](values)[:, :3], np.float64)
    return np.where(np.isfinite(values)[:, None], colours, GREY)


def as_bytes(colours: Array) -> npt.NDArray[np.uint8]:
    """Return colours in 0 to 1 as bytes."""
    return np.rint(255.0 * np.clip(colours, 0.0, 1.0)).astype(np.uint8)
