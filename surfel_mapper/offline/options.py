# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Options of a replay, and the formats that it writes; loads no compiler, for the command line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from surfel_mapper.config import load_layer_packages
from surfel_mapper.layers import formats

BAG = 'bag'
"""Format that is written while mapping: a bag of normals in the directory ``normals``."""

TILES = 'tiles'
"""Format of a Parquet dataset in the directory ``map``."""

MAP_FORMATS = {
    'ply': 'map.ply',
    'pcd': 'map.pcd',
    'parquet': 'map.parquet',
    TILES: 'map',
    'npz': 'map.npz',
    BAG: 'normals',
}
"""File of each format of the map; npz, parquet and tiles are exact, to be loaded again.

In the order of writing: of several maps in a directory the one written last is read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayOptions:
    """
    Options of a replay beside its configuration.

    Attributes
    ----------
    window : bool
        Let scans leave the map by the window of the configuration, as the node does; else all
        scans stay.
    align : bool, optional
        Close loops, and align all scans with each other at the end; the latter keeps all points
        in memory until then. By default loops are closed if poses come from registration.
    formats : tuple of str
        Formats: ply, pcd, parquet, npz and bag of the map, obj and glb of the layer models.
    poses_out : Path, optional
        File for the poses of the scans, as TUM text.
    truth : Path, optional
        True poses of the sensor, a file or a simulated bag; the summary states the errors.
    view : bool
        Show the map in rerun while it grows.
    rrd : Path, optional
        File for the same, for rerun to open.
    overwrite : bool
        Replace files that exist; without it, the output must be a new or an empty directory.

    """

    window: bool = False
    align: bool | None = None
    formats: tuple[str, ...] = ('ply', 'npz')
    poses_out: Path | None = None
    truth: Path | None = None
    view: bool = False
    rrd: Path | None = None
    overwrite: bool = False


def known_formats() -> dict[str, str]:
    """Return the file of each format in the output directory: of the map, and of all layers."""
    load_layer_packages()
    return {**MAP_FORMATS, **{name: layer.formats[name] for name, layer in formats().items()}}
