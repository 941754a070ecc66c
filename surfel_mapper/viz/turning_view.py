# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The interactive 3D view of report.html: its elements and the data for page/view.js.

The data is JSON without the character <, so it cannot begin a tag. A surfel takes 12 bytes, 1.3 MB
of text for the limit, which keeps the page below 2 MB; with meshes fewer surfels are shown.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.discs import SPREAD
from surfel_mapper.viz.mesh import MAX_TRIANGLES, mesh_data

Array = npt.NDArray[np.float64]

MAX_SHOWN, BESIDE_MESHES = 80_000, 45_000
"""Limits of the surfels shown, alone and if there are meshes; see ``detail.drawn_surfels``."""

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
    """
    Return the 3D view with its data; layers can be shown in the place of the surfels.

    ``surfels`` are those drawn, of several levels for a large map; if they are more than the limit
    a selection with a fixed seed is shown.
    """
    layers = {name: mesh for name, mesh in layers.items() if len(mesh)}
    shown = within_sight(surfels)
    note = (
        '<span class="keys">Drag or arrows turn, with shift they move; wheel, + and - zoom, '
        '0 resets, F is full screen. A click shows the values of a surfel.</span>'
        '<span class="touch">A finger turns, two move and zoom; a tap shows the values of a '
        'surfel.</span>'
    )
    mixed = np.random.default_rng(0).permutation(
        len(shown)
    )  # while the view moves, only the first are drawn
    shown = shown.select(mixed[: most_shown(layers)])
    if len(shown) < len(mixed):
        note += f' {len(shown):,} of {summary["surfels"]:,} surfels are shown.'
    elif len(surfels) < summary['surfels']:
        note += (
            f' The {summary["surfels"]:,} surfels are shown by {len(shown):,}: parts of the map, '
            'first those far from the end of the trajectory, by larger voxels of the same points.'
        )
    choice = ''
    if layers:
        kinds = ''.join(f'<option>{name}</option>' for name in ('surfels', *layers))
        choice = f'<label>show <select id="shown">{kinds}</select></label>'
    for name, mesh in layers.items():
        if len(mesh) > MAX_TRIANGLES // len(layers):
            note += f' {len(mesh):,} triangles of the {name} are merged into fewer.'
    origin_m = np.asarray(summary.get('origin_m', (0.0, 0.0, 0.0)), np.float64)
    data = json.dumps(view_data(shown, trajectory, layers, origin_m)).replace('<', '\\u003c')
    fallback = '<p class="none">This browser has no WebGL 2.</p>'
    if picture is not None:
        png = base64.b64encode(small_png(picture)).decode()
        fallback = f'<img alt="the map, drawn" src="data:image/png;base64,{png}">'
    colours = ''.join(f'<option>{n}</option>' for n in ('normal', 'planarity', 'height', 'slope'))
    return (
        '<h2>The map</h2><div class="view" id="view">'
        '<canvas id="surfels" tabindex="0" role="application" aria-describedby="help" '
        'aria-label="The map in three dimensions"></canvas>'
        f'<div id="picture" hidden>{fallback}</div>'
        f'<div class="tools">{choice}'
        f'<label>colour <select id="colouring">{colours}</select></label>'
        '<label><input type="checkbox" id="hide" checked> hide surfels that face away</label>'
        '<button id="reset">reset</button><button id="full">full screen</button></div>'
        '<div class="length" aria-hidden="true">'
        '<span id="bar"></span><span id="metres"></span></div>'
        '<output class="values" id="values" aria-live="polite" hidden></output>'
        '<div class="scale"><span id="least">0</span><span class="ramp"></span>'
        f'<span id="most">1</span></div></div><p class="none" id="help">{note}</p>'
        f'<script type="application/json" id="map">{data}</script>'
    )


def most_shown(layers: Mapping[str, Mesh]) -> int:
    """Return the limit of the surfels beside these layers."""
    return BESIDE_MESHES if any(map(len, layers.values())) else MAX_SHOWN


def small_png(picture: str | Path) -> bytes:
    """Return a PNG file at half of its size, for browsers that show nothing else."""
    from PIL import Image

    content = io.BytesIO()
    with Image.open(picture) as image:
        image.convert('RGB').reduce(2).save(content, 'PNG', compress_level=3)
    return content.getvalue()


def within_sight(surfels: Surfels) -> Surfels:
    """Return the surfels without outliers so far away that all others would be tiny."""
    if not len(surfels):
        return surfels
    low, high = np.percentile(surfels.position, [0.5, 99.5], axis=0)
    spare = 0.6 * (high - low) + 1.0
    inside = (surfels.position >= low - spare) & (surfels.position <= high + spare)
    return surfels.select(np.asarray(inside.all(axis=1)))


def view_data(
    surfels: Surfels, trajectory: Array, layers: Mapping[str, Mesh], origin_m: Array
) -> dict[str, Any]:
    """
    Return the data for page/view.js, in metres from the middle of the map.

    Heights and the middle are stated with the map's origin added.
    """
    from matplotlib import colormaps

    low, high = np.zeros(3), np.ones(3)
    positions = [surfels.position] if len(surfels) else [mesh.vertices for mesh in layers.values()]
    if positions:
        xyz = np.concatenate(positions)
        low, high = xyz.min(axis=0), xyz.max(axis=0)
    size = np.maximum(high - low, 1e-3)
    radius = SPREAD * surfels.radius
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
        'layers': [
            mesh_data(mesh, low, size, MAX_TRIANGLES // len(layers)) for mesh in layers.values()
        ],
        'middle': [float(value) for value in low + 0.5 * size + origin_m],
        'heights': [f'{origin_m[2] + end:.{decimals}f} m' for end in (low[2], high[2])],
    }


def encoded(values: npt.NDArray[Any]) -> str:
    """Return the bytes of an array in base64."""
    return base64.b64encode(values.tobytes()).decode()
