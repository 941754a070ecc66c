# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
EuclideanField: distances to the nearest obstacle in a block map (an ESDF).

The distances of a truncated signed distance field are measured along rays and end at the
truncation; planners need the Euclidean distance, farther out. An update computes the squared
distance, in voxels, of every voxel of the box about the blocks to the nearest occupied voxel. It
is exact, that of scipy.ndimage.distance_transform_edt up to ``max_m``.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_real, Record
from surfel_mapper.errors import ConfigError
from surfel_mapper.tsdf.blocks import BlockMap, Int64
from surfel_mapper.tsdf.kernels.euclidean import FAR, MAX_REACH, spread
from surfel_mapper.tsdf.queries import checked_size, extent, in_voxels

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, repr=False)
class KnownDistances(Record):
    """
    Distances of the observed voxels about a place.

    Attributes
    ----------
    points : (P, 3) float64
        Centres of the voxels, map frame, m.
    distance : (P,) float32
        Distance to the nearest obstacle, m, at most ``max_m``; 0 in obstacles.

    """

    points: npt.NDArray[np.float64]
    distance: npt.NDArray[np.float32]


class EuclideanField:
    """
    Euclidean distances from voxels to the nearest occupied voxel, between their centres.

    Voxels up to half a voxel in front of a surface are occupied, as in ``tsdf.queries.states``.

    Attributes
    ----------
    max_m : float
        Distances are exact up to this, m.
    radius_m : float
        They are computed within this of the place given to ``update``, m; 0: everywhere.

    Parameters
    ----------
    blocks : BlockMap
        The map.
    max_m, radius_m : float
        As above.

    Raises
    ------
    ConfigError
        If max_m is not positive or more than 127 voxels.

    """

    def __init__(self, blocks: BlockMap, *, max_m: float = 2.0, radius_m: float = 0.0) -> None:
        size_m = blocks.config.voxel_size_m
        if not size_m <= as_real('esdf.max_m', max_m) <= MAX_REACH * size_m:
            raise ConfigError(
                f'esdf.max_m: {max_m}, expected {size_m} to {MAX_REACH * size_m:g}, that '
                f'is 1 to {MAX_REACH} voxels'
            )
        self.max_m, self.radius_m = max_m, radius_m
        self._blocks = blocks
        self._low: Int64 = np.zeros(3, np.int64)
        self._squared: npt.NDArray[np.uint16] = np.empty((0, 0, 0), np.uint16)
        self._observed: Flags = np.empty((0, 0, 0), bool)
        self._state: tuple[float, ...] = ()

    @property
    def nbytes(self) -> int:
        """Bytes used by the distances."""
        return self._squared.nbytes + self._observed.nbytes

    def update(self, center: npt.ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """
        Compute the distances of the present map.

        Parameters
        ----------
        center : (3,) float
            Distances are computed about it, map frame, m; needed with ``radius_m``.

        Raises
        ------
        MapLimitError
            If the blocks span too many voxels.

        """
        blocks, side = self._blocks, self._blocks.config.voxels_per_side
        state = blocks.version, *np.asarray(center, np.float64).tolist()
        if state == self._state:
            return
        rows = blocks.rows()
        centers = (blocks.index(rows) + 0.5) * blocks.config.block_size_m
        far_m = np.linalg.norm(centers - state[1:], axis=1)
        radius_m = self.radius_m or math.inf
        near = far_m <= radius_m + self.max_m + math.sqrt(3.0) * blocks.config.block_size_m
        rows, within = rows[near], far_m[near] <= radius_m
        index = blocks.index(rows)
        low, high = extent(blocks, index)
        size = checked_size(high - low)
        observed = blocks.weight[rows] > 0.0
        occupied = observed & (blocks.distance[rows] <= 0.5 * blocks.config.voxel_size_m)
        offsets = (index - low // side)[:, ::-1]
        self._observed = dense(observed & within[:, None], offsets, size, side)
        self._squared = self._transform(dense(occupied, offsets, size, side))
        self._low, self._state = low, state

    def _transform(self, occupied: Flags) -> npt.NDArray[np.uint16]:
        """Return the squared distances of voxels to occupied ones, (nz, ny, nx) both."""
        reach = int(self.max_m / self._blocks.config.voxel_size_m * (1.0 + 1e-9))
        squared = np.where(occupied, np.uint16(0), FAR)
        for axes in ((0, 1, 2), (0, 2, 1), (1, 0, 2)):  # along y, x and z
            source = np.ascontiguousarray(squared.transpose(axes))
            squared = source.copy()
            spread(source, reach, squared)
        return np.ascontiguousarray(squared.transpose(1, 2, 0))

    def sample(self, points: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """
        Return the distances of the voxels at points after the last update.

        Parameters
        ----------
        points : (P, 3) float
            In the map frame, m.

        Returns
        -------
        (P,) float32
            Distance to the nearest obstacle, m, at most ``max_m``; 0 in obstacles; nan if the
            voxel was not observed or is out of the radius.

        Raises
        ------
        ValueError
            If points are of another shape.

        """
        scaled = np.floor(in_voxels(self._blocks, points)[0]) - self._low
        shape = self._squared.shape[::-1]
        inside = np.all((scaled >= 0.0) & (scaled < shape), axis=1)
        x, y, z = scaled[inside].astype(np.int64).T
        distances = np.full(len(scaled), np.nan, np.float32)
        metres = self._metres(self._squared[z, y, x])
        distances[inside] = np.where(self._observed[z, y, x], metres, np.nan)
        return distances

    def known(self) -> KnownDistances:
        """Return the distances of all observed voxels within the radius."""
        index = np.nonzero(self._observed)
        voxels = np.stack(index[::-1], axis=1) + self._low
        return KnownDistances(
            points=np.asarray((voxels + 0.5) * self._blocks.config.voxel_size_m, np.float64),
            distance=self._metres(self._squared[index]),
        )

    def _metres(self, squared: npt.NDArray[np.uint16]) -> npt.NDArray[np.float32]:
        metres = np.sqrt(squared.astype(np.float32)) * self._blocks.config.voxel_size_m
        return np.asarray(np.minimum(metres, self.max_m), np.float32)


def dense(values: Flags, offsets: Int64, size: Int64, side: int) -> Flags:
    """Return the voxels of blocks (K, N) at offsets (K, 3), z y x, in a box of voxels, x y z."""
    box = np.zeros((*size[::-1] // side, side, side, side), bool)
    box[tuple(offsets.T)] = values.reshape(-1, side, side, side)
    return box.transpose(0, 3, 1, 4, 2, 5).reshape(tuple(size[::-1]))
