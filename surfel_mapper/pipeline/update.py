# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What one scan did to the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.registration import RegistrationResult
from surfel_mapper.mapping.moments import pack_keys
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.mapping.window import Eviction
from surfel_mapper.pipeline.window_aligner import Alignment
from surfel_mapper.scan import Scan

if TYPE_CHECKING:  # the models take 0.1 s to load
    from surfel_mapper.models.live import ModelUpdate


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Update:
    """
    What one scan did to the map.

    Attributes
    ----------
    scan : Scan
        As it came in, but deskewed; filters have not touched it.
    stamp_ns : int
        Stamp of the scan.
    frame_id : str
        The frame of the map, in which the surfels are.
    T_map_sensor : (4, 4) float64
        Pose of the sensor in the map, after the alignment if one was due.
    num_points : int
        Points of the scan that entered the map.
    changed : Surfels
        Every voxel that the scan or an eviction changed and that has ``map.min_points``.
    removed_voxel_index : (K, 3) int32
        Voxels that were surfels and, after an eviction, an alignment or because scans see
        through them, have too few points.
    evictions : tuple of Eviction
        The scans that left, oldest first.
    alignment : Alignment, optional
        Result of the alignment of the window, if one was due after this scan.
    registration : RegistrationResult, optional
        Result of the registration to the map, if ``pose.source`` is ``registration``.
    models : ModelUpdate, optional
        What became of planes, surfaces and Gaussians, where they were brought up to date.
    milliseconds : dict of str to float
        Time by stage: filter (where there are any), reduce, insert (evictions included),
        normals, total.

    """

    scan: Scan
    stamp_ns: int
    frame_id: str
    T_map_sensor: npt.NDArray[np.float64]
    num_points: int
    changed: Surfels
    removed_voxel_index: npt.NDArray[np.int32]
    evictions: tuple[Eviction, ...]
    milliseconds: dict[str, float]
    alignment: Alignment | None = None
    registration: RegistrationResult | None = None
    models: ModelUpdate | None = None


def removed_voxels(
    evictions: Sequence[Eviction],
    cleared: npt.NDArray[np.int32],
    alignment: Alignment | None,
    changed: Surfels,
) -> npt.NDArray[np.int32]:
    """Return the voxels (K, 3) that were surfels before all these, and are none now."""
    fallen = [cleared, *(eviction.fallen for eviction in evictions)]
    if alignment is None:
        return np.concatenate(fallen)
    gone = np.unique(np.concatenate([*fallen, alignment.removed_voxel_index]), axis=0)
    left: npt.NDArray[np.int32] = gone[~np.isin(pack_keys(gone), pack_keys(changed.voxel_index))]
    return left
