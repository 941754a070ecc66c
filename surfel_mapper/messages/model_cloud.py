# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Models as columns of clouds: a row a primitive, or a row a surfel with its primitive.

Every primitive is an oriented box: its middle, its axes as a quaternion, and how long it is along
each. Of a plane that is a rectangle around what it covers, of a Gaussian the box around its
ellipsoid of two sigma.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from surfel_mapper.models.shapes import ellipsoid_frames

if TYPE_CHECKING:
    from surfel_mapper.mapping.surfels import Surfels
    from surfel_mapper.models.multi_model import Gaussians, MultiModel
    from surfel_mapper.models.shapes import PatchShape

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

    x y z, the middle of the box, m; normal_x normal_y normal_z d, of the plane n . p + d = 0
    that the points are nearest to; qx qy qz qw, which turns the axes of the box to those of the
    map; extent_x extent_y extent_z, its edges, m; area, m^2; rms, root mean square distance of
    the points from plane or surface, m; all float32, and normal, d, area and rms nan for
    Gaussians. num_points, id and version (uint32); kind (uint8): PLANE, SURFACE or GAUSSIAN.

    Parameters
    ----------
    shapes : sequence of PatchShape
        Planes, then surfaces.
    gaussians : Gaussians
        The rest.
    versions : mapping of int to int
        Of all of them, by id.

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
        row[:7] = (*shape.middle, *patch.normal, patch.offset_m)
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


def quaternions(R: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return rotations (K, 3, 3) as quaternions xyzw (K, 4)."""
    if not len(R):  # older scipys refuse none
        return np.empty((0, 4))
    found: npt.NDArray[np.float64] = Rotation.from_matrix(R).as_quat()
    return found


def surfel_primitive_columns(surfels: Surfels, model: MultiModel) -> Columns:
    """
    Return the columns of ~/surfel_primitives: a row a surfel.

    x y z, m, normal_x normal_y normal_z (float32), primitive (int32): the id of the primitive
    that it belongs to, -1 for none; and kind (uint8): that of the primitive, NONE for none.

    Parameters
    ----------
    surfels : Surfels
        N of them.
    model : MultiModel
        With a label for each.

    """
    kinds = {
        -1: NONE,
        **{plane.id: PLANE for plane in model.planes},
        **{surface.id: SURFACE for surface in model.surfaces},
        **dict.fromkeys(model.gaussians.id.tolist(), GAUSSIAN),
    }
    used, place = np.unique(model.labels, return_inverse=True)
    found = np.array([kinds[number] for number in used.tolist()], np.uint8)
    columns = np.concatenate([surfels.position, surfels.normal], axis=1).astype(np.float32)
    names = (*'xyz', 'normal_x', 'normal_y', 'normal_z')
    return {
        **dict(zip(names, columns.T, strict=True)),
        'primitive': model.labels,
        'kind': found[place] if len(used) else np.empty(0, np.uint8),
    }
