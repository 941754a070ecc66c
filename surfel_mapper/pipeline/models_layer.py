# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The models that a mapper keeps beside its surfels, and when they follow the map.

They follow by the stamps of the scans, never by the clock, so that a bag replayed at any speed
gives the same updates. Whatever changed in between counts once, so a longer period costs less.
"""

from __future__ import annotations

from surfel_mapper.config import ModelsLayerConfig
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.models.live import LiveModels, ModelUpdate


class ModelsLayer:
    """
    Live models of a map.

    Parameters
    ----------
    config : ModelsLayerConfig
        Their settings.
    surfel_map : SurfelMap
        What they follow.

    """

    def __init__(self, config: ModelsLayerConfig, surfel_map: SurfelMap) -> None:
        """Begin with none."""
        self.models = LiveModels(config, surfel_map)
        self._period_ns = round(config.extract_period_s * 1e9)
        self._last_ns: int | None = None

    def clear(self) -> None:
        """Forget the models and when they were made."""
        self.models.clear()
        self._last_ns = None

    def follow(self, stamp_ns: int) -> ModelUpdate | None:
        """Bring the models up to date where a scan of this stamp makes it due."""
        if self._last_ns is not None and abs(stamp_ns - self._last_ns) < self._period_ns:
            return None
        self._last_ns = stamp_ns
        return self.models.update()
