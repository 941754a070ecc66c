# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
map.png: a map obliquely from above, and its plan with coordinates beside it.

A compiled kernel draws the discs (rendering.py) and matplotlib the rest: drawn by matplotlib, each
70,000 discs took 2 s. The oblique view is level on the ground and has no perspective, so its scale
bar and the squares of its ground hold anywhere. A line below states the surfels left out.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import escaped
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.viz.discs import Colouring, DrawnDiscs, label_of, shaded
from surfel_mapper.viz.framing import best_direction, ceiling_m, ground_m, mass_box, upright
from surfel_mapper.viz.rendering import Camera, fitted, rendered, round_length

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

DPI = 160

WIDTH_PX, HEIGHTS_PX, PLAN_PX = 1220, (640, 1000), (420, 820)
"""Width of the oblique view, limits of the height of both, and of the width of the plan."""

LONGER = 1.6
"""A trajectory is shown whole if the view becomes at most this many times as large."""

ABOVE, BELOW, BETWEEN, BORDER = 64, 150, 78, 24
"""Margins: the title; the key and the note below; left of the plan; at the sides, px."""

NOTE_PX = 50
"""Height of the note."""

DIGIT_PX, GAP_PX = 11, 60
"""Width of a digit of a tick, and the space around its number, px."""

TITLE_PT, TEXT_PT, LETTER = 12.0, 8.0, 0.55
"""Font sizes; that of long titles is smaller. Width of a letter relative to it."""

BALL_PX, BAR_PX = 80, (220, 14)
"""Size of the legends: a ball of all normals, a bar of values."""

RED, GREEN, GRID, INK = '#d62728', '#2ca02c', '#dcdfe2', '#4a5054'
LINE, LINE_ALPHA, IN_FRONT_M = 0.25, 0.25, 0.3
"""Grey and opacity of the lines of the ground; surfels above by IN_FRONT_M (m) hide them."""


@dataclass(frozen=True, slots=True, eq=False)
class MapScene:
    """A map as it is drawn: discs, trajectory, and the frame that is level on its ground."""

    discs: DrawnDiscs
    trajectory: Array
    R_level_map: Array
    ground_m: float
    top_m: float = np.inf
    hidden: int = field(default=0)

    @classmethod
    def of(cls, discs: DrawnDiscs, trajectory: Array | None = None) -> MapScene:
        """Return a scene whose discs below a ceiling are drawn."""
        way = np.empty((0, 3)) if trajectory is None else np.asarray(trajectory, np.float64)
        R = upright(discs)
        level = turned(discs, R)
        ground = ground_m(level)
        sensor_m = float(np.median((way @ R.T)[:, 2])) if len(way) else ground + 1.0
        top = ceiling_m(level, sensor_m)
        below = level.position[:, 2] < top
        hidden = len(discs) - int(below.sum())
        return cls(discs.select(below), way, R, ground, top, hidden)

    def oblique(self) -> Camera:
        """Return the oblique view."""
        R = self._direction()
        low, high = self._box(R)
        height = WIDTH_PX * (high - low)[1] / (high - low)[0]
        return fitted(R, low, high, WIDTH_PX, int(np.clip(height, *HEIGHTS_PX)))

    def _direction(self) -> Array:
        level = turned(self.discs, self.R_level_map)
        ends = np.array(HEIGHTS_PX) / WIDTH_PX
        return best_direction(level, *ends) @ self.R_level_map

    def plan(self, height: int) -> Camera:
        """Return the plan along axes of the map, the longer side upwards."""
        near = self.R_level_map[2]
        axis = int(np.abs(near).argmax())
        across, along = (np.eye(3)[a] for a in range(3) if a != axis)
        if np.cross(across, along) @ near < 0.0:
            across, along = along, across
        R = np.stack([across, along, np.cross(across, along)])
        low, high = self._box(R)
        if (high - low)[0] > (high - low)[1]:
            R = np.stack([-along, across, R[2]])
            low, high = self._box(R)
        width = height * (high - low)[0] / (high - low)[1]
        return fitted(R, low, high, int(np.clip(width, *PLAN_PX)), height)

    def _box(self, R_view_map: Array) -> tuple[Array, Array]:
        """Return the corners of the part of a view that has the mass and the trajectory."""
        facing = self.discs.normal @ R_view_map[2]
        rows = facing > 0.0
        at = self.discs.position[rows] @ R_view_map[:2].T
        low, high = mass_box(at, self.discs.radius_m[rows] * facing[rows])
        way = self.trajectory @ R_view_map[:2].T
        if len(way):
            lower, higher = np.minimum(low, way.min(axis=0)), np.maximum(high, way.max(axis=0))
            if (higher - lower).prod() <= LONGER * (high - low).prod():
                return lower, higher
        return low, high

    def colours(self, colouring: Colouring) -> npt.NDArray[np.uint8]:
        """Return the colours of the discs, (K, 3); light comes from above the ground."""
        return colouring.of(turned(self.discs, self.R_level_map, self.discs.position))

    def left_out(self, camera: Camera) -> int:
        """Return the number of discs beyond a view."""
        return len(self.discs) - int(camera.contains(self.discs.position).sum())


def turned(discs: DrawnDiscs, R: Array, position: Array | None = None) -> DrawnDiscs:
    """Return discs in another frame, or at positions with normals of another frame."""
    position = discs.position @ R.T if position is None else position
    return DrawnDiscs(position, discs.normal @ R.T, discs.radius_m, discs.values)


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
        Positions of the sensor; drawn as a line from start to end.
    colouring : str
        One of discs.COLOURINGS.
    origin_m : (3,) float64, m
        Origin of the map in the fixed frame, ``SurfelMap.origin_m``; the plan has the coordinates
        of the fixed frame.

    Raises
    ------
    ConfigError
        If there is no such colouring.
    FileFormatError
        If the file cannot be written.

    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    origin = np.asarray(origin_m, np.float64)
    scene = MapScene.of(DrawnDiscs.of(surfels), trajectory)
    colours = Colouring.over(colouring, [scene.discs])
    oblique = scene.oblique()
    plan = scene.plan(oblique.height)
    labels = BETWEEN + DIGIT_PX * digits_of(plan, origin)
    width = BORDER + oblique.width + labels + plan.width + BORDER
    height = ABOVE + oblique.height + BELOW
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    FigureCanvasAgg(figure)
    ax = axes_at(figure, BORDER, BELOW, oblique.width, oblique.height)
    draw_oblique(ax, scene, oblique, colours)
    draw_key(figure, scene, oblique, colours)
    ax = axes_at(figure, BORDER + oblique.width + labels, BELOW, plan.width, plan.height)
    draw_plan(ax, scene, plan, colours, origin)
    # a name of a file may be no text, or hold dollar signs
    write: dict[str, Any] = {'parse_math': False, 'color': INK}
    points = 72.0 * (width - 40) / DPI / (LETTER * max(len(escaped(title)), 1))
    at = BORDER / width, 1.0 - 20 / height
    size = min(TITLE_PT, points)
    figure.text(*at, escaped(title), fontsize=size, va='top', **write)
    note = left_out(scene, oblique, plan)
    figure.text(BORDER / width, 20 / height, note, fontsize=TEXT_PT, va='bottom', **write)
    with replace_file(path) as file:
        figure.savefig(file, format='png', dpi=DPI, pil_kwargs={'compress_level': 3})


def left_out(scene: MapScene, oblique: Camera, plan: Camera) -> str:
    """Return the sentence about surfels that the views do not show."""
    total = len(scene.discs) + scene.hidden
    outside = [scene.left_out(camera) for camera in (oblique, plan)]
    text = f'{total:,} surfels; beyond the views are {outside[0]:,} on the left, '
    text += f'{outside[1]:,} on the right'
    if not all(camera.contains(scene.trajectory).all() for camera in (oblique, plan)):
        text += ', with a part of the trajectory'
    if scene.hidden:
        text += f'; the ceiling is cut away at {scene.top_m - scene.ground_m:.1f} m above the '
        text += f'ground with {scene.hidden:,}'
    return text + '; those that face away are not drawn.'


def axes_at(figure: Figure, left: int, bottom: int, width: int, height: int) -> Axes:
    """Return axes of a size in pixels."""
    whole = figure.get_size_inches() * DPI
    return figure.add_axes(
        (left / whole[0], bottom / whole[1], width / whole[0], height / whole[1])
    )


def draw_oblique(ax: Axes, scene: MapScene, camera: Camera, colouring: Colouring) -> None:
    """Draw the discs, the squares of the ground and the trajectory."""
    low, high = camera.limits
    image, depth = rendered(camera, scene.discs, scene.colours(colouring))
    line = ground_lines(scene, camera, depth)[..., None]
    image[..., :3] = image[..., :3] * image[..., 3:] + 1.0 - image[..., 3:]
    image[..., :3] += line * (LINE - image[..., :3])
    extent = (low[0], high[0], low[1], high[1])
    ax.imshow(image[..., :3], extent=extent, interpolation='nearest', aspect='auto')
    draw_way(ax, camera.projected(scene.trajectory))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[])
    ax.spines[:].set_color(GRID)


def square_m(camera: Camera) -> float:
    """Return the side of the squares of the ground, m."""
    return round_length(camera.width / camera.px_per_m / 8.0)


def ground_lines(
    scene: MapScene, camera: Camera, depth: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Return how strongly each pixel shows the lines of the squares of the ground, (H, W)."""
    R = camera.R_view_map @ scene.R_level_map.T
    low, high = camera.limits
    right = np.linspace(low[0], high[0], 2 * camera.width + 1)[1::2]
    up = np.linspace(high[1], low[1], 2 * camera.height + 1)[1::2, None]
    near = (scene.ground_m - right * R[0, 2] - up * R[1, 2]) / R[2, 2]
    inside = scene.discs.position[camera.contains(scene.discs.position)]
    at = (inside if len(inside) else np.full((1, 3), 5.0)) @ scene.R_level_map.T
    lines, within, side = np.zeros(depth.shape), depth >= -near - IN_FRONT_M, square_m(camera)
    for axis in (0, 1):
        squares = (right * R[0, axis] + up * R[1, axis] + near * R[2, axis]) / side
        slope = np.hypot(*(R[k, axis] - R[k, 2] / R[2, 2] * R[2, axis] for k in (0, 1)))
        px = slope / (side * camera.px_per_m)
        away = np.abs(squares - np.rint(squares)) / px
        lines = np.maximum(lines, np.clip(1.2 - away, 0.0, 1.0))
        within &= squares > np.floor(at[:, axis].min() / side) - px
        within &= squares < np.ceil(at[:, axis].max() / side) + px
    return np.where(within, LINE_ALPHA * lines, 0.0).astype(np.float32)


def draw_key(figure: Figure, scene: MapScene, camera: Camera, colouring: Colouring) -> None:
    """Draw scale bar, axes and the meaning of the colours below the oblique view."""
    ax = axes_at(figure, BORDER, NOTE_PX, camera.width, BELOW - NOTE_PX)
    ax.set(xlim=(0, camera.width), ylim=(0, BELOW - NOTE_PX))
    ax.axis('off')
    text: dict[str, Any] = {'fontsize': TEXT_PT, 'color': INK, 'va': 'center'}
    side = square_m(camera)
    ax.plot([4, 4 + side * camera.px_per_m], [66, 66], color=INK, linewidth=2.5)
    ax.text(4, 36, f'{side:g} m, a square of the ground', **text)
    for name, axis in zip('xyz', camera.R_view_map[:2].T, strict=True):
        arrow = {'arrowstyle': '->', 'color': INK, 'shrinkA': 0.0, 'shrinkB': 0.0}
        right, up = axis
        ax.annotate('', (450 + 36 * right, 46 + 36 * up), (450, 46), arrowprops=arrow)
        ax.text(450 + 48 * right, 46 + 48 * up, name, ha='center', **text)
    draw_legend(figure, scene, camera, colouring)
    at = camera.width - BALL_PX - 12, 46 if colouring.kind == 'normal' else 78
    ax.text(*at, label_of(colouring.kind), ha='right', **text)
    if len(scene.trajectory):
        draw_way(ax, np.full((min(len(scene.trajectory), 2), 2), -99.0))
        key = ax.legend(
            fontsize=TEXT_PT, loc='center left', bbox_to_anchor=(520 / camera.width, 0.5), ncols=3
        )
        key.set_frame_on(False)


def draw_plan(
    ax: Axes, scene: MapScene, camera: Camera, colouring: Colouring, origin_m: Array
) -> None:
    """Draw the discs from above, with the coordinates of the fixed frame and equal ticks."""
    from matplotlib.ticker import MultipleLocator

    image, _ = rendered(camera, scene.discs, scene.colours(colouring))
    corners, way = np.stack(camera.limits), camera.projected(scene.trajectory)
    names = []
    for column, axis in enumerate((ax.xaxis, ax.yaxis)):
        row = camera.R_view_map[column]
        number = int(np.abs(row).argmax())
        corners[:, column] = row[number] * corners[:, column] + origin_m[number]
        way[:, column] = row[number] * way[:, column] + origin_m[number]
        axis.set_major_locator(MultipleLocator(tick_step(camera, origin_m)))
        names.append(f'{"xyz"[number]} (m)')
    extent = (*corners[:, 0], *corners[:, 1])
    ax.imshow(image, extent=extent, interpolation='nearest', aspect='auto', zorder=2)
    draw_way(ax, way)
    ax.set(xlim=corners[:, 0], ylim=corners[:, 1])
    ax.set_axisbelow(True)
    ax.grid(visible=True, color=GRID, linewidth=0.6)
    ax.spines[:].set_color(GRID)
    ax.tick_params(labelsize=TEXT_PT, colors=INK, length=0.0)
    ax.set_xlabel(names[0], fontsize=TEXT_PT, color=INK, labelpad=1.0)
    ax.set_ylabel(names[1], fontsize=TEXT_PT, color=INK)
    ax.ticklabel_format(useOffset=False, style='plain')


def draw_way(ax: Axes, way: Array) -> None:
    """Draw a trajectory, (S, 2) in the units of the axes, with its start and its end."""
    if not len(way):
        return
    dots: dict[str, Any] = {
        'zorder': 4,
        'linestyle': '',
        'markeredgecolor': 'white',
        'markeredgewidth': 0.8,
    }
    if len(way) > 1:
        ax.plot(*way.T, color='white', linewidth=3.0, zorder=3)
        ax.plot(*way.T, color=RED, linewidth=1.5, zorder=3, label='trajectory')
        ax.plot(*way[:1].T, marker='o', color=GREEN, markersize=7.0, label='start', **dots)
    name = 'end' if len(way) > 1 else 'sensor'
    ax.plot(*way[-1:].T, marker='s', color=RED, markersize=6.0, label=name, **dots)


def draw_legend(figure: Figure, scene: MapScene, camera: Camera, colouring: Colouring) -> None:
    """Draw a ball with the colours of all normals, or a bar with those of all values."""
    right = BORDER + camera.width
    if colouring.kind == 'normal':
        ax = axes_at(figure, right - BALL_PX, NOTE_PX + 8, BALL_PX, BALL_PX)
        x, y = np.meshgrid(np.linspace(-1.0, 1.0, BALL_PX), np.linspace(1.0, -1.0, BALL_PX))
        z = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
        ball = shaded(np.stack([x, y, z], axis=-1) @ camera.R_view_map @ scene.R_level_map.T)
        ax.imshow(np.dstack([ball, x * x + y * y <= 1.0]), interpolation='nearest')
        ax.axis('off')
    elif colouring.has_scale:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        ax = axes_at(figure, right - BAR_PX[0] - 16, NOTE_PX + 42, *BAR_PX)
        values = ScalarMappable(Normalize(colouring.low, colouring.high), 'viridis')
        figure.colorbar(values, cax=ax, orientation='horizontal')
        ax.tick_params(labelsize=TEXT_PT, colors=INK)
        ax.locator_params(nbins=4)


def digits_of(camera: Camera, origin_m: Array) -> int:
    """Return the number of digits of the coordinates of a plan."""
    return len(f'{np.abs(origin_m).max() + np.abs(np.stack(camera.limits)).max():.0f}')


def tick_step(camera: Camera, origin_m: Array) -> float:
    """Return the distance of the ticks of both axes of a plan, m."""
    space = DIGIT_PX * digits_of(camera, origin_m) + GAP_PX
    return round_length(2.0 * space / camera.px_per_m)
