# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Saving the map where the configuration says, and nowhere else."""

from __future__ import annotations

from pathlib import Path

from surfel_mapper.io.map_state import save_map as save_state
from surfel_mapper.io.ply import write_surfels
from surfel_mapper.pipeline import Mapper


def save_map(mapper: Mapper) -> str:
    """
    Write the map to ``output.directory``; return what was written.

    ``output.map_name``.ply holds the surfels, for other programs; ``output.map_name``.npz the
    exact map and its window, to go on from.

    Raises
    ------
    FileFormatError, OSError
        If the file or its directory cannot be written.

    """
    output = mapper.config.output
    directory = Path(output.directory).expanduser().absolute()
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f'{output.map_name}.ply'
    surfels = mapper.map.surfels(mapper.config.map.min_points)
    write_surfels(path, surfels)
    digest = save_state(path.with_suffix('.npz'), mapper.map, mapper.window)
    return (
        f'{path} and .npz: {len(surfels)} surfels of {len(mapper.window)} scans '
        f'({mapper.counters.received} received), digest {digest}'
    )
