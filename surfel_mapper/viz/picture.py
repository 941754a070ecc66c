# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
map.png: a map from above and from the side, its surfels shaded by normal and light.

A compiled kernel paints the surfels and matplotlib adds the axes: drawn by matplotlib, each 70,000
surfels took 2 s. A surfel is drawn as a disc seen at an angle, an ellipse, so walls become lines
from above. Surfels that face away from the viewer are left out, because they would hide
the others: from above the ceiling of a hall, from the side its near wall. The rest is painted from
far to near.

Frames, colours and axes are one module because each is of no use without the others.

A few distant surfels would make all others tiny, so the picture leaves out half a percent of the
surfels at either end of each axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import ConfigError, escaped
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.viz.discs import ramp, shaded, sides_m, SPREAD
from surfel_mapper.viz.kernels.painting import paint_discs

if TYPE_CHECKING:
    from matplotlib.axes import Axes


Array = npt.NDArray[np.float64]

Discs = tuple[Array, npt.NDArray[np.float32]]
"""Discs and their colours, 0 to 255, in the form that paint_discs takes."""

FACING_AWAY = -0.2
"""Smallest cosine between the normal of a drawn surfel and the direction to the viewer."""

EDGE_ON = 0.18
"""Thickness of a disc seen edge-on, relative to its radius."""

THINNEST_PX = 0.5
"""Smallest half width of a drawn disc, so that it covers a pixel."""

TICK_COLUMNS, TICK_ROWS = 160, 70
"""Space for the number at a tick, px."""

GRID = 229.5
LINE, LINE_PX = (214, 39, 40), 2.7
"""Grey of the grid; colour and width of the trajectory."""

MOST_DOTS = 200_000
"""Limit of the dots that a line is drawn with."""


@dataclass(frozen=True, slots=True)
class View:
    """A viewing direction: the map axes to the right, up and towards the viewer."""

    right: int
    up: int
    near: int
    signs: tuple[int, int, int]
    """-1 for an axis that runs the other way."""

    def projected(self, vectors: Array) -> Array:
        """Return the components of (K, 3) vectors to the right, up and towards the viewer."""
        columns = vectors.T[[self.right, self.up, self.near]]
        components: Array = columns * np.array(self.signs, np.float64)[:, None]
        return components


@dataclass(frozen=True, slots=True)
class Frame:
    """
    A view of the map in pixels; left_m and top_m are its upper left corner, as ``View.projected``.

    ``origin_m`` holds what is added to the coordinates along both axes at the ticks.
    """

    view: View
    left_m: float
    top_m: float
    width: int
    height: int
    px_per_m: float
    origin_m: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(
        cls,
        view: View,
        box: tuple[Array, Array],
        px_per_m: float,
        origin_m: npt.ArrayLike = (0.0, 0.0, 0.0),
    ) -> Frame:
        """Return the frame that shows a box of a map with an origin."""
        low, high = (view.projected(corner[None])[:2, 0] for corner in box)
        width, height = (max(round(abs(side) * px_per_m), 1) for side in high - low)
        origin = np.asarray(origin_m, np.float64)
        at = (float(origin[view.right]), float(origin[view.up]))
        return cls(view, low[0], max(low[1], high[1]), width, height, px_per_m, at)

    def placed(self, positions: Array) -> Array:
        """Return the columns and rows of (K, 3) positions, (K, 2) px."""
        right, up, _ = self.view.projected(positions)
        return np.column_stack([right - self.left_m, self.top_m - up]) * self.px_per_m - 0.5

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Limits of the axes, m: left and right, bottom and top."""
        right = self.left_m + self.width / self.px_per_m
        bottom = self.top_m - self.height / self.px_per_m
        across, up, _ = self.view.signs
        return (across * self.left_m, across * right), (up * bottom, up * self.top_m)

    def ticks(self) -> tuple[Array, Array]:
        """Return the ticks along both axes, which are round numbers once the origin is added."""
        from matplotlib.ticker import MaxNLocator

        ticks = []
        rooms = (self.width // TICK_COLUMNS, self.height // TICK_ROWS)
        for ends, number, origin_m in zip(self.bounds, rooms, self.origin_m, strict=True):
            low, high = min(ends), max(ends)
            locator = MaxNLocator(max(number, 1))
            values = np.asarray(locator.tick_values(low + origin_m, high + origin_m)) - origin_m
            ticks.append(values[(values >= low) & (values <= high)])
        return ticks[0], ticks[1]

    def gridded(self) -> npt.NDArray[np.float32]:
        """Return a white image with lines at the ticks, (H, W, 3)."""
        image = np.full((self.height, self.width, 3), 255.0, np.float32)
        (along, up), (across, upwards, _) = self.ticks(), self.view.signs
        columns = np.rint((across * along - self.left_m) * self.px_per_m - 0.5).astype(np.int64)
        rows = np.rint((self.top_m - upwards * up) * self.px_per_m - 0.5).astype(np.int64)
        image[:, columns.clip(0, self.width - 1)] = GRID
        image[rows.clip(0, self.height - 1)] = GRID
        return image

    def discs(self, surfels: Surfels, half_m: Array, colours: Array) -> Discs:
        """
        Return the surfels that face the viewer as discs, far to near.

        Parameters
        ----------
        surfels : Surfels
            K surfels.
        half_m : (K,) float64, m
            Half sizes of their discs.
        colours : (K, 3) float64
            Red, green and blue, 0 to 1.

        """
        normal_right, normal_up, facing = self.view.projected(surfels.normal)
        order = np.argsort(self.view.projected(surfels.position)[2], kind='stable')
        order = order[facing[order] > FACING_AWAY]
        half = self.px_per_m * half_m[order]
        thin = half * np.maximum(np.abs(facing[order]), EDGE_ON)
        # across the normal; rows go down
        angle = np.arctan2(normal_right, normal_up)[order]
        sizes = np.maximum(np.column_stack([half, thin]), THINNEST_PX)
        discs = np.column_stack([self.placed(surfels.position[order]), sizes, angle])
        return discs, (255.0 * colours[order]).astype(np.float32)

    def line(self, positions: Array) -> Discs:
        """Return a line through (S, 3) positions as discs, one for each pixel of its length."""
        pixels = self.placed(positions)
        steps = np.hypot(*np.diff(pixels, axis=0).T)
        way = np.concatenate([[0.0], np.cumsum(steps)])[: len(pixels)]
        at = np.linspace(0.0, way[-1], min(round(way[-1]) + 1, MOST_DOTS)) if len(way) else way
        discs = np.zeros((len(at), 5))
        discs[:, 0], discs[:, 1] = (np.interp(at, way, axis) for axis in pixels.T)
        discs[:, 2:4] = 0.5 * LINE_PX
        return discs, np.tile(np.array(LINE, np.float32), (len(at), 1))


COLOURINGS = ('normal', 'planarity')
"""Colours of surfels: shaded by normal and light, or planarity by a colour map."""


def colours_of(surfels: Surfels, colouring: str) -> Array:
    """
    Return the colours (K, 3) of surfels, 0 to 1.

    Raises
    ------
    ConfigError
        If there is no such colouring.

    """
    if colouring not in COLOURINGS:
        raise ConfigError(f'colouring {colouring!r}, expected one of {", ".join(COLOURINGS)}')
    return shaded(surfels.normal) if colouring == 'normal' else ramp(surfels.planarity)


X, Y, Z = 0, 1, 2

BEYOND = 0.5
"""Surfels left out at either end of an axis, per cent."""

FLATTEST = 0.08
"""Smallest length of an axis relative to the longest, so that a flat map has a visible side."""

WIDTH_PX, HEIGHT_PX, DPI = 1760, 1440, 160
"""Size of both views together, px; the larger map extent fills one of them. Labels are extra."""

LEFT, RIGHT, BELOW, ABOVE = 120, 170, 90, 60
"""Margins around each view for its labels, on the right for the colour bar, px."""

DIGIT_PX, BESIDE = 15, 55
"""Width of a digit of a number at a tick, and of what is beside the numbers on the left, px."""

SMALLEST_PX = 640
"""Smallest width of the picture."""

TITLE_PT, LETTER = 12.0, 0.55
"""Font size of the title, reduced for long ones, and width of a letter relative to it."""

FRAME_PX = 2
"""Rim of each image left to the frame of the axes, px."""


def draw_map(
    surfels: Surfels,
    path: str | Path,
    title: str = '',
    *,
    trajectory: Array | None = None,
    colouring: str = 'normal',
    origin_m: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> None:
    """
    Draw a map as a PNG file, written whole or not at all.

    Parameters
    ----------
    surfels : Surfels
        The map; may be empty.
    path : str or Path
        The file.
    title : str
        Title above the picture.
    trajectory : (S, 3) float64, m, optional
        Positions of the sensor; drawn as a line.
    colouring : str
        ``normal``: shaded by normal and light; ``planarity``: by a colour map.
    origin_m : (3,) float64, m
        Origin of the map in the fixed frame, ``SurfelMap.origin_m``; the axes have the coordinates
        of the fixed frame.

    Raises
    ------
    ConfigError
        If there is no such colouring.
    FileFormatError
        If the file cannot be written.

    """
    from matplotlib.image import imsave

    drawn = surfels.select(np.isfinite(surfels.planarity))
    colours = colours_of(drawn, colouring)
    box = low, high = limits(drawn)
    both = views(high - low)
    extent = high - low
    px_per_m = min(
        WIDTH_PX / extent[both[0].right], HEIGHT_PX / sum(extent[view.up] for view in both)
    )
    frames = [Frame.of(view, box, px_per_m, origin_m) for view in both]
    pixels, corners = framed(frames, title, colouring)
    for frame, (row, column) in zip(frames, corners, strict=True):
        image = frame.gridded()
        paint_discs(*frame.discs(drawn, 0.5 * SPREAD * sides_m(drawn), colours), image)
        if trajectory is not None and len(trajectory):
            paint_discs(*frame.line(trajectory), image)
        height, width = image.shape[:2]
        inside = image[FRAME_PX : height - FRAME_PX, FRAME_PX : width - FRAME_PX]
        y, x = row + FRAME_PX, column + FRAME_PX
        pixels[y : y + inside.shape[0], x : x + inside.shape[1]] = np.rint(inside)
    with replace_file(path) as file:
        imsave(file, pixels, format='png', dpi=DPI, pil_kwargs={'compress_level': 3})


def limits(surfels: Surfels) -> tuple[Array, Array]:
    """Return the corners of the box to be drawn, (3,) each; 10 m wide for an empty map."""
    if not len(surfels):
        return np.full(3, -5.0), np.full(3, 5.0)
    low, high = np.percentile(surfels.position, [BEYOND, 100.0 - BEYOND], axis=0)
    longest = (high - low).max() + float(np.median(sides_m(surfels)))
    margin = np.maximum(0.02 * longest, 0.5 * (FLATTEST * longest - (high - low)))
    return low - margin, high + margin


def views(extent: Array) -> tuple[View, View]:
    """Return the views from above and from the side, the longer axis to the right."""
    if extent[X] >= extent[Y]:
        return View(X, Y, Z, (1, 1, 1)), View(X, Z, Y, (1, 1, -1))
    return View(Y, X, Z, (1, -1, 1)), View(Y, Z, X, (1, 1, 1))


def framed(
    frames: Sequence[Frame], title: str, colouring: str
) -> tuple[npt.NDArray[np.uint8], list[tuple[int, int]]]:
    """
    Return a picture with empty axes, one below the other; of planarity with a colour bar.

    The second value holds row and column of the upper left corner of each pair of axes. Numbers of
    UTM need a wider margin than LEFT.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

    across = frames[0].width
    digits = max(
        (len(f'{tick + frame.origin_m[1]:.10g}') for frame in frames for tick in frame.ticks()[1]),
        default=0,
    )
    margin = max(LEFT, BESIDE + DIGIT_PX * digits)
    width = max(margin + across + (RIGHT if colouring == 'planarity' else RIGHT // 3), SMALLEST_PX)
    height = ABOVE + sum(frame.height + BELOW for frame in frames)
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    canvas = FigureCanvasAgg(figure)

    def axes_at(row: int, column: int, high: int, wide: int) -> Axes:
        bottom = height - row - high
        return figure.add_axes((column / width, bottom / height, wide / width, high / height))

    corners, row = [], ABOVE
    for frame in frames:
        label(axes_at(row, margin, frame.height, across), frame)
        corners.append((row, margin))
        row += frame.height + BELOW
    if colouring == 'planarity':
        bar = axes_at(ABOVE, margin + across + 30, height - ABOVE - BELOW, 25)
        figure.colorbar(ScalarMappable(cmap='viridis'), cax=bar).set_label(colouring)
    title = escaped(title)  # a name of a file may be no text, or hold dollar signs
    points = 72.0 * (width - 40) / DPI / (LETTER * max(len(title), 1))
    figure.axes[0].set_title(
        title, fontsize=min(TITLE_PT, points), x=0.0, ha='left', parse_math=False
    )
    canvas.draw()
    drawn = np.array(canvas.buffer_rgba())
    return drawn[..., :3], corners


def label(ax: Axes, frame: Frame) -> None:
    """Set limits, ticks and labels of axes from a frame."""
    names = [f'{"xyz"[axis]} (m)' for axis in (frame.view.right, frame.view.up)]
    for axis, ends, ticks, origin_m in zip(
        (ax.xaxis, ax.yaxis), frame.bounds, frame.ticks(), frame.origin_m, strict=True
    ):
        axis.set_ticks(ticks + origin_m)
        axis.set_view_interval(ends[0] + origin_m, ends[1] + origin_m, ignore=True)
    ax.set(xlabel=names[0], ylabel=names[1])
    ax.ticklabel_format(useOffset=False, style='plain')
