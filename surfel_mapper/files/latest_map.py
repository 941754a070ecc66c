# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The map of an output directory: the one that was written last.

A run replaces the files that it writes and leaves others of an earlier run, so tiles and files of
one directory may be of different maps. It stands alone so that all verbs, map.load and
SurfelMap.load read the same map, each among the forms that it can read.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from surfel_mapper.files.map_state import FILE
from surfel_mapper.files.parquet_tiles import dataset_in, tiles_in

TILES = 'map'
"""The form of a dataset of tiles: the directory itself, or ``map`` inside it."""

RESTORABLE = (FILE, TILES)
"""Forms from which mapping continues; the file may have a window and layers."""

EXACT = (*RESTORABLE, 'map.parquet')
"""Forms that keep the moments."""

DRAWABLE = (*EXACT, 'map.ply', 'map.pcd')
"""Forms that have position and normal of each surfel."""


def map_in(directory: str | Path, forms: Sequence[str]) -> Path | None:
    """
    Return the map in a directory that was written last, a file or a dataset; None without one.

    Parameters
    ----------
    directory : str or Path
        Output directory of a replay or a merge, or a dataset of tiles.
    forms : sequence of str
        The forms that the caller reads; of maps written at the same time the first is returned.

    """
    tiles = dataset_in(directory)
    paths = [tiles if form == TILES else Path(directory, form) for form in forms]
    maps = [path for path in paths if path is not None and (path == tiles or path.is_file())]
    return max(maps, key=modified_ns, default=None)


def modified_ns(path: Path) -> int:
    """Return the time at which a file, or the newest tile of a dataset, was written, ns."""
    files = tiles_in(path).values() if path.is_dir() else (path,)
    return max(file.stat().st_mtime_ns for file in files)
