# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
WindowedScan: what a window keeps of a scan.

Its moments are what leaves the map again, to the bit; its points, where they are kept, are those
that the moments are of, so that the scan can be reduced anew at another pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.moments import point_keys, ScanMoments


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class WindowedScan:
    """
    A scan in the window.

    Attributes
    ----------
    moments : ScanMoments
        What the map holds of it.
    stamp_ns : int
        Time of the scan.
    T_map_sensor : (4, 4) float64
        The pose it was added at.
    points : (N, 3) float32 or float64, m, optional
        Its points in the sensor frame, where they are kept: those that the moments are of.
    columns : mapping of str to (N,) array
        What else of them the map sums.

    """

    moments: ScanMoments
    stamp_ns: int
    T_map_sensor: npt.NDArray[np.float64]
    points: npt.NDArray[Any] | None = None
    columns: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)

    @property
    def nbytes(self) -> int:
        """Bytes of moments, points and columns."""
        kept = [*self.columns.values(), *([] if self.points is None else [self.points])]
        return self.moments.nbytes + sum(array.nbytes for array in kept)


def without(scan: WindowedScan, keys: npt.NDArray[np.int64]) -> WindowedScan:
    """Return a scan without the voxels of some sorted keys."""
    hit = contains(keys, scan.moments.key)
    if not hit.any():
        return scan
    rest = replace(scan, moments=scan.moments.select(~hit))
    if scan.points is None:
        return rest
    size_m = scan.moments.voxel_size_m
    stay = ~contains(keys, point_keys(scan.points, scan.T_map_sensor, size_m))
    columns = {name: column[stay] for name, column in scan.columns.items()}
    return replace(rest, points=scan.points[stay], columns=columns)


def contains(keys: npt.NDArray[np.int64], wanted: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Return which of the wanted keys are among the keys, which are sorted."""
    at = np.searchsorted(keys, wanted)
    return np.asarray(keys[np.minimum(at, len(keys) - 1)] == wanted)
