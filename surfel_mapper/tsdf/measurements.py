# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Input and result of an integration, whether of an image or of points: pose, settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.arguments import as_array, as_numbers
from surfel_mapper.config import TsdfConfig
from surfel_mapper.config.layers import LEAST_WEIGHT, MAX_LABEL, MAX_WEIGHT
from surfel_mapper.errors import CloudFormatError, PoseError
from surfel_mapper.geometry import check_rigid
from surfel_mapper.tsdf.blocks import BlockMap, Int64
from surfel_mapper.tsdf.kernels import lookup as kernels
from surfel_mapper.tsdf.kernels.blocks import STAMP
from surfel_mapper.tsdf.kernels.integration import OBSERVED

logger = logging.getLogger(__name__)

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]


def warn_of_short_truncation(config: TsdfConfig) -> None:
    """Warn if the truncation leaves holes."""
    if config.tau_m < 2.0 * config.voxel_size_m:
        logger.warning(
            'layers.tsdf.truncation_m: %g m is less than two voxels of %g m; surfaces may have '
            'holes',
            config.tau_m,
            config.voxel_size_m,
        )


@dataclass(frozen=True, kw_only=True)
class Integrated:
    """
    Counts of one integrated range image.

    Attributes
    ----------
    num_blocks : int
        Blocks selected.
    num_updated : int
        Blocks in which at least one voxel was observed.
    num_added : int
        Updated blocks that are new in the map.
    num_voxels : int
        Voxels observed.

    """

    num_blocks: int
    num_updated: int
    num_added: int
    num_voxels: int


def fuse_into(
    blocks: BlockMap,
    index: Int64,
    near: npt.NDArray[np.bool_],
    stamp_ns: int,
    fuse: Callable[[Int64, Int64], Int64],
) -> Integrated:
    """
    Fuse a measurement into its blocks, of which missing ones are added.

    Parameters
    ----------
    blocks : BlockMap
        The map.
    index : (K, 3) int64
        The blocks.
    near : (K,) bool
        Blocks near a surface. Others are left out if they were free for long.
    stamp_ns : int
        Stamp of the measurement, ns.
    fuse : callable
        Fuses into blocks, given by their places in index and their rows; returns figures of each.

    """
    num_before = blocks.num_blocks
    rows = blocks.place(index)
    try:
        skipped = ~near & blocks.settled(rows)
        blocks.head[rows[skipped], STAMP] = stamp_ns
        chosen = np.flatnonzero(~skipped)
        figures = fuse(chosen, rows[chosen])
        observed = figures[:, OBSERVED]
        changed = observed > 0
        updated = rows[chosen][changed]
        if len(updated):
            blocks.touch_fused(updated, stamp_ns, figures[changed])
    finally:
        blocks.drop_new(rows)
    return Integrated(
        num_blocks=len(rows),
        num_updated=len(updated),
        num_added=blocks.num_blocks - num_before,
        num_voxels=int(observed.sum()),
    )


def settings(config: TsdfConfig) -> Float32:
    """Return the settings that any integration needs, in the order of kernels/lookup.py."""
    values = np.zeros(kernels.NUM_SETTINGS, np.float32)
    values[kernels.TAU] = config.tau_m
    values[kernels.MIN_RANGE] = config.min_range_m
    values[kernels.MAX_RANGE] = config.max_range_m
    values[kernels.DROPOFF] = config.voxel_size_m
    values[kernels.MIN_WEIGHT] = LEAST_WEIGHT
    values[kernels.MAX_WEIGHT] = MAX_WEIGHT
    values[kernels.CONTRADICTS] = 0.5 * config.voxel_size_m
    return values


def checked_points(points: npt.ArrayLike) -> npt.NDArray[Any]:
    """Return points (N, 3) as float32 or float64; raise CloudFormatError for other shapes."""
    try:
        array = as_array('points', points)
    except ValueError as error:
        raise CloudFormatError(str(error)) from None
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in 'fiu':
        raise CloudFormatError(f'points: {array.dtype} {array.shape}, expected (N, 3) float')
    if array.dtype == np.float16:
        return array.astype(np.float32)
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)


def checked_column(
    name: str, values: Any, kind: Any, shapes: tuple[tuple[int, ...], ...]
) -> npt.NDArray[Any] | None:
    """Return a column of points as an array; raise CloudFormatError for other types and shapes."""
    if values is None:
        return None
    try:
        array = as_array(name, values)
    except ValueError as error:
        raise CloudFormatError(str(error)) from None
    if array.shape not in shapes or not np.issubdtype(array.dtype, kind):
        expected = f'{kind.__name__} {" or ".join(map(str, shapes))}, one for each point'
        raise CloudFormatError(f'{name}: {array.dtype} {array.shape}, expected {expected}')
    return array


def checked_labels(name: str, labels: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    """Return labels as int32; raise CloudFormatError if they are not whole or out of range."""
    ends = (labels.min(), labels.max()) if labels.size else (0, 0)
    if labels.dtype.kind not in 'iu' or not -1 <= ends[0] <= ends[1] <= MAX_LABEL:
        raise CloudFormatError(
            f'{name}: {labels.dtype} from {ends[0]} to {ends[1]}, expected whole numbers from -1 '
            f'to {MAX_LABEL}'
        )
    return labels.astype(np.int32, copy=False)


def checked_pose(T_map_sensor: Float64) -> Float64:
    """Return a pose as float64; raise PoseError if it is not finite or not rigid."""
    try:
        T = as_numbers('pose of the sensor', T_map_sensor)
        check_rigid('pose of the sensor', T)
    except ValueError as error:
        raise PoseError(str(error)) from None
    return T
