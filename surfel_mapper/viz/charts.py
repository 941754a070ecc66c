# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Plots as SVG, written by hand: lines over time, histograms, and bars with a name.

An SVG of a few kilobytes whose text is text and whose colours are those of the page around it;
matplotlib would write some 50 kB, with every letter as a path. Whatever text comes in is escaped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
import itertools
import math

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

WIDTH, HEIGHT = 520, 220
LEFT, RIGHT, TOP, BOTTOM = 56, 12, 12, 40
"""Margins around the plotted area, in the units of the picture."""

POINTS = 400
"""A line has no more points than this; of more, the median of each stretch is drawn."""

COLOURS = 8
"""The page gives so many colours for lines, --line-0 and so on."""

NO_DATA = '<p class="none">none</p>'


@dataclass(frozen=True, slots=True)
class Scale:
    """From values to places in the picture, along one axis."""

    low: float
    high: float
    first: float
    last: float

    def __call__(self, value: float) -> float:
        """Return the place of a value."""
        share = (value - self.low) / (self.high - self.low)
        return self.first + share * (self.last - self.first)


def lines(x: Array, series: Mapping[str, Array], x_label: str, y_label: str) -> str:
    """
    Return a plot of lines over a common x, from y = 0 on.

    Parameters
    ----------
    x : (N,) float64
        Ascending.
    series : mapping of str to (N,) float64
        A line each, by its name; nan leaves a gap.
    x_label, y_label : str
        What the axes show.

    """
    drawn = {name: thinned(x, y) for name, y in series.items() if np.isfinite(y).any()}
    if not drawn:
        return NO_DATA
    top = max(highest(y[np.isfinite(y)]) for _, y in drawn.values())
    across = Scale(float(x[0]), float(x[-1]) if x[-1] > x[0] else x[0] + 1.0, *_horizontal())
    up = Scale(0.0, top * 1.05 or 1.0, *_vertical())
    parts = [_axes(across, up, x_label, y_label)]
    for number, (name, (places, values)) in enumerate(drawn.items()):
        path, pen = [], 'M'
        for place, value in zip(places, values, strict=True):
            if math.isfinite(value):
                path.append(f'{pen}{across(place):.1f} {up(min(value, up.high)):.1f}')
                pen = 'L'
            else:
                pen = 'M'
        colour = f'var(--line-{number % COLOURS})'
        parts.append(f'<path class="line" d="{"".join(path)}" stroke="{colour}"/>')
        parts.append(_legend(name, number, colour))
    return _picture(parts, x_label, y_label)


def histogram(values: Array, low: float, high: float, x_label: str, y_label: str) -> str:
    """Return a histogram of 36 bars of equal width; what is not finite is left out."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return NO_DATA
    counts, edges = np.histogram(np.clip(finite, low, high), bins=36, range=(low, high))
    across = Scale(low, high, *_horizontal())
    up = Scale(0.0, float(counts.max()) * 1.05, *_vertical())
    parts = [_axes(across, up, x_label, y_label)]
    for count, start, end in zip(counts, edges, edges[1:], strict=False):
        tip = f'{start:.3g} to {end:.3g}: {count}'
        parts.append(
            f'<rect class="bar" x="{across(start) + 0.5:.1f}" y="{up(count):.1f}" '
            f'width="{across(end) - across(start) - 1:.1f}" height="{up(0) - up(count):.1f}">'
            f'<title>{tip}</title></rect>'
        )
    return _picture(parts, x_label, y_label)


def named_bars(counts: Mapping[str, int]) -> str:
    """Return a horizontal bar for every name, with its number, the largest over all the width."""
    if not counts:
        return NO_DATA
    height, top = 24, max(max(counts.values()), 1)
    parts = []
    for row, (name, count) in enumerate(counts.items()):
        y, length = row * height, 230.0 * count / top
        parts.append(
            f'<text x="190" y="{y + 16}" text-anchor="end">{escape(name)}</text>'
            f'<rect class="bar" x="200" y="{y + 4}" width="{length:.1f}" height="16"/>'
            f'<text x="{206 + length:.1f}" y="{y + 16}">{count}</text>'
        )
    size = f'viewBox="0 0 {WIDTH} {height * len(counts)}"'
    return f'<svg {size} role="img">{"".join(parts)}</svg>'


def thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """Return a line of at most POINTS points: medians of stretches, nan where all are."""
    if len(x) <= POINTS:
        return x, y
    bounds = np.linspace(0, len(x), POINTS + 1).astype(np.int64)
    parts = [slice(a, b) for a, b in itertools.pairwise(bounds)]
    medians = [
        np.median(y[part][np.isfinite(y[part])]) if np.isfinite(y[part]).any() else np.nan
        for part in parts
    ]
    return np.array([x[part].mean() for part in parts]), np.array(medians)


def highest(values: Array) -> float:
    """Return the largest value, unless it is alone so far above the rest that these vanish."""
    return float(min(values.max(), 5.0 * np.percentile(values, 95)) or values.max())


def ticks(low: float, high: float) -> list[float]:
    """Return some five round numbers in a range."""
    step = 10.0 ** math.floor(math.log10((high - low) / 5.0))
    step *= next(factor for factor in (1, 2, 5, 10) if (high - low) / (step * factor) <= 6.0)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [number * step for number in range(first, last + 1)]


def short(value: float) -> str:
    """Return a number with few letters: 1.5M, 20k, 0.1."""
    for factor, letter in ((1e9, 'G'), (1e6, 'M'), (1e3, 'k')):
        if abs(value) >= factor:
            return f'{value / factor:.3g}{letter}'
    return f'{value:.3g}'


def _horizontal() -> tuple[float, float]:
    return LEFT, WIDTH - RIGHT


def _vertical() -> tuple[float, float]:
    return HEIGHT - BOTTOM, TOP


def _axes(across: Scale, up: Scale, x_label: str, y_label: str) -> str:
    parts = []
    for value in ticks(up.low, up.high):
        y = up(value)
        parts.append(
            f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
            f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{short(value)}</text>'
        )
    for value in ticks(across.low, across.high):
        parts.append(
            f'<text x="{across(value):.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">'
            f'{short(value)}</text>'
        )
    middle = (TOP + HEIGHT - BOTTOM) / 2
    parts.append(
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 6}" text-anchor="middle">'
        f'{escape(x_label)}</text>'
        f'<text transform="translate(12 {middle}) rotate(-90)" text-anchor="middle">'
        f'{escape(y_label)}</text>'
    )
    return ''.join(parts)


def _legend(name: str, number: int, colour: str) -> str:
    x, y = LEFT + 8 + 78 * (number % 6), TOP + 4 + 14 * (number // 6)
    return (
        f'<rect x="{x}" y="{y - 2}" width="10" height="3" fill="{colour}"/>'
        f'<text x="{x + 14}" y="{y + 3}">{escape(name)}</text>'
    )


def _picture(parts: list[str], x_label: str, y_label: str) -> str:
    about = escape(f'{y_label} by {x_label}', quote=True)
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{about}">'
        f'{"".join(parts)}</svg>'
    )
