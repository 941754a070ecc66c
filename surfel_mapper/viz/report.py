# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
report.html: one page about a map, with an interactive 3D view, plots and tables.

The file is self-contained, and a content security policy forbids the page to load anything else,
and to run or apply inline scripts and styles but the two of page/, whose hashes it states. So
styles of single elements, as matplotlib writes them, become rules of the style sheet. Names from
bags are untrusted: all text is escaped.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
import hashlib
from importlib.resources import files
import json
from pathlib import Path
import re
from typing import Any

import numpy as np

from surfel_mapper.config import Config
from surfel_mapper.counters import decimals, STAGES
from surfel_mapper.errors import counted
from surfel_mapper.files.atomic import replace_file
from surfel_mapper.mapping.surfels import Surfels
from surfel_mapper.tsdf.mesh import Mesh
from surfel_mapper.viz.charts import histogram, lines, NO_DATA, short
from surfel_mapper.viz.discs import DrawnDiscs
from surfel_mapper.viz.framing import levelled
from surfel_mapper.viz.history import History
from surfel_mapper.viz.markup import as_html, html_figures, html_table
from surfel_mapper.viz.turning_view import turning_view

POLICY = (
    "default-src 'none'; style-src {style}; script-src {script}; img-src data:; base-uri 'none'; "
    "form-action 'none'"
)
"""Content security policy, to be filled with the hashes of the style sheet and the script."""

STATES = {
    'lost': 'not placed on the map',
    'unconfirmed': 'placed again, not yet confirmed by the next scans',
    'ambiguous': 'with another pose that fits as well',
    'degenerate': 'without surfaces that fix every direction',
    'jumped': 'far from the expected place, without being certain',
    'surrounded': 'with most surfaces moving with the sensor',
    'rejoined': 'placed at the end, with all scans of their part',
}
"""States of tracking in words."""

TAG = re.compile(r'<[a-z][^<>]*>')
INLINE_STYLE = re.compile(r' style="([^"]*)"')


def write_report(
    path: str | Path,
    title: str,
    summary: Mapping[str, Any],
    surfels: Surfels,
    history: History | None = None,
    layers: Mapping[str, Mesh] | None = None,
    sections: Sequence[str] = (),
    drawn: Surfels | None = None,
) -> None:
    """
    Write a report, whole or not at all.

    Parameters
    ----------
    path : str or Path
        The file.
    title : str
        Title of the page, for example the name of the bag.
    summary : mapping
        As ``Mapper.summary`` returns it; with ``recorded_s``, ``replay_s`` and ``settings`` if
        known.
    surfels : Surfels
        The map, or a part of it.
    history : History, optional
        Figures of each scan; without it there are no plots over time.
    layers : mapping of str to Mesh, optional
        Meshes that can be shown in place of the surfels, by name.
    sections : sequence of str
        Further sections as HTML, below the map.
    drawn : Surfels, optional
        The surfels of the 3D view, as ``drawn_surfels`` of detail.py returns them for a large map.

    Raises
    ------
    FileFormatError
        If the file cannot be written.

    """
    history = history or History()
    valid = surfels.select(np.isfinite(surfels.planarity))
    shown = valid if drawn is None else drawn.select(np.isfinite(drawn.planarity))
    blocks = [
        f'<h1>{as_html(title)}</h1><p class="about">{as_html(about(summary))}</p>',
        turning_view(shown, history.trajectory, history.seconds, summary, layers or {}),
        figures(summary, history, valid),
        *sections,
        plots(valid, summary, history),
        pose_errors_table(summary.get('pose_errors')),
        tracking_table(summary.get('registration', {})),
        f'<h2>Milliseconds a scan</h2>{times_table(summary)}',
        settings_table(summary.get('settings', {}), summary.get('settings_set')),
    ]
    with replace_file(path) as file:
        file.write(page(title, ''.join(blocks)).encode('utf-8', 'replace'))


def page(title: str, body: str) -> str:
    """Return a complete HTML page."""
    folder = files('surfel_mapper.viz') / 'page'
    style = (folder / 'report.css').read_text(encoding='utf-8')
    script = (folder / 'view.js').read_text(encoding='utf-8')
    body, rules = without_inline_styles(body)
    style += rules
    policy = POLICY.format(style=source_hash(style), script=source_hash(script))
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<link rel="icon" href="data:,"><title>{as_html(title)}</title>'
        f'<style>{style}</style></head>\n<body>{body}'
        f'<footer>made by surfel_mapper</footer>\n<script>{script}</script></body></html>\n'
    )


def without_inline_styles(body: str) -> tuple[str, str]:
    """
    Return a page whose elements have no style attributes, and their rules as a style sheet.

    Only tags are searched: text may hold quotes, but no angle brackets, since it is escaped.
    """
    numbers: dict[str, int] = {}

    def numbered(style: re.Match[str]) -> str:
        return f' data-style="{numbers.setdefault(style[1], len(numbers))}"'

    body = TAG.sub(lambda tag: INLINE_STYLE.sub(numbered, tag[0]), body)
    rules = (f'[data-style="{number}"] {{ {style} }}\n' for style, number in numbers.items())
    return body, ''.join(rules)


def source_hash(content: str) -> str:
    """Return the hash of a style sheet or script for a content security policy."""
    digest = hashlib.sha256(content.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def about(summary: Mapping[str, Any]) -> str:
    """Return the sources of the map and its digest in one line."""
    names = [*summary.get('topics', []), *summary.get('pose_topics', []), summary.get('poses')]
    source = ', '.join(str(name) for name in names if name)
    return ' \u00b7 '.join(filter(None, [source, f'digest {summary.get("digest", "unknown")}']))


def figures(summary: Mapping[str, Any], history: History, surfels: Surfels) -> str:
    """Return the main figures of the map, as HTML."""
    scans = summary['scans']
    shown = {
        'scans mapped': f'{scans["mapped"]:,} of {scans["received"]:,}',
        'surfels': f'{len(surfels):,}',
        'points in surfels': short(int(surfels.num_points.sum())),
        'points of all scans': short(summary['points']),
        'voxel size': f'{summary["voxel_size_m"]:g} m',
    }
    origin_m = summary.get('origin_m', [0.0, 0.0, 0.0])
    if any(origin_m):
        shown['origin of the map'] = ', '.join(f'{value:.12g}' for value in origin_m) + ' m'
    if len(history) > 1 and len(summary.get('bags', ())) < 2:  # not the way between bags
        steps = np.diff(history.trajectory, axis=0)
        shown['distance driven'] = f'{np.sqrt((steps * steps).sum(axis=1)).sum():.1f} m'
    if summary.get('recorded_s'):
        shown['recorded'] = f'{summary["recorded_s"]:.1f} s'
    if 'total' in summary['milliseconds']:
        shown['time a scan (median)'] = f'{summary["milliseconds"]["total"]["median"]:.1f} ms'
    return html_figures(shown)


def tracking_table(registration: Mapping[str, Any]) -> str:
    """Return the scans of doubtful poses by reason and the parts that stayed apart, as HTML."""
    if 'tracking' not in registration:
        return ''
    rows = [
        (STATES.get(state, state), spent['scans'], f'{spent["seconds"]:.1f}')
        for state, spent in registration['tracking'].items()
        if spent['scans']
    ]
    paragraphs = ''.join(
        f'<p>apart_{number}: {counted(track["scans"], "scan")} from {track["first_s"]:.3f} to '
        f'{track["last_s"]:.3f} s have no certain place on the map: {as_html(track["reason"])}</p>'
        for number, track in enumerate(registration['apart'], start=1)
    )
    table = html_table(('scans', 'number', 's'), rows) if rows else '<p class="none">None.</p>'
    return f'<h2>Scans of doubtful pose</h2>{table}{paragraphs}'


def plots(surfels: Surfels, summary: Mapping[str, Any], history: History) -> str:
    """Return the section with all plots."""
    seconds = history.seconds
    times = {
        stage: np.array(history.milliseconds[stage])
        for stage in sorted(history.milliseconds, key=stage_order)
    }
    up = levelled(DrawnDiscs.of(surfels))[2]
    slope = np.degrees(np.arccos(np.clip(np.abs(surfels.normal @ up), 0.0, 1.0)))
    dropped = {'dropped': history.dropped}
    charts = {
        'Voxels over time': lines(seconds, {'voxels': history.voxels}, 'time (s)', 'voxels'),
        'Time by stage': lines(seconds, times, 'time (s)', 'ms a scan'),
        'Planarity of the surfels': histogram(
            surfels.planarity, 0.0, 1.0, 'planarity: 0 a line or a ball, 1 a plane', 'surfels'
        ),
        'Slope of the surfels': histogram(
            slope, 0.0, 90.0, 'angle of the normal to the vertical (deg)', 'surfels'
        ),
    }
    if history.dropped.any():
        charts['Scans dropped so far'] = lines(seconds, dropped, 'time (s)', 'scans')
    shown = ''.join(
        f'<figure><figcaption>{name}</figcaption>{chart}</figure>'
        for name, chart in charts.items()
        if chart != NO_DATA
    )
    counts_by_name = {**fates(summary), **points_left_out(summary)}
    table = html_table((), [(name, f'{count:,}') for name, count in counts_by_name.items()])
    return f'<h2>Figures</h2><div class="plots">{shown}</div>{table}'


def points_left_out(summary: Mapping[str, Any]) -> dict[str, int]:
    """Return the number of points left out, by cause."""
    causes = named(summary.get('points_left_out', {}))
    return {f'points left out: {cause}': number for cause, number in causes.items()}


def fates(summary: Mapping[str, Any]) -> dict[str, int]:
    """Return the number of scans that were not mapped, by cause."""
    scans = summary['scans']
    gated = {'scans left out, too near to the last': scans['gated']} if scans['gated'] else {}
    return gated | {f'scans dropped: {cause}': n for cause, n in named(scans['dropped']).items()}


def named(counts: Mapping[str, int]) -> dict[str, int]:
    """Return the counts that are not zero, by cause in words."""
    return {str(cause).replace('_', ' '): int(n) for cause, n in counts.items() if n}


def pose_errors_table(errors: Mapping[str, Any] | None) -> str:
    """Return a table of pose errors; an empty string if the true poses are unknown."""
    if errors is None:
        return ''
    kinds = ('rmse', 'mean', 'median', 'max')
    rows = []
    for kind in ('absolute', 'relative'):
        for name, unit, factor in (('translation_m', 'mm', 1e3), ('rotation_deg', 'deg', 1.0)):
            error = errors[kind][name]
            numbers = [decimals(error[figure], factor) for figure in kinds]
            rows.append([f'{kind}, {unit}', *numbers])
    drift_m, drift_deg = (decimals(errors[f'drift_{unit}_per_100m']) for unit in ('m', 'deg'))
    compared = counted(errors['num_poses'], 'pose')
    drift = f'{compared} compared; drift {drift_m} m and {drift_deg} deg in 100 m.'
    table = html_table(('', *kinds), rows)
    return f'<h2>Errors of the poses</h2>{table}<p>{as_html(drift)}</p>'


def times_table(summary: Mapping[str, Any]) -> str:
    """Return a table of the median and 99th percentile of every stage of a scan."""
    stages = sorted(summary['milliseconds'], key=stage_order)
    times = [(stage, summary['milliseconds'][stage]) for stage in stages if stage != 'loops']
    rows = [(stage, f'{ms["median"]:.2f}', f'{ms["p99"]:.2f}') for stage, ms in times]
    return html_table(('stage', 'median', 'p99'), rows)


def stage_order(stage: str) -> int:
    """Return the position of a stage in tables; unknown stages come before the total."""
    return STAGES.index(stage) if stage in STAGES else len(STAGES) - 1


def settings_table(settings: Mapping[str, Any], chosen: Sequence[str] | None = None) -> str:
    """Return a table of all settings, those that the user set first; None: all not at default."""
    default = Config().to_mapping()
    if chosen is None:
        chosen = [name for name, value in settings.items() if value != default.get(name)]
    ours = {name: value for name, value in settings.items() if name in chosen}
    usual = {name: value for name, value in settings.items() if name not in ours}

    def table(values: Mapping[str, Any]) -> str:
        rows = [(name, json.dumps(value, default=str)) for name, value in values.items()]
        return html_table((), rows, num_texts=2)

    changed = table(ours) if ours else '<p class="none">No setting was changed.</p>'
    unchanged = f'<summary>{counted(len(usual), "setting")} not changed</summary>{table(usual)}'
    return f'<h2>Settings</h2>{changed}<details>{unchanged}</details>'
