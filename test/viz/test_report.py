# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A report is one self-contained page with the map, and escapes all names from bags."""

import base64
import dataclasses
from html.parser import HTMLParser
import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from surfel_mapper.errors import FileFormatError
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.pipeline import Mapper
from surfel_mapper.viz.discs import RGB
from surfel_mapper.viz.report import write_report
from surfel_mapper.viz.turning_view import column_data, MAX_SHOWN, nearest_pose, SURFEL
from test.cli.test_replay_align import bag, replayed, settings
from test.viz.test_history import mapped

__all__ = ['bag', 'settings']  # fixtures

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


def decoded(column):
    """Return the values of a column as page/view.js decodes them."""
    kind, steps = ('<u2', 65535) if column['bytes'] == 2 else ('u1', 255)
    codes = np.frombuffer(base64.b64decode(column['codes']), kind).astype(float)
    part = (np.where(codes > 0.0, codes, np.nan) - 1.0) / (steps - 1.0)
    low, high = column['low'], column['high']
    return low * (high / low) ** part if column['log'] else low + part * (high - low)


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
    for column in data['columns']:
        expected = getattr(surfels, column['name'].replace(' ', '_'))[nearest]
        # 254 steps from the least to the largest value
        np.testing.assert_allclose(decoded(column), expected, atol=np.ptp(expected) / 254.0)
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
    surfels, rng = plane(330), np.random.default_rng(1)
    channels = {name: rng.uniform(0, 255, len(surfels)) for name in ('intensity', *RGB)}
    surfels = dataclasses.replace(surfels, channels=channels)
    parsed = report(tmp_path, surfels, surfels=len(surfels))

    assert len(shown(parsed)[1]) == MAX_SHOWN < len(surfels)
    assert (tmp_path / 'report.html').stat().st_size < 1_900_000  # the picture is to come
    assert any('50,000 of 108,900 surfels are shown' in text for *_, text in parsed.text)


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


@pytest.mark.parametrize('high', [9, 300, 60_000])
def test_whole_numbers_of_a_column_are_exact(high):
    values = np.random.default_rng(1).integers(3, high, 500)
    np.testing.assert_allclose(decoded(column_data('num_points', values)), values, atol=1e-9)


def test_columns_of_wide_ranges_are_coded_by_their_logarithm_and_keep_gaps():
    values = np.concatenate([np.geomspace(1e-4, 1e-3, 300), [2.0, np.nan]])
    column = column_data('normal_sigma', values)
    assert column['log']
    # a step is a 254th of four decades
    np.testing.assert_allclose(decoded(column), values, rtol=np.log(2e4) / 254.0)


@pytest.mark.parametrize('values', [np.full(4, np.nan), np.zeros(3), np.empty(0)])
def test_columns_without_a_range_are_coded_too(values):
    np.testing.assert_array_equal(decoded(column_data('thickness', values)), values)


def test_surfels_belong_to_the_pose_that_is_nearest():
    way = np.column_stack([np.arange(11.0), np.zeros(11), np.zeros(11)])
    position = np.array([[-5.0, 1.0, 0.0], [3.2, 9.0, 1.0], [40.0, 0.0, 0.0]])
    np.testing.assert_allclose(nearest_pose(position, way), [0.0, 0.3, 1.0])
    np.testing.assert_allclose(nearest_pose(position, way[:1]), 1.0)


def test_figures_are_those_of_the_map_and_of_the_median_scan(tmp_path):
    surfels = plane(4)
    parsed = report(tmp_path, surfels, milliseconds={'total': {'median': 3.21, 'p99': 9.0}})
    texts = [text for tag, _, text in parsed.text if tag in ('dt', 'dd')]
    figures = dict(zip(texts[::2], texts[1::2], strict=True))
    assert figures['surfels'] == str(len(surfels))
    assert figures['points in surfels'] == str(surfels.num_points.sum())
    assert figures['time a scan (median)'] == '3.2 ms'
    assert 'speed' not in figures


def test_settings_of_the_user_are_named_first(tmp_path):
    settings = {'map.voxel_size_m': 0.2, 'pose.source': 'tf', 'map.min_points': 5}
    parsed = report(tmp_path, settings=settings, settings_set=['map.voxel_size_m'])
    cells = [text for tag, _, text in parsed.text if tag == 'td']
    assert cells.index('map.voxel_size_m') < cells.index('pose.source')
    assert [t for tag, _, t in parsed.text if tag == 'summary'] == ['2 settings not changed']


def test_doubtful_poses_are_stated_in_words(tmp_path):
    spent = {'scans': 15, 'seconds': 1.5}
    tracking = {'surrounded': spent, 'lost': {'scans': 0, 'seconds': 0.0}}
    parsed = report(tmp_path, registration={'tracking': tracking, 'apart': []})
    cells = [text for tag, _, text in parsed.text if tag == 'td']
    assert 'with most surfaces moving with the sensor' in cells
    assert 'surrounded' not in cells
    assert 'not placed on the map' not in cells


def test_the_page_draws_the_poses_after_the_alignment(bag, settings, tmp_path):
    """It drew those of the odometry."""
    _, poses = replayed(bag, settings, tmp_path, '--align')
    data, _ = shown(Parsed((tmp_path / 'out' / 'report.html').read_text(encoding='utf-8')))
    way = np.frombuffer(base64.b64decode(data['trajectory']), '<f4').reshape(-1, 3)
    steps = np.diff(poses[:, :3, 3], axis=0)
    np.testing.assert_allclose(np.diff(way, axis=0), steps, atol=1e-4)
