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
        Ids of patches that changed or are gone, in the order of the groups at first.
    groups : Described
        Voxels of the changed ones.

    """
    size_m, gone = graph.map.voxel_size_m, set(ids)
    live = [
        (ids[k], groups.rows[k], groups.samples.normals[k], groups.boxes[k])
        for k in np.flatnonzero(groups.curved).tolist()
    ]
    was = [patches[n].box for n in ids if n in patches and patches[n].is_surface]
    changed = np.array([*(box for *_, box in live), *was]).reshape(-1, 2, 3)
    live += [
        (n, t.rows, t.normal, t.box) for n, t in patches.items() if t.is_surface and n not in gone
    ]
    boxes = np.array([box for *_, box in live]).reshape(-1, 2, 3)
    is_target = near_any(boxes, changed, REACH_VOXELS * size_m)
    if not is_target.any():
        return {}
    used = np.flatnonzero(near_any(boxes, boxes[is_target], REACH_VOXELS * size_m)).tolist()
    flat_rows = [live[k][1][graph.kind[live[k][1]] == FLAT] for k in used]
    rows = np.concatenate(flat_rows)
    owner = np.repeat(np.arange(len(used)), [len(flat) for flat in flat_rows])
    axes = np.array([live[k][2] for k in used])
    beyond = continuations(graph.position[rows], graph.normal[rows], owner, axes, size_m)
    return {
        live[k][0]: np.sort(rows[at]) for k, at in zip(used, beyond, strict=True) if is_target[k]
    }


def near_any(boxes: Array, targets: Array, reach_m: float) -> npt.NDArray[np.bool_]:
    """Return which boxes (K, 2, 3) are within reach of any other (C, 2, 3), m."""
    low, high = targets[:, 0].T - reach_m, targets[:, 1].T + reach_m
    apart = np.zeros((len(boxes), len(targets)), np.bool_)
    for axis in range(3):
        apart |= boxes[:, None, 0, axis] > high[axis]
        apart |= boxes[:, None, 1, axis] < low[axis]
    return np.asarray(~apart.all(axis=1), np.bool_)
