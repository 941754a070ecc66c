# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel_mapper.replay`` writes and returns what the verb replay does."""

from collections import Counter
import csv
import json
import re

import numpy as np
import pytest

from surfel_mapper import Config, Mapper, replay, Scan
from surfel_mapper.cli.main import main
from surfel_mapper.errors import (
    AlignmentError,
    DependencyError,
    FileFormatError,
    MapError,
)
from surfel_mapper.files import parquet
from surfel_mapper.files.map_state import load_map
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.offline.outputs import ScanTrajectory
from surfel_mapper.offline.replay import map_recording, ReplayOptions
from surfel_mapper.offline.request import Request
from surfel_mapper.offline.summary import as_text
from test import extras
from test.bags.recorded import drive, NUM_SCANS, PERIOD_NS, START_NS, write_rosbag2

pytestmark = pytest.mark.usefixtures('undrawn')


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
        'map.npz',
        'trajectory.tum',
        'scans.csv',
        'map.png',
        'report.html',
        'summary.json',
    ]
    expected = json.loads((tmp_path / 'verb' / 'summary.json').read_text())
    for values in (written, expected):
        del values['replay_s'], values['milliseconds'], values['stage_s']
    assert written == expected
    assert result.mapper.map.digest() == expected['digest']
    ply = [(tmp_path / name / 'map.ply').read_bytes() for name in ('call', 'verb')]
    assert ply[0] == ply[1]
    with open(tmp_path / 'call' / 'scans.csv', newline='') as file:
        rows = list(csv.DictReader(file))
    counts = Counter(row['outcome'] for row in rows)
    dropped = sum(expected['scans']['dropped'].values())
    assert counts == +Counter(mapped=expected['scans']['mapped'], dropped=dropped)
    assert len(rows) == expected['scans']['received']
    assert {row['pose_source'] for row in rows if row['outcome'] == 'mapped'} == {
        expected['poses_from']
    }
    assert all(float(row['total_ms']) > 0.0 for row in rows if row['outcome'] == 'mapped')


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

    assert counts == sorted(counts)  # received; a scan may wait until the next is reduced
    assert counts[-1] == (NUM_SCANS // 2, NUM_SCANS // 2)
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
        stopped=lambda: len(done) >= 3,
    )
    assert result.summary['interrupted']
    assert result.summary['scans']['mapped'] == 3

    with pytest.raises(MapError, match='stopped before a scan was mapped'):
        replay(bag, output=tmp_path / 'none', stopped=lambda: True)
    assert not (tmp_path / 'none').exists()


def contents(directory):
    return {path.name for path in directory.iterdir()}


@pytest.mark.parametrize('option', ['poses_out', 'rrd'])
@pytest.mark.parametrize('place', ['none/file', 'file/file', '.'])
def test_files_that_cannot_be_written_are_refused_before_the_first_scan(
    bag, tmp_path, option, place
):
    if option == 'rrd':
        extras.load('rerun')
    (tmp_path / 'file').touch()
    with pytest.raises(FileFormatError, match='cannot be written'):
        replay(
            Request(path=bag / 'no such bag'),  # not even opened
            output=tmp_path / 'out',
            options=ReplayOptions(**{option: tmp_path / place}),
        )
    assert contents(tmp_path) == {'file'}


def test_formats_without_their_package_are_refused_before_the_first_scan(
    bag, tmp_path, monkeypatch
):
    def missing():
        raise DependencyError('pyarrow cannot be loaded')

    monkeypatch.setattr(parquet, 'import_pyarrow', missing)
    with pytest.raises(DependencyError, match='pyarrow'):
        replay(bag, output=tmp_path / 'out', options=ReplayOptions(formats=('parquet',)))
    assert not (tmp_path / 'out').exists()


def test_the_map_is_written_before_an_alignment_that_fails(bag, tmp_path):
    config = Config.from_mapping({'window.max_scans': 1})
    options = ReplayOptions(window=True, align=True)

    with pytest.raises(AlignmentError, match='1 scan in the map'):
        replay(bag, output=tmp_path / 'out', config=config, options=options)

    assert contents(tmp_path / 'out') == {'map.ply', 'map.npz', 'trajectory.tum'}
    assert load_map(tmp_path / 'out')[0].num_points > 0


def test_the_stages_are_parts_of_the_wall_time(bag, tmp_path):
    summary = replay(bag, output=tmp_path / 'out').summary

    stages = {name: s for name, s in summary['stage_s'].items() if name != 'total'}
    assert {'read', 'decode', 'reduce', 'insert', 'normals', 'clocks', 'record'} <= set(stages)
    assert 0.0 < sum(stages.values()) <= summary['replay_s']
    line = next(line for line in as_text(summary, []).splitlines() if line.startswith('read '))
    means, _, mapping = line.partition(' a scan   ')
    without_clock = Config.from_mapping({'pose.source': 'registration'})
    registered = replay(bag, output=tmp_path / 'registered', config=without_clock).summary
    assert 'clocks' not in registered['stage_s']
    printed = re.findall(r'(\w+) (-?[\d.]+) ms', means)
    assert [name for name, _ in printed][-2:] == ['other', 'total']
    *parts, total = (float(milliseconds) for _, milliseconds in printed)
    assert abs(sum(parts) - total) <= 0.05 * len(printed)  # of rounding
    times = summary['milliseconds']['total']
    assert mapping.startswith(f'mapping {times["median"]:.1f} ms, p99 {times["p99"]:.1f}   ')


def test_doubts_of_a_recording_in_place_of_a_map_are_one_line(bag, monkeypatch, caplog):
    monkeypatch.setattr('surfel_mapper.offline.replay.uncertain_text', lambda figures: 'one\ntwo')
    map_recording(bag)
    assert caplog.records[-1].message == f'{bag}: one; two'


@pytest.mark.drawn
def test_a_single_scan_has_no_speed_and_no_lines_over_time(tmp_path):
    path = tmp_path / 'one.xyz'
    np.savetxt(path, np.random.default_rng(1).uniform(-1.0, 1.0, (2000, 3)))
    summary = replay(path, output=tmp_path / 'out').summary

    assert 'real time' not in as_text(summary, [])
    page = (tmp_path / 'out/report.html').read_text(encoding='utf-8')
    assert '1 scan, 2 k points' in page
    assert 'Planarity of the surfels' in page
    assert 'over time</figcaption>' not in page
    assert 'recorded</dt>' not in page


def test_the_trajectory_is_that_of_the_map_if_time_was_set_back():
    mapper = Mapper(Config.from_mapping({'pose.source': 'identity'}))
    trajectory = ScanTrajectory(mapper)
    for stamp_s in (100, 101, 50, 52):
        points = np.full((5, 3), float(stamp_s), np.float32)
        mapper.add_scan(Scan(points=points, stamp_ns=stamp_s * 10**9, frame_id='lidar'))
        for update in mapper.insert_ready():
            trajectory.add(update)
    assert trajectory.stamps_ns == [50 * 10**9, 52 * 10**9]
    assert (len(trajectory.poses), mapper.map.num_points) == (2, 10)


@pytest.mark.parametrize(
    ('change', 'says'),
    [
        (
            lambda entries, at_ns: entries.transform(
                '/tf_static', at_ns, 'base_link', 'lidar', (1.0, 0.0, 0.25)
            ),
            "'lidar' has moved from (0.000, 0.000, 0.250) m in 'base_link' to (1.000, 0.000",
        ),
        (
            lambda entries, at_ns: entries.transform(
                '/tf', at_ns, 'odom', 'base_link', (-2.0, 0.0, 0.75)
            ),
            "'base_link' has moved from (1.000, 0.000, 0.750) m in 'odom' to (-2.000, 0.000",
        ),
    ],
)
def test_a_map_with_another_mount_or_a_jump_of_the_poses_is_in_doubt(
    tmp_path, capsys, change, says
):
    entries = drive()
    change(entries, START_NS + 2 * PERIOD_NS + 20_000_000)
    entries.sort(key=lambda entry: entry[2])
    bag = write_rosbag2(tmp_path / 'bag', entries)
    assert main(['replay', str(bag), '-o', str(tmp_path / 'out')]) == 4
    said = capsys.readouterr()
    assert f'surfel-mapper: {says}' in said.err
    assert 'the map holds scans of the old place' in said.out
