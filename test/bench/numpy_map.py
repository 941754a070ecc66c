# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The same exact windowed map in plain numpy, without compiled kernels.

Its integers equal those of SurfelMap, views included, as the bench checks. It is optimised: runs
of consecutive points in one voxel are summed by differences of a running sum, which leaves a sixth
to a third of the keys to sort; eviction keeps its rows and needs no search. Most of its time goes
to numpy.linalg.eigh. Limits of indices and counts are not checked.

Imports numpy only, because peers use it in environments without the package.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

INDEX_BITS = 21
OFFSET = 1 << (INDEX_BITS - 1)
MASK = (1 << INDEX_BITS) - 1
VIEW_SCALE = 1 << 14

COUNT, SUM, PRODUCT, VIEW = slice(0, 1), slice(1, 4), slice(4, 10), slice(10, 13)
"""Columns of moments (K, 13) int64."""

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class NumpySurfels:
    """Quantities derived for K voxels; see Surfels."""

    position: Floats
    normal: Floats
    planarity: Floats
    curvature: Floats
    eigenvalues: Floats
    num_points: Ints
    voxel_index: Ints


def reduce_points(
    xyz: list[npt.NDArray[Any]], T_map_sensor: Floats, size_m: float
) -> tuple[Ints, Ints]:
    """
    Sum the points of a scan by voxel.

    Parameters
    ----------
    xyz : 3 arrays (N,) float32 or float64
        Coordinates in the sensor frame, m; points with nan or inf are left out.
    T_map_sensor : (4, 4) float64
        Pose of the sensor.
    size_m : float
        Edge of a voxel.

    Returns
    -------
    key (K,) int64, ascending, and moments (K, 13) int64

    """
    finite = np.isfinite(xyz[0] + xyz[1] + xyz[2])
    x, y, z = (column[finite].astype(np.float64) for column in xyz)
    scale = 65536.0 / size_m
    lattice = [
        np.floor((((r0 * x + r1 * y) + r2 * z) + t) * scale).astype(np.int64)
        for r0, r1, r2, t in T_map_sensor[:3]
    ]
    qx, qy, qz = ((value & 65535) - 32768 for value in lattice)
    key = pack([value >> 16 for value in lattice])
    ends = np.append(np.flatnonzero(key[1:] != key[:-1]), len(key) - 1)  # of runs of one voxel
    unique, place = np.unique(key[ends], return_inverse=True)
    moments = np.empty((len(unique), 13), np.int64)
    moments[:, 0] = np.bincount(place, np.diff(ends, prepend=-1))
    columns = (qx, qy, qz, qx * qx, qx * qy, qx * qz, qy * qy, qy * qz, qz * qz)
    for number, column in enumerate(columns, 1):
        # bincount sums in float64, which holds these integers exactly
        moments[:, number] = np.bincount(place, np.diff(np.cumsum(column)[ends], prepend=0))
    moments[:, VIEW] = moments[:, COUNT] * views(unique, T_map_sensor[:3, 3], size_m)
    return unique, moments


def pack(index: list[Ints]) -> Ints:
    """Return the keys of voxel indices, three arrays (K,)."""
    i, j, k = index
    return ((i + OFFSET) << (2 * INDEX_BITS)) | ((j + OFFSET) << INDEX_BITS) | (k + OFFSET)


def unpack(key: Ints) -> Ints:
    """Return the voxel indices (K, 3) of keys."""
    shifts = np.array([2 * INDEX_BITS, INDEX_BITS, 0])
    index: Ints = ((key[:, None] >> shifts) & MASK) - OFFSET
    return index


def views(key: Ints, origin: Floats, size_m: float) -> Ints:
    """Return the unit vectors (K, 3) from voxels to the sensor, times 2^14 and rounded."""
    towards = origin - (unpack(key) + 0.5) * size_m
    dx, dy, dz = towards.T
    length = np.sqrt((dx * dx + dy * dy) + dz * dz)
    with np.errstate(invalid='ignore'):
        scaled = np.rint(VIEW_SCALE * (towards / length[:, None]))
    return np.where(length[:, None] > 0.0, scaled, 0.0).astype(np.int64)


def derive(key: Ints, moments: Ints, size_m: float) -> NumpySurfels:
    """Return the surfels of voxels, by eigh."""
    unit = size_m / 65536.0
    num_points, index = moments[:, 0], unpack(key)
    n = num_points.astype(np.float64)[:, None]
    mean = moments[:, SUM] / n
    scatter = moments[:, PRODUCT] - n * mean[:, [0, 0, 0, 1, 1, 2]] * mean[:, [0, 1, 2, 1, 2, 2]]
    covariance = (scatter * (unit**2 / np.maximum(n - 1.0, 1.0)))[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]]
    eigenvalues, vectors = np.linalg.eigh(covariance.reshape(-1, 3, 3))
    normal = vectors[:, :, 0]
    towards = np.einsum('ij,ij->i', normal, moments[:, VIEW].astype(np.float64))
    total = eigenvalues.sum(axis=1)
    with np.errstate(invalid='ignore', divide='ignore'):
        return NumpySurfels(
            position=(index + (mean + 32768.5) / 65536.0) * size_m,
            normal=np.where(towards[:, None] < 0.0, -normal, normal),
            planarity=2.0 * (eigenvalues[:, 1] - eigenvalues[:, 0]) / total,
            curvature=eigenvalues[:, 0] / total,
            eigenvalues=eigenvalues,
            num_points=num_points,
            voxel_index=index,
        )


class NumpyMap:
    """
    A map with sorted keys, and its window of scans.

    Parameters
    ----------
    voxel_size_m : float
    window : int
        Number of scans in the window.

    """

    def __init__(self, voxel_size_m: float, window: int) -> None:
        self._size_m = voxel_size_m
        self._window = window
        self._scans: deque[tuple[Ints, Ints]] = deque()  # rows and moments of each
        self._key = np.empty(0, np.int64)  # ascending
        self._row = np.empty(0, np.int64)  # of each key
        self._moments = np.zeros((1024, 13), np.int64)
        self._row_key = np.zeros(1024, np.int64)
        self._free = np.arange(1024)

    def step(self, xyz: list[npt.NDArray[Any]], T_map_sensor: Floats) -> NumpySurfels:
        """Map a scan, evict the oldest, return the surfels of all voxels that changed."""
        key, moments = reduce_points(xyz, T_map_sensor, self._size_m)
        rows = self._insert(key, moments)
        self._scans.append((rows, moments))
        changed = np.zeros(len(self._moments), bool)
        changed[rows] = True
        if len(self._scans) > self._window:
            rows, moments = self._scans.popleft()
            changed[rows] = True
            changed[self._remove(rows, moments)] = False
        rows = np.flatnonzero(changed)
        return derive(self._row_key[rows], self._moments[rows], self._size_m)

    def state(self) -> tuple[Ints, Ints]:
        """Return the keys (K,), ascending, and the moments (K, 13) of all voxels."""
        return self._key, self._moments[self._row]

    def _insert(self, key: Ints, moments: Ints) -> Ints:
        """Add moments; return their rows."""
        at = np.searchsorted(self._key, key)
        known = np.zeros(len(key), bool)
        inside = at < len(self._key)
        known[inside] = self._key[at[inside]] == key[inside]
        rows = np.empty(len(key), np.int64)
        rows[known] = self._row[at[known]]
        self._moments[rows[known]] += moments[known]
        new = ~known
        rows[new] = fresh = self._take(int(np.count_nonzero(new)))
        self._moments[fresh], self._row_key[fresh] = moments[new], key[new]
        self._key = np.insert(self._key, at[new], key[new])
        self._row = np.insert(self._row, at[new], fresh)
        return rows

    def _remove(self, rows: Ints, moments: Ints) -> Ints:
        """Subtract moments from their rows; return the rows that are empty now."""
        left = self._moments[rows] - moments
        self._moments[rows] = left
        empty: Ints = rows[left[:, 0] == 0]
        at = np.searchsorted(self._key, self._row_key[empty])
        self._key, self._row = np.delete(self._key, at), np.delete(self._row, at)
        self._free = np.concatenate([self._free, empty])
        return empty

    def _take(self, num: int) -> Ints:
        """Return rows that are free."""
        if num > len(self._free):
            old, more = len(self._moments), max(len(self._moments), num)
            self._moments = np.concatenate([self._moments, np.zeros((more, 13), np.int64)])
            self._row_key = np.concatenate([self._row_key, np.zeros(more, np.int64)])
            self._free = np.concatenate([self._free, np.arange(old, old + more)])
        taken, self._free = self._free[:num], self._free[num:]
        return taken
