# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Saving the map where the configuration says."""

from __future__ import annotations

from pathlib import Path

from surfel_mapper.io.ply import write_surfels
from surfel_mapper.pipeline import Mapper


def save_map(mapper: Mapper) -> str:
    """
    Write the map to ``output.map_name``.ply in ``output.directory``; return what was written.

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
    return (
        f'{path}: {len(surfels)} surfels of {len(mapper.window)} scans '
        f'({mapper.counters.received} received), digest {mapper.map.digest()}'
    )
