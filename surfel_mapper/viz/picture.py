# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
map.png: a map from above and from the side, its surfels coloured by planarity.

A surfel is drawn as what it is, a disc seen at an angle: an ellipse, so walls become lines from
above. What faces away from the viewer is left out, because it would hide what matters: from
above the ceiling of a hall, from the side its near wall. The rest is painted from far to near.

Few far surfels would make all others tiny, so the picture ends where either end of an axis has
only one in 200 surfels left.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.io.files import replace_file
from surfel_mapper.mapping.surfels import Surfels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = npt.NDArray[np.float64]

X, Y, Z = 0, 1, 2

FACING_AWAY = -0.2
"""A surfel is left out where the cosine between normal and direction to the viewer is below."""

EDGE_ON = 0.18
"""A disc seen edge-on is drawn this thick, by its radius."""

SPREAD = 1.45
"""
Diameter of a disc by the side of the square whose points spread as far: just enough that the
discs of neighbours that are full of points leave no gaps between them.
"""

BEYOND = 0.5
"""The picture leaves out this many per cent of the surfels at either end of an axis."""

FLATTEST = 0.08
"""No axis is drawn shorter than this by the longest, so that the view of a plane has room."""

WIDTH_INCH, HEIGHT_INCH, DPI = 11.0, 9.0, 160
"""The larger of the two views together takes so much of width or height; labels come on top."""


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


def draw_map(
    surfels: Surfels,
    path: str | Path,
    title: str = '',
    *,
    trajectory: Array | None = None,
) -> None:
    """
    Draw a map as a PNG file, written whole or not at all.

    Parameters
    ----------
    surfels : Surfels
        May be none.
    path : str or Path
        The file.
    title : str
        Stands above.
    trajectory : (S, 3) float64, m, optional
        Where the sensor was; drawn as a line.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = surfels.select(np.isfinite(surfels.planarity))
    low, high = limits(drawn)
    top, side = views(high - low)
    extent = high - low
    heights = [extent[top.up], extent[side.up]]
    size = figure_size(extent[top.right], sum(heights))
    figure = Figure(figsize=size, dpi=DPI, layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 1, gridspec_kw={'height_ratios': heights}, sharex=True)
    for view, ax in zip((top, side), axes, strict=True):
        shown = draw_view(ax, view, drawn, (low, high), trajectory)
    axes[0].set_title(title)
    bar = figure.colorbar(shown, ax=axes, fraction=0.025, pad=0.015)
    bar.set_label('planarity')
    with replace_file(path) as file:
        figure.savefig(file, format='png', bbox_inches='tight', pad_inches=0.15)


def limits(surfels: Surfels) -> tuple[Array, Array]:
    """Return the corners of the box to be drawn, (3,) each; some box where there is no surfel."""
    if not len(surfels):
        return np.full(3, -5.0), np.full(3, 5.0)
    low, high = np.percentile(surfels.position, [BEYOND, 100.0 - BEYOND], axis=0)
    longest = (high - low).max() + float(np.median(sides_m(surfels)))
    margin = np.maximum(0.02 * longest, 0.5 * (FLATTEST * longest - (high - low)))
    return low - margin, high + margin


def sides_m(surfels: Surfels) -> Array:
    """Return the side of the square that spreads as far as the points of each surfel."""
    # along either side of a square the variance is a twelfth of the side squared
    sides: Array = np.sqrt(6.0 * surfels.eigenvalues[:, 1:].sum(axis=1))
    return sides


def views(extent: Array) -> tuple[View, View]:
    """Return the views from above and from the side; the longer way lies across the picture."""
    if extent[X] >= extent[Y]:
        return View(X, Y, Z, (1, 1, 1)), View(X, Z, Y, (1, 1, -1))
    return View(Y, X, Z, (1, -1, 1)), View(Y, Z, X, (1, 1, 1))


def figure_size(width_m: float, height_m: float) -> tuple[float, float]:
    """Return width and height of the figure in inches for what the views show, in metres."""
    inch_per_m = min(WIDTH_INCH / width_m, HEIGHT_INCH / height_m)
    return max(inch_per_m * width_m, 5.0) + 1.5, inch_per_m * height_m + 1.5


def draw_view(
    ax: Axes,
    view: View,
    surfels: Surfels,
    box: tuple[Array, Array],
    trajectory: Array | None,
) -> Any:
    """Draw the surfels that face the viewer, from far to near; return them for the colour bar."""
    from matplotlib.collections import EllipseCollection

    normal_right, normal_up, facing = view.seen(surfels.normal)
    order = np.argsort(view.seen(surfels.position)[2], kind='stable')
    order = order[facing[order] > FACING_AWAY]
    long_m = SPREAD * sides_m(surfels)[order]
    discs = EllipseCollection(
        widths=long_m,
        heights=long_m * np.maximum(np.abs(facing[order]), EDGE_ON),
        angles=np.degrees(np.arctan2(normal_up, normal_right))[order] - 90.0,
        units='xy',
        offsets=surfels.position[order][:, [view.right, view.up]],
        offset_transform=ax.transData,
        array=surfels.planarity[order],
        cmap='viridis',
        clim=(0.0, 1.0),
        linewidths=0.0,
    )
    ax.add_collection(discs)
    if trajectory is not None:
        ax.plot(trajectory[:, view.right], trajectory[:, view.up], color='tab:red', linewidth=1.2)
    frame_view(ax, view, box)
    return discs


def frame_view(ax: Axes, view: View, box: tuple[Array, Array]) -> None:
    """Set limits, equal scales and labels."""
    low, high = box
    up = (low[view.up], high[view.up])
    ax.set_xlim(low[view.right], high[view.right])
    ax.set_ylim(up if view.signs[1] > 0 else up[::-1])
    ax.set_aspect('equal')
    ax.set_xlabel(f'{"xyz"[view.right]} (m)')
    ax.set_ylabel(f'{"xyz"[view.up]} (m)')
    ax.grid(color='0.9')
    ax.set_axisbelow(True)
