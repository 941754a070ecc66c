# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LiveModels: planes, B-spline surfaces and Gaussians of a map, kept up to date as it changes.

Surfels take the place of the clusters; raw points are not needed. Changes are read from the map
itself, so scans that are added, removed or moved by an alignment need no special case. The voxels
of each primitive follow from the present map and the noise of the sensor, to the bit; its history
decides the ids, the frames within a tenth of the thickness of a plane, and the noise if that is
not configured: it is estimated while the map grows (surfel_noise.py).

An update reads the changed voxels (surfel_graph.py), recomputes the connected components around
them, cuts these into charts (charts.py), grows and joins all charts as those of one cloud
(surfel_joining.py), matches ids (id_matching.py), and refits patches with material changes
(live_patches.py). Flat voxels without a patch and rough voxels are one Gaussian each.

Source: Gao and Dong 2025 for the tests and the models; surfels as clusters are our own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.compilation import clock
from surfel_mapper.config import ModelsLayerConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.models.charts import bisected, chart_components
from surfel_mapper.models.frames import PACKED
from surfel_mapper.models.id_matching import IdMatches, match
from surfel_mapper.models.kernels.surfel_classes import FLAT, NONE, YOUNG
from surfel_mapper.models.live_patches import Described, PatchFitter, Tracked
from surfel_mapper.models.live_seams import rows_beyond
from surfel_mapper.models.multi_model import Gaussians, MultiModel, Surface
from surfel_mapper.models.shapes import ellipsoid_corners, Shapes
from surfel_mapper.models.surfel_graph import GraphChange, SurfelGraph
from surfel_mapper.models.surfel_joining import join_charts, renumbered
from surfel_mapper.models.surfel_noise import map_noise, MOST_VOXELS

__all__ = ['LiveModels', 'ModelUpdate']

LEAST_ESTIMATED, GROWTH = 256, 1.25
"""Voxels at the first estimate of the noise; growth of voxels or updates until the next one."""

OTHER_NOISE = 0.9
"""Ratio of estimates of the noise from which all voxels are measured anew."""

Rows = npt.NDArray[np.int32]
Indices = npt.NDArray[np.int64]


class LiveModels:
    """
    The models of a map.

    Parameters
    ----------
    config : ModelsLayerConfig
        Settings.
    surfel_map : SurfelMap
        The map to follow; it is read in ``update`` only.

    Attributes
    ----------
    versions : dict of int to int
        By id: 1 when created, one more with every change.

    """

    def __init__(self, config: ModelsLayerConfig, surfel_map: SurfelMap) -> None:
        self.config = config
        self.map = surfel_map
        self.versions: dict[int, int] = {}
        self._graph = SurfelGraph(config, surfel_map)
        self._fitter = PatchFitter(self._graph)
        self._next_id = 0
        self._estimate_at, self._updates = (0.0, 0.0), 0
        self.clear()

    def clear(self) -> None:
        """Remove all models; the next update reads the whole map, and no id is reused."""
        self._cleared = (*getattr(self, '_cleared', ()), *self.versions)
        self.versions.clear()
        self._graph.clear()
        self._patches: dict[int, Tracked] = {}
        self._charts: dict[int, list[Rows]] = {}
        self._surfels: Surfels | None = None
        self._model: MultiModel | None = None

    def update(self) -> ModelUpdate:
        """Follow the changes of the map since the last call."""
        start = clock()
        self._surfels = self._model = None
        if not self.config.noise_m:
            self._follow_noise()
        change = self._graph.update()
        self._recut(change)
        members, ends = sorted_rows(self._joined())
        ids, matched = self._matched(members, ends)
        self._next_id += len(matched.created)
        born, changed, died = self._relabel(members, ends, ids)
        changed += self._refit(members, ends, ids, matched)
        for gone in matched.removed:
            del self._patches[gone]
        created = sorted([*matched.created, *born])
        removed = sorted([*self._cleared, *matched.removed, *died, *change.gone.tolist()])
        self._cleared = ()
        self._count(created, changed, removed)
        return ModelUpdate(
            created=tuple(created),
            updated=tuple(sorted(changed)),
            removed=tuple(removed),
            merged=tuple(matched.merged),
            split=tuple(matched.split),
            milliseconds=(clock() - start) * 1e3,
            num_changed=change.num_voxels,
        )

    @property
    def noise_m(self) -> float:
        """Noise of the sensor, sigma, m: as configured, or as estimated from the map."""
        return self._graph.noise_m

    @property
    def surfels(self) -> Surfels:
        """All voxels as surfels at the last update, including those of few points."""
        if self._surfels is None:
            self._surfels = self._graph.surfels()
        return self._surfels

    @property
    def model(self) -> MultiModel:
        """The models; labels are the ids of the surfels, -1 for none."""
        if self._model is None:
            graph = self._graph
            patches = [self._patches[number].patch for number in sorted(self._patches)]
            rows = np.flatnonzero(graph.is_gaussian)
            rows = rows[np.argsort(graph.label[rows])]
            labels = graph.label[graph.key >= 0]
            self._model = MultiModel(
                planes=[patch for patch in patches if not isinstance(patch, Surface)],
                surfaces=[patch for patch in patches if isinstance(patch, Surface)],
                gaussians=Gaussians(
                    id=graph.label[rows].astype(np.int64),
                    num_points=graph.count[rows],
                    mean=graph.position[rows],
                    covariance=graph.covariance[rows][:, PACKED],
                ),
                labels=labels,
                voxel_size_m=self.map.voxel_size_m,
                num_thinned=len(labels),
            )
        return self._model

    def warm_up(self) -> None:
        """Compile the kernels, including those for drawing."""
        size_m = self.map.voxel_size_m
        surfel_map = SurfelMap(size_m)
        models = LiveModels(replace(self.config, min_points=4, min_voxels=1), surfel_map)
        for side, bend in ((130, 0.0), (130, 0.012), (40, 0.04)):  # plane, large field, small one
            x, y = np.mgrid[0:side, 0:side] * (0.2 * size_m)
            bend /= size_m
            points = np.stack([x, y, bend * x * x], -1).reshape(-1, 3)
            far = 10.0 * points[::10] + 50.0 * size_m  # sparse: patches grow in coarse voxels
            moments = [surfel_map.add(xyz) for xyz in (points, points[:20] + 0.1 * size_m, far)]
            models.update()
            Shapes().of(models.model, models.versions)
            ellipsoid_corners(models.model.gaussians)
            bisected(models._graph, np.arange(2, dtype=np.int32), 0.5, 1)
            map_noise(surfel_map)
            surfel_map.remove(moments[1])
            models.update()
            surfel_map.remove(moments[0])
            surfel_map.remove(moments[2])
        models.update()

    def summary(self) -> dict[str, Any]:
        """Return counts and size, for files, reports and diagnostics."""
        model = self.model
        return {
            'planes': len(model.planes),
            'surfaces': len(model.surfaces),
            'gaussians': len(model.gaussians),
            'bytes': model.size_bytes,
        }

    def _follow_noise(self) -> None:
        """Estimate the noise if voxels or updates grew by GROWTH since the last estimate."""
        self._updates += 1
        number = self.map.num_voxels
        if number < self._estimate_at[0] and self._updates < self._estimate_at[1]:
            return
        if number < LEAST_ESTIMATED or number > MOST_VOXELS:
            return
        self._estimate_at = GROWTH * number, GROWTH * self._updates
        noise_m = map_noise(self.map)
        if not OTHER_NOISE * noise_m <= self.noise_m <= noise_m / OTHER_NOISE:
            self._graph.assume_noise(noise_m)

    def _recut(self, change: GraphChange) -> None:
        """Recompute connected components around changes, and cut these into charts."""
        graph, least = self._graph, self.config.min_voxels
        flags = np.zeros(len(graph.key) + 1, np.bool_)  # the last: no component
        flags[change.relinked] = flags[change.touched] = True
        self._charts = {name: kept for name, kept in self._charts.items() if not flags[name]}
        single = (graph.kind == FLAT) & (graph.component < 0)
        apart = np.flatnonzero(flags[graph.component] | single).astype(np.int32)
        component = graph.connected(apart)
        order = np.lexsort((graph.key[apart], component))
        _, first = np.unique(component[order], return_index=True)
        graph.component[apart] = apart[order[first]][component]
        named = np.full(len(graph.key), -1, np.int32)
        named[apart] = graph.component[apart]
        rows, starts = sorted_rows(named)
        large = np.diff(starts) >= least
        ends = np.concatenate([[0], np.cumsum(np.diff(starts)[large])])
        kept = rows[np.repeat(large, np.diff(starts))]
        angles = self.config.fold_angle_deg, self.config.max_angle_deg
        for chart in chart_components(graph, kept, ends, angles, least):
            # a view would keep the rows of all charts
            self._charts.setdefault(int(graph.component[chart[0]]), []).append(chart.copy())

    def _joined(self) -> Rows:
        """Return the patch of each row, -1 for none: charts with what they grow over, joined."""
        graph = self._graph
        owner = np.full(len(graph.key), -1, np.int32)
        charts = [chart for group in self._charts.values() for chart in group]
        if charts:
            owner[np.concatenate(charts)] = np.repeat(np.arange(len(charts)), [*map(len, charts)])
        hosted = np.flatnonzero(graph.host >= 0)
        owner[hosted] = owner[graph.host[hosted]]
        return join_charts(graph, owner)

    def _matched(self, members: Rows, ends: Indices) -> tuple[Indices, IdMatches]:
        """Return the ids of patches (K,), and those of patches with other voxels than before."""
        labels, sizes = self._graph.label[members], np.diff(ends)
        low, high = (end.reduceat(labels, ends[:-1]) for end in (np.minimum, np.maximum))
        ids = np.where(low == high, low, -1).astype(np.int64)
        for k, number in enumerate(ids.tolist()):
            tracked = self._patches.get(number)
            if tracked is None or len(tracked.rows) != sizes[k]:
                ids[k] = -1
        changed = ids < 0
        old = np.array(sorted(self._patches.keys() - set(ids.tolist())), np.int64)
        starts = np.concatenate([[0], np.cumsum(sizes[changed])])
        old_labels = labels[np.repeat(changed, sizes)].astype(np.int64)
        matched = match(old, old_labels, starts, self._next_id)
        ids[changed] = matched.ids
        return ids, matched

    def _relabel(
        self, members: Rows, ends: Indices, ids: Indices
    ) -> tuple[list[int], list[int], list[int]]:
        """Label all voxels; return Gaussians created, changed and removed."""
        graph = self._graph
        old_label, was_gaussian, kind = graph.label.copy(), graph.is_gaussian, graph.own_kind
        graph.label[:] = -1
        graph.label[members] = np.repeat(ids, np.diff(ends))
        now_gaussian = (graph.label < 0) & (kind != YOUNG) & (kind != NONE)
        new = np.flatnonzero(now_gaussian & ~was_gaussian)
        old_label[new] = self._next_id + np.arange(len(new))
        self._next_id += len(new)
        rows = np.flatnonzero(now_gaussian)
        graph.label[rows] = old_label[rows]
        changed = old_label[now_gaussian & was_gaussian & graph.is_material]
        died = old_label[was_gaussian & ~now_gaussian]
        graph.is_gaussian = now_gaussian
        return old_label[new].tolist(), changed.tolist(), died.tolist()

    def _refit(self, members: Rows, ends: Indices, ids: Indices, matched: IdMatches) -> list[int]:
        """Refit patches with material changes; return the ids of those that existed."""
        assigned = set(matched.ids)
        is_material = np.logical_or.reduceat(self._graph.is_material[members], ends[:-1])
        chosen = {
            number: members[ends[k] : ends[k + 1]].copy()  # a view would keep all members
            for k, (number, matters) in enumerate(zip(ids.tolist(), is_material, strict=True))
            if matters or number in assigned
        }
        existed = [number for number in chosen if number in self._patches]
        groups = self._fitter.describe(list(chosen.values()))
        beyond = rows_beyond(self._graph, self._patches, [*chosen, *matched.removed], groups)
        refit = [n for n in beyond if n not in chosen and self._continues_otherwise(n, beyond[n])]
        self._fit(list(chosen), groups, beyond)
        self._fit(refit, self._fitter.describe([self._patches[n].rows for n in refit]), beyond)
        return existed + refit

    def _continues_otherwise(self, number: int, beyond: Rows) -> bool:
        """Return whether the voxels beyond the seams of a surface changed."""
        same = np.array_equal(self._patches[number].beyond, beyond)
        return not same or bool(self._graph.is_material[beyond].any())

    def _fit(self, ids: list[int], groups: Described, beyond: dict[int, Rows]) -> None:
        """Fit patches anew."""
        none: Rows = np.empty(0, np.int32)
        previous = [self._patches.get(number) for number in ids]
        extra = [beyond.get(number, none) for number in ids]
        for tracked in self._fitter.fit(ids, groups, previous, extra) if ids else ():
            self._patches[tracked.patch.id] = tracked

    def _count(self, created: list[int], changed: list[int], removed: list[int]) -> None:
        """Update the versions."""
        for number in removed:
            self.versions.pop(number, None)
        for number in created:
            self.versions[number] = 1
        for number in changed:
            self.versions[number] += 1


def sorted_rows(group: Rows) -> tuple[Rows, Indices]:
    """Return rows with a group (R,), sorted by its first row, and the start of each group."""
    rows = np.flatnonzero(group >= 0).astype(np.int32)
    number = renumbered(group[rows])
    starts = np.concatenate([[0], np.cumsum(np.bincount(number))])
    return rows[np.argsort(number, kind='stable')], starts


@dataclass(frozen=True, slots=True)
class ModelUpdate:
    """
    Changes of the primitives since the previous update.

    Attributes
    ----------
    created, updated, removed : tuple of int
        New ids, changed ones, removed ones; each id in one of these at most, ascending. The parts
        of a split are created, merged primitives are removed.
    merged : tuple of (int, int)
        Removed planes and surfaces, and those that they became part of.
    split : tuple of (int, int)
        Planes and surfaces, and the new ones that were part of them.
    milliseconds : float
        Duration of the update.
    num_changed : int
        Changed voxels.

    """

    created: tuple[int, ...]
    updated: tuple[int, ...]
    removed: tuple[int, ...]
    merged: tuple[tuple[int, int], ...]
    split: tuple[tuple[int, int], ...]
    milliseconds: float
    num_changed: int
