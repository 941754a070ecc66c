# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Plots are valid XML for any input, and their marks are as long as the numbers they stand for."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from surfel_mapper.viz.charts import (
    HEIGHT,
    histogram,
    lines,
    NO_DATA,
    NUM_BINS,
    WIDTH,
)

NASTY = '</svg><script>"&$x$'


def paths(svg, color):
    """Return the corners of each path drawn in a colour of the page, (N, 2), and its commands."""
    found = []
    for path in ElementTree.fromstring(svg).iter('{http://www.w3.org/2000/svg}path'):
        if color in path.get('style', ''):
            numbers = re.findall(r'[-\d.]+', path.get('d'))
            corners = np.array(numbers, float).reshape(-1, 2)
            found.append((corners, re.sub(r'[^A-Z]', '', path.get('d'))))
    return found


def line_of(svg):
    """Return the longest path of the first line; the others are its mark in the legend."""
    return max(paths(svg, 'var(--line-0)'), key=lambda found: len(found[0]))


def test_line_rises_from_left_to_right_with_its_values():
    corners, _ = line_of(lines(np.arange(5.0), {'a': np.arange(5.0)}, 's', 'n'))
    x, y = corners.T
    np.testing.assert_allclose(np.diff(x), np.diff(x).mean(), rtol=1e-3)
    np.testing.assert_allclose(np.diff(y), np.diff(y).mean(), rtol=1e-3)
    assert x[0] < x[-1]
    assert y[0] > y[-1]
    assert ((x > 0) & (x < WIDTH) & (y > 0) & (y < HEIGHT)).all()


def test_nan_leaves_a_gap_and_a_line_of_nan_alone_is_left_out():
    values = np.array([1.0, 2.0, np.nan, 2.0, 1.0])
    svg = lines(np.arange(5.0), {'a': values, 'b': np.full(5, np.nan)}, 's', 'n')
    corners, commands = line_of(svg)
    assert commands == 'MLML'
    assert len(corners) == 4
    assert paths(svg, 'var(--line-1)') == []


@pytest.mark.parametrize('values', [[], [np.nan], [0.0], [5.0, 5.0]])
def test_few_values_are_drawn_and_no_values_are_reported(values):
    x = np.arange(float(len(values)))
    svg = lines(x, {'a': np.array(values)}, 's', 'n')
    assert svg == NO_DATA if np.isfinite(values).sum() < 2 else line_of(svg)
    assert histogram(np.array([]), 0.0, 1.0, 'x', 'n') == NO_DATA


def test_histogram_counts_every_finite_value():
    rng = np.random.default_rng(1)
    values = np.r_[rng.uniform(0.0, 1.0, 1000), np.nan, 1.0, 7.0]
    ((corners, _),) = paths(histogram(values, 0.0, 1.0, 'x', 'n'), 'var(--bar)')
    heights = corners[0, 1] - corners[1 : 2 * NUM_BINS : 2, 1]
    expected = np.bincount(
        np.minimum(values[np.isfinite(values)] * NUM_BINS, NUM_BINS - 1).astype(int)
    )
    assert len(heights) == NUM_BINS
    np.testing.assert_allclose(heights / heights.max(), expected / expected.max(), atol=1e-3)


def test_text_is_escaped_everywhere():
    one = np.ones(3)
    for svg in (
        lines(np.arange(3.0), {NASTY: one}, NASTY, NASTY),
        histogram(one, 0.0, 1.0, NASTY, NASTY),
    ):
        ElementTree.fromstring(svg)
        assert '<script' not in svg
        assert NASTY in ''.join(ElementTree.fromstring(svg).itertext())
