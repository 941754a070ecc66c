# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Plots of the report as SVG: lines over time and histograms.

matplotlib draws them. Text stays text, and the colours are CSS variables of the page
(page/report.css), so that plots follow its light or dark style: each element is drawn in a
placeholder colour, which is replaced in the SVG. A plot takes 2 to 20 kB.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
import io
import itertools
import re
from typing import Any, TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import escaped
from surfel_mapper.viz.markup import as_html

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = npt.NDArray[np.float64]

WIDTH, HEIGHT = 520, 220
"""Size of a plot in the units of its viewBox, px when not scaled."""

POINTS = 400
"""Most points of a line; longer lines are reduced to the median of each stretch."""

NUM_BINS = 36

LEFT, RIGHT, TOP, BOTTOM = 54, 14, 6, 36
"""Margins around the axes of lines and histograms, px; their labels are short numbers."""

FAINT, RULE, BAR = '#fe0001', '#fe0002', '#fe0003'
"""Placeholder colours of text, grid lines and bars."""

LINES = tuple(f'#fe001{number}' for number in range(8))
"""Placeholder colours of lines."""

VARIABLES = {
    FAINT: 'var(--faint)',
    RULE: 'var(--rule)',
    BAR: 'var(--bar)',
    **{color: f'var(--line-{number})' for number, color in enumerate(LINES)},
}
"""CSS variable of each placeholder colour."""

STYLE: dict[Any, Any] = {
    'axes.edgecolor': RULE,
    'axes.labelcolor': FAINT,
    'axes.spines.left': False,
    'axes.spines.right': False,
    'axes.spines.top': False,
    'font.family': ['sans-serif'],
    'font.size': 10.0,
    'grid.color': RULE,
    'legend.frameon': False,
    'legend.handlelength': 1.0,
    'svg.fonttype': 'none',
    'text.color': FAINT,
    'text.parse_math': False,  # names come from bags and may hold dollar signs
    'xtick.color': FAINT,
    'xtick.major.size': 0.0,
    'ytick.color': FAINT,
    'ytick.major.size': 0.0,
}

UNWANTED = (r'<style.*?</style>', r'(?<=<g) id="[^"]*"', r'font-family: [^;]*; ')
"""Parts of matplotlib's SVG: a style for the whole page, ids that repeat, and fonts."""

NO_DATA = '<p class="none">none</p>'


def lines(x: Array, series: Mapping[str, Array], x_label: str, y_label: str) -> str:
    """
    Return a plot of lines over a common x; the y axis begins at 0.

    Parameters
    ----------
    x : (N,) float64
        Ascending.
    series : mapping of str to (N,) float64
        Values of each line by its name; nan leaves a gap. A single value is no line.
    x_label, y_label : str
        Labels of the axes.

    """
    drawn = {name: thinned(x, y) for name, y in series.items() if np.isfinite(y).any()}
    if not drawn or len(x) < 2:
        return NO_DATA
    top = max(highest(y[np.isfinite(y)]) for _, y in drawn.values())
    with _axes() as (figure, axes):
        for number, (name, (xs, values)) in enumerate(drawn.items()):
            color = LINES[number % len(LINES)]
            axes.plot(xs, values, color=color, linewidth=1.6, label=_visible(name))
        axes.set(ylim=(0.0, top * 1.2 or 1.0), xlabel=x_label, ylabel=y_label)
        if x[-1] > x[0]:
            axes.set_xlim(x[0], x[-1])
        axes.legend(loc='upper left', ncols=5, columnspacing=1.2)
        return _svg(figure, f'{y_label} by {x_label}')


def histogram(values: Array, low: float, high: float, x_label: str, y_label: str) -> str:
    """Return a histogram of NUM_BINS bars from low to high; non-finite values are left out."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return NO_DATA
    counts, edges = np.histogram(np.clip(finite, low, high), NUM_BINS, (low, high))
    with _axes() as (figure, axes):
        axes.stairs(counts, edges, fill=True, color=BAR, linewidth=0.0)
        axes.set(xlim=(low, high), ylim=(0.0, 1.05 * counts.max()))
        axes.set(xlabel=x_label, ylabel=y_label)
        return _svg(figure, f'{y_label} by {x_label}')


def thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """Return a line of at most POINTS points: medians of stretches, nan for a gap."""
    if len(x) <= POINTS:
        return x, y
    bounds = np.linspace(0, len(x), POINTS + 1).astype(np.int64)
    stretches = [slice(a, b) for a, b in itertools.pairwise(bounds)]
    medians = [
        np.median(y[stretch][np.isfinite(y[stretch])]) if np.isfinite(y[stretch]).any() else np.nan
        for stretch in stretches
    ]
    return np.array([x[stretch].mean() for stretch in stretches]), np.array(medians)


def highest(values: Array) -> float:
    """Return the top of the y axis: the maximum, at most five times the 95th percentile."""
    return float(min(values.max(), 5.0 * np.percentile(values, 95)) or values.max())


def short(value: float) -> str:
    """Return a number in few characters: 1.5M, 20k, 0.1."""
    for factor, letter in ((1e9, 'G'), (1e6, 'M'), (1e3, 'k')):
        if abs(value) >= factor:
            return f'{value / factor:.3g}{letter}'
    return f'{value:.3g}'


@contextmanager
def _axes() -> Iterator[tuple[Figure, Axes]]:
    """
    Make a figure with one pair of axes in the style of the page.

    Labels are short numbers in fixed margins: to measure every label takes twice the time.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH / 72.0, HEIGHT / 72.0), dpi=72)
        box = (LEFT, BOTTOM, WIDTH - LEFT - RIGHT, HEIGHT - BOTTOM - TOP)
        axes = figure.add_axes(tuple(np.divide(box, (WIDTH, HEIGHT, WIDTH, HEIGHT))))
        axes.grid(visible=True, axis='y')
        axes.set_axisbelow(True)
        axes.locator_params(nbins=6)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(lambda value, _: short(value))
        yield figure, axes


def _visible(name: str) -> str:
    """Return a name as text that is drawn; matplotlib hides those that begin with _."""
    return f'\u200b{escaped(name)}' if name.startswith('_') else escaped(name)


def _svg(figure: Figure, about: str) -> str:
    """Return a figure as an SVG element: no prolog, no ids, colours of the page."""
    file = io.StringIO()
    metadata = dict.fromkeys(('Creator', 'Date', 'Format', 'Type'))
    figure.savefig(file, format='svg', transparent=True, metadata=metadata)
    text = file.getvalue()
    text = text[text.index('<svg') :]
    for pattern in UNWANTED:
        text = re.sub(pattern, '', text)
    for color, variable in VARIABLES.items():
        text = text.replace(color, variable)
    label = as_html(about)
    return text.replace('<svg', f'<svg role="img" aria-label="{label}"', 1)
