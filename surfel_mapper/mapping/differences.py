# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Differences between two maps, voxel by voxel: surfels that came, went and turned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surfel_mapper.arguments import as_real
from surfel_mapper.errors import counted, MapError
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels

FLAT = 0.5
"""Smallest planarity, before and after, of a surfel whose normal can turn."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MapDifferences:
    """
    Differences from one map to another.

    Attributes
    ----------
    came : Surfels
        Surfels of the later map in voxels that had none.
    went : Surfels
        Surfels of the earlier map in voxels that have none now.
    turned : Surfels
        Surfels of the later map whose normals differ by more than the angle.
    num_same : int
        Voxels with a surfel in both maps.
    equal : bool
        Whether the maps are equal to the bit.

    """

    came: Surfels
    went: Surfels
    turned: Surfels
    num_same: int
    equal: bool

    def __str__(self) -> str:
        """Return the counts as a sentence."""
        if self.equal:
            return 'equal to the bit'
        return (
            f'{counted(len(self.came), "surfel")} came, {len(self.went)} went, '
            f'{len(self.turned)} turned; voxels with one in both: {self.num_same:,}'
        )


def diff(
    before: SurfelMap, after: SurfelMap, *, min_points: int = 20, angle_deg: float = 30.0
) -> MapDifferences:
    """
    Return the differences from one map to another.

    Parameters
    ----------
    before, after : SurfelMap
        Maps of one frame and one voxel size.
    min_points : int
        Points that a voxel needs to count as a surfel.
    angle_deg : float
        Angle between normals beyond which a flat surfel (planarity over 0.5) has turned.

    Raises
    ------
    TypeError
        If an argument is no map.
    MapError
        If the maps differ in voxel size or level, or their origins are not a whole number of
        voxels apart.

    Examples
    --------
    >>> import numpy as np
    >>> from surfel_mapper import SurfelMap
    >>> earlier, later = SurfelMap(0.5), SurfelMap(0.5)
    >>> floor = np.random.default_rng(0).uniform([0, 0, 0.2], [2, 2, 0.2], (1000, 3))
    >>> _ = earlier.add(floor), later.add(floor), later.add(floor + [0, 0, 2])
    >>> print(diff(earlier, later))
    16 surfels came, 0 went, 0 turned; voxels with one in both: 16

    """
    for surfel_map in (before, after):
        if not isinstance(surfel_map, SurfelMap):
            raise TypeError(f'diff: a {type(surfel_map).__name__}, expected two SurfelMaps')
    if not 0.0 <= as_real('angle_deg', angle_deg) <= 90.0:  # false for nan
        raise ValueError(f'angle_deg: {angle_deg}, expected 0 to 90 degrees')
    lattices = [(surfel_map.voxel_size_m, surfel_map.level) for surfel_map in (before, after)]
    if lattices[0] != lattices[1]:
        raise MapError(
            f'maps of voxel size {before.voxel_size_m:g} m, level {before.level}, and '
            f'{after.voxel_size_m:g} m, level {after.level}, expected equal ones'
        )
    if not np.array_equal(before.origin_m, after.origin_m):
        before = before.at_origin(after.origin_m)
    old, new = before.surfels(min_points), after.surfels(min_points)
    keys = [pack_keys(surfels.voxel_index) for surfels in (old, new)]
    _, i, j = np.intersect1d(keys[0], keys[1], return_indices=True)
    cosine = np.abs((old.normal[i] * new.normal[j]).sum(axis=1))
    is_flat = np.minimum(old.planarity[i], new.planarity[j]) > FLAT
    return MapDifferences(
        came=new.select(~np.isin(keys[1], keys[0])),
        went=old.select(~np.isin(keys[0], keys[1])),
        turned=new.select(j[is_flat & (cosine < np.cos(np.deg2rad(angle_deg)))]),
        num_same=len(i),
        equal=before == after,
    )
