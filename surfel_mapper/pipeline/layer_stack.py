# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
LayerStack: the layers that are switched on, in the order in which they follow a scan.

All that is called on every layer is called here, so that a layer that fails costs its own result
and nothing else: the failure is counted under the name of the layer and logged.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.counters import Laps
from surfel_mapper.errors import SurfelMapperError
from surfel_mapper.layers import enabled, Images, InsertedScan, Layer, Surroundings
from surfel_mapper.pipeline.drops import Drops


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

    """

    def __init__(self, config: Config, around: Surroundings, drops: Drops) -> None:
        layers = [layer(config, around) for layer in enabled(config)]
        self.by_name: Mapping[str, Layer] = {layer.name: layer for layer in layers}
        self._drops = drops

    def __iter__(self) -> Iterator[Layer]:
        """Iterate over the layers, in their order."""
        return iter(self.by_name.values())

    @property
    def needs_free_rays(self) -> bool:
        """Whether a layer needs the directions in which the sensor met nothing."""
        return any(layer.needs_free_rays for layer in self)

    @property
    def images(self) -> Images:
        """The images that scans are joined with: those of the first layer that wants any."""
        wanted = (layer.images for layer in self)
        return next((images for images in wanted if images.topics), Images())

    def voxels_to_clear(self, inserted: InsertedScan, laps: Laps) -> npt.NDArray[np.int32]:
        """Return the voxels (E, 3) that layers want cleared after a scan, each once."""
        found = []
        for layer in self:
            try:
                voxels = layer.voxels_to_clear(inserted)
            except SurfelMapperError as error:
                self._count_failure(layer, inserted, error)
                continue
            if len(voxels):
                found.append(voxels)
                self._drops.counters.voxels_cleared[layer.name] += len(voxels)
            if type(layer).voxels_to_clear is not Layer.voxels_to_clear:
                laps.end(layer.name)
        if len(found) < 2:
            return found[0] if found else np.empty((0, 3), np.int32)
        return np.unique(np.concatenate(found), axis=0)

    def follow(self, inserted: InsertedScan, laps: Laps) -> dict[str, Any]:
        """Pass a scan to all layers; return their results by name."""
        results = {}
        for layer in self:
            try:
                result = layer.follow(inserted)
            except SurfelMapperError as error:
                self._count_failure(layer, inserted, error)
                continue
            if result is not None:
                results[layer.name] = result
                laps.end(layer.name)
        return results

    def clear(self) -> None:
        """Clear all layers."""
        for layer in self:
            layer.clear()

    def finish(self) -> None:
        """Finish all layers, at the end of a recording."""
        for layer in self:
            layer.finish()

    def warm_up(self) -> None:
        """Compile the kernels of all layers."""
        for layer in self:
            layer.warm_up()

    def reconfigure(self, config: Config) -> None:
        """Give all layers new settings."""
        for layer in self:
            layer.reconfigure(config)

    def summary(self) -> dict[str, dict[str, Any]]:
        """Return the figures of the layers that have any, by name."""
        found = {layer.name: layer.summary() for layer in self}
        return {name: figures for name, figures in found.items() if figures}

    def _count_failure(self, layer: Layer, inserted: InsertedScan, error: Exception) -> None:
        stamp_s = inserted.scan.stamp_ns / 1e9
        self._drops.message(layer.name, f'layer {layer.name}: scan at {stamp_s:.6f} s: {error}')
