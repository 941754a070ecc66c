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

from surfel_mapper.errors import ConfigError
from surfel_mapper.mapping.surfels import QUALITY, Surfels

Array = npt.NDArray[np.float64]

COLUMNS = ('planarity', 'curvature', 'num_points', *QUALITY)
"""Columns of Surfels that discs have as values."""

COLOURINGS = ('normal', 'height', *COLUMNS, 'intensity', 'rgb', 'age', 'label')
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

CORNERS = 6
"""Corners of a disc; more are not seen at the size of a surfel."""

GREY = 0.6
"""Colour of a disc whose value is not known."""

PALETTE = np.array(
    [
        [31, 119, 180],
        [255, 127, 14],
        [44, 160, 44],
        [214, 39, 40],
        [148, 103, 189],
        [140, 86, 75],
        [227, 119, 194],
        [188, 189, 34],
        [23, 190, 207],
    ],
)
"""Colours of labels, by the label modulo their number."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnDiscs:
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

    """

    position: Array
    normal: Array
    radius_m: Array
    values: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)

    @classmethod
    def of(
        cls, surfels: Surfels, values: Mapping[str, npt.NDArray[Any]] | None = None
    ) -> DrawnDiscs:
        """Return the discs of surfels that have a normal, with further values (K,) of each."""
        is_known = np.isfinite(surfels.planarity)
        all_values = {
            **{name: getattr(surfels, name) for name in COLUMNS},
            **surfels.channels,
            **(values or {}),
        }
        return cls(
            surfels.position[is_known],
            surfels.normal[is_known],
            SPREAD * surfels.radius[is_known],
            {name: value[is_known] for name, value in all_values.items()},
        )

    def __len__(self) -> int:
        """Return the number of discs."""
        return len(self.position)

    def select(self, rows: Any) -> DrawnDiscs:
        """Return selected discs: by a slice, a mask (K,) bool or row indices."""
        values = {name: value[rows] for name, value in self.values.items()}
        return DrawnDiscs(self.position[rows], self.normal[rows], self.radius_m[rows], values)

    def triangles(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
        """
        Return the hexagons about the discs, which leave no gaps between neighbours.

        Their corners are (6 K, 3), m, the numbers of those of each triangle (4 K, 3).
        """
        normal = self.normal
        beside = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
        along = np.cross(normal, beside)
        along *= (2.0 / np.sqrt(3.0) * self.radius_m / np.sqrt((along * along).sum(axis=1)))[
            :, None
        ]
        across = np.cross(normal, along)
        corners = np.empty((len(self), CORNERS, 3), np.float32)
        for corner, turn in enumerate(np.arange(CORNERS) * (2.0 * np.pi / CORNERS)):
            corners[:, corner] = self.position + np.cos(turn) * along + np.sin(turn) * across
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
        valued = [discs for discs in drawn if has_value(discs, kind)]
        if not valued and any(map(len, drawn)):
            names = sorted({name for discs in drawn for name in discs.values})
            raise ConfigError(
                f'colouring {kind!r}: nothing shown has it; its values: {", ".join(names)}'
            )
        if kind in ('rgb', 'label') or not valued:
            return cls(kind)
        values = np.concatenate([value_of(discs, kind) for discs in valued])
        values = values[np.isfinite(values)]
        if not len(values):
            return cls(kind)
        low, high = np.percentile(values, [BEYOND, 100.0 - BEYOND])
        return cls(kind, float(low), float(max(high, low + 1e-9)))

    def of(self, discs: DrawnDiscs) -> npt.NDArray[np.uint8]:
        """Return the colours of discs, (K, 3)."""
        if self.kind == 'normal':
            return as_bytes(shaded(discs.normal))
        if not has_value(discs, self.kind):
            return np.full((len(discs), 3), round(255.0 * GREY), np.uint8)
        if self.kind == 'rgb':
            return as_bytes(np.stack([discs.values[name] for name in RGB], axis=1) / 255.0)
        if self.kind == 'label':
            label = discs.values['label'].astype(np.int64)
            return np.asarray(PALETTE[label % len(PALETTE)], np.uint8)
        values = (value_of(discs, self.kind) - self.low) / (self.high - self.low)
        return as_bytes(ramp(values))


def has_value(discs: DrawnDiscs, kind: str) -> bool:
    """Return whether discs have the value of a colouring."""
    return kind in ('normal', 'height') or (RGB[0] if kind == 'rgb' else kind) in discs.values


def value_of(discs: DrawnDiscs, kind: str) -> Array:
    """Return the values of a colouring, (K,)."""
    return np.asarray(discs.position[:, 2] if kind == 'height' else discs.values[kind], np.float64)


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
