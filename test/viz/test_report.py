# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A report is one self-contained page with the map, and escapes all names from bags."""

import base64
from html.parser import HTMLParser
import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from surfel_mapper.errors import FileFormatError
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline import Mapper
from surfel_mapper.viz.report import write_report
from surfel_mapper.viz.turning_view import MAX_SHOWN, SURFEL
from test.viz.test_history import mapped

NASTY = '</title></script><script>alert("x")</script><img src=x onerror=alert(1)>'


class Parsed(HTMLParser):
    """Tags with attributes, and the text of every element by tag."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self._open = [], [], [('', {})]
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self._open.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text.append((*self._open[-1], data))

    def one(self, tag, **attributes):
        (found,) = [
            text
            for name, attrs, text in self.text
            if name == tag and attributes.items() <= attrs.items()
        ]
        return found


def report(tmp_path, drawn=None, title='street', layers=None, sections=(), **summary):
    mapper, history = mapped(3)
    surfels = mapper.map.surfels(2) if drawn is None else drawn
    path = tmp_path / 'report.html'
    summary = {**mapper.summary(), **summary}
    write_report(path, title, summary, surfels, history, layers=layers, sections=sections)
    return Parsed(path.read_text(encoding='utf-8'))


def shown(parsed):
    data = json.loads(parsed.one('script', id='map'))
    rows = np.frombuffer(base64.b64decode(data['surfels']), SURFEL)
    return data, rows


def plane(num, normal=(0.0, 0.0, 1.0)):
    rng = np.random.default_rng(2)
    grid = np.stack(np.meshgrid(*[np.arange(num)] * 2), axis=-1).reshape(-1, 1, 2) * 0.5
    points = (grid + rng.uniform(0.0, 0.5, (num * num, 6, 2))).reshape(-1, 2)
    surfel_map = SurfelMap(0.5)
    surfel_map.add(np.column_stack([points, np.full(len(points), 0.1)]), origin=[0.0, 0.0, 5.0])
    return surfel_map.surfels(5)


def test_the_page_holds_the_surfels_where_they_are(tmp_path):
    surfels = plane(20)

    data, rows = shown(report(tmp_path, surfels))

    low, high = surfels.position.min(axis=0), surfels.position.max(axis=0)
    found = low + rows['place'] / 65535.0 * np.array(data['size'])
    assert len(rows) == len(surfels) == 400
    distance, nearest = cKDTree(surfels.position).query(found)
    assert distance.max() < 1e-3
    assert sorted(nearest) == list(range(400))
    np.testing.assert_array_equal(rows['normal'], np.tile([0, 0, 127], (400, 1)))
    np.testing.assert_allclose(
        np.sort(rows['planarity']) / 255.0, np.sort(surfels.planarity), atol=1 / 255
    )
    np.testing.assert_allclose(high - low, data['size'], atol=1e-3)
    assert (rows['radius'] > 0).all()


def test_the_page_asks_for_nothing_and_is_not_allowed_to(tmp_path):
    parsed = report(tmp_path)

    for tag, attributes in parsed.tags:
        address = attributes.get('src') or attributes.get('href') or 'data:'
        assert address.startswith('data:'), (tag, attributes)
    (policy,) = [a['content'] for t, a in parsed.tags if 'http-equiv' in a]
    assert policy.startswith("default-src 'none';")
    assert 'http' not in policy


def test_names_of_a_bag_are_text_and_nothing_else(tmp_path):
    plain = report(tmp_path)
    parsed = report(
        tmp_path,
        title=NASTY,
        topics=[NASTY],
        pose_topics=[NASTY],
        poses=NASTY,
        points_left_out={NASTY: 3},
        settings={NASTY: NASTY, 'frames.fixed': NASTY},
        milliseconds={NASTY: {'median': 1.0, 'p99': 2.0}},
        scans={'received': 3, 'mapped': 2, 'gated': 0, 'dropped': {NASTY: 1}},
        digest=NASTY,
    )

    for tag in ('script', 'img', 'title', 'style'):
        found = [name for name, _ in parsed.tags if name == tag]
        assert len(found) >= 1 or tag == 'img'
        assert len(found) == [name for name, _ in plain.tags].count(tag)
    assert not any('onerror' in attributes for _, attributes in parsed.tags)
    assert parsed.one('h1') == NASTY


def test_large_map_is_subsampled_and_the_page_says_so(tmp_path):
    surfels = plane(330)
    parsed = report(tmp_path, surfels, surfels=len(surfels))

    assert len(shown(parsed)[1]) == MAX_SHOWN < len(surfels)
    assert any('80,000 of 108,900 surfels are shown' in text for *_, text in parsed.text)


@pytest.mark.parametrize('num', [0, 1])
def test_few_surfels_make_a_page_too(tmp_path, num):
    assert len(shown(report(tmp_path, plane(2).select(np.arange(num))))[1]) == num


def test_without_history_there_are_histograms_alone(tmp_path):
    mapper = Mapper()
    write_report(tmp_path / 'r.html', 'a', mapper.summary(), plane(5))
    parsed = Parsed((tmp_path / 'r.html').read_text())
    labels = [attributes['aria-label'] for tag, attributes in parsed.tags if tag == 'svg']
    histograms = [label for label in labels if label.startswith('surfels by')]
    assert len(histograms) == 2
    assert not any('by time' in label for label in labels)


def test_a_page_that_cannot_be_written_is_an_error(tmp_path):
    with pytest.raises(FileFormatError, match='nowhere'):
        write_report(tmp_path / 'nowhere' / 'r.html', 'a', Mapper().summary(), plane(2))
