# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The drawings of layers: meshes for the page of a report, a picture of models, a section of HTML.

Layers describe shapes and tables as arrays (layers/drawings.py); only this folder draws them. A
picture is seen without perspective.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.files.atomic import replace_file
from surfel_mapper.geometry import face_normals
from surfel_mapper.layers.drawings import (
    Drawing,
    EllipsoidsDrawing,
    MeshDrawing,
    PointsPicture,
    RingsDrawing,
    Section,
)
from surfel_mapper.models.shapes import CORNERS, FACES
from surfel_mapper.tsdf.mesh import concatenated, EMPTY, Mesh
from surfel_mapper.viz.discs import as_bytes, DrawnDiscs
from surfel_mapper.viz.framing import mass_box
from surfel_mapper.viz.markup import as_html, html_figures, html_table
from surfel_mapper.viz.mesh import MAX_TRIANGLES
from surfel_mapper.viz.rendering import Camera, rendered, round_length

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = npt.NDArray[np.float64]

PANEL_INCH, TEXT_INCH, LEAST_INCH, MOST_INCH, DPI = 6.0, 0.6, 3.0, 9.0, 120
"""Width of a panel, height of its texts, least and greatest height of both, pixels of an inch."""

MARGIN = 0.03
"""Margin of the frame, as a share of its longer side."""

MOST_RADIUS_PX = 4.0
"""Largest radius of a point: points fill the frame if they are evenly spread."""

GROUND, LIGHT, AMBIENT = (0.93, 0.94, 0.95), np.array([-0.35, 0.5, 0.8]), 0.45
"""Background; direction to the light: right, up, towards the viewer; share of all sides."""

EDGE = (0.1, 0.1, 0.1)
"""Colour of outlines."""

MOST_TRIANGLES = 60_000
"""Limit of the triangles of shapes and ellipsoids in a picture."""

NEAR_COLOR, FAR_COLOR = (0.95, 0.75, 0.25), (0.15, 0.2, 0.45)
"""Colours of points by their distance."""

BAR_SHARE = 0.3
"""Largest length of the scale bar, as a share of the width of the frame."""


def draw_points(path: str | Path, picture: PointsPicture) -> None:
    """
    Draw a cloud and its shapes side by side as a PNG file, written whole or not at all.

    Parameters
    ----------
    path : str or Path
        The file.
    picture : PointsPicture
        The cloud, its shapes, and the place they are seen from.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    R = view_axes(picture.points, picture.viewpoint)
    mesh = page_mesh(picture.drawings, MOST_TRIANGLES)
    projected = picture.points @ R[:2].T
    low, high = frame_of(projected)
    outside = int(((projected < low) | (projected > high)).any(axis=1).sum())
    note = f', {outside:,} of them outside' if outside else ''
    aspect = (high[1] - low[1]) / (high[0] - low[0])
    height = min(max(PANEL_INCH * aspect + TEXT_INCH, LEAST_INCH), MOST_INCH)
    size = 2.0 * PANEL_INCH + TEXT_INCH, height
    figure = Figure(figsize=size, dpi=DPI, layout='constrained')
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    fill_points(left, picture.points, R, (low, high))
    fill_shapes(right, mesh, picture.drawings, R)
    titles = picture.titles[0] + note, picture.titles[1]
    for ax, title in zip((left, right), titles, strict=True):
        ax.set(aspect='equal', xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        ax.set(xticks=[], yticks=[], facecolor=GROUND)
        ax.set_title(title, fontsize='medium')
        draw_scale(ax, low, high)
    with replace_file(path) as file:
        figure.savefig(file, format='png')


def frame_of(projected: Array) -> tuple[Array, Array]:
    """Return the corners (2,) of the rectangle of most points (N, 2), m, with a margin."""
    low, high = mass_box(projected, np.ones(len(projected)))
    margin = MARGIN * max(float((high - low).max()), 1e-3)
    return low - margin, high + margin


def fill_points(ax: Axes, points: Array, R: Array, frame: tuple[Array, Array]) -> None:
    """Draw points (N, 3) as discs that close their gaps, with a bar of their distances."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    low, high = frame
    px_per_m = PANEL_INCH * DPI / float(high[0] - low[0])
    width, height = np.rint((high - low) * px_per_m).astype(int).tolist()
    spacing_m = float(np.sqrt(np.prod(high - low) / max(len(points), 1)))
    radius_m = min(spacing_m, MOST_RADIUS_PX / px_per_m)
    distance = -points @ R[2]
    near, far = np.percentile(distance, [1.0, 99.0]) if len(points) else (0.0, 1.0)
    colours = LinearSegmentedColormap.from_list('distance', [NEAR_COLOR, FAR_COLOR])
    scale = ScalarMappable(Normalize(0.0, max(float(far - near), 1e-9), clip=True), colours)
    normals = np.broadcast_to(R[2], points.shape)
    discs = DrawnDiscs(points, normals, np.full(len(points), radius_m))
    camera = Camera(R, 0.5 * (low + high), width, height, px_per_m)
    image, _ = rendered(camera, discs, as_bytes(scale.to_rgba(distance - near)[:, :3]))
    ax.imshow(image, extent=(low[0], high[0], low[1], high[1]), interpolation='nearest')
    bar = ax.figure.colorbar(scale, ax=ax, location='left', shrink=0.5, pad=0.01)
    bar.set_label('distance beyond the nearest (m)', fontsize='small')
    bar.ax.tick_params(labelsize='small')


def fill_shapes(ax: Axes, mesh: Mesh, drawings: Sequence[Drawing], R: Array) -> None:
    """Draw triangles, shaded, and the rings of drawings, from far to near."""
    from matplotlib.collections import PolyCollection

    corners = mesh.vertices[mesh.triangles] @ R.T
    normals = face_normals(corners)
    lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-300)
    lit = np.abs(normals @ (LIGHT / np.linalg.norm(LIGHT))) / lengths
    faces = mesh.colors[mesh.triangles[:, 0]] / 255.0 * (AMBIENT + (1.0 - AMBIENT) * lit)[:, None]
    rings = [
        ring for drawing in drawings if isinstance(drawing, RingsDrawing) for ring in drawing.rings
    ]
    pairs = [np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) @ R.T for ring in rings]
    sides = np.concatenate([np.empty((0, 2, 3)), *pairs])
    depth = np.concatenate([corners[:, :, 2].mean(axis=1), sides[:, :, 2].mean(axis=1)])
    # outlines are on top of their own triangles
    depth[len(corners) :] += 0.01 * max(float(np.ptp(depth)), 1e-9) if len(depth) else 0.0
    order = np.argsort(depth, kind='stable')
    outlines = [*corners[:, :, :2], *sides[:, :, :2]]
    widths = np.repeat([0.5, 0.9], [len(corners), len(sides)])
    colors = np.concatenate([faces, np.tile(EDGE, (len(sides), 1))])
    ax.add_collection(
        PolyCollection(
            [outlines[k] for k in order],
            facecolors=colors[order],
            edgecolors=colors[order],
            linewidths=widths[order],
            closed=False,
        )
    )


def draw_scale(ax: Axes, low: Array, high: Array) -> None:
    """Draw a bar of 1, 2 or 5 times a power of ten metres in the lower left corner."""
    width, height = high - low
    length_m = round_length(BAR_SHARE * width)
    x, y = low[0] + 0.03 * width, low[1] + 0.04 * height
    ax.plot([x, x + length_m], [y, y], color='black', linewidth=3.0, solid_capstyle='butt')
    text = f'{length_m:g} m' if length_m >= 1.0 else f'{100.0 * length_m:g} cm'
    ax.text(x, y + 0.02 * height, text, fontsize='small', bbox={'facecolor': GROUND, 'pad': 2.0})


def page_meshes(drawings: Iterable[Drawing]) -> dict[str, Mesh]:
    """
    Return the meshes for a page by the first part of the drawings' names.

    Ellipsoids become icosahedra, as many, those of largest weight, as fit beside the meshes: a
    page reduces a mesh of more than its share of MAX_TRIANGLES by merging vertices, which mixes
    colours.
    """
    groups: dict[str, list[Drawing]] = {}
    for drawing in drawings:
        groups.setdefault(drawing.name.partition('/')[0], []).append(drawing)
    share = MAX_TRIANGLES // max(len(groups), 1)
    return {name: page_mesh(group, share) for name, group in groups.items()}


def page_mesh(drawings: Sequence[Drawing], max_triangles: int) -> Mesh:
    """Return the meshes among some drawings, and their ellipsoids as icosahedra, as one mesh."""
    meshes = [d.mesh for d in drawings if isinstance(d, MeshDrawing) and len(d.mesh)]
    room = max(max_triangles - sum(map(len, meshes)), 0)
    for drawing in drawings:
        if isinstance(drawing, EllipsoidsDrawing):
            mesh = ellipsoids_mesh(drawing, room // len(FACES))
            room -= len(mesh)
            meshes += [mesh] if len(mesh) else []
    return concatenated(meshes)


def ellipsoids_mesh(drawing: EllipsoidsDrawing, most: int) -> Mesh:
    """Return at most a number of ellipsoids, those of largest weight, as icosahedra."""
    rows = np.sort(np.argsort(-drawing.weights, kind='stable')[:most])
    if not len(rows):
        return EMPTY
    axes = np.swapaxes(drawing.R_map_axes[rows], 1, 2)
    corners = CORNERS * drawing.half_sizes_m[rows, None] @ axes + drawing.centers[rows, None]
    begins = len(CORNERS) * np.arange(len(rows))
    color = np.rint(255.0 * np.asarray(drawing.color[:3])).astype(np.uint8)
    return Mesh(
        vertices=corners.reshape(-1, 3),
        triangles=(FACES + begins[:, None, None]).reshape(-1, 3).astype(np.int32),
        colors=np.tile(color, (corners.size // 3, 1)),
    )


def view_axes(cloud: Array, viewpoint: Array) -> Array:
    """
    Return the axes (3, 3) of a picture as rows: to the right, up, towards the viewer.

    Up is z, as of a map; for a camera that looks along z it is -y. Clouds around the sensor or
    below it are seen obliquely from above.
    """
    ahead: Array = np.zeros(3)
    width = 1e-9
    if len(cloud):
        ahead = cloud.mean(axis=0) - viewpoint
        width = max(width, float(np.linalg.norm(cloud.std(axis=0))))
    length = float(np.linalg.norm(ahead))
    if length <= width or ahead[2] < -0.8 * length:
        ahead, length = np.array([0.0, 0.6, -0.8]), 1.0
    ahead /= length
    up = np.array([0.0, -1.0, 0.0]) if ahead[2] > 0.8 else np.array([0.0, 0.0, 1.0])
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, ahead), -ahead])


def section_html(section: Section, picture: str | Path | None = None) -> str:
    """
    Return a section of a report as HTML.

    Parameters
    ----------
    section : Section
        The texts; they are escaped.
    picture : str or Path, optional
        The picture of the section, a PNG file.

    """
    elements = [f'<h2>{as_html(section.title)}</h2>', html_figures(section.figures)]
    if picture is not None:
        png = base64.b64encode(Path(picture).read_bytes()).decode()
        alt = f'picture: {as_html(section.title)}'
        elements.append(f'<img class="wide" alt="{alt}" src="data:image/png;base64,{png}">')
    if section.table is not None:
        table = section.table
        elements.append(html_table(table.titles, table.rows, table.num_texts, table.colors))
    if section.note:
        elements.append(f'<p class="none">{as_html(section.note)}</p>')
    return ''.join(elements)
