# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Draw the recorded runs of the benches on the page runs.md, when mkdocs builds it.

``python -m test.bench --record docs/figures`` adds a run to the file of each bench.
"""

from base64 import b64encode
from collections import defaultdict
import io
import json
from pathlib import Path
from statistics import median

COLUMNS = {
    'real': {'total_ms': 'ms a scan', 'x_numpy': 'times as fast as numpy'},
    'filters': {'Mpt_s': 'millions of points a second'},
    'lum': {'compute_ms': 'ms', 'x_pcl': 'times as fast as PCL'},
    'registration': {'cpu_ms': 'ms a scan', 'drift_m_100m': 'drift in 100 m, m'},
    'tsdf': {'cpu_ms': 'ms a scan'},
    'robot': {'p50_ms': 'median latency, ms', 'p99_ms': '99th percentile of the latency, ms'},
    'live': {'p50_ms': 'median latency, ms', 'p99_ms': '99th percentile of the latency, ms'},
}
"""Drawn columns of each bench, with their titles."""

COLOURS = 'C0', 'C1', 'C2', 'C3', 'C4', 'C5'


def on_page_markdown(markdown, page, **_):
    """Replace the mark of the page by a drawing of each column."""
    if page.file.src_uri != 'runs.md':
        return markdown
    return markdown.replace('<!-- runs -->', sections(Path(__file__).parent))


def sections(folder):
    """Return the drawings of all benches of a folder as Markdown."""
    parts = []
    for bench, columns in COLUMNS.items():
        runs = json.loads((folder / f'{bench}.json').read_text(encoding='utf-8'))
        parts.append(f'## {bench}\n\n`{runs[-1]["command"]}`\n')
        for column, title in columns.items():
            svg = b64encode(drawing(runs, column, title).encode()).decode()
            parts.append(f'![{title}](data:image/svg+xml;base64,{svg})\n')
    return '\n'.join(parts)


def points(runs, column):
    """Return the values of a column with their machines, by the texts and voxel size of a row."""
    values = defaultdict(list)
    for run in runs:
        for row in run['rows']:
            if row.get(column) is not None:
                texts = {name: value for name, value in row.items() if name != 'causes'}
                names = [value for value in texts.values() if isinstance(value, str)]
                names += [f'{row["voxel_m"]:g} m'] if 'voxel_m' in row else []
                values[', '.join(names)].append((row[column], run['cpu']))
    return values


def drawing(runs, column, title):
    """Return an SVG with a dot for each run, in the colour of its machine."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    values, machines = points(runs, column), sorted({run['cpu'] for run in runs})
    figure = Figure(figsize=(8.0, 0.26 * len(values) + 1.2), layout='constrained')
    ax = figure.subplots()
    for machine, colour in zip(machines, COLOURS, strict=False):
        dots = [
            (value, number)
            for number, pairs in enumerate(values.values())
            for value, cpu in pairs
            if cpu == machine
        ]
        if dots:
            ax.plot(*zip(*dots, strict=True), 'o', color=colour, label=machine)
    middles = [median(value for value, _ in pairs) for pairs in values.values()]
    names = [f'{name}: {middle:.3g}' for name, middle in zip(values, middles, strict=True)]
    ax.set_yticks(range(len(names)), names)
    ax.invert_yaxis()
    ax.set(xscale='log', title=f'{title}; the number is the median of the runs')
    ax.grid(visible=True, axis='x', which='both', alpha=0.3)
    ax.legend(fontsize='small', loc='best')
    file = io.StringIO()
    with rc_context({'svg.fonttype': 'none'}):  # text that can be searched
        figure.savefig(file, format='svg')
    return file.getvalue()
