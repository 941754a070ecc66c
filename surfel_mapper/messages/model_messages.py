# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes, surfaces and Gaussians as columns of clouds and as markers.

In clouds, a row is a primitive, or a surfel with its primitive. Every primitive is an oriented
box: centre, axes as a quaternion, edge lengths. The box of a plane is the rectangle around its
points, that of a Gaussian the box around its ellipsoid of two sigma.

As markers, each patch has its own, so a viewer can tell which one is clicked, with a constant
colour that follows from its id. A message begins with a marker that deletes all others, so it is
complete even if messages before it were lost.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import colorsys
from functools import partial
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.geometry import quaternions
from surfel_mapper.messages.markers import (
    ADD,
    DELETE_ALL,
    IDENTITY,
    LINE_LIST,
    Marker,
    TEXT_VIEW_FACING,
    TRIANGLE_LIST,
)
from surfel_mapper.messages.model_packets import rows_of
from surfel_mapper.messages.surfel_markers import shade
from surfel_mapper.models.outlines import next_corners
from surfel_mapper.models.shapes import ellipsoid_corners, ellipsoid_frames, FACES

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels
    from surfel_mapper.models.multi_model import Gaussians, MultiModel
    from surfel_mapper.models.shapes import PatchShape


OPACITY = 0.6
"""Opacity of filled patches, so that surfels are seen through them."""

GREY = (0.62, 0.62, 0.62)
"""Colour of Gaussians."""

MAX_GAUSSIANS = 4000
"""Number of Gaussians drawn, those with most points; 60 corners of 40 bytes each: 10 MB."""

LINE_VOXELS, TEXT_VOXELS = 0.15, 1.0
"""Width of outlines and height of letters, in voxels."""

GOLDEN = 0.618033988749895
"""Golden ratio: steps of the hue by this fraction of a turn stay far apart."""


def primitive_colors(ids: Sequence[int]) -> npt.NDArray[np.float64]:
    """Return the colours of patches by their ids, (K, 3) in [0, 1]."""
    colors = [colorsys.hsv_to_rgb(number * GOLDEN % 1.0, 0.75, 0.9) for number in ids]
    return np.array(colors).reshape(-1, 3)


def model_markers(
    shapes: Sequence[PatchShape],
    gaussians: Gaussians,
    voxel_size_m: float,
    *,
    stamp_ns: int,
    frame_id: str,
) -> list[Marker]:
    """
    Return markers that draw models and delete all earlier ones.

    Parameters
    ----------
    shapes : sequence of PatchShape
        Planes and surfaces.
    gaussians : Gaussians
        Drawn as ellipsoids of two sigma; at most MAX_GAUSSIANS, those with most points.
    voxel_size_m : float
        Unit of the widths of lines and the heights of letters.
    stamp_ns, frame_id : int, str
        Of the models.

    Returns
    -------
    list of Marker
        One that deletes all; ``planes`` or ``surfaces``, ``outlines`` and ``ids`` for each patch,
        with the id of the primitive; and ``gaussians``, if there are any.

    """
    make = partial(Marker, stamp_ns=stamp_ns, frame_id=frame_id)
    markers = [make(ns='', id=0, type=0, action=DELETE_ALL)]
    for shape in shapes:
        markers += patch_markers(shape, voxel_size_m, partial(make, action=ADD))
    if len(gaussians):
        corners = ellipsoid_corners(most_points(gaussians, MAX_GAUSSIANS))
        drawn = corners[:, FACES].reshape(-1, 3, 3)
        markers.append(
            make(
                ns='gaussians',
                id=0,
                type=TRIANGLE_LIST,
                action=ADD,
                points=drawn.reshape(-1, 3),
                colors=shaded(drawn, GREY, 1.0),
            )
        )
    return markers


def patch_markers(
    shape: PatchShape, voxel_size_m: float, make: Callable[..., Marker]
) -> list[Marker]:
    """Return the markers of one patch: filled, its outline, its id."""
    number = shape.patch.id
    (color,) = primitive_colors([number]).tolist()
    above = shape.centre + voxel_size_m * shape.patch.normal
    filled: dict[str, Any] = {'color': (*color, OPACITY)}
    if shape.is_curved:  # viewers do not light markers; unshaded it would look flat
        filled = {'colors': shaded(shape.corners, color, OPACITY)}
    ends = [np.stack([ring, next_corners(ring)], axis=1) for ring in shape.rings]
    return [
        make(
            ns='surfaces' if shape.is_curved else 'planes',
            id=number,
            type=TRIANGLE_LIST,
            points=shape.corners.reshape(-1, 3),
            **filled,
        ),
        make(
            ns='outlines',
            id=number,
            type=LINE_LIST,
            color=(*color, 1.0),
            scale=(LINE_VOXELS * voxel_size_m, 0.0, 0.0),
            points=np.concatenate(ends).reshape(-1, 3),
        ),
        make(
            ns='ids',
            id=number,
            type=TEXT_VIEW_FACING,
            text=str(number),
            scale=(0.0, 0.0, TEXT_VOXELS * voxel_size_m),
            pose=(*above, *IDENTITY[3:]),
        ),
    ]


def shaded(
    corners: npt.NDArray[np.float64], color: Sequence[float], opacity: float
) -> npt.NDArray[np.float32]:
    """Return the shaded colours (3 T, 4) of the corners of triangles (T, 3, 3)."""
    colors = np.empty((len(corners), 3, 4), np.float32)
    colors[..., :3] = shade(corners)[:, None, None] * np.asarray(color, np.float32)
    colors[..., 3] = opacity
    return colors.reshape(-1, 4)


def most_points(gaussians: Gaussians, most: int) -> Gaussians:
    """Return at most ``most`` Gaussians, those with most points."""
    if len(gaussians) <= most:
        return gaussians
    rows = np.sort(np.argsort(-gaussians.num_points, kind='stable')[:most])
    return rows_of(gaussians, rows)


PLANE, SURFACE, GAUSSIAN, NONE = 0, 1, 2, 255
"""Kinds in the column ``kind``."""

Columns = dict[str, npt.NDArray[Any]]

FLOATS = (
    *('x', 'y', 'z', 'normal_x', 'normal_y', 'normal_z', 'd', 'qx', 'qy', 'qz', 'qw'),
    *('extent_x', 'extent_y', 'extent_z', 'area', 'rms'),
)


def primitive_columns(
    shapes: Sequence[PatchShape], gaussians: Gaussians, versions: Mapping[int, int]
) -> Columns:
    """
    Return the columns of ~/primitives: planes, then surfaces, then Gaussians.

    float32: x y z, centre of the box, m; normal_x normal_y normal_z d, best-fit plane
    n . p + d = 0; qx qy qz qw, rotation from the axes of the box to the map; extent_x extent_y
    extent_z, its edges, m; area, m^2; rms, root mean square distance of the points from plane or
    surface, m. normal, d, area and rms are nan for Gaussians. uint32: num_points, id, version.
    uint8: kind, PLANE, SURFACE or GAUSSIAN.

    Parameters
    ----------
    shapes : sequence of PatchShape
        Planes, then surfaces.
    gaussians : Gaussians
        The Gaussians.
    versions : mapping of int to int
        Versions of all primitives, by id.

    """
    floats = np.concatenate([patch_rows(shapes), gaussian_rows(gaussians)])
    ids = [*(shape.patch.id for shape in shapes), *gaussians.id.tolist()]
    numbers = [*(shape.patch.num_points for shape in shapes), *gaussians.num_points.tolist()]
    kinds = [SURFACE if shape.is_curved else PLANE for shape in shapes]
    return {
        **{name: floats[:, k].astype(np.float32) for k, name in enumerate(FLOATS)},
        'num_points': np.array(numbers, np.uint32),
        'id': np.array(ids, np.uint32),
        'version': np.array([versions[number] for number in ids], np.uint32),
        'kind': np.array([*kinds, *[GAUSSIAN] * len(gaussians)], np.uint8),
    }


def patch_rows(shapes: Sequence[PatchShape]) -> npt.NDArray[np.float64]:
    """Return the columns FLOATS (K, 16) of patches."""
    rows = np.empty((len(shapes), len(FLOATS)))
    R_map_patch = np.array([shape.patch.R_patch_map.T for shape in shapes]).reshape(-1, 3, 3)
    rows[:, 7:11] = quaternions(R_map_patch)
    for row, shape in zip(rows, shapes, strict=True):
        patch = shape.patch
        row[:7] = (*shape.centre, *patch.normal, patch.offset_m)
        row[11:] = (*(shape.high - shape.low), shape.area_m2, patch.rms_m)
    return rows


def gaussian_rows(gaussians: Gaussians) -> npt.NDArray[np.float64]:
    """Return the columns FLOATS (G, 16) of Gaussians."""
    rows = np.full((len(gaussians), len(FLOATS)), np.nan)
    R_map_axes, half = ellipsoid_frames(gaussians)
    rows[:, :3] = gaussians.mean
    rows[:, 7:11] = quaternions(R_map_axes)
    rows[:, 11:14] = 2.0 * half
    return rows


def surfel_primitive_columns(surfels: Surfels, model: MultiModel) -> Columns:
    """
    Return the columns of ~/surfel_primitives: one row per surfel.

    x y z, m, normal_x normal_y normal_z (float32); primitive (int32), the id of the primitive of
    the surfel, -1 for none; kind (uint8) of that primitive, NONE for none.

    Parameters
    ----------
    surfels : Surfels
        N surfels.
    model : MultiModel
        Model with N labels.

    """
    kinds = {
        -1: NONE,
        **{plane.id: PLANE for plane in model.planes},
        **{surface.id: SURFACE for surface in model.surfaces},
        **dict.fromkeys(model.gaussians.id.tolist(), GAUSSIAN),
    }
    used, inverse = np.unique(model.labels, return_inverse=True)
    used_kinds = np.array([kinds[number] for number in used.tolist()], np.uint8)
    columns = np.concatenate([surfels.position, surfels.normal], axis=1).astype(np.float32)
    names = (*'xyz', 'normal_x', 'normal_y', 'normal_z')
    return {
        **dict(zip(names, columns.T, strict=True)),
        'primitive': model.labels,
        'kind': used_kinds[inverse] if len(used) else np.empty(0, np.uint8),
    }
