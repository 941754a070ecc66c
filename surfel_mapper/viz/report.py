# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
report.html: one page that says what was mapped, with plots and the map to turn around.

Everything is inside the file, and a content security policy forbids the page to load anything
else. Names in bags are anyone's: all text is escaped, and data for the script is JSON in which
no tag can begin. The map is 12 bytes a surfel, 1.6 MB of text for the 100,000 shown at most; the
mesh of the TSDF takes up to 4 MB more.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape
from importlib.resources import files
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import Config
from surfel_mapper.io.files import replace_file
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.charts import histogram, lines, named_bars, short
from surfel_mapper.viz.history import History
from surfel_mapper.viz.mesh import MAX_TRIANGLES, mesh_data
from surfel_mapper.viz.picture import limits, sides_m, SPREAD

Array = npt.NDArray[np.float64]

MAX_SHOWN = 100_000
"""Of a larger map so many surfels are shown, picked at random, always the same."""

STAGES = ('decode', 'filter', 'reduce', 'insert', 'normals', 'total')
"""Stages in the order in which a scan goes through them."""

POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"

SURFEL = np.dtype(
    [('place', '<u2', 3), ('radius', 'u1'), ('planarity', 'u1'), ('normal', 'i1', 3), ('', 'u1')]
)
"""A surfel as page/view.js takes it."""


def write_report(
    path: str | Path,
    title: str,
    summary: Mapping[str, Any],
    surfels: Surfels,
    history: History | None = None,
    picture: str | Path | None = None,
    mesh: Mesh | None = None,
) -> None:
    """
    Write a report, whole or not at all.

    Parameters
    ----------
    path : str or Path
        The file.
    title : str
        Above the page: what was mapped.
    summary : mapping
        As ``Mapper.summary`` returns it; ``recorded_s``, ``replay_s`` and ``settings`` beside it
        where known.
    surfels : Surfels
        The map, or a part of it.
    history : History, optional
        What happened scan by scan; without it there are no plots over time.
    picture : str or Path, optional
        A PNG file, for browsers that cannot draw in 3D.
    mesh : Mesh, optional
        The surface of the TSDF, to be shown in the place of the surfels.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    history = history or History()
    valid = surfels.select(np.isfinite(surfels.planarity))
    parts = [
        f'<h1>{escape(title)}</h1><p class="about">{escape(about(summary))}</p>',
        figures(summary, history),
        view(valid, history.trajectory, summary, picture, mesh),
        plots(valid, summary, history),
        pose_errors_table(summary.get('pose_errors')),
        f'<h2>Milliseconds a scan</h2>{times_table(summary)}',
        settings_table(summary.get('settings', {})),
    ]
    with replace_file(path) as file:
        file.write(page(title, ''.join(parts)).encode('utf-8', 'replace'))


def page(title: str, body: str) -> str:
    """Return a whole page."""
    folder = files('surfel_mapper.viz') / 'page'
    style = (folder / 'report.css').read_text(encoding='utf-8')
    script = (folder / 'view.js').read_text(encoding='utf-8')
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<link rel="icon" href="data:,"><title>{escape(title)}</title>'
        f'<style>{style}</style></head>\n<body>{body}'
        f'<footer>made by surfel_mapper</footer>\n<script>{script}</script></body></html>\n'
    )


def about(summary: Mapping[str, Any]) -> str:
    """Return in a line where the map came from."""
    names = [*summary.get('topics', []), *summary.get('pose_topics', []), summary.get('poses')]
    source = ', '.join(str(name) for name in names if name)
    return ' \u00b7 '.join(filter(None, [source, f'digest {summary.get("digest", "unknown")}']))


def figures(summary: Mapping[str, Any], history: History) -> str:
    """Return the most important numbers."""
    scans = summary['scans']
    shown = {
        'scans mapped': f'{scans["mapped"]} of {scans["received"]}',
        'points': short(summary['points']),
        'surfels': f'{summary["surfels"]:,}',
        'voxels': f'{summary["voxels"]:,} of {summary["voxel_size_m"]:g} m',
    }
    if len(history) > 1:
        steps = np.diff(history.trajectory, axis=0)
        shown['way of the sensor'] = f'{np.sqrt((steps * steps).sum(axis=1)).sum():.1f} m'
    if 'recorded_s' in summary:
        shown['recorded'] = f'{summary["recorded_s"]:.1f} s'
    if summary.get('replay_s'):
        speed = summary.get('recorded_s', 0.0) / summary['replay_s']
        shown['speed'] = f'{speed:.3g} \u00d7 real time'
    cells = ''.join(f'<div><dt>{k}</dt><dd>{escape(v)}</dd></div>' for k, v in shown.items())
    return f'<dl class="figures">{cells}</dl>'


def view(
    surfels: Surfels,
    trajectory: Array,
    summary: Mapping[str, Any],
    picture: str | Path | None,
    mesh: Mesh | None,
) -> str:
    """Return the 3D view with its data."""
    shown = within_sight(surfels)
    note = 'Drag to turn, with shift to move, wheel to zoom.'
    mixed = np.random.default_rng(0).permutation(len(shown))  # while it turns, the first are drawn
    shown = shown.select(mixed[:MAX_SHOWN])
    if len(mixed) > MAX_SHOWN:
        note += f' {MAX_SHOWN:,} of {summary["surfels"]:,} surfels are shown.'
    choice = ''
    if mesh is not None and len(mesh):
        kinds = '<option>surfels</option><option>mesh</option>'
        choice = f'<label>show <select id="shown">{kinds}</select></label>'
        if len(mesh) > MAX_TRIANGLES:
            note += f' The mesh of {len(mesh):,} triangles is made smaller.'
    data = json.dumps(view_data(shown, trajectory, mesh)).replace('<', '\\u003c')
    fallback = '<p class="none">This browser has no WebGL 2.</p>'
    if picture is not None:
        png = base64.b64encode(Path(picture).read_bytes()).decode()
        fallback = f'<img alt="the map, drawn" src="data:image/png;base64,{png}">'
    colours = ''.join(f'<option>{n}</option>' for n in ('planarity', 'height', 'slope', 'normal'))
    return (
        '<h2>The map</h2><div class="view"><canvas id="surfels"></canvas>'
        f'<div id="picture" hidden>{fallback}</div>'
        f'<div class="tools">{choice}'
        f'<label>colour <select id="colouring">{colours}</select></label>'
        '<label><input type="checkbox" id="hide" checked> hide what faces away</label>'
        '<button id="reset">reset</button></div>'
        '<div class="scale"><span id="least">0</span><span class="ramp"></span>'
        f'<span id="most">1</span></div></div><p class="none">{note}</p>'
        f'<script type="application/json" id="map">{data}</script>'
    )


def within_sight(surfels: Surfels) -> Surfels:
    """Return the surfels without those so far away that all others would be tiny."""
    low, high = limits(surfels)
    spare = 0.5 * (high - low)
    inside = (surfels.position >= low - spare) & (surfels.position <= high + spare)
    return surfels.select(np.asarray(inside.all(axis=1)))


def view_data(
    surfels: Surfels, trajectory: Array, mesh: Mesh | None = None
) -> dict[str, Any]:
    """Return what page/view.js needs: everything about the middle of the map, in metres."""
    from matplotlib import colormaps

    low, high = np.zeros(3), np.ones(3)
    if not len(surfels) and mesh is not None and len(mesh):
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    if len(surfels):
        low, high = surfels.position.min(axis=0), surfels.position.max(axis=0)
    size = np.maximum(high - low, 1e-3)
    radius = 0.5 * SPREAD * sides_m(surfels)
    largest = float(radius.max(initial=1e-3))
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
        **({'mesh': mesh_data(mesh, low, size)} if mesh is not None and len(mesh) else {}),
        'heights': [f'{low[2]:.3g} m', f'{high[2]:.3g} m'],
    }


def encoded(values: npt.NDArray[Any]) -> str:
    """Return the bytes of an array as text."""
    return base64.b64encode(values.tobytes()).decode()


def plots(surfels: Surfels, summary: Mapping[str, Any], history: History) -> str:
    """Return all plots."""
    seconds = history.seconds
    at, counts = history.surfels
    times = {
        stage: np.array(history.milliseconds[stage])
        for stage in sorted(history.milliseconds, key=stage_order)
    }
    slope = np.degrees(np.arccos(np.clip(np.abs(surfels.normal[:, 2]), 0.0, 1.0)))
    growth = {'surfels': counts.astype(np.float64)}
    dropped = {'dropped': history.dropped.astype(np.float64)}
    charts = {
        'Surfels over time': lines(seconds[at], growth, 'time (s)', 'surfels'),
        'Time by stage': lines(seconds, times, 'time (s)', 'ms a scan'),
        'Planarity of the surfels': histogram(
            surfels.planarity, 0.0, 1.0, 'planarity: 0 a line or a ball, 1 a plane', 'surfels'
        ),
        'Slope of the surfels': histogram(
            slope, 0.0, 90.0, 'angle of the normal to the vertical (deg)', 'surfels'
        ),
        'Scans by what became of them': named_bars(fates(summary)),
        'Points left out': named_bars(named(summary.get('points_left_out', {}))),
    }
    if history.dropped.any():
        charts['Scans dropped so far'] = lines(seconds, dropped, 'time (s)', 'scans')
    shown = ''.join(
        f'<figure><figcaption>{name}</figcaption>{chart}</figure>'
        for name, chart in charts.items()
        if chart
    )
    return f'<h2>Figures</h2><div class="plots">{shown}</div>'


def fates(summary: Mapping[str, Any]) -> dict[str, int]:
    """Return how many scans were mapped, and how many were not, by cause."""
    scans = summary['scans']
    gated = {'left out by the motion gate': scans['gated']} if scans['gated'] else {}
    dropped = {f'dropped: {cause}': n for cause, n in named(scans['dropped']).items()}
    return {'mapped': scans['mapped'], **gated, **dropped}


def named(counts: Mapping[str, int]) -> dict[str, int]:
    """Return counts by cause in words, those that are not zero."""
    return {str(cause).replace('_', ' '): int(n) for cause, n in counts.items() if n}


def pose_errors_table(errors: Mapping[str, Any] | None) -> str:
    """Return how far the poses are from the true ones, where these are known."""
    if errors is None:
        return ''
    rows = ''
    for kind in ('absolute', 'relative'):
        for name, unit, factor in (('translation_m', 'mm', 1e3), ('rotation_deg', 'deg', 1.0)):
            found = errors[kind][name]
            cells = ''.join(
                f'<td class="number">{found[figure] * factor:.3f}</td>'
                for figure in ('rmse', 'mean', 'median', 'max')
            )
            rows += f'<tr><td>{kind}, {unit}</td>{cells}</tr>'
    head = ''.join(f'<th class="number">{name}</th>' for name in ('rmse', 'mean', 'median', 'max'))
    drift = (
        f'{errors["num_poses"]} poses compared; drift {errors["drift_m_per_100m"]:.3f} m and '
        f'{errors["drift_deg_per_100m"]:.3f} deg in 100 m.'
    )
    return (
        f'<h2>Errors of the poses</h2><table><tr><th></th>{head}</tr>{rows}</table>'
        f'<p>{escape(drift)}</p>'
    )


def times_table(summary: Mapping[str, Any]) -> str:
    """Return median and 99th percentile of every stage."""
    rows = ''.join(
        f'<tr><td>{escape(str(stage))}</td><td class="number">{times["median"]:.2f}</td>'
        f'<td class="number">{times["p99"]:.2f}</td></tr>'
        for stage, times in sorted(
            summary['milliseconds'].items(), key=lambda item: stage_order(item[0])
        )
    )
    head = '<tr><th>stage</th><th class="number">median</th><th class="number">p99</th></tr>'
    return f'<table>{head}{rows}</table>'


def stage_order(stage: str) -> int:
    """Return where a stage stands among the others: unknown ones before the total."""
    return STAGES.index(stage) if stage in STAGES else len(STAGES) - 1


def settings_table(settings: Mapping[str, Any]) -> str:
    """Return all settings, those that differ from their defaults first."""
    default = Config().to_mapping()
    ours = {name: value for name, value in settings.items() if value != default.get(name)}
    rest = {name: value for name, value in settings.items() if name not in ours}

    def table(values: Mapping[str, Any]) -> str:
        rows = ''.join(
            f'<tr><td>{escape(name)}</td><td>{escape(json.dumps(value, default=str))}</td></tr>'
            for name, value in values.items()
        )
        return f'<table>{rows}</table>'

    changed = table(ours) if ours else '<p class="none">All settings are at their defaults.</p>'
    return (
        f'<h2>Settings</h2>{changed}'
        f'<details><summary>{len(rest)} at their defaults</summary>{table(rest)}</details>'
    )
