# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The drawings of layers: meshes for the page of a report, a picture of points, a section of HTML.

Layers describe shapes and tables as arrays (layers/drawings.py); only this folder draws them. A
picture is seen without perspective.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from surfel_mapper.files.atomic import replace_file
from surfel_mapper.layers.drawings import (
    Drawing,
    EllipsoidsDrawing,
    MeshDrawing,
    PointsPicture,
    Section,
    Table,
)
from surfel_mapper.models.shapes import CORNERS, FACES
from surfel_mapper.tsdf.mesh import EMPTY, Mesh
from surfel_mapper.viz.charts import as_html
from surfel_mapper.viz.discs import as_bytes, DrawnDiscs
from surfel_mapper.viz.mesh import MAX_TRIANGLES
from surfel_mapper.viz.rendering import fitted, rendered

Array = npt.NDArray[np.float64]

HEIGHT_INCH, PANEL_INCH, TITLE_INCH, DPI = 6.0, 6.5, 0.4, 120

POINT_PX = 1.2
"""Radius of a point."""


def draw_points(path: str | Path, picture: PointsPicture) -> None:
    """
    Draw panels of points side by side as a PNG file, written whole or not at all.

    Parameters
    ----------
    path : str or Path
        The file.
    picture : PointsPicture
        The panels, and the place they are seen from.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    R = view_axes(picture.panels[0].points, picture.viewpoint)
    at = np.concatenate([panel.points @ R[:2].T for panel in picture.panels])
    low, high = (at.min(axis=0), at.max(axis=0)) if len(at) else (-np.ones(2), np.ones(2))
    panel_px = round(PANEL_INCH * DPI), round((HEIGHT_INCH - TITLE_INCH) * DPI)
    camera = fitted(R, low, np.maximum(high, low + 1e-3), *panel_px)
    radius_m = POINT_PX / camera.px_per_m
    size = PANEL_INCH * len(picture.panels), HEIGHT_INCH
    figure = Figure(figsize=size, dpi=DPI)
    FigureCanvasAgg(figure)
    for number, panel in enumerate(picture.panels):
        colors = panel.colors
        if colors is None:
            colors = depth_colors(-panel.points @ R[2])
        normal = np.broadcast_to(R[2], panel.points.shape)
        discs = DrawnDiscs(panel.points, normal, np.full(len(panel.points), radius_m))
        image, _ = rendered(camera, discs, as_bytes(colors[:, :3]))
        across = 1.0 / len(picture.panels)
        ax = figure.add_axes((number * across, 0.0, across, 1.0 - TITLE_INCH / HEIGHT_INCH))
        ax.imshow(image, interpolation='nearest', aspect='auto')
        ax.set_title(panel.title)
        ax.set_axis_off()
    with replace_file(path) as file:
        figure.savefig(file, format='png')


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
    return joined_mesh(meshes)


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


def joined_mesh(meshes: Sequence[Mesh]) -> Mesh:
    """Return some meshes as one; it has colours only if all of them have."""
    if len(meshes) < 2:
        return meshes[0] if meshes else EMPTY
    begins = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])[:-1]
    moved = [mesh.triangles + begin for mesh, begin in zip(meshes, begins, strict=True)]
    has_colors = all(len(mesh.colors) for mesh in meshes)
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        triangles=np.concatenate(moved).astype(np.int32),
        colors=np.concatenate([m.colors for m in meshes]) if has_colors else EMPTY.colors,
    )


def depth_colors(depth: Array) -> Array:
    """Return the colours (N, 3) of points by their distance: near ones are bright."""
    low, high = np.percentile(depth, [1.0, 99.0]) if len(depth) else (0.0, 1.0)
    far = np.clip((depth - low) / max(high - low, 1e-9), 0.0, 1.0)[:, None]
    near_color, far_color = np.array([0.95, 0.75, 0.25]), np.array([0.15, 0.2, 0.45])
    colors: Array = (1.0 - far) * near_color + far * far_color
    return colors


def view_axes(cloud: Array, viewpoint: Array) -> Array:
    """
    Return the axes (3, 3) of a picture as rows: to the right, up, towards the viewer.

    Up is z, as of a map; for a camera that looks along z it is -y.
    """
    ahead = cloud.mean(axis=0) - viewpoint if len(cloud) else np.zeros(3)
    length = float(np.linalg.norm(ahead))
    ahead = ahead / length if length > 1e-9 else np.array([0.0, 0.6, -0.8])
    up = np.array([0.0, -1.0, 0.0]) if abs(ahead[2]) > 0.8 else np.array([0.0, 0.0, 1.0])
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
    cells = ''.join(
        f'<div><dt>{as_html(k)}</dt><dd>{as_html(v)}</dd></div>'
        for k, v in section.figures.items()
    )
    elements = [f'<h2>{as_html(section.title)}</h2>']
    if cells:
        elements.append(f'<dl class="figures">{cells}</dl>')
    if picture is not None:
        png = base64.b64encode(Path(picture).read_bytes()).decode()
        alt = f'picture: {as_html(section.title)}'
        elements.append(f'<img class="wide" alt="{alt}" src="data:image/png;base64,{png}">')
    if section.table is not None:
        elements.append(table_html(section.table))
    if section.note:
        elements.append(f'<p class="none">{as_html(section.note)}</p>')
    return ''.join(elements)


def table_html(table: Table) -> str:
    """Return a table as HTML, with a swatch of colour before each row."""
    num_texts = table.num_texts

    def cells(tag: str, values: Sequence[str]) -> str:
        texts = ''.join(f'<{tag}>{as_html(value)}</{tag}>' for value in values[:num_texts])
        numbers = (f'<{tag} class="number">{as_html(v)}</{tag}>' for v in values[num_texts:])
        return texts + ''.join(numbers)

    rows = []
    for values, color in zip(table.rows, np.asarray(table.colors), strict=True):
        red, green, blue = np.rint(255.0 * color[:3]).astype(int)
        swatch = f'<td class="swatch" style="background: rgb({red} {green} {blue})"></td>'
        rows.append(f'<tr>{swatch}{cells("td", values)}</tr>')
    return f'<table><tr><th></th>{cells("th", table.titles)}</tr>{"".join(rows)}</table>'
