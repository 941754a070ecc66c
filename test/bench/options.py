# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Options: the size of a benchmark; quoted figures are for the defaults."""

from __future__ import annotations

from dataclasses import dataclass, field
import os
from pathlib import Path

WARM_SCANS = 5
"""Number of scans mapped into a full window before timing starts; by then kernels are loaded."""


def cache_directory() -> Path:
    """Return the directory of simulated scans and of the environments of peers."""
    caches = os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'
    return Path(caches) / 'surfel_mapper_bench'


@dataclass(frozen=True, kw_only=True)
class Options:
    """
    Options of every bench.

    Attributes
    ----------
    scans : int
        Scans timed, after the window is full.
    window : int
        Scans in the window.
    voxel_sizes_m : tuple of float
        Edges of voxels.
    beams, columns : int
        Of the simulated lidar.
    peers : bool
        Whether other packages are installed and measured too.
    cache : Path
        Directory of files kept between runs.
    data : tuple of Path
        Data sets of users: folders of depth images, bags.
    frames : int
        Frames of each data set, at most.

    """

    scans: int = 100
    window: int = 100
    voxel_sizes_m: tuple[float, ...] = (0.5, 0.2)
    beams: int = 64
    columns: int = 2048
    peers: bool = False
    cache: Path = field(default_factory=cache_directory)
    data: tuple[Path, ...] = ()
    frames: int = 10

    @property
    def num_points(self) -> int:
        """Points of a scan, those without return included."""
        return self.beams * self.columns

    @property
    def untimed(self) -> int:
        """Scans before the first that is timed."""
        return self.window + WARM_SCANS
