# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LiveModels: planes, B-spline surfaces and Gaussians of a map, kept up to date as it changes.

The voxels are the pieces; raw points are not needed. What changed is read from the map itself,
so scans that come, leave or are moved by an alignment are all the same. Which voxels form one
primitive follows from the map as it is, to the bit, whatever came before; what comes before
decides the ids, and within a tenth of the thickness of a plane how its frame lies.

An update takes the voxels that changed (pieces.py), finds anew what hangs together with them, cuts
it into charts (charts.py), gives those the ids of the patches they were (identity.py), and fits
the patches of which something has changed that matters (live_patches.py). What is flat in no
patch, and what is rough, is a Gaussian a voxel.

Source: Gao and Dong 2025 for the tests and the models; that a voxel is a piece is our own.
"""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import ModelsLayerConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.models.charts import charts_of, cut
from surfel_mapper.models.identity import match, Matched
from surfel_mapper.models.kernels.piece_classes import FLAT, NONE, YOUNG
from surfel_mapper.models.kernels.piece_groups import (
    hang_together,
    name_components,
    rows_of_groups,
    sort_by_group,
)
from surfel_mapper.models.live_patches import PatchFitter, symmetric, Tracked
from surfel_mapper.models.model_update import ModelUpdate
from surfel_mapper.models.multi_model import Gaussians, MultiModel, Surface
from surfel_mapper.models.piece_changes import Change
from surfel_mapper.models.pieces import Pieces
from surfel_mapper.models.shapes import ellipsoid_corners, Shapes

__all__ = ['LiveModels', 'ModelUpdate']

Rows = npt.NDArray[np.int32]
Indices = npt.NDArray[np.int64]


class LiveModels:
    """
    The models of a map.

    Parameters
    ----------
    config : ModelsLayerConfig
        Their settings.
    surfel_map : SurfelMap
        What they are read from; only when ``update`` is called.

    Attributes
    ----------
    versions : dict of int to int
        By id: 1 when it was created, one more whenever it changed.

    """

    def __init__(self, config: ModelsLayerConfig, surfel_map: SurfelMap) -> None:
        """Begin with no models; the first update reads all that the map holds."""
        self.config = config
        self.map = surfel_map
        self.versions: dict[int, int] = {}
        self._pieces = Pieces(config, surfel_map)
        self._fitter = PatchFitter(self._pieces)
        self._next_id = 0
        self.clear()

    def clear(self) -> None:
        """Forget all; the next update reads the whole map, and no id comes back."""
        self._cleared = (*getattr(self, '_cleared', ()), *self.versions)
        self.versions.clear()
        self._pieces.clear()
        self._patches: dict[int, Tracked] = {}
        self._surfels: Surfels | None = None
        self._model: MultiModel | None = None

    def update(self) -> ModelUpdate:
        """Follow what changed in the map since the last call."""
        start = perf_counter()
        self._surfels = self._model = None
        change = self._pieces.follow()
        touched, rows, starts = self._regrouped(change)
        members, ends = self._charts(rows, starts)
        old = self._old_patches(change, touched)
        labels = self._pieces.label[members].astype(np.int64)
        matched = match(old, labels, ends, self._next_id)
        self._next_id += len(matched.created)
        born, changed, died = self._relabel(change, touched, rows, members, ends, matched.ids)
        changed += self._refit(members, ends, matched)
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
            milliseconds=(perf_counter() - start) * 1e3,
            num_changed=change.num_voxels,
        )

    @property
    def surfels(self) -> Surfels:
        """All voxels as surfels, as of the last update; those of few points too."""
        if self._surfels is None:
            self._surfels = self._pieces.surfels()
        return self._surfels

    @property
    def model(self) -> MultiModel:
        """The models; labels are the ids of the surfels, -1 where there is none."""
        if self._model is None:
            pieces = self._pieces
            patches = [self._patches[number].patch for number in sorted(self._patches)]
            rows = np.flatnonzero(pieces.alone)
            rows = rows[np.argsort(pieces.label[rows])]
            labels = pieces.label[pieces.key >= 0]
            self._model = MultiModel(
                planes=[patch for patch in patches if not isinstance(patch, Surface)],
                surfaces=[patch for patch in patches if isinstance(patch, Surface)],
                gaussians=Gaussians(
                    id=pieces.label[rows].astype(np.int64),
                    num_points=pieces.count[rows],
                    mean=pieces.position[rows],
                    covariance=symmetric(pieces.covariance[rows]),
                ),
                labels=labels,
                voxel_size_m=self.map.voxel_size_m,
                num_thinned=len(labels),
            )
        return self._model

    def warm_up(self) -> None:
        """Compile the kernels, those that draw the models too."""
        size_m = self.map.voxel_size_m
        surfel_map = SurfelMap(size_m)
        models = LiveModels(replace(self.config, min_points=4, min_voxels=1), surfel_map)
        for side, bend in ((130, 0.0), (130, 0.012), (40, 0.04)):  # plane, large field, small one
            x, y = np.mgrid[0:side, 0:side] * (0.2 * size_m)
            bend /= size_m
            points = np.stack([x, y, bend * x * x], -1).reshape(-1, 3)
            moments = [surfel_map.add(part) for part in (points, points[:20] + 0.1 * size_m)]
            models.update()
            Shapes().of(models.model, models.versions)
            ellipsoid_corners(models.model.gaussians)
            cut(models._pieces, np.arange(2, dtype=np.int32), 0.5, 1)
            surfel_map.remove(moments[1])
            models.update()
            surfel_map.remove(moments[0])
        models.update()

    def summary(self) -> dict[str, Any]:
        """Return what the models are, for files, reports and diagnostics."""
        model = self.model
        return {
            'planes': len(model.planes),
            'surfaces': len(model.surfaces),
            'gaussians': len(model.gaussians),
            'bytes': model.size_bytes,
        }

    def _regrouped(self, change: Change) -> tuple[npt.NDArray[np.bool_], Rows, Indices]:
        """
        Find anew what hangs together.

        Returns
        -------
        (R,) bool
            Components of which something has changed.
        (M,) int32
            Their rows, component by component.
        (K + 1,) int64
            The first row of each of those that are large enough for a patch, and where they end.

        """
        pieces = self._pieces
        size = len(pieces.key)
        rows, flags = np.empty(size, np.int32), np.zeros(size, np.bool_)
        flags[change.loose] = True
        single = (pieces.kind == FLAT) & (pieces.component < 0)
        apart = rows[: rows_of_groups(pieces.component, flags, single, rows)].copy()
        parent = np.empty(len(apart), np.int64)
        hang_together(apart, pieces.links, pieces.around, pieces.places, parent)
        name_components(apart, parent, pieces.key, pieces.component)
        flags[:] = False
        flags[change.touched] = True
        flags[change.loose] = False
        flags[pieces.component[apart]] = True
        flags[pieces.component[change.hosts]] = True
        single[:] = False
        num = rows_of_groups(pieces.component, flags, single, rows)
        return flags, *self._sorted(rows[:num], pieces.component)

    def _sorted(self, rows: Rows, group: Rows) -> tuple[Rows, Indices]:
        """Return rows group by group, and where each begins."""
        ordered, starts = np.empty_like(rows), np.empty(len(rows) + 1, np.int64)
        num = sort_by_group(rows, group, self._pieces.places, ordered, starts)
        return ordered, starts[: num + 1]

    def _charts(self, rows: Rows, starts: Indices) -> tuple[Rows, Indices]:
        """Return the voxels of patches, those that lie on them too, and where each begins."""
        pieces, least = self._pieces, self.config.min_voxels
        large = np.flatnonzero(np.diff(starts) >= least)
        kept = np.repeat(np.diff(starts) >= least, np.diff(starts))
        ends = np.concatenate([[0], np.cumsum(np.diff(starts)[large])])
        charts = charts_of(pieces, rows[kept], ends, self.config.fold_angle_deg, least)
        number = np.full(len(pieces.key), -1, np.int32)
        for k, chart in enumerate(charts):
            number[chart] = k
        hosted = np.flatnonzero(pieces.host >= 0)
        number[hosted] = number[pieces.host[hosted]]
        return self._sorted(np.flatnonzero(number >= 0).astype(np.int32), number)

    def _old_patches(self, change: Change, touched: npt.NDArray[np.bool_]) -> Indices:
        """Return the ids of the patches that may be others now."""
        flags = touched.copy()
        flags[change.loose] = flags[change.touched] = True
        found = [number for number, known in self._patches.items() if flags[known.component]]
        return np.array(sorted(found), np.int64)

    def _relabel(
        self,
        change: Change,
        touched: npt.NDArray[np.bool_],
        rows: Rows,
        members: Rows,
        ends: Indices,
        ids: list[int],
    ) -> tuple[list[int], list[int], list[int]]:
        """Give labels to all voxels concerned; return Gaussians created, changed and removed."""
        pieces = self._pieces
        hosted = np.flatnonzero(pieces.host >= 0)
        hosted = hosted[touched[pieces.component[pieces.host[hosted]]]]
        concerned = np.zeros(len(pieces.key), np.bool_)
        for part in (rows, change.rows, hosted):
            concerned[part] = True
        every = np.flatnonzero(concerned)
        before, was_alone = pieces.label[every].astype(np.int64), pieces.alone[every]
        pieces.label[every], pieces.alone[every] = -1, False
        pieces.label[members] = np.repeat(np.array(ids, np.int32), np.diff(ends))
        kind = pieces.kind[every]
        is_alone = (pieces.label[every] < 0) & (kind != YOUNG) & (kind != NONE)
        new = is_alone & ~was_alone
        before[new] = self._next_id + np.arange(new.sum())
        self._next_id += int(new.sum())
        pieces.label[every[is_alone]] = before[is_alone]
        pieces.alone[every[is_alone]] = True
        changed = is_alone & was_alone & pieces.is_material[every]
        died = before[was_alone & ~is_alone]
        return before[new].tolist(), before[changed].tolist(), died.tolist()

    def _refit(self, members: Rows, ends: Indices, matched: Matched) -> list[int]:
        """Fit the patches of which something has changed that matters; return those known."""
        pieces, chosen, parts = self._pieces, [], []
        flat = np.flatnonzero(pieces.component[members] >= 0)
        first = members[flat[np.searchsorted(flat, ends[:-1])]]
        is_material = np.logical_or.reduceat(pieces.is_material[members], ends[:-1])
        found = zip(matched.ids, pieces.component[first].tolist(), is_material, strict=True)
        for k, (number, component, matters) in enumerate(found):
            rows, known = members[ends[k] : ends[k + 1]], self._patches.get(number)
            if known is not None:
                known.component = component
                if not matters and np.array_equal(known.rows, rows):
                    continue
            chosen.append(number)
            parts.append((rows, component))
        before = [self._patches.get(number) for number in chosen]
        fitted = self._fitter.fit(chosen, [rows for rows, _ in parts], before)
        for (patch, origin, field), (rows, component) in zip(fitted, parts, strict=True):
            self._patches[patch.id] = Tracked(patch, rows, component, origin, field)
        return [number for number, known in zip(chosen, before, strict=True) if known is not None]

    def _count(self, created: list[int], changed: list[int], removed: list[int]) -> None:
        """Keep the versions."""
        for number in removed:
            self.versions.pop(number, None)
        for number in created:
            self.versions[number] = 1
        for number in changed:
            self.versions[number] += 1
