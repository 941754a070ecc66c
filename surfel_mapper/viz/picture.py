# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
map.png: a map obliquely from above, and its plan with coordinates beside it.

A compiled kernel draws the discs (rendering.py) and matplotlib the rest: drawn by matplotlib, each
70,000 discs took 2 s. The oblique view is level on the ground and has no perspective, so its scale
bar and the squares of its ground hold anywhere. A line below states the surfels left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import counted, escaped
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.viz.discs import as_bytes, DrawnDiscs, shaded
from surfel_mapper.viz.framing import best_direction, ceiling_m, ground_m, mass_box, upright
from surfel_mapper.viz.rendering import Camera, fitted, Image, rendered, round_length

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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

BALL_PX = 80
"""Size of the legend, a ball of all normals."""

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
    hidden: int = 0

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
        level = turned(self.discs, self.R_level_map)
        R = best_direction(level, *np.array(HEIGHTS_PX) / WIDTH_PX) @ self.R_level_map
        low, high = self._box(R)
        height = WIDTH_PX * (high - low)[1] / (high - low)[0]
        return fitted(R, low, high, WIDTH_PX, int(np.clip(height, *HEIGHTS_PX)))

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

    def rendered(self, camera: Camera) -> tuple[Image, Image]:
        """Return the image of the discs and its depth; light comes from above the ground."""
        colours = as_bytes(shaded(self.discs.normal @ self.R_level_map.T))
        return rendered(camera, self.discs, colours)

    def left_out(self, camera: Camera) -> int:
        """Return the number of discs beyond a view."""
        return len(self.discs) - int(camera.contains(self.discs.position).sum())


def turned(discs: DrawnDiscs, R: Array) -> DrawnDiscs:
    """Return discs in another frame."""
    return DrawnDiscs(discs.position @ R.T, discs.normal @ R.T, discs.radius_m, discs.values)


def draw_map(
    surfels: Surfels,
    path: str | Path,
    title: str = '',
    *,
    trajectory: Array | None = None,
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
    origin_m : (3,) float64, m
        Origin of the map in the fixed frame, ``SurfelMap.origin_m``; the plan has the coordinates
        of the fixed frame.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    origin = np.asarray(origin_m, np.float64)
    scene = MapScene.of(DrawnDiscs.of(surfels), trajectory)
    oblique = scene.oblique()
    plan = scene.plan(oblique.height)
    left_px = BORDER + oblique.width + BETWEEN + DIGIT_PX * digits_of(plan, origin)
    width, height = left_px + plan.width + BORDER, ABOVE + oblique.height + BELOW
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    FigureCanvasAgg(figure)
    page = figure.add_axes((0.0, 0.0, 1.0, 1.0), zorder=2)
    page.set(xlim=(0, width), ylim=(0, height))
    page.axis('off')
    draw_oblique(page, scene, oblique)
    draw_plan(page, scene, plan, origin, left_px)
    draw_key(page, scene, oblique)
    # a name of a file may be no text, or hold dollar signs
    write: dict[str, Any] = {'parse_math': False, 'color': INK}
    note = left_out(scene, oblique, plan)
    for text, y, largest_pt in ((escaped(title), height - 20, TITLE_PT), (note, 36, TEXT_PT)):
        fitting_pt = 72.0 * (width - 40) / DPI / (LETTER * max(len(text), 1))
        page.text(BORDER, y, text, fontsize=min(largest_pt, fitting_pt), va='top', **write)
    with replace_file(path) as file:
        figure.savefig(file, format='png', dpi=DPI, pil_kwargs={'compress_level': 3})


def left_out(scene: MapScene, oblique: Camera, plan: Camera) -> str:
    """Return the sentence about surfels that the views do not show."""
    total = len(scene.discs) + scene.hidden
    outside = [scene.left_out(camera) for camera in (oblique, plan)]
    text = f'Drawn as {counted(total, "surfel")}, large where the map is flat. Not in the views: '
    text += f'{outside[0]:,} on the left, {outside[1]:,} on the right'
    if not all(camera.contains(scene.trajectory).all() for camera in (oblique, plan)):
        text += ', part of the trajectory'
    if scene.hidden:
        text += f', {scene.hidden:,} of the ceiling, above {scene.top_m - scene.ground_m:.1f} m'
    return text + ', and all that face away.'


def draw_oblique(page: Axes, scene: MapScene, camera: Camera) -> None:
    """Draw the discs, the squares of the ground and the trajectory."""
    from matplotlib.patches import Rectangle

    image, depth = scene.rendered(camera)
    line = ground_lines(scene, camera, depth)[..., None]
    shown = image[..., :3] * image[..., 3:] + 1.0 - image[..., 3:]
    place_image(page, shown + line * (LINE - shown), BORDER, BELOW)
    frame = Rectangle((BORDER, BELOW), camera.width, camera.height, fill=False, edgecolor=GRID)
    page.add_patch(frame)
    draw_way(page, scene.trajectory, camera, BORDER)


def place_image(page: Axes, image: npt.NDArray[Any], left_px: int, bottom: int) -> None:
    """Place an image with its lower left corner at a pixel of the page, without resampling."""
    figure: Any = page.figure
    figure.figimage(as_bytes(image), left_px, bottom, origin='upper', zorder=1)


def square_m(camera: Camera) -> float:
    """Return the side of the squares of the ground, m."""
    return round_length(camera.width / camera.px_per_m / 8.0)


def ground_lines(scene: MapScene, camera: Camera, depth: Image) -> Image:
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


def draw_key(page: Axes, scene: MapScene, camera: Camera) -> None:
    """Draw scale bar, axes and the meaning of the colours below the oblique view."""
    text: dict[str, Any] = {'fontsize': TEXT_PT, 'color': INK, 'va': 'center'}
    side, x_px, low = square_m(camera), BORDER + 4, NOTE_PX
    page.plot([x_px, x_px + side * camera.px_per_m], [low + 66] * 2, color=INK, linewidth=2.5)
    page.text(x_px, low + 36, f'{side:g} m, one square of the grid', **text)
    arrow = {'arrowstyle': '->', 'color': INK, 'shrinkA': 0.0, 'shrinkB': 0.0}
    x, y = BORDER + 450, low + 46
    for name, (right, up) in zip('xyz', camera.R_view_map[:2].T.tolist(), strict=True):
        page.annotate('', (x + 36 * right, y + 36 * up), (x, y), arrowprops=arrow)
        shift = 10 if name == 'z' else 0  # another axis may point up as well
        page.text(x + 48 * right - shift, y + 48 * up, name, ha='center', **text)
    edge = BORDER + camera.width - BALL_PX
    across, along = np.meshgrid(np.linspace(-1.0, 1.0, BALL_PX), np.linspace(1.0, -1.0, BALL_PX))
    near = np.sqrt(np.maximum(1.0 - across**2 - along**2, 0.0))
    normal = np.stack([across, along, near], axis=-1) @ camera.R_view_map @ scene.R_level_map.T
    place_image(page, np.dstack([shaded(normal), near > 0.0]), edge, low + 8)
    page.text(edge - 12, low + 46, 'normal', ha='right', **text)
    if len(scene.trajectory):
        width, height = page.get_xlim()[1], page.get_ylim()[1]
        at = (BORDER + 520) / width, (low + 50) / height
        page.legend(fontsize=TEXT_PT, loc='center left', bbox_to_anchor=at, ncols=3, frameon=False)


def draw_plan(page: Axes, scene: MapScene, camera: Camera, origin_m: Array, left_px: int) -> None:
    """Draw the discs from above, with the coordinates of the fixed frame and equal ticks."""
    from matplotlib.ticker import MultipleLocator

    figure: Any = page.figure
    page_px = 2 * tuple(figure.get_size_inches() * DPI)
    ax = figure.add_axes(np.divide((left_px, BELOW, camera.width, camera.height), page_px))
    place_image(page, scene.rendered(camera)[0], left_px, BELOW)
    draw_way(page, scene.trajectory, camera, left_px)
    corners, names = np.stack(camera.limits), []
    for column, axis in enumerate((ax.xaxis, ax.yaxis)):
        row = camera.R_view_map[column]
        number = int(np.abs(row).argmax())
        corners[:, column] = row[number] * corners[:, column] + origin_m[number]
        axis.set_major_locator(MultipleLocator(tick_step(camera, origin_m)))
        names.append(f'{"xyz"[number]} (m)')
    ax.set(xlim=corners[:, 0], ylim=corners[:, 1])
    ax.grid(visible=True, color=GRID, linewidth=0.6)
    ax.spines[:].set_color(GRID)
    ax.tick_params(labelsize=TEXT_PT, colors=INK, length=0.0)
    ax.set_xlabel(names[0], fontsize=TEXT_PT, color=INK, labelpad=1.0)
    ax.set_ylabel(names[1], fontsize=TEXT_PT, color=INK)
    ax.ticklabel_format(useOffset=False, style='plain')


def draw_way(page: Axes, trajectory: Array, camera: Camera, left_px: int) -> None:
    """Draw a trajectory, (S, 3) m, with its start and its end, on the view at a column."""
    from matplotlib.transforms import Bbox

    if not len(trajectory):
        return
    corner = np.array([left_px, BELOW])
    way = (camera.projected(trajectory) - camera.limits[0]) * camera.px_per_m + corner
    dots: dict[str, Any] = {'zorder': 4, 'linestyle': '', 'markeredgecolor': 'white'}
    name, drawn = 'sensor', []
    if len(way) > 1:
        name = 'end'
        drawn += page.plot(*way.T, color='white', linewidth=3.0)
        drawn += page.plot(*way.T, color=RED, linewidth=1.5, label='trajectory')
        drawn += page.plot(*way[:1].T, 'o', color=GREEN, markersize=7.0, label='start', **dots)
    drawn += page.plot(*way[-1:].T, 's', color=RED, markersize=6.0, label=name, **dots)
    for line in drawn:
        line.set_clip_box(Bbox.from_bounds(left_px, BELOW, camera.width, camera.height))
        if left_px != BORDER:
            line.set_label('_')  # the key has each name once


def digits_of(camera: Camera, origin_m: Array) -> int:
    """Return the number of digits of the coordinates of a plan."""
    return len(f'{np.abs(origin_m).max() + np.abs(np.stack(camera.limits)).max():.0f}')


def tick_step(camera: Camera, origin_m: Array) -> float:
    """Return the distance of the ticks of both axes of a plan, m."""
    space = DIGIT_PX * digits_of(camera, origin_m) + GAP_PX
    return round_length(2.0 * space / camera.px_per_m)
