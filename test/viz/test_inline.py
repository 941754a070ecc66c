# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A map as the result of a cell: a frame with a whole page, drawn in a real browser."""

from __future__ import annotations

import base64
from html.parser import HTMLParser
from io import BytesIO
import json
import re

import numpy as np
from PIL import Image
import pytest

from surfel_mapper import show, SurfelMap
from surfel_mapper.viz.turning_view import MAX_SHOWN, SURFEL
from test import extras
from test.viz.test_report import plane
from test.viz.test_report_browser import BROWSER, browser, num_coloured, picture_until, WAIT_S

__all__ = ['browser']  # a fixture


class Frame(HTMLParser):
    def handle_starttag(self, tag, attributes):
        self.tag, self.attributes = tag, dict(attributes)


def data_of(view):
    """Return the data in the page that a notebook gets, and its surfels."""
    frame = Frame()
    frame.feed(view._repr_html_())
    assert frame.tag == 'iframe'
    script = r'<script type="application/json" id="map">(.*?)</script>'
    found = re.search(script, frame.attributes['srcdoc'])
    data = json.loads(found[1])
    return data, np.frombuffer(base64.b64decode(data['surfels']), SURFEL)


def ground(size_m, number):
    rng = np.random.default_rng(1)
    surfel_map = SurfelMap(0.5, origin_m=(512_000.0, 0.0, 0.0))
    surfel_map.add(rng.uniform(0.0, size_m, (number, 3)) * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.1])
    return surfel_map


def test_all_points_of_a_map_are_in_the_frame():
    surfel_map = ground(20.0, 30_000)
    data, rows = data_of(show(surfel_map))
    surfels = surfel_map.adaptive(5)

    assert len(rows) == len(surfels) == 9  # of 8 m
    assert surfels.num_points.sum() == 30_000
    low, size = surfels.position.min(axis=0), np.array(data['size'])
    places = low + rows['place'] / 65535.0 * size
    np.testing.assert_allclose(np.sort(places[:, 0]), np.sort(surfels.position[:, 0]), atol=0.01)
    np.testing.assert_allclose(data['middle'][0], 512_010.0, atol=1.5)  # of cells of 8 m


def test_a_large_map_stays_small_and_has_no_gaps():
    surfel_map = ground(160.0, 1_000_000)
    view = show(surfel_map, place=[0.0, 0.0, 0.0])
    data, rows = data_of(view)

    assert surfel_map.num_surfels(5) > MAX_SHOWN >= len(rows)
    assert len(view._repr_html_()) < 2_000_000
    area = np.pi * (rows['radius'] / 255.0 * data['largest']) ** 2
    assert (
        area.sum() > 160.0**2
    )  # all of the ground is covered, by larger discs where they are far


def test_surfels_can_be_shown_too():
    assert len(data_of(show(plane(5)))[1]) == 25


def test_other_things_are_refused():
    with pytest.raises(TypeError, match=r'a ndarray, expected a SurfelMap or Surfels; points are'):
        show(np.zeros((3, 3)))


@extras.needs('playwright')
@pytest.mark.skipif(BROWSER is None, reason='no browser on the PATH')
def test_the_frame_is_drawn(browser, tmp_path):
    content = f'<!doctype html><html><body>{show(plane(30))._repr_html_()}</body></html>'
    (tmp_path / 'notebook.html').write_text(content, encoding='utf-8')
    complaints, tab = [], browser.new_page(viewport={'width': 900, 'height': 800})
    tab.set_default_timeout(1000 * WAIT_S)
    tab.on('console', lambda message: complaints.append(message.text))
    tab.goto((tmp_path / 'notebook.html').as_uri())
    frame = tab.frame_locator('iframe')
    frame.locator('#surfels').wait_for()

    def shot():
        image = Image.open(BytesIO(frame.locator('#surfels').screenshot()))
        return np.asarray(image.convert('RGB')) / 255.0

    assert num_coloured(picture_until(lambda image: num_coloured(image) > 5000, shot)) > 5000
    assert complaints == []
    tab.close()
