# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
SurfelGraph: class, links, components and labels of the voxels of a map, updated incrementally.

The arrays have a row for each row of the map's slab, so voxels are found by the map's own hash
table. Class, links and host of a voxel depend on the moments of it and its neighbours only, and
are recomputed whenever these change, so they do not depend on the map's history. Whether a change
is worth reporting is a separate question: see ``is_material``.

A voxel may move to another row when a map is cleared and restored; it keeps its label.
"""

from __future__ import annotations

from dataclasses import dataclass
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
from surfel_mapper.models.kernels.surfel_classes import (
    classify,
    classify_sparse,
    FLAT,
    mark_material,
    NONE,
)
from surfel_mapper.models.kernels.surfel_links import (
    find_hosts,
    link_neighbours,
    ROUNDS,
    spread,
    unlink,
    update_links,
)

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int32]

LEAST_THICKNESS_M, THICKNESS_VOXELS = 0.02, 0.2
"""Default thickness of a flat voxel, 6 sigma: a share of its size, at least LEAST_THICKNESS_M."""
MOVED, TURNED, GREW = 0.1, math.cos(math.radians(2.0)), 1.2
"""
A change is material if the mean moves by more than MOVED thicknesses, the cosine between the
normals falls below TURNED, or the number of points changes by the factor GREW.
"""


class SurfelGraph:
    """
    The voxels of a map as nodes of a graph of surfaces.

    Parameters
    ----------
    config : ModelsLayerConfig
        Settings.
    surfel_map : SurfelMap
        The map to follow.

    Attributes
    ----------
    key : (R,) int64
        Key of the voxel in each row, -1 for none.
    count, num_scans, position, normal, eigenvalues, covariance, axes
        Its surfel; covariance xx xy xz yy yz zz; axes as in models/kernels/surfel_classes.py.
    own_kind, own_normal
        Class and normal of the voxel alone; kind and normal take sparse voxels with those around.
    kind, links, neighbours
        See models/kernels/surfel_classes.py and models/kernels/surfel_links.py.
    host : (R,) int32
        The flat voxel nearby on whose plane a voxel that is not flat lies, -1 for none.
    level : (R,) uint8
        Number of steps from a flat voxel over others with hosts; 0 without a host.
    component : (R,) int32
        Connected component, by the row of its voxel of least key; -1 if not flat.
    label : (R,) int32
        Id of its primitive, -1 for none.
    is_gaussian : (R,) bool
        Whether that is a Gaussian of this voxel.
    is_material : (R,) bool
        Whether its last change is worth reporting.
    noise_m : float
        Assumed noise of the sensor, sigma, m.

    """

    def __init__(self, config: ModelsLayerConfig, surfel_map: SurfelMap) -> None:
        size_m = surfel_map.voxel_size_m
        self.map = surfel_map
        self.thickness_m = config.flat_thickness_m or max(
            LEAST_THICKNESS_M, THICKNESS_VOXELS * size_m
        )
        self._config = config
        self._report_rules = ((MOVED * self.thickness_m) ** 2, TURNED, GREW)
        steps = half_neighbourhood()
        self._neighbour_steps = np.concatenate([steps, -steps])
        self.clear()
        self.assume_noise(config.noise_m)

    def assume_noise(self, noise_m: float) -> None:
        """Take another noise of the sensor, sigma, m: the next update measures all voxels anew."""
        config, size_m = self._config, self.map.voxel_size_m
        self.noise_m = noise_m
        offset_m = max(self.thickness_m, 3.0 * noise_m)
        self.limit_m = math.hypot(self.thickness_m, 6.0 * noise_m)
        variance = (self.limit_m / 6.0) ** 2
        far_sq = 12.5 * size_m**2  # just over twice the diagonal
        self._class_rules = (float(config.min_points), variance, size_m)
        self._link_rules = (
            math.cos(math.radians(config.max_angle_deg)),
            offset_m,
            math.cos(math.radians(config.arc_angle_deg)),
            0.5 * offset_m,
            far_sq,
        )
        self._host_rules = (offset_m, variance, far_sq)
        self._is_stale = True
        self._reported_count[:] = 0  # as new, so that all patches are fitted again

    def clear(self) -> None:
        """Remove all voxels; the next update reads the whole map."""
        self._version = -1
        none = np.empty(0, np.int32)
        self.key = np.empty(0, np.int64)
        self.count = self.num_scans = np.empty(0, np.int64)
        self.position, self.normal, self.own_normal, self.eigenvalues = np.empty((4, 0, 3))
        self.covariance, self.axes = np.empty((0, 6)), np.empty((0, 2, 3))
        self.kind = self.own_kind = self.level = np.empty(0, np.uint8)
        self.links = np.empty(0, np.uint64)
        self.neighbours = np.empty((0, len(self._neighbour_steps)), np.int32)
        self.host, self.component, self.label = (none,) * 3
        self.is_gaussian = self.is_material = np.empty(0, np.bool_)
        self._marks = self._is_here = np.empty(0, np.bool_)
        self._reported_position, self._reported_normal = np.empty((2, 0, 3))
        self._reported_count = np.empty(0, np.int64)

    def update(self) -> GraphChange:
        """Read the changes of the map since the last call."""
        forgotten = self._forgotten()
        changed = self.map.rows_changed(-1 if self._is_stale else self._version)
        self._version, self._is_stale = self.map.version, False
        self._make_room(int(changed.max(initial=-1)) + 1)
        new, old = self.map.keys_of(changed), self.key[changed]
        vacated, filled = changed[(old >= 0) & (old != new)], changed[new >= 0]
        gone = forgotten.joined(self._gone(vacated))
        relinked = [gone.component]
        near = self.neighbours[vacated]
        marked = np.empty(len(self.key), np.int32)
        num = unlink(vacated, self.neighbours, self.links, self._marks, marked)
        self._blank(vacated)
        came = filled[self.key[filled] < 0]
        self.key[filled] = new[new >= 0]
        gone.return_to(came, self.key, self.label, self.is_gaussian)
        keys = (self.key[came][:, None] + self._neighbour_steps).ravel()
        link_neighbours(
            came,
            self.map.find(keys).reshape(len(came), len(self._neighbour_steps)),
            self.neighbours,
        )
        changed, filled = filled, self._around(filled, near, 1)
        filled, was = self._measure(changed, filled)
        is_flat = self.kind[filled] == FLAT
        relinked.append(self.component[filled[(was == FLAT) != is_flat]])
        touched = self.component[filled]
        self.component[filled[~is_flat]] = -1
        relinked.append(self._relinked(filled, marked, num))
        self._find_hosts(filled, near)
        return GraphChange(
            num_voxels=len(changed) + len(gone.key),
            relinked=unique_components(relinked),
            touched=unique_components([touched]),
            gone=gone.remaining,
        )

    def _relinked(self, changed: Rows, marked: Rows, num: int) -> Rows:
        """
        Link changed voxels; return the components of all voxels whose links changed.

        The first ``num`` rows of ``marked`` are those that ``unlink`` has marked already.
        """
        self._is_here[changed] = True
        state = (self.kind, self.position, self.normal, self.own_kind)
        num = update_links(
            changed,
            self._is_here,
            self.neighbours,
            state,
            self._link_rules,
            self.links,
            self._marks,
            marked,
            num,
        )
        self._is_here[changed] = self._marks[marked[:num]] = False
        return self.component[marked[:num]]

    def connected(self, rows: Rows) -> Rows:
        """Return the connected component (M,) of linked rows, in the order of their first rows."""
        from scipy.sparse import coo_array  # 0.2 s that maps without models save
        from scipy.sparse.csgraph import connected_components

        index = np.full(len(self.key), -1, np.int32)
        index[rows] = np.arange(len(rows))
        bits = np.arange(self.neighbours.shape[1] // 2, dtype=np.uint64)
        first, step = np.nonzero(self.links[rows, None] >> bits & np.uint64(1))
        second = index[self.neighbours[rows[first], step]]
        ends = first[second >= 0], second[second >= 0]
        links = coo_array((np.ones(len(ends[0]), np.bool_), ends), (len(rows), len(rows)))
        component: Rows = connected_components(links, directed=False)[1]
        return component

    def surfels(self) -> Surfels:
        """Return all voxels as surfels, in the order of their rows."""
        rows = np.flatnonzero(self.key >= 0)
        eigenvalues = self.eigenvalues[rows]
        e0, e1, e2 = eigenvalues.T
        total = np.where(e2 > 0.0, e0 + e1 + e2, np.nan)
        return Surfels(
            position=self.position[rows],
            normal=self.own_normal[rows],
            planarity=2.0 * (e1 - e0) / total,
            curvature=e0 / total,
            eigenvalues=eigenvalues,
            num_points=self.count[rows],
            voxel_index=unpack_keys(self.key[rows]),
            num_scans=self.num_scans[rows],
            size=np.full(len(rows), self.map.voxel_size_m),
        )

    def _forgotten(self) -> RemovedVoxels:
        """Remove and return all voxels if the map was cleared since the last update."""
        rows = np.flatnonzero(self.key >= 0)
        if self.map.cleared_at <= self._version:
            rows = rows[:0]
        forgotten = self._gone(rows)
        if len(rows):
            self._blank(rows)
            self.links[:] = 0
            self.neighbours[:] = -1
        return forgotten

    def _gone(self, rows: npt.NDArray[Any]) -> RemovedVoxels:
        return RemovedVoxels(
            self.key[rows], self.label[rows], self.is_gaussian[rows], self.component[rows]
        )

    def _make_room(self, num_rows: int) -> None:
        """Grow the arrays to at least this number of rows."""
        more = max(num_rows, 2 * len(self.key)) - len(self.key)
        if num_rows <= len(self.key):
            return
        empty = dict.fromkeys(('key', 'host', 'component', 'label', 'neighbours'), -1)
        for name, values in vars(self).items():
            if isinstance(values, np.ndarray) and name != '_neighbour_steps':
                added = np.full((more, *values.shape[1:]), empty.get(name, 0), values.dtype)
                setattr(self, name, np.concatenate([values, added]))

    def _blank(self, rows: npt.NDArray[Any]) -> None:
        """Reset rows whose voxels are gone."""
        self.key[rows] = self.host[rows] = self.component[rows] = self.label[rows] = -1
        self.kind[rows], self.own_kind[rows], self.level[rows] = NONE, NONE, 0
        self.is_gaussian[rows] = False
        self._reported_count[rows] = 0

    def _around(self, rows: Rows, emptied: Rows, steps: int) -> Rows:
        """Return rows, those of neighbours of emptied voxels, and all within some steps."""
        if 4 * len(rows) > np.count_nonzero(self.key >= 0):  # cheaper than to walk
            return np.flatnonzero(self.key >= 0).astype(np.int32)
        reached = np.empty(len(self.key), np.int32)
        start = np.concatenate([rows, emptied.ravel()])
        num = spread(start, self.neighbours, steps, self._is_here, reached)
        around = reached[:num]
        return around[self.key[around] >= 0]

    def _measure(self, rows: Rows, around: Rows) -> tuple[Rows, npt.NDArray[np.uint8]]:
        """
        Copy surfels from the map, classify them and those around, mark material changes.

        Returns the given rows and those around whose class or normal changed, with the previous
        classes of both.
        """
        old_kind, normals = self.kind[around], self.normal[around]
        surfels = self.map.surfels_of(rows, covariance=True)
        self.count[rows], self.position[rows] = surfels.num_points, surfels.position
        self.own_normal[rows], self.eigenvalues[rows] = surfels.normal, surfels.eigenvalues
        self.covariance[rows], self.num_scans[rows] = surfels.covariance, surfels.num_scans
        classify(
            rows,
            self.count,
            self.own_normal,
            self.covariance,
            self._class_rules,
            self.own_kind,
            self.axes,
        )
        alone = self.count, self.position, self.own_normal, self.covariance, self.eigenvalues
        classify_sparse(
            around,
            self.neighbours,
            self.own_kind,
            alone,
            self._class_rules,
            self.kind,
            self.normal,
        )
        self.is_material[:] = False
        reported = (self._reported_count, self._reported_position, self._reported_normal)
        mark_material(
            around,
            old_kind,
            self.count,
            self.position,
            self.normal,
            self.kind,
            reported,
            self._report_rules,
            self.is_material,
        )
        self._is_here[rows] = True
        moved = self._is_here[around] | (old_kind != self.kind[around])
        moved |= (normals != self.normal[around]).any(axis=1)
        self._is_here[rows] = False
        return around[moved], old_kind[moved]

    def flat_normals(self, rows: npt.NDArray[Any]) -> Array:
        """Return the normals (K, 3) of flat voxels, 0 for others."""
        return np.where((self.kind[rows] == FLAT)[:, None], self.normal[rows], 0.0)

    def is_thin(self, rows: npt.NDArray[Any], normals: Array) -> npt.NDArray[np.bool_]:
        """Return which voxels (K,) are thin enough along directions (K, 3) to lie on a plane."""
        xx, xy, xz, yy, yz, zz = self.covariance[rows].T
        x, y, z = normals.T
        along = x * x * xx + y * y * yy + z * z * zz + 2.0 * (x * y * xy + x * z * xz + y * z * yz)
        thin: npt.NDArray[np.bool_] = along < self._host_rules[1]
        return thin

    def _find_hosts(self, changed: Rows, emptied: Rows) -> None:
        """Recompute the hosts of voxels around changes."""
        around = self._around(changed, emptied, ROUNDS)
        rows = around[(self.kind[around] != FLAT) & (self.kind[around] != NONE)]
        flat = changed[self.kind[changed] == FLAT]
        self.host[flat], self.level[flat] = -1, 0
        state = (self.kind, self.position, self.normal)
        rules = self._host_rules
        find_hosts(rows, self.neighbours, state, self.covariance, rules, self.host, self.level)


def half_neighbourhood() -> npt.NDArray[np.int64]:
    """Return the key differences (13,) to neighbours of greater key."""
    offsets = [step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)]
    x, y, z = np.array(offsets, np.int64).T
    steps: npt.NDArray[np.int64] = (x << (2 * INDEX_BITS)) + (y << INDEX_BITS) + z
    return steps


@dataclass(frozen=True, slots=True, eq=False)
class GraphChange:
    """
    Changes of a SurfelGraph.

    Attributes
    ----------
    num_voxels : int
        Voxels that appeared, changed or disappeared.
    relinked : (C,) int32
        Components whose connectivity may have changed.
    touched : (C,) int32
        Components with any change of their voxels.
    gone : (G,) int32
        Labels of Gaussians whose voxels disappeared, without those that moved to another row.

    """

    num_voxels: int
    relinked: Rows
    touched: Rows
    gone: Rows


@dataclass(slots=True, eq=False)
class RemovedVoxels:
    """Voxels that left their rows: keys, labels, whether Gaussian, components."""

    key: npt.NDArray[np.int64]
    label: Rows
    is_gaussian: npt.NDArray[np.bool_]
    component: Rows

    def joined(self, removed: RemovedVoxels) -> RemovedVoxels:
        """Return these and others."""
        names = ('key', 'label', 'is_gaussian', 'component')
        return RemovedVoxels(
            *(np.concatenate([getattr(self, n), getattr(removed, n)]) for n in names)
        )

    def return_to(
        self,
        came: Rows,
        keys: npt.NDArray[np.int64],
        labels: Rows,
        is_gaussian: npt.NDArray[np.bool_],
    ) -> None:
        """
        Move the labels of voxels that are in another row now to that row.

        Parameters
        ----------
        came : (C,) int32
            Rows with a new voxel.
        keys : (R,) int64
            Keys of all rows.
        labels, is_gaussian : (R,) int32, (R,) bool
            Changed in place.

        """
        if not len(self.key) or not len(came):
            return
        order = np.argsort(self.key)
        index = np.minimum(np.searchsorted(self.key[order], keys[came]), len(order) - 1)
        back = order[index]
        same = self.key[back] == keys[came]
        labels[came[same]] = self.label[back[same]]
        is_gaussian[came[same]] = self.is_gaussian[back[same]]
        kept = np.ones(len(self.key), np.bool_)
        kept[back[same]] = False
        self.key, self.component = self.key[kept], self.component[kept]
        self.label, self.is_gaussian = self.label[kept], self.is_gaussian[kept]

    @property
    def remaining(self) -> Rows:
        """Labels of Gaussians whose voxels are gone."""
        return self.label[self.is_gaussian]


def unique_components(components: list[Rows]) -> Rows:
    """Return the sorted distinct components, without -1."""
    every = np.concatenate(components)
    flags = np.zeros(every.max(initial=-1) + 1, np.bool_)
    flags[every[every >= 0]] = True
    return np.flatnonzero(flags).astype(np.int32)
