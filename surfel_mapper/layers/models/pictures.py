# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Models as drawings: shapes for 3D views, panels of points for a picture, a section of the report.

Every plane and surface has a colour of its own; Gaussians are grey.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import counted
from surfel_mapper.layers.drawings import (
    Drawing,
    EllipsoidsDrawing,
    MeshDrawing,
    PointsPicture,
    RingsDrawing,
    Section,
    Table,
)
from surfel_mapper.messages.model_messages import GREY, primitive_colors
from surfel_mapper.models.multi_model import Gaussians, MultiModel
from surfel_mapper.models.shapes import ellipsoid_frames, PatchShape, shape_of
from surfel_mapper.tsdf.mesh import concatenated, Mesh

PICTURE = 'models.png'

MOST_POINTS = 120_000
"""Maximum number of points drawn of a cloud; a larger one is subsampled evenly."""

MOST_ROWS = 25
"""Rows of the table of a report, for the largest planes and surfaces."""

TITLES = ('id', 'kind', 'area (m\u00b2)', 'points', 'rms (mm)', 'slope (deg)')


def drawings_of(shapes: Sequence[PatchShape], gaussians: Gaussians) -> list[Drawing]:
    """Return patches as a mesh and as rings, and Gaussians as ellipsoids of two sigmas."""
    R_map_axes, half_sizes_m = ellipsoid_frames(gaussians)
    rings = [(shape.patch.id, ring) for shape in shapes for ring in shape.rings]
    return [
        MeshDrawing(name='models/patches', mesh=patches_mesh(shapes)),
        RingsDrawing(
            name='models/outlines',
            rings=[ring for _, ring in rings],
            colors=primitive_colors([number for number, _ in rings]),
            labels=[str(number) for number, _ in rings],
        ),
        EllipsoidsDrawing(
            name='models/gaussians',
            centers=gaussians.mean,
            half_sizes_m=half_sizes_m,
            R_map_axes=R_map_axes,
            color=GREY,
            weights=gaussians.num_points,
        ),
    ]


def patches_mesh(shapes: Sequence[PatchShape]) -> Mesh:
    """Return planes and surfaces as one mesh in their colours."""
    colors = np.rint(255.0 * primitive_colors([shape.patch.id for shape in shapes]))
    meshes = []
    for shape, color in zip(shapes, colors.astype(np.uint8), strict=True):
        painted = np.tile(color, (len(shape.vertices), 1))
        faces = shape.faces.astype(np.int32)
        meshes.append(Mesh(vertices=shape.vertices, triangles=faces, colors=painted))
    return concatenated(meshes)


def picture_of(
    points: npt.NDArray[Any],
    model: MultiModel,
    viewpoint: npt.NDArray[np.float64],
    title: str = '',
) -> PointsPicture:
    """
    Return the picture of a cloud and, beside it, its models.

    Parameters
    ----------
    points : (N, 3) float, m
        The cloud; points that are not finite are left out.
    model : MultiModel
        Its models.
    viewpoint : (3,) float64, m
        Place from which they are seen.
    title : str
        Of the cloud; the number of its points by default.

    """
    cloud = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    kinds = f'{counted(len(model.planes), "plane")}, {counted(len(model.surfaces), "surface")}'
    kinds += f', {counted(len(model.gaussians), "Gaussian")} (2 sigma)'
    return PointsPicture(
        file_name=PICTURE,
        points=cloud[:: -(-len(cloud) // MOST_POINTS) or 1],
        drawings=drawings_of([shape_of(patch) for patch in model.patches], model.gaussians),
        titles=(title or counted(len(points), 'point'), f'{kinds}: {model.size_bytes:,} bytes'),
        viewpoint=viewpoint,
    )


def section_of(
    model: MultiModel, shapes: Sequence[PatchShape], picture: PointsPicture | None = None
) -> Section:
    """Return the section of a report: figures, the picture, and the largest patches."""
    largest = sorted(shapes, key=lambda shape: -shape.area_m2)[:MOST_ROWS]
    labels = model.labels
    in_patches = np.isin(labels, [shape.patch.id for shape in shapes])
    figures = {
        'planes': f'{len(model.planes):,}',
        'surfaces': f'{len(model.surfaces):,}',
        'Gaussians': f'{len(model.gaussians):,}',
        'area of planes': f'{sum(s.area_m2 for s in shapes if not s.is_curved):.1f} m\u00b2',
        'area of surfaces': f'{sum(s.area_m2 for s in shapes if s.is_curved):.1f} m\u00b2',
        'surfels on them': f'{100.0 * in_patches.sum() / max(len(labels), 1):.1f} %',
        'bytes when packed': f'{model.size_bytes:,}',
    }
    note = f'The largest {MOST_ROWS} of {len(shapes):,}.' if len(shapes) > MOST_ROWS else ''
    table = Table(
        titles=TITLES,
        num_texts=2,
        rows=[row_of(shape) for shape in largest],
        colors=primitive_colors([shape.patch.id for shape in largest]),
    )
    return Section(
        title='Planes, surfaces, Gaussians',
        figures=figures,
        picture=picture,
        table=table if largest else None,
        note=note,
    )


def row_of(shape: PatchShape) -> list[str]:
    """Return the row of a plane or surface in the table."""
    patch = shape.patch
    slope_deg = np.degrees(np.arccos(min(abs(patch.normal[2]), 1.0)))
    return [
        str(patch.id),
        'surface' if shape.is_curved else 'plane',
        f'{shape.area_m2:.2f}',
        f'{patch.num_points:,}',
        f'{1e3 * patch.rms_m:.1f}',
        f'{slope_deg:.1f}',
    ]
