# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Pieces: what each voxel of a map is to the models, kept up to date.

The arrays have a row for each row of the map's slab, so a voxel is found by the map's own hash
table. Class, links and host of a voxel depend on the moments of it and its neighbours alone and
are worked out anew whenever these change at all; so they are the same however the map came about.
Whether a change is worth telling anyone is another question: see ``is_material``.
"""

from __future__ import annotations

from itertools import product
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsLayerConfig
from surfel_mapper.kernels.layout import INDEX_BITS
from surfel_mapper.mapping.moments import unpack_keys
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.models.kernels.piece_classes import classify, FLAT, NONE, tell
from surfel_mapper.models.kernels.pieces import enter, leave, lie_on, link
from surfel_mapper.models.piece_changes import Change, found, Gone

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int32]

LEAST_THICKNESS_M, THICKNESS_VOXELS = 0.02, 0.2
MOVED, TURNED, GREW = 0.1, math.cos(math.radians(2.0)), 1.2
"""A change is material if the mean moves by so much of the thickness, the normal turns farther, or
there are so many times the points."""


class Pieces:
    """
    The voxels of a map as pieces of surfaces.

    Parameters
    ----------
    config : ModelsLayerConfig
        Settings.
    surfel_map : SurfelMap
        What they follow.

    Attributes
    ----------
    key : (R,) int64
        Of the voxel in each row, -1 for none.
    count, position, normal, eigenvalues, covariance, axes
        What it holds; covariance xx xy xz yy yz zz; axes as in models/kernels/piece_classes.py.
    kind, links, around
        See models/kernels/piece_classes.py and models/kernels/pieces.py.
    host : (R,) int32
        The flat neighbour that a voxel lies on which is not flat, -1 for none.
    component : (R,) int32
        What it hangs together with, by the row of the voxel of least key; -1 if not flat.
    label : (R,) int32
        Id of its primitive, -1 for none.
    alone : (R,) bool
        Whether that is a Gaussian, its own.
    is_material : (R,) bool
        Whether it has changed so that it matters.
    places : (R,) int32
        All -1, for kernels that need a number for each row.

    """

    def __init__(self, config: ModelsLayerConfig, surfel_map: SurfelMap) -> None:
        """Begin with no voxels."""
        size_m = surfel_map.voxel_size_m
        self.map = surfel_map
        self.thickness_m = config.flat_thickness_m or max(
            LEAST_THICKNESS_M, THICKNESS_VOXELS * size_m
        )
        offset_m = max(self.thickness_m, 3.0 * config.noise_m)
        self.limit_m = math.hypot(self.thickness_m, 6.0 * config.noise_m)
        variance = (self.limit_m / 6.0) ** 2
        far_sq = 12.5 * (config.reach_voxels * size_m) ** 2  # twice the diagonal, and some
        self._class_rules = (float(config.min_points), variance, size_m)
        self._link_rules = (
            math.cos(math.radians(config.max_angle_deg)),
            offset_m,
            math.cos(math.radians(config.arc_angle_deg)),
            0.5 * offset_m,
            far_sq,
        )
        self._host_rules = (offset_m, variance, far_sq)
        self._tell_rules = ((MOVED * self.thickness_m) ** 2, TURNED, GREW)
        self._absorbs = config.absorb
        steps = half_steps(config.reach_voxels)
        self._steps = np.concatenate([steps, -steps])
        self.clear()

    def clear(self) -> None:
        """Forget all voxels; the next change is the whole map."""
        self._version = -1
        none = np.empty(0, np.int32)
        self.key = np.empty(0, np.int64)
        self.count = np.empty(0, np.int64)
        self.position, self.normal, self.eigenvalues = np.empty((3, 0, 3))
        self.covariance, self.axes = np.empty((0, 6)), np.empty((0, 2, 3))
        self.kind = np.empty(0, np.uint8)
        self.links = np.empty(0, np.uint64)
        self.around = np.empty((0, len(self._steps)), np.int32)
        self.host, self.component, self.label, self.places = (none,) * 4
        self.alone = self.is_material = np.empty(0, np.bool_)
        self._marks = self._is_here = np.empty(0, np.bool_)
        self._told_position, self._told_normal = np.empty((2, 0, 3))
        self._told_count = np.empty(0, np.int64)

    def follow(self) -> Change:
        """Take over what changed in the map since the last call."""
        forgotten = self._forgotten()
        changed = self.map.rows_changed(self._version)
        self._version = self.map.version
        self._make_room(int(changed.max(initial=-1)) + 1)
        new, old = self.map.keys_of(changed), self.key[changed]
        left, here = changed[(old >= 0) & (old != new)], changed[new >= 0]
        gone = forgotten.joined(self._gone(left))
        loose = [gone.component]
        near = self.around[left]
        marked = np.empty(len(self.key), np.int32)
        num = leave(left, self.around, self.links, self._marks, marked)
        self._blank(left)
        came = here[self.key[here] < 0]
        self.key[here] = new[new >= 0]
        gone.return_to(came, self.key, self.label, self.alone)
        keys = (self.key[came][:, None] + self._steps).ravel()
        enter(came, self.map.find(keys).reshape(len(came), len(self._steps)), self.around)
        was_flat = self.kind[here] == FLAT
        self._measure(here)
        is_flat = self.kind[here] == FLAT
        loose.append(self.component[here[was_flat != is_flat]])
        touched = self.component[here]
        self.component[here[~is_flat]] = -1
        self._is_here[here] = True
        state = (self.kind, self.position, self.normal)
        num = link(
            here,
            self._is_here,
            self.around,
            state,
            self._link_rules,
            self.links,
            self._marks,
            marked,
            num,
        )
        self._is_here[here] = self._marks[marked[:num]] = False
        loose.append(self.component[marked[:num]])
        rehosted, old_hosts, new_hosts = self._rehosted(here, near)
        return Change(
            num_voxels=len(here) + len(gone.key),
            rows=np.concatenate([here, rehosted]),
            loose=found(loose),
            touched=found([touched, self.component[old_hosts[old_hosts >= 0]]]),
            hosts=new_hosts[new_hosts >= 0],
            gone=gone.remaining,
        )

    def surfels(self) -> Surfels:
        """Return all voxels as surfels, in the order of their rows."""
        held = np.flatnonzero(self.key >= 0)
        eigenvalues = self.eigenvalues[held]
        e0, e1, e2 = eigenvalues.T
        total = np.where(e2 > 0.0, e0 + e1 + e2, np.nan)
        return Surfels(
            position=self.position[held],
            normal=self.normal[held],
            planarity=2.0 * (e1 - e0) / total,
            curvature=e0 / total,
            eigenvalues=eigenvalues,
            num_points=self.count[held],
            voxel_index=unpack_keys(self.key[held]),
        )

    def _forgotten(self) -> Gone:
        """Forget all voxels where the map has been cleared since, and return them; else none."""
        rows = np.flatnonzero(self.key >= 0)
        if self.map.cleared_at <= self._version:
            rows = rows[:0]
        forgotten = self._gone(rows)
        if len(rows):
            self._blank(rows)
            self.links[:] = 0
            self.around[:] = -1
        return forgotten

    def _gone(self, rows: npt.NDArray[Any]) -> Gone:
        return Gone(self.key[rows], self.label[rows], self.alone[rows], self.component[rows])

    def _make_room(self, num_rows: int) -> None:
        """Give the arrays so many rows."""
        more = max(num_rows, 2 * len(self.key)) - len(self.key)
        if num_rows <= len(self.key):
            return
        empty = dict.fromkeys(('key', 'host', 'component', 'label', 'places', 'around'), -1)
        for name, values in vars(self).items():
            if isinstance(values, np.ndarray) and name != '_steps':
                added = np.full((more, *values.shape[1:]), empty.get(name, 0), values.dtype)
                setattr(self, name, np.concatenate([values, added]))

    def _blank(self, rows: npt.NDArray[Any]) -> None:
        """Forget the voxels of some rows."""
        self.key[rows] = self.host[rows] = self.component[rows] = self.label[rows] = -1
        self.kind[rows] = NONE
        self.alone[rows] = False
        self._told_count[rows] = 0

    def _measure(self, rows: Rows) -> None:
        """Take over what voxels hold, classify them, and see what of it is material."""
        before = self.kind[rows]
        surfels = self.map.surfels_of(rows)
        self.count[rows], self.position[rows] = surfels.num_points, surfels.position
        self.normal[rows], self.eigenvalues[rows] = surfels.normal, surfels.eigenvalues
        self.covariance[rows] = self.map.covariances_of(rows)
        classify(
            rows,
            self.count,
            self.normal,
            self.covariance,
            self._class_rules,
            self.kind,
            self.axes,
        )
        self.is_material[:] = False
        told = (self._told_count, self._told_position, self._told_normal)
        tell(
            rows,
            before,
            self.count,
            self.position,
            self.normal,
            self.kind,
            told,
            self._tell_rules,
            self.is_material,
        )

    def _rehosted(self, here: Rows, emptied: Rows) -> tuple[Rows, Rows, Rows]:
        """Find on which flat neighbours voxels lie: rows, hosts before and now."""
        if not self._absorbs:
            none = np.empty(0, np.int32)
            return none, none, none
        near = np.zeros(len(self.key) + 1, np.bool_)
        near[emptied] = near[self.around[here]] = True  # -1 is the last
        near[here] = True
        rows = np.flatnonzero(near[:-1] & (self.kind != FLAT) & (self.kind != NONE))
        rows = rows.astype(np.int32)
        before = self.host[rows]
        hosts = np.empty(len(rows), np.int32)
        state = (self.kind, self.position, self.normal)
        lie_on(rows, self.around, state, self.covariance, self._host_rules, hosts)
        flat = here[self.kind[here] == FLAT]
        changed = (before != hosts) | self.is_material[rows]
        once = np.concatenate([self.host[flat], before[changed]])
        self.host[flat] = -1
        self.host[rows] = hosts
        return rows[changed], once, hosts[changed]


def half_steps(reach: int) -> npt.NDArray[np.int64]:
    """Return the keys' differences (H,) to the neighbours of greater key, up to so many away."""
    offsets = [step for step in product(range(-reach, reach + 1), repeat=3) if step > (0, 0, 0)]
    x, y, z = np.array(offsets, np.int64).T
    steps: npt.NDArray[np.int64] = (x << (2 * INDEX_BITS)) + (y << INDEX_BITS) + z
    return steps
