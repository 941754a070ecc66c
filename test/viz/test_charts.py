# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Plots are valid XML whatever is drawn, and show the numbers where they belong."""

from xml.etree import ElementTree

import numpy as np
import pytest

from surfel_mapper.viz.charts import (
    HEIGHT,
    histogram,
    LEFT,
    lines,
    named_bars,
    NO_DATA,
    POINTS,
    short,
    thinned,
    ticks,
    WIDTH,
)

NASTY = '</svg><script>"&'


def elements(svg, tag):
    return ElementTree.fromstring(svg).findall(f'.//{tag}')


def places(path):
    corners = path.get('d')[1:].replace('M', 'L').split('L')
    return [tuple(map(float, corner.split())) for corner in corners]


def test_a_line_goes_from_the_left_to_the_right_and_up_with_its_values():
    (path,) = elements(lines(np.arange(5.0), {'a': np.arange(5.0)}, 's', 'n'), 'path')
    x, y = np.array(places(path)).T
    assert x[0] == LEFT
    assert (np.diff(x) > 0).all()
    assert (np.diff(y) < 0).all()
    assert ((x > 0) & (x < WIDTH) & (y > 0) & (y < HEIGHT)).all()


def test_nan_leaves_a_gap_and_a_line_of_nan_alone_is_left_out():
    values = np.array([1.0, 2.0, np.nan, 2.0, 1.0])
    svg = lines(np.arange(5.0), {'a': values, 'b': np.full(5, np.nan)}, 's', 'n')
    (path,) = elements(svg, 'path')
    assert path.get('d').count('M') == 2
    assert len(places(path)) == 4


def test_one_value_far_above_all_others_does_not_flatten_them():
    values = np.r_[1e6, np.linspace(1.0, 2.0, 99)]
    (path,) = elements(lines(np.arange(100.0), {'a': values}, 's', 'n'), 'path')
    y = np.array(places(path))[:, 1]
    assert np.ptp(y[1:]) > 15.0
    assert y.min() > 0.0


@pytest.mark.parametrize('values', [[], [np.nan], [0.0], [5.0, 5.0]])
def test_few_values_are_drawn_or_said_to_be_none(values):
    x = np.arange(float(len(values)))
    svg = lines(x, {'a': np.array(values)}, 's', 'n')
    assert svg == NO_DATA if not np.isfinite(values).any() else elements(svg, 'path')
    assert histogram(np.array([]), 0.0, 1.0, 'x', 'n') == NO_DATA
    assert named_bars({}) == NO_DATA


def test_a_histogram_counts_every_finite_value():
    rng = np.random.default_rng(1)
    values = np.r_[rng.uniform(0.0, 1.0, 1000), np.nan, 1.0]
    bars = elements(histogram(values, 0.0, 1.0, 'x', 'n'), 'rect')
    counts = [int(bar.find('title').text.rpartition(' ')[2]) for bar in bars]
    assert sum(counts) == 1001
    heights = np.array([float(bar.get('height')) for bar in bars])
    np.testing.assert_allclose(heights / heights.max(), np.array(counts) / max(counts), atol=0.01)


def test_bars_are_as_long_as_their_numbers():
    bars = elements(named_bars({'a': 10, 'b': 5}), 'rect')
    lengths = [float(bar.get('width')) for bar in bars]
    assert lengths[0] == 2 * lengths[1]


def test_text_is_escaped_everywhere():
    one = np.ones(3)
    for svg in (
        lines(np.arange(3.0), {NASTY: one}, NASTY, NASTY),
        histogram(one, 0.0, 1.0, NASTY, NASTY),
        named_bars({NASTY: 1}),
    ):
        ElementTree.fromstring(svg)
        assert '<script' not in svg


def test_a_long_line_is_thinned_to_medians():
    x, y = thinned(np.arange(10_000.0), np.tile([1.0, 1.0, 9.0], 3334)[:10_000])
    assert len(x) == len(y) == POINTS
    assert set(y) == {1.0}


@pytest.mark.parametrize(('low', 'high'), [(0.0, 1.0), (0.0, 7.3e5), (12.0, 13.0), (0.0, 1e-3)])
def test_ticks_are_few_round_and_inside(low, high):
    found = np.array(ticks(low, high))
    assert 3 <= len(found) <= 7
    assert (found >= low - 1e-9).all()
    assert (found <= high * (1 + 1e-9)).all()
    assert np.ptp(np.diff(found)) < 1e-9 * high


def test_numbers_are_short():
    assert [short(v) for v in (0.25, 17.0, 2e4, 1.5e6, 3e9)] == ['0.25', '17', '20k', '1.5M', '3G']
