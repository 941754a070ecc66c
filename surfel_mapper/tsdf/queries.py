# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Queries of the field at points: distance, gradient, occupancy, labels.

Distances are measured along rays and truncated. They exceed the Euclidean distance by 1 / cos of
the angle of incidence; the zero level, the surface, is not affected.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_numbers, Record
from surfel_mapper.errors import MapLimitError
from surfel_mapper.tsdf.blocks import BlockMap
from surfel_mapper.tsdf.kernels import queries as kernels

UNKNOWN = kernels.UNKNOWN
FREE = kernels.FREE
OCCUPIED = kernels.OCCUPIED

MAX_VOXELS = 1 << 27
"""Limit of the voxels in a box: their distances take 0.5 GB, computing them four times that."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Sampled(Record):
    """
    The field at points.

    Attributes
    ----------
    distance : (P,) float32
        Signed distance, m, positive in front of a surface; nan if unknown.
    gradient : (P, 3) float32
        Gradient of the distance, no unit, map frame; nan if unknown.

    """

    distance: npt.NDArray[np.float32]
    gradient: npt.NDArray[np.float32]


def sample(blocks: BlockMap, points: npt.ArrayLike) -> Sampled:
    """
    Return distance and gradient at points, interpolated between voxel centres.

    Parameters
    ----------
    blocks : BlockMap
        The map.
    points : (P, 3) float
        In the map frame, m.

    Raises
    ------
    ValueError
        If points are of another shape.

    """
    scaled, bits = in_voxels(blocks, points)
    distance, gradient = np.empty(len(scaled), np.float32), np.empty(scaled.shape, np.float32)
    scale = 1.0 / blocks.config.voxel_size_m
    head, table, state = blocks.lookup
    kernels.sample(scaled, scale, bits, blocks.field, head, table, state, distance, gradient)
    return Sampled(distance=distance, gradient=gradient)


def states(blocks: BlockMap, points: npt.ArrayLike) -> npt.NDArray[np.uint8]:
    """
    Return the state of the voxel at each point: UNKNOWN, FREE or OCCUPIED.

    Voxels up to half a voxel in front of a surface, and those behind it, are occupied.

    Parameters
    ----------
    blocks : BlockMap
        The map.
    points : (P, 3) float
        In the map frame, m.

    Raises
    ------
    ValueError
        If points are of another shape.

    """
    scaled, bits = in_voxels(blocks, points)
    states, occupied_m = np.empty(len(scaled), np.uint8), 0.5 * blocks.config.voxel_size_m
    most, (head, table, state) = np.float32(occupied_m), blocks.lookup
    kernels.classify(scaled, bits, most, blocks.field, head, table, state, states)
    return states


def in_voxels(blocks: BlockMap, points: npt.ArrayLike) -> tuple[npt.NDArray[np.float64], int]:
    """Return points in units of voxels, and the bits of a voxel index within a block."""
    xyz = as_numbers('points', points)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ValueError(f'points: {xyz.shape}, expected (P, 3)')
    bits = blocks.config.voxels_per_side.bit_length() - 1
    return xyz / blocks.config.voxel_size_m, bits


Float32 = npt.NDArray[np.float32]


def extent(
    blocks: BlockMap, index: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the bounds of blocks in voxels: the first of each axis, and the last plus one."""
    if not len(index):
        return np.zeros(3, np.int64), np.zeros(3, np.int64)
    side = blocks.config.voxels_per_side
    return index.min(axis=0) * side, (index.max(axis=0) + 1) * side


def checked_size(size: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the size of a box in voxels; raise MapLimitError beyond MAX_VOXELS."""
    shape = size.tolist()
    if math.prod(shape) > MAX_VOXELS:
        raise MapLimitError(
            f'a box of {" x ".join(map(str, shape))} voxels; at most {MAX_VOXELS}: take a smaller '
            'one, or set layers.tsdf.max_radius_m'
        )
    return size


def labels_at(blocks: BlockMap, points: npt.ArrayLike) -> tuple[npt.NDArray[np.int32], Float32]:
    """
    Return the label of the voxel at each point, and its lead over all others, measurements.

    Parameters
    ----------
    blocks : BlockMap
        A map that keeps labels (``semantics``).
    points : (P, 3) float
        In the map frame, m.

    Returns
    -------
    (P,) int32 and (P,) float32
        As ``labels_of``; -1 and 0 for points outside of the map, and for uncertain labels.

    Raises
    ------
    ValueError
        If points are of another shape, or the map keeps no labels.

    """
    if blocks.config.semantics == 'none':
        raise ValueError("semantics: 'none', expected a map that keeps labels")
    scaled, bits = in_voxels(blocks, points)
    near = np.abs(scaled).max(axis=1) < 1e12  # false for nan and for indices beyond int64
    voxel = np.floor(np.where(near[:, None], scaled, 0.0)).astype(np.int64)
    rows = np.where(near, blocks.find(voxel >> bits), -1)
    x, y, z = (voxel & ((1 << bits) - 1)).T
    votes = blocks.votes[rows, :, x + ((y + (z << bits)) << bits)]
    votes[rows < 0] = 0.0  # as in a voxel without labels
    return labels_of(votes.T, blocks.config.label_lead)


def labels_of(votes: Float32, least_lead: float) -> tuple[npt.NDArray[np.int32], Float32]:
    """
    Return the label of each voxel and its lead, from votes (2, ...); -1 and 0 for none.

    A smaller lead than ``least_lead`` is none. See tsdf/kernels/channels.py for the votes.
    """
    votes = np.where(votes[1] >= least_lead, votes, np.float32(0.0))
    return votes[0].astype(np.int32) - 1, votes[1]
