# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Planes, surfaces and Gaussians as markers: filled, with outlines and ids.

Each patch has markers of its own, so a viewer tells which one is clicked, and a colour of its own,
which follows from its id and so stays. A message begins with one that deletes all: it holds
everything there is, whatever messages before it were lost, and what is gone is gone from the
picture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import colorsys
from dataclasses import replace
from functools import partial
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.messages.cdr import (
    ADD,
    DELETE_ALL,
    IDENTITY,
    LINE_LIST,
    Marker,
    TEXT_VIEW_FACING,
    TRIANGLE_LIST,
)
from surfel_mapper.messages.mesh_marker import shade
from surfel_mapper.models.outlines import next_corners
from surfel_mapper.models.shapes import ellipsoid_corners, FACES

if TYPE_CHECKING:
    from surfel_mapper.models.multi_model import Gaussians
    from surfel_mapper.models.shapes import PatchShape

OPACITY = 0.6
"""Of what is filled, so that surfels are seen through it."""

GREY = (0.62, 0.62, 0.62)
"""Of Gaussians."""

MAX_GAUSSIANS = 4000
"""Those of most points are drawn, 60 corners of 40 bytes each: 10 MB."""

LINE_VOXELS, TEXT_VOXELS = 0.15, 1.0
"""Width of outlines, and height of letters."""

GOLDEN = 0.618033988749895
"""Hues this far apart do not soon come close to one another again."""


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
    Return markers that draw models in the place of all that was drawn before.

    Parameters
    ----------
    shapes : sequence of PatchShape
        Planes and surfaces.
    gaussians : Gaussians
        What is drawn as ellipsoids of two sigma; of more than MAX_GAUSSIANS those of most points.
    voxel_size_m : float
        What lines and letters are measured in.
    stamp_ns, frame_id : int, str
        Of the models.

    Returns
    -------
    list of Marker
        One that deletes all; ``planes`` or ``surfaces``, ``outlines`` and ``ids`` of each patch,
        whose id is that of the primitive; and ``gaussians``, if there are any.

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
    above = shape.middle + voxel_size_m * shape.patch.normal
    filled: dict[str, Any] = {'color': (*color, OPACITY)}
    if shape.is_curved:  # viewers light no markers, and without shades it would look flat
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
    """Return the colours (3 T, 4) of corners of triangles (T, 3, 3), as light falls on them."""
    colors = np.empty((len(corners), 3, 4), np.float32)
    colors[..., :3] = shade(corners)[:, None, None] * np.asarray(color, np.float32)
    colors[..., 3] = opacity
    return colors.reshape(-1, 4)


def most_points(gaussians: Gaussians, most: int) -> Gaussians:
    """Return at most so many Gaussians, those of most points."""
    if len(gaussians) <= most:
        return gaussians
    rows = np.sort(np.argsort(-gaussians.num_points, kind='stable')[:most])
    return replace(
        gaussians,
        id=gaussians.id[rows],
        num_points=gaussians.num_points[rows],
        mean=gaussians.mean[rows],
        covariance=gaussians.covariance[rows],
    )
