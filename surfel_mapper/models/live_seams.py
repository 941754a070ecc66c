# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The seams of a map that changes: voxels of other surfaces that continue a surface.

Only surfaces within reach of a changed one are searched, so the time follows the change. Short,
as models/seams.py holds the search itself, for clouds, too.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.models.kernels.surfel_classes import FLAT
from surfel_mapper.models.live_patches import Described, Tracked
from surfel_mapper.models.seams import continuations, REACH_VOXELS
from surfel_mapper.models.surfel_graph import SurfelGraph

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int32]


def rows_beyond(
    graph: SurfelGraph, patches: dict[int, Tracked], ids: list[int], groups: Described
) -> dict[int, Rows]:
    """
    Return rows that continue surfaces, by id: of all surfaces within reach of changed ones.

    Parameters
    ----------
    graph : SurfelGraph
        The voxels.
    patches : dict of int to Tracked
        The previous patches.
    ids : list of int
        Ids of patches that changed or are gone; those of the groups first.
    groups : Described
        Voxels of the changed ones.

    """
    size_m, gone = graph.map.voxel_size_m, set(ids)
    now = [
        (ids[k], groups.rows[k], groups.samples.normals[k], groups.boxes[k])
        for k in np.flatnonzero(groups.curved).tolist()
    ]
    was = [patches[n].box for n in ids if n in patches and patches[n].is_surface]
    changed = np.array([*(box for *_, box in now), *was]).reshape(-1, 2, 3)
    now += [
        (n, t.rows, t.normal, t.box) for n, t in patches.items() if t.is_surface and n not in gone
    ]
    boxes = np.array([box for *_, box in now]).reshape(-1, 2, 3)
    is_target = near_any(boxes, changed, REACH_VOXELS * size_m)
    if not is_target.any():
        return {}
    used = np.flatnonzero(near_any(boxes, boxes[is_target], REACH_VOXELS * size_m)).tolist()
    parts = [now[k][1][graph.kind[now[k][1]] == FLAT] for k in used]
    rows = np.concatenate(parts)
    owner = np.repeat(np.arange(len(used)), [len(part) for part in parts])
    axes = np.array([now[k][2] for k in used])
    found = continuations(graph.position[rows], graph.normal[rows], owner, axes, size_m)
    return {
        now[k][0]: np.sort(rows[at]) for k, at in zip(used, found, strict=True) if is_target[k]
    }


def near_any(boxes: Array, others: Array, reach_m: float) -> npt.NDArray[np.bool_]:
    """Return which boxes (K, 2, 3) are within reach of any other (C, 2, 3), m."""
    low, high = others[:, 0].T - reach_m, others[:, 1].T + reach_m
    apart = np.zeros((len(boxes), len(others)), np.bool_)
    for axis in range(3):
        apart |= boxes[:, None, 0, axis] > high[axis]
        apart |= boxes[:, None, 1, axis] < low[axis]
    return np.asarray(~apart.all(axis=1), np.bool_)
