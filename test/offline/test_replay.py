# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel_mapper.replay`` writes and returns what the verb replay does."""

import json

import numpy as np
import pytest

from surfel_mapper import Config, replay
from surfel_mapper.cli.main import main
from surfel_mapper.errors import BagError, ConfigError, MapError
from surfel_mapper.files.map_state import load_map
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.offline.replay import ReplayOptions
from surfel_mapper.offline.request import Request
from test.bags.recorded import drive, NUM_SCANS, START_NS, write_rosbag2


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_rosbag2(tmp_path_factory.mktemp('bags') / 'drive', drive())


def test_a_replay_in_python_is_that_of_the_verb(bag, tmp_path):
    assert main(['replay', str(bag), '--output', str(tmp_path / 'verb')]) == 0

    result = replay(bag, output=tmp_path / 'call')

    written = json.loads((tmp_path / 'call' / 'summary.json').read_text())
    assert json.loads(json.dumps(result.summary)) == written
    assert [path.name for path in result.written] == [
        'map.ply',
        'map.png',
        'report.html',
        'summary.json',
    ]
    expected = json.loads((tmp_path / 'verb' / 'summary.json').read_text())
    for values in (written, expected):
        del values['replay_s'], values['milliseconds']
    assert written == expected
    assert result.mapper.map.digest() == expected['digest']
    ply = [(tmp_path / name / 'map.ply').read_bytes() for name in ('call', 'verb')]
    assert ply[0] == ply[1]


def test_options_and_a_part_are_followed(bag, tmp_path):
    poses = tmp_path / 'poses.tum'
    options = ReplayOptions(window=True, formats=('npz',), poses_out=poses)
    config = Config.from_mapping({'window.max_scans': 2})
    counts = []

    result = replay(
        Request(path=bag, every=2),
        output=tmp_path / 'out',
        config=config,
        options=options,
        progress=lambda done, total: counts.append((done, total)),
    )

    assert counts == [(done, NUM_SCANS // 2) for done in range(1, NUM_SCANS // 2 + 1)]
    assert len(result.mapper.window) == 2
    assert load_map(tmp_path / 'out' / 'map.npz')[0].digest() == result.summary['digest']
    np.testing.assert_array_equal(read_trajectory(poses).stamp_ns, result.trajectory.stamps_ns)
    assert result.trajectory.stamps_ns[0] == START_NS


def test_a_stopped_replay_writes_the_scans_so_far(bag, tmp_path):
    done = []
    result = replay(
        bag,
        output=tmp_path / 'out',
        progress=lambda *counts: done.append(counts),
        stopped=lambda: len(done) == 3,
    )
    assert result.summary['interrupted']
    assert result.summary['scans']['mapped'] == 3

    with pytest.raises(MapError, match='stopped before a scan was mapped'):
        replay(bag, output=tmp_path / 'none', stopped=lambda: True)
    assert not (tmp_path / 'none').exists()


@pytest.mark.parametrize(
    ('options', 'config', 'error', 'says'),
    [
        ({'formats': ('stl',)}, None, ConfigError, "formats: 'stl', expected some of ply"),
        ({'formats': ('dxf',)}, None, ConfigError, 'layers.models.enabled: true'),
        ({}, {'frames.fixed': 'map'}, BagError, 'none of 6 clouds of /points was mapped'),
    ],
)
def test_wrong_options_are_refused_and_leave_nothing(bag, tmp_path, options, config, error, says):
    with pytest.raises(error, match=says):
        replay(
            bag,
            output=tmp_path / 'out',
            config=Config.from_mapping(config or {}),
            options=ReplayOptions(**options),
        )
    assert not (tmp_path / 'out').exists()
