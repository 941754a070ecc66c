# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Merge finished maps: the exact sum of their points, at the origin of the first."""

from __future__ import annotations

from collections.abc import Sequence
import logging
from pathlib import Path

from surfel_mapper.errors import FileFormatError, MapError
from surfel_mapper.files.latest_map import EXACT, map_in
from surfel_mapper.files.map_state import window_stamps_ns
from surfel_mapper.files.trajectory import read_trajectory, trajectory_beside
from surfel_mapper.mapping.surfel_map import SurfelMap

_log = logging.getLogger(__name__)


def merged(sources: Sequence[Path]) -> SurfelMap:
    """
    Return the sum of the maps in files or output directories.

    Raises
    ------
    FileFormatError
        If a map cannot be read.
    MapError
        If the maps differ in voxel size or columns, or their origins are not a whole number of
        voxels apart.

    """
    for source in sources:
        if not source.exists() or (source.is_dir() and map_in(source, EXACT) is None):
            raise FileFormatError(
                f'{source}: no map; expected map/tile_i=*/tile_j=*/, or map.parquet or map.npz of '
                'surfel-mapper replay'
            )
    total = SurfelMap.load(sources[0])
    for source in sources[1:]:
        try:
            total.merge(SurfelMap.load(source))
        except MapError as error:
            raise MapError(f'{source}: {error}; merged with {sources[0]}') from error
    warn_of_repeated_scans(sources)
    return total


def warn_of_repeated_scans(sources: Sequence[Path]) -> None:
    """Log a warning if two maps contain scans of equal stamps, by the trajectories beside them."""
    source_of: dict[int, Path] = {}
    for source in sources:
        stamps_ns = stamps_of_map(source)
        repeated = source_of.keys() & stamps_ns
        if repeated:
            _log.warning(
                '%s: %d of its %d scans have stamps of scans in %s; the points of a drive that is '
                'merged twice count twice',
                source,
                len(repeated),
                len(stamps_ns),
                source_of[min(repeated)],
            )
        source_of |= dict.fromkeys(stamps_ns - source_of.keys(), source)


def stamps_of_map(source: Path) -> set[int]:
    """Return the stamps of a map's scans, ns: of the trajectory beside it, or of its window."""
    path = trajectory_beside(source)
    if path is not None:
        stamps_ns = read_trajectory(path).stamp_ns
        return set() if stamps_ns is None else set(stamps_ns.tolist())
    file = map_in(source, EXACT) or source
    return set(window_stamps_ns(file)) if file.suffix == '.npz' and file.is_file() else set()
