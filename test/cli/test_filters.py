# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper filters`` lists the filters of a chain; ``replay --filters`` runs one."""

from __future__ import annotations

import json

import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.filters.registry import all_filters
from test.bags.recorded import drive, write_rosbag2

pytestmark = pytest.mark.usefixtures('undrawn')


def listed(capsys, *arguments):
    assert main(['filters', *arguments]) == 0
    return capsys.readouterr().out


def test_every_filter_is_listed_with_its_line_and_parameters(capsys):
    text = listed(capsys)
    for cls in all_filters():
        assert f'{cls.name} ({cls.libpointmatcher})\n' in text or f'{cls.name}\n' in text
    assert 'VoxelGridDataPointsFilter' in text
    assert '  size_x_m (vSizeX): 1, float in [0.001, inf]. Edge along x, m.\n' in text
    assert max(map(len, text.splitlines())) <= 99


def test_one_filter_is_listed_by_either_name(capsys):
    ours, theirs = listed(capsys, 'ground'), listed(capsys, 'OctreeGridDataPointsFilter')
    assert ours.startswith('ground\n')
    assert theirs.startswith('octree_grid (OctreeGridDataPointsFilter)\n')
    assert 'max_size_m (maxSizeByNode): 0, float in [0, inf].' in theirs


def test_defaults_that_differ_under_the_other_name_are_listed(capsys):
    text = ' '.join(listed(capsys, 'voxel_grid').split())
    assert 'anchor: origin (minimum under the other name), str of origin, minimum.' in text


def test_machines_get_json(capsys):
    (found,) = json.loads(listed(capsys, 'max_dist', '--json'))
    assert (found['name'], found['libpointmatcher']) == ('max_dist', 'MaxDistDataPointsFilter')
    assert found['parameters'][1] == {
        'name': 'max_m',
        'libpointmatcher': 'maxDist',
        'type': 'float',
        'default': '1',
        'libpointmatcher_default': '1',
        'allowed': '',
        'meaning': 'Points here or farther are dropped, m.',
    }
    assert len(json.loads(listed(capsys, '--json'))) == len(all_filters())


def test_an_unknown_name_exits_with_1_and_the_nearest(capsys):
    assert main(['filters', 'voxelgrid']) == 1
    assert 'did you mean voxel_grid' in capsys.readouterr().err


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_rosbag2(tmp_path_factory.mktemp('bags') / 'drive', drive())


def test_a_replay_filters_and_reports_it(bag, tmp_path, capsys):
    chain = tmp_path / 'mapper.yaml'
    chain.write_text('input:\n- RandomSamplingDataPointsFilter: {prob: 0.5}\n- remove_nan\n')
    output = tmp_path / 'out'
    arguments = ['replay', str(bag), '--output', str(output), '--filters', f'{chain}#input']
    assert main(arguments) == 0
    filters = json.loads((output / 'summary.json').read_text())['filters']
    first = filters['1 random_sampling']
    assert abs(first['points_out'] / first['points_in'] - 0.5) < 0.05
    assert filters['2 remove_nan']['points_in'] == first['points_out']
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith('1 random_sampling: 27 k points in, ') for line in lines)

    assert main([*arguments[:-1], f'{chain}#output', '--overwrite']) == 1
    assert "no key 'output' there; keys: input" in capsys.readouterr().err
