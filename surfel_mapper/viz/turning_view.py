# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The interactive 3D view of report.html: its elements and the data for page/view.js.

The data is JSON without the character <, so it cannot begin a tag. A surfel takes 12 bytes: 1.6 MB
of text for the limit of 100,000; each mesh takes up to 4 MB more.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.discs import sides_m, SPREAD
from surfel_mapper.viz.mesh import MAX_TRIANGLES, mesh_data
from surfel_mapper.viz.picture import limits

Array = npt.NDArray[np.float64]

MAX_SHOWN = 100_000
"""Limit of the surfels shown; larger maps are subsampled with a fixed seed."""

SURFEL = np.dtype(
    [('place', '<u2', 3), ('radius', 'u1'), ('planarity', 'u1'), ('normal', 'i1', 3), ('', 'u1')]
)
"""Surfel format of page/view.js."""


def turning_view(
    surfels: Surfels,
    trajectory: Array,
    summary: Mapping[str, Any],
    picture: str | Path | None,
    layers: Mapping[str, Mesh],
) -> str:
    """Return the 3D view with its data; layers can be shown in the place of the surfels."""
    layers = {name: mesh for name, mesh in layers.items() if len(mesh)}
    shown = within_sight(surfels)
    note = 'Drag to turn, with shift to move, wheel to zoom.'
    mixed = np.random.default_rng(0).permutation(
        len(shown)
    )  # while the view moves, only the first are drawn
    shown = shown.select(mixed[:MAX_SHOWN])
    if len(mixed) > MAX_SHOWN:
        note += f' {MAX_SHOWN:,} of {summary["surfels"]:,} surfels are shown.'
    choice = ''
    if layers:
        kinds = ''.join(f'<option>{name}</option>' for name in ('surfels', *layers))
        choice = f'<label>show <select id="shown">{kinds}</select></label>'
    for name, mesh in layers.items():
        if len(mesh) > MAX_TRIANGLES:
            note += f' {len(mesh):,} triangles of the {name} are merged into fewer.'
    height_m = summary.get('origin_m', (0.0, 0.0, 0.0))[2]
    data = json.dumps(view_data(shown, trajectory, layers, height_m)).replace('<', '\\u003c')
    fallback = '<p class="none">This browser has no WebGL 2.</p>'
    if picture is not None:
        png = base64.b64encode(Path(picture).read_bytes()).decode()
        fallback = f'<img alt="the map, drawn" src="data:image/png;base64,{png}">'
    colours = ''.join(f'<option>{n}</option>' for n in ('normal', 'planarity', 'height', 'slope'))
    return (
        '<h2>The map</h2><div class="view"><canvas id="surfels"></canvas>'
        f'<div id="picture" hidden>{fallback}</div>'
        f'<div class="tools">{choice}'
        f'<label>colour <select id="colouring">{colours}</select></label>'
        '<label><input type="checkbox" id="hide" checked> hide surfels that face away</label>'
        '<button id="reset">reset</button></div>'
        '<div class="scale"><span id="least">0</span><span class="ramp"></span>'
        f'<span id="most">1</span></div></div><p class="none">{note}</p>'
        f'<script type="application/json" id="map">{data}</script>'
    )


def within_sight(surfels: Surfels) -> Surfels:
    """Return the surfels without outliers so far away that all others would be tiny."""
    low, high = limits(surfels)
    spare = 0.5 * (high - low)
    inside = (surfels.position >= low - spare) & (surfels.position <= high + spare)
    return surfels.select(np.asarray(inside.all(axis=1)))


def view_data(
    surfels: Surfels, trajectory: Array, layers: Mapping[str, Mesh], height_m: float
) -> dict[str, Any]:
    """
    Return the data for page/view.js, in metres from the middle of the map.

    Heights are stated with that of the map's origin added.
    """
    from matplotlib import colormaps

    low, high = np.zeros(3), np.ones(3)
    places = [surfels.position] if len(surfels) else [mesh.vertices for mesh in layers.values()]
    if places:
        seen = np.concatenate(places)
        low, high = seen.min(axis=0), seen.max(axis=0)
    size = np.maximum(high - low, 1e-3)
    radius = 0.5 * SPREAD * sides_m(surfels)
    largest = float(radius.max(initial=1e-3))
    decimals = max(2 - int(np.floor(np.log10(size[2]))), 0)
    packed = np.zeros(len(surfels), SURFEL)
    packed['place'] = np.rint((surfels.position - low) / size * 65535.0)
    packed['radius'] = np.ceil(radius / largest * 255.0)
    packed['planarity'] = np.rint(surfels.planarity * 255.0)
    packed['normal'] = np.rint(surfels.normal * 127.0)
    path = (trajectory - (low + 0.5 * size)).astype('<f4')
    ramp = np.rint(colormaps['viridis'](np.linspace(0.0, 1.0, 256))[:, :3] * 255.0)
    return {
        'surfels': encoded(packed),
        'trajectory': encoded(path),
        'ramp': encoded(ramp.astype(np.uint8)),
        'size': [float(side) for side in size],
        'largest': largest,
        'layers': [mesh_data(mesh, low, size) for mesh in layers.values()],
        'heights': [f'{height_m + end:.{decimals}f} m' for end in (low[2], high[2])],
    }


def encoded(values: npt.NDArray[Any]) -> str:
    """Return the bytes of an array in base64."""
    return base64.b64encode(values.tobytes()).decode()
