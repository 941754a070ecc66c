# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Update: the changes that one scan made to the map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.alignment.registration import RegistrationResult
from surfel_mapper.arguments import Record
from surfel_mapper.layers import names as layer_names
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.mapping.window import Eviction
from surfel_mapper.pipeline.drops import ScanOutcome
from surfel_mapper.pipeline.window_aligner import Alignment
from surfel_mapper.scan import Scan


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Update(Record):
    """
    The changes that one scan made to the map.

    Attributes
    ----------
    scan : Scan
        Deskewed, before the filters.
    filtered : Scan
        The scan after the filters, with the columns that they added; without filters the scan
        itself.
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
        Voxels that were surfels and have too few points since an eviction, an alignment, or a
        layer cleared them.
    evictions : tuple of Eviction
        The scans that left, oldest first.
    alignment : Alignment, optional
        Result of the alignment of the window, if one was due after this scan.
    registration : RegistrationResult, optional
        Result of the registration to the map, if ``pose.source`` is ``registration``.
    T_fixed_body : (4, 4) float64, optional
        Pose of the frame that registration tracks.
    layers : mapping of str to object
        The results of layers that followed the scan, by name; ``update.models`` is that of
        ``models``, or None.
    outcome : ScanOutcome
        ``mapped``, or ``localised`` in a frozen map, with the source of the pose.
    milliseconds : dict of str to float
        Time by stage: filter (if there are any), reduce, insert (evictions included), one stage
        for each layer, normals, total.

    """

    scan: Scan
    filtered: Scan
    stamp_ns: int
    frame_id: str
    T_map_sensor: npt.NDArray[np.float64]
    num_points: int
    changed: Surfels
    removed_voxel_index: npt.NDArray[np.int32]
    evictions: tuple[Eviction, ...]
    outcome: ScanOutcome
    milliseconds: dict[str, float]
    alignment: Alignment | None = None
    registration: RegistrationResult | None = None
    T_fixed_body: npt.NDArray[np.float64] | None = None
    layers: Mapping[str, Any] = field(default_factory=dict)

    if not TYPE_CHECKING:  # hidden from mypy: the names depend on the registry

        def __getattr__(self, name: str) -> Any:
            """Return the result of a layer, None if it had none."""
            if name in layer_names():
                return self.layers.get(name)
            raise AttributeError(f'{type(self).__name__!r} object has no attribute {name!r}')
