# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Models in pictures: models.png, the triangles of the 3D views, and the section of the report.

models.png shows a cloud, and beside it points sampled from its models. Both are seen from the
position of the sensor, in parallel projection, painted from far to near. Every plane and surface
has a colour of its own; Gaussians are grey.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.files.atomic import replace_file
from surfel_mapper.messages.model_messages import GREY, most_points, primitive_colors
from surfel_mapper.models.multi_model import Gaussians, MultiModel
from surfel_mapper.models.shapes import CORNERS, ellipsoid_corners, FACES, PatchShape
from surfel_mapper.tsdf.mesh import EMPTY, Mesh
from surfel_mapper.viz.mesh import MAX_TRIANGLES

Array = npt.NDArray[np.float64]

MOST_POINTS = 120_000
"""Limit of the points drawn; larger clouds are subsampled."""

MOST_OF_GAUSSIAN = 50
"""Limit of the points drawn for a Gaussian: a voxel of a map may have thousands."""

WIDTH_INCH, HEIGHT_INCH, DPI = 13.0, 6.0, 120


def draw_models(
    path: str | Path,
    points: npt.NDArray[Any],
    model: MultiModel,
    viewpoint: Array,
    title: str = '',
) -> None:
    """
    Draw a cloud and its models as a PNG file, written whole or not at all.

    Parameters
    ----------
    path : str or Path
        The file.
    points : (N, 3) float, m
        The cloud; non-finite points are left out.
    model : MultiModel
        Its models.
    viewpoint : (3,) float64, m
        Position of the viewer.
    title : str
        Title of the cloud; by default its number of points.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    cloud = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    cloud = cloud[:: max(len(cloud) // MOST_POINTS, 1)]
    parts = [patch.samples(0.5 * model.voxel_size_m) for patch in model.patches]
    colors = np.concatenate([primitive_colors([p.id for p in model.patches]), [GREY]])
    few = np.minimum(model.gaussians.num_points, MOST_OF_GAUSSIAN)
    parts.append(replace(model.gaussians, num_points=few).samples())
    made = np.concatenate(parts)
    painted = np.repeat(colors, [len(part) for part in parts], axis=0)
    R = view_axes(cloud, viewpoint)
    figure = Figure(figsize=(WIDTH_INCH, HEIGHT_INCH), dpi=DPI, layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    titles = (
        title or f'{len(points)} points',
        f'{len(model.planes)} planes, {len(model.surfaces)} surfaces, '
        f'{len(model.gaussians)} Gaussians: {model.size_bytes} bytes',
    )
    for ax, title, drawn, shade in zip(
        axes, titles, (cloud, made), (shaded(cloud @ R[2]), painted), strict=True
    ):
        order = np.argsort(-(drawn @ R[2]))
        seen = drawn[order] @ R[:2].T
        ax.scatter(seen[:, 0], seen[:, 1], s=1.5, c=shade[order], linewidths=0)
        ax.set_title(title)
        ax.set_aspect('equal')
        ax.set_axis_off()
    with replace_file(path) as file:
        figure.savefig(file, format='png')


def models_mesh(shapes: Sequence[PatchShape], gaussians: Gaussians | None = None) -> Mesh:
    """Return planes and surfaces, and ellipsoids of Gaussians, as one mesh in their colours."""
    vertices, faces = [shape.vertices for shape in shapes], [shape.faces for shape in shapes]
    colors = [*primitive_colors([shape.patch.id for shape in shapes])]
    if gaussians is not None:
        begins: npt.NDArray[np.int64] = len(CORNERS) * np.arange(len(gaussians))
        vertices.append(ellipsoid_corners(gaussians).reshape(-1, 3))
        faces.append((FACES + begins[:, None, None]).reshape(-1, 3))
        colors.append(np.array(GREY))
    if not vertices:
        return EMPTY
    starts = np.cumsum([0, *map(len, vertices)])[:-1]
    moved = [part + begin for part, begin in zip(faces, starts, strict=True)]
    painted = np.repeat(np.array(colors), [len(part) for part in vertices], axis=0)
    return Mesh(
        vertices=np.concatenate(vertices),
        triangles=np.concatenate(moved).astype(np.int32),
        colors=np.rint(255.0 * painted).astype(np.uint8),
    )


def page_mesh(shapes: Sequence[PatchShape], gaussians: Gaussians) -> Mesh:
    """
    Return the mesh of models for a page: all patches, and the largest Gaussians that fit.

    A mesh above the limit would be simplified by merging vertices, which mixes colours.
    """
    room = max(MAX_TRIANGLES - sum(len(shape.faces) for shape in shapes), 0)
    return models_mesh(shapes, most_points(gaussians, room // len(FACES)))


def shaded(depth: Array) -> Array:
    """Return the colours (N, 3) of points by depth: near points are bright."""
    low, high = np.percentile(depth, [1.0, 99.0]) if len(depth) else (0.0, 1.0)
    far = np.clip((depth - low) / max(high - low, 1e-9), 0.0, 1.0)[:, None]
    near_color, far_color = np.array([0.95, 0.75, 0.25]), np.array([0.15, 0.2, 0.45])
    colors: Array = (1.0 - far) * near_color + far * far_color
    return colors


def view_axes(cloud: Array, viewpoint: Array) -> Array:
    """
    Return the axes of a picture as the rows of (3, 3): right, up, away from the viewer.

    Up is z, or -y for a viewer who looks along z, such as a camera.
    """
    ahead = cloud.mean(axis=0) - viewpoint if len(cloud) else np.zeros(3)
    length = float(np.linalg.norm(ahead))
    ahead = ahead / length if length > 1e-9 else np.array([0.0, 0.6, -0.8])
    up = np.array([0.0, -1.0, 0.0]) if abs(ahead[2]) > 0.8 else np.array([0.0, 0.0, 1.0])
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, ahead), ahead])


MOST_ROWS = 25
"""Limit of the rows of the table: the largest planes and surfaces."""

TITLES = ('area (m\u00b2)', 'points', 'rms (mm)', 'slope (deg)')


def models_section(
    model: MultiModel, shapes: Sequence[PatchShape], picture: str | Path | None = None
) -> str:
    """
    Return the section of a report about models, as HTML.

    Parameters
    ----------
    model : MultiModel
        The models.
    shapes : sequence of PatchShape
        Shapes of its planes and surfaces.
    picture : str or Path, optional
        A PNG file that shows the models.

    """
    largest = sorted(shapes, key=lambda shape: -shape.area_m2)[:MOST_ROWS]
    drawn = ''
    if picture is not None:
        png = base64.b64encode(Path(picture).read_bytes()).decode()
        drawn = f'<img class="models" alt="the models, drawn" src="data:image/png;base64,{png}">'
    note = ''
    if len(shapes) > MOST_ROWS:
        note = f'<p class="none">The largest {MOST_ROWS} of {len(shapes):,}.</p>'
    parts = (figures(model, shapes), drawn, table(largest), note)
    return f'<h2>Planes, surfaces, Gaussians</h2>{"".join(parts)}'


def figures(model: MultiModel, shapes: Sequence[PatchShape]) -> str:
    """Return numbers and sizes of the models, as HTML."""
    labels = model.labels
    in_patches = np.isin(labels, [shape.patch.id for shape in shapes])
    shown = {
        'planes': f'{len(model.planes):,}',
        'surfaces': f'{len(model.surfaces):,}',
        'Gaussians': f'{len(model.gaussians):,}',
        'area of planes': f'{sum(s.area_m2 for s in shapes if not s.is_curved):.1f} m\u00b2',
        'area of surfaces': f'{sum(s.area_m2 for s in shapes if s.is_curved):.1f} m\u00b2',
        'surfels on them': f'{100.0 * in_patches.sum() / max(len(labels), 1):.1f} %',
        'bytes when packed': f'{model.size_bytes:,}',
    }
    cells = ''.join(f'<div><dt>{k}</dt><dd>{v}</dd></div>' for k, v in shown.items())
    return f'<dl class="figures">{cells}</dl>'


def table(shapes: Sequence[PatchShape]) -> str:
    """Return a table of planes and surfaces with their colours; an empty string for none."""
    if not shapes:
        return ''
    rows = ''.join(map(row, shapes))
    numbers = ''.join(f'<th class="number">{title}</th>' for title in TITLES)
    return f'<table><tr><th></th><th>id</th><th>kind</th>{numbers}</tr>{rows}</table>'


def row(shape: PatchShape) -> str:
    """Return the table row of a plane or surface."""
    patch = shape.patch
    red, green, blue = np.rint(255.0 * primitive_colors([patch.id])[0]).astype(int)
    slope_deg = np.degrees(np.arccos(min(abs(patch.normal[2]), 1.0)))
    values = (
        f'{shape.area_m2:.2f}',
        f'{patch.num_points:,}',
        f'{1e3 * patch.rms_m:.1f}',
        f'{slope_deg:.1f}',
    )
    numbers = ''.join(f'<td class="number">{value}</td>' for value in values)
    kind = 'surface' if shape.is_curved else 'plane'
    return (
        f'<tr><td class="swatch" style="background: rgb({red} {green} {blue})"></td>'
        f'<td>{patch.id}</td><td>{kind}</td>{numbers}</tr>'
    )
