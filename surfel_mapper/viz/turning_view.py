# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The interactive 3D view of report.html: its elements and the data for page/view.js.

The data is JSON without the character <, so it cannot begin a tag. A surfel takes 12 bytes and one
or two for each of its values, 1.7 MB of text for the limit of surfels, which keeps the page below
2 MB; with meshes fewer surfels are shown.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from importlib.resources import files
import json
from string import Template
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.discs import as_bytes, COLUMNS, DrawnDiscs, ramp, SPREAD, UNITS
from surfel_mapper.viz.framing import levelled
from surfel_mapper.viz.mesh import MAX_TRIANGLES, mesh_data

Array = npt.NDArray[np.float64]

MAX_SHOWN, BESIDE_MESHES = 50_000, 28_000
"""Limits of the surfels shown, alone and if there are meshes; see ``detail.drawn_surfels``."""

SURFEL = np.dtype(
    [('place', '<u2', 3), ('radius', 'u1'), ('time', 'u1'), ('normal', 'i1', 3), ('level', 'u1')]
)
"""Surfel format of page/view.js; ``level`` is 8 times that of the cell."""

MOST_POSES = 2000
"""Limit of the positions of the trajectory."""

UNLIMITED_M = 1e9
"""Edge of cells at which no disc ends."""

LOGARITHMIC = 8.0
"""Values are coded by their logarithm if the largest is more than this times the median."""


def turning_view(
    surfels: Surfels,
    trajectory: Array,
    seconds: Array,
    summary: Mapping[str, Any],
    layers: Mapping[str, Mesh],
) -> str:
    """
    Return the 3D view with its data; layers can be shown in the place of the surfels.

    ``surfels`` are those drawn, of several levels for a large map; if they are more than the limit
    a selection with a fixed seed is shown. ``trajectory`` has the positions of the sensor, (S, 3)
    m, and ``seconds`` their times.
    """
    layers = {name: mesh for name, mesh in layers.items() if len(mesh)}
    shown = within_sight(surfels)
    note = ''
    # while the view moves, only the first are drawn
    mixed = np.random.default_rng(0).permutation(len(shown))
    shown = shown.select(mixed[: most_shown(layers)])
    if len(shown) < len(mixed):
        note += f' {len(shown):,} of {summary["surfels"]:,} surfels are shown.'
    elif len(surfels) < summary['surfels']:
        note += (
            f' The {summary["surfels"]:,} surfels are drawn as {len(shown):,}. Flat regions are '
            'merged, and in a large map all that is far from the end of the trajectory.'
        )
    options = ''.join(f'<option>{name}</option>' for name in ('surfels', *layers))
    choice = f'<label>show <select id="shown">{options}</select></label>' if layers else ''
    for name, mesh in layers.items():
        if len(mesh) > MAX_TRIANGLES // len(layers):
            note += f' {len(mesh):,} triangles of the {name} are merged into fewer.'
    origin_m = np.asarray(summary.get('origin_m', (0.0, 0.0, 0.0)), np.float64)
    data = json.dumps(view_data(shown, trajectory, seconds, layers, origin_m)).replace(
        '<', '\\u003c'
    )
    template = (files('surfel_mapper.viz') / 'page' / 'view.html').read_text(encoding='utf-8')
    return Template(template.strip()).substitute(choice=choice, note=note, data=data)


def most_shown(layers: Mapping[str, Mesh]) -> int:
    """Return the limit of the surfels beside these layers."""
    return BESIDE_MESHES if any(map(len, layers.values())) else MAX_SHOWN


def within_sight(surfels: Surfels) -> Surfels:
    """Return the surfels without outliers so far away that all others would be tiny."""
    if not len(surfels):
        return surfels
    low, high = np.percentile(surfels.position, [0.5, 99.5], axis=0)
    spare = 0.6 * (high - low) + 1.0
    inside = (surfels.position >= low - spare) & (surfels.position <= high + spare)
    return surfels.select(np.asarray(inside.all(axis=1)))


def view_data(
    surfels: Surfels,
    trajectory: Array,
    seconds: Array,
    layers: Mapping[str, Mesh],
    origin_m: Array,
) -> dict[str, Any]:
    """
    Return the data for page/view.js, in metres from the middle of the map.

    Heights and the middle are stated with the map's origin added.
    """
    low, high = np.zeros(3), np.ones(3)
    positions = [surfels.position] if len(surfels) else [mesh.vertices for mesh in layers.values()]
    if positions:
        xyz = np.concatenate(positions)
        low, high = xyz.min(axis=0), xyz.max(axis=0)
    size = np.maximum(high - low, 1e-3)
    radius = SPREAD * surfels.radius
    largest = float(radius.max(initial=1e-3))
    rows = np.unique(np.linspace(0, max(len(trajectory) - 1, 0), MOST_POSES).astype(np.int64))
    way = trajectory[rows[: len(trajectory)]]
    passed = nearest_pose(surfels.position, way[:: max(len(way) // 256, 1)])
    packed = np.zeros(len(surfels), SURFEL)
    cell_m, side_m = cells_of(surfels)
    packed['level'] = 8 * np.rint(np.log2(side_m / cell_m))
    packed['place'] = place_codes(surfels.position, side_m[:, None], low, size / 65535.0)
    packed['radius'] = np.ceil(radius / largest * 255.0)
    packed['time'] = np.rint(255.0 * passed)
    packed['normal'] = np.rint(surfels.normal * 127.0)
    columns = {name: getattr(surfels, name) for name in COLUMNS} | dict(surfels.channels)
    return {
        'surfels': encoded(packed),
        'columns': [column_data(name, values) for name, values in columns.items()],
        'trajectory': encoded((way - (low + 0.5 * size)).astype('<f4')),
        'seconds': seconds[rows[: len(way)]].round(2).tolist() if len(seconds) else [],
        'ramp': encoded(as_bytes(ramp(np.arange(256) / 255.0))),
        'size': size.tolist(),
        'largest': largest,
        'cell': cell_m,
        'grid': (low + 0.5 * size).tolist(),
        'layers': [
            mesh_data(mesh, low, size, MAX_TRIANGLES // len(layers)) for mesh in layers.values()
        ],
        'level': levelled(DrawnDiscs.of(surfels)).tolist(),
        'middle': (low + 0.5 * size + origin_m).tolist(),
    }


def cells_of(surfels: Surfels) -> tuple[float, Array]:
    """Return the smallest edge of the cells, and all, (K,) m; UNLIMITED if one is unknown."""
    side_m = surfels.size.astype(np.float64)
    if not len(side_m) or not np.isfinite(side_m).all():
        return UNLIMITED_M, np.full(len(side_m), UNLIMITED_M)
    return float(side_m.min()), side_m


def place_codes(position: Array, side_m: Array, low: Array, step_m: Array) -> Array:
    """Return positions (K, 3) in steps from a corner, rounded to the inside of their cells."""
    cell = np.floor(position / side_m) * side_m - low
    least, most = np.ceil(cell / step_m + 0.01), np.floor((cell + side_m) / step_m - 0.01)
    codes = np.clip(np.rint((position - low) / step_m), least, most)
    return np.asarray(np.clip(codes, 0.0, 65535.0))


def nearest_pose(position: Array, way: Array) -> Array:
    """Return which of some poses (S, 3) is nearest to each position, (K,) from 0 to 1."""
    if len(way) < 2:
        return np.ones(len(position))
    nearest = [
        ((way * way).sum(axis=1) - 2.0 * block @ way.T).argmin(axis=1)
        for block in np.array_split(position, len(position) // 8192 + 1)
    ]
    return np.asarray(np.concatenate(nearest) / (len(way) - 1.0))


def column_data(name: str, values: npt.NDArray[Any]) -> dict[str, Any]:
    """
    Return a column for page/view.js: its name and unit, and codes from low to high.

    Whole numbers are exact up to 65,535. Others have 255 steps, of their logarithm if a few are
    much larger; a code of 0 is nan.
    """
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    steps = 65535 if values.dtype.kind == 'i' and 254 < high - low < 65535 else 255
    is_log = low > 0.0 and high > LOGARITHMIC * float(np.median(finite)) and steps == 255
    if values.dtype.kind == 'i' and high - low < 65535:
        high = low + steps - 1.0
    scaled = (
        np.log(values / low) / np.log(high / low)
        if is_log
        else (values - low) / (high - low or 1.0)
    )
    codes = np.where(np.isfinite(values), 1.0 + np.rint(scaled * (steps - 1.0)), 0.0)
    return {
        'name': name.replace('_', ' '),
        'unit': UNITS.get(name, ''),
        'low': low,
        'high': high,
        'log': is_log,
        'shown': [float(v) for v in np.percentile(finite, [1.0, 99.0])] if len(finite) else [0, 1],
        'bytes': 2 if steps > 255 else 1,
        'whole': values.dtype.kind == 'i',
        'codes': encoded(codes.astype('<u2' if steps > 255 else 'u1')),
    }


def encoded(values: npt.NDArray[Any]) -> str:
    """Return the bytes of an array in base64."""
    return base64.b64encode(values.tobytes()).decode()
