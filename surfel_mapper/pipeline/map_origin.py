# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Origin of the map in the fixed frame, for poses in UTM or ECEF: ``map.origin``.

A map reaches 524 km each way with voxels of 0.5 m and is exact for the poses that it is given,
but UTM northings are 5,000 km. The origin is subtracted from each pose in the fixed frame when
it comes in: poses are shifted before they are composed or interpolated, so the map is to the bit
that of shifted poses. The difference of two coordinates of equal size is exact in float64.

(A module of its own because poses, mapper and outputs all need it.)
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import AUTO, Config
from surfel_mapper.config.stages import MAX_ORIGIN_M
from surfel_mapper.errors import ConfigError, MapError
from surfel_mapper.geometry import compose, Transform
from surfel_mapper.mapping.surfel_map import SurfelMap

AUTO_VOXELS = 1024
"""``auto`` rounds to this many voxels, so that maps of several drives merge exactly, and drives
near the origin of their frame have the origin 0."""

_log = logging.getLogger(__name__)


REGISTRATION = 'registration'
"""The pose.source whose poses begin at the origin of the map."""


def has_own_frame(config: Config) -> bool:
    """Return whether the frame of the map has another origin than the fixed frame."""
    return bool(config.map.origin) and config.pose.source != REGISTRATION


class MapOrigin:
    """
    The origin of a map, from the configuration, the first pose, or a map that is loaded.

    Parameters
    ----------
    config : Config
        ``map.origin``.
    surfel_map : SurfelMap
        Its ``origin_m`` is set.

    Attributes
    ----------
    has_own_frame : bool
        Whether the frame of the map has another origin than the fixed frame.
    is_known : bool
        False until ``auto`` has found it.

    Raises
    ------
    ConfigError
        If an origin is given and poses come from registration.

    """

    def __init__(self, config: Config, surfel_map: SurfelMap) -> None:
        self._map = surfel_map
        self.has_own_frame = has_own_frame(config)
        self._is_registered = config.pose.source == REGISTRATION
        self.is_known = not self.has_own_frame or config.map.origin != AUTO
        if config.map.origin_m:
            if not self.has_own_frame:
                raise ConfigError(
                    f'map.origin: {config.map.origin!r}, expected auto or nothing with '
                    'pose.source registration, whose poses begin at the origin of the map'
                )
            surfel_map.origin_m = config.map.origin_m

    @property
    def T_local_fixed(self) -> Transform:
        """From the fixed frame to the frame whose origin is that of the map."""
        T: Transform = np.eye(4)
        if self.has_own_frame:
            T[:3, 3] -= self._map.origin_m
        return T

    def find(self, position: npt.ArrayLike) -> None:
        """Take the origin from the first position (3,) in the fixed frame."""
        step_m = AUTO_VOXELS * self._map.voxel_size_m
        self._map.origin_m = np.rint(np.asarray(position, np.float64) / step_m) * step_m + 0.0
        self.is_known = True
        _log.info('map.origin auto: %s', self._map.origin_m.tolist())

    def find_in(self, points: npt.NDArray[Any]) -> None:
        """Take the origin from the first of points (N, 3) in the fixed frame that it may be."""
        possible = (np.abs(points) < MAX_ORIGIN_M).all(axis=1)  # also not nan
        if possible.any():
            self.find(points[np.argmax(possible)])

    def take_from(self, loaded: SurfelMap) -> None:
        """
        Take the origin of a map that is loaded, if no pose was shifted by another.

        Raises
        ------
        MapError
            If it is known, and differs.

        """
        if self.has_own_frame and self.is_known:
            if not np.array_equal(loaded.origin_m, self._map.origin_m):
                wanted = ' '.join(f'{value:.17g}' for value in loaded.origin_m)
                raise MapError(
                    f'map with origin {loaded.origin_m.tolist()}, expected '
                    f"{self._map.origin_m.tolist()}; start with map.origin: '{wanted}'"
                )
            return
        if not self.has_own_frame and self._needs_own_frame(loaded):
            raise MapError(
                f'map with origin {loaded.origin_m.tolist()}, expected none; start with '
                'map.origin: auto and this map as map.load'
            )
        self._map.origin_m = loaded.origin_m
        self.is_known = True

    def _needs_own_frame(self, loaded: SurfelMap) -> bool:
        """Return whether poses that come in have to be shifted for a map."""
        return bool(loaded.origin_m.any()) and not self._is_registered

    def shifted(self, transform: Transform, *, is_child: bool) -> Transform:
        """Return the pose of a frame in the fixed frame, or of the fixed frame, shifted."""
        if not (self.has_own_frame and self._map.origin_m.any()):
            return transform
        if is_child:
            shift = np.eye(4)
            shift[:3, 3] = self._map.origin_m
            return compose(transform, shift)
        T: Transform = transform.copy()
        T[:3, 3] -= self._map.origin_m
        return T
