# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The exact windowed map with Open3D's hash map in place of sorted keys; the rest is numpy.

Its integers are those of NumpyMap. A scan of the window keeps the places of its voxels in the
hash map, so that eviction looks nothing up; the hash map is made large enough never to move them.
"""

from __future__ import annotations

import numpy as np
from open3d import core

from test.bench.numpy_map import NumpyMap, unpack

CAPACITY = 1 << 23
"""Voxels; a window of 100 scans of a VLS-128 has 6 million at 0.2 m."""


class Peer(NumpyMap):
    """A map out of core.HashMap, and its window of scans."""

    def __init__(self, voxel_size_m, window):
        super().__init__(voxel_size_m, window)
        self._map = core.HashMap(CAPACITY, core.int64, (3,), core.int64, (13,))
        self._moments = self._map.value_tensor().numpy()
        self._row_key = np.zeros(CAPACITY, np.int64)

    def step(self, points, T_map_sensor):
        """Map a scan, evict the oldest, return the surfels of all voxels that changed."""
        return super().step(list(points.T), T_map_sensor)

    @property
    def num_voxels(self):
        """Voxels in the map."""
        return self._map.size()

    def _insert(self, key, moments):
        place, is_new = (found.numpy() for found in self._map.activate(tensor(key)))
        known = ~is_new
        rows = place.astype(np.int64)  # of those known, nothing yet
        if known.any():  # the hash map refuses to look up nothing
            rows[known] = self._map.find(tensor(key[known]))[0].numpy()
        self._moments[rows[is_new]], self._row_key[rows[is_new]] = moments[is_new], key[is_new]
        self._moments[rows[known]] += moments[known]
        return rows

    def _remove(self, rows, moments):
        left = self._moments[rows] - moments
        self._moments[rows] = left
        empty = rows[left[:, 0] == 0]
        if len(empty):
            self._map.erase(tensor(self._row_key[empty]))
        return empty


def tensor(key):
    """
    Return keys as the hash map takes them: as three indices.

    Packed into one number they collide in its hash, and a scan takes seconds.
    """
    return core.Tensor.from_numpy(unpack(key))
