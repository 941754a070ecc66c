# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LayerStack: the layers that are switched on, in the order in which they follow a scan.

All calls on every layer are made here, so that a layer that fails costs its own result and nothing
else: the failure is counted under the name of the layer and logged. A layer that fails
MAX_FAILURES times in a row is switched off until it is cleared, because it may be inconsistent.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.compilation import CompileStage
from surfel_mapper.config import Config
from surfel_mapper.counters import Laps
from surfel_mapper.errors import CloudFormatError, SurfelMapperError
from surfel_mapper.layers import Contains, enabled, Images, InsertedScan, Layer, Surroundings
from surfel_mapper.pipeline.drops import described, Drops

_log = logging.getLogger(__name__)

MAX_FAILURES = 3
"""Failures in a row after which a layer is switched off: one bad scan or two may come."""


class LayerStack:
    """
    The layers of a pipeline.

    Parameters
    ----------
    config : Config
        Says which layers are switched on.
    around : Surroundings
        Map, window and sensors.
    drops : Drops
        Counts the failures of layers.

    Attributes
    ----------
    by_name : mapping of str to Layer
    active : list of Layer
        The layers that are not switched off, in their order; replaced when one is.
    clearing, following : list of Layer
        Those of them that can want voxels cleared, and those that follow scans.

    """

    def __init__(self, config: Config, around: Surroundings, drops: Drops) -> None:
        layers = [layer(config, around) for layer in enabled(config)]
        self.by_name: Mapping[str, Layer] = {layer.name: layer for layer in layers}
        self._activate(layers)
        self._drops = drops
        self._failures: Counter[tuple[str, str]] = Counter()  # in a row, by name and task

    def _activate(self, layers: list[Layer]) -> None:
        """Follow scans with some of the layers from now on."""
        no_voxels, no_result = Layer.voxels_to_clear, Layer.follow
        self.active = layers
        self.clearing = [r for r in layers if type(r).voxels_to_clear is not no_voxels]
        self.following = [r for r in layers if type(r).follow is not no_result]

    @property
    def needs_free_rays(self) -> bool:
        """Whether a layer needs the directions in which the sensor met nothing."""
        return any(layer.needs_free_rays for layer in self.active)

    @property
    def images(self) -> Images:
        """The images that scans are joined with: those of the first layer that wants any."""
        wanted = (layer.images for layer in self.active)
        return next((images for images in wanted if images.topics), Images())

    def voxels_to_clear(self, inserted: InsertedScan, laps: Laps) -> npt.NDArray[np.int32]:
        """Return the voxels (E, 3) that layers want cleared after a scan, each once."""
        cleared = []
        for layer in self.clearing:
            try:
                voxels = layer.voxels_to_clear(inserted)
            except Exception as error:  # MemoryError too
                self._count_failure(layer, 'clear', inserted, error)
                continue
            if len(voxels):
                cleared.append(voxels)
                self._drops.counters.voxels_cleared[layer.name] += len(voxels)
            laps.end(layer.name)
            self._failures.pop((layer.name, 'clear'), None)
        if len(cleared) < 2:
            return cleared[0] if cleared else np.empty((0, 3), np.int32)
        return np.unique(np.concatenate(cleared), axis=0)

    def follow(self, inserted: InsertedScan, laps: Laps) -> dict[str, Any]:
        """Pass a scan to all layers; return their results by name."""
        results = {}
        for layer in self.following:
            try:
                result = layer.follow(inserted)
            except Exception as error:  # MemoryError too
                self._count_failure(layer, 'follow', inserted, error)
                continue
            self._failures.pop((layer.name, 'follow'), None)
            if result is not None:
                results[layer.name] = result
                laps.end(layer.name)
        return results

    def clear(self) -> None:
        """Clear all layers, and switch those on that were switched off."""
        self._failures.clear()
        self._drops.counters.layers_off.clear()
        self._activate(list(self.by_name.values()))
        for layer in self.active:
            with self._drops.guarded(f'clearing layer {layer.name}'):
                layer.clear()

    def clear_region(self, contains: Contains) -> None:
        """Empty a region of all layers."""
        for layer in self.active:
            with self._drops.guarded(f'clearing a region of layer {layer.name}'):
                layer.clear_region(contains)

    def finish(self) -> None:
        """Finish all layers, at the end of a recording."""
        for layer in self.active:
            with self._drops.guarded(f'finishing layer {layer.name}'):
                layer.finish()

    def warm_up_stages(self) -> list[CompileStage]:
        """Return the stages that compile the kernels of all layers."""
        return [CompileStage(f'layer {layer.name}', layer.warm_up) for layer in self.active]

    def reconfigure(self, config: Config) -> None:
        """Give all layers new settings, also those that are switched off until the next clear."""
        for layer in self.by_name.values():
            with self._drops.guarded(f'reconfiguring layer {layer.name}'):
                layer.reconfigure(config)

    def summary(self) -> dict[str, dict[str, Any]]:
        """Return the figures of the layers that have any, by name."""
        by_layer = {}
        for layer in self.active:
            with self._drops.guarded(f'figures of layer {layer.name}'):
                by_layer[layer.name] = layer.summary()
        return {name: figures for name, figures in by_layer.items() if figures}

    def _count_failure(
        self, layer: Layer, task: str, inserted: InsertedScan, error: Exception
    ) -> None:
        """Count a failure; switch the layer off if it was the last of several in a row."""
        name, stamp_s = layer.name, inserted.scan.stamp_ns / 1e9
        is_known = isinstance(error, SurfelMapperError)
        text = str(error) if is_known else described(error)
        self._drops.message(name, f'layer {name}: scan at {stamp_s:.6f} s: {text}')
        self._failures[name, task] += 1
        if self._failures[name, task] >= MAX_FAILURES and not isinstance(error, CloudFormatError):
            self._drops.counters.layers_off[name] = text
            self._activate([kept for kept in self.active if kept is not layer])
            _log.error(
                'layer %s is switched off until the map is cleared: it failed %d times in a row, '
                'last with: %s',
                name,
                self._failures[name, task],
                text,
            )
