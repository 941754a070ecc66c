# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper replay`` writes map, picture and summary, or states why it refuses."""

import json
from pathlib import Path

import numpy as np
from plyfile import PlyData
import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.mapping.surfel_map import SurfelMap
from test.bags.recorded import (
    CLOUD,
    cut,
    drive,
    NUM_SCANS,
    write_rosbag2,
)

pytestmark = pytest.mark.usefixtures('undrawn')

MAPS = {'map.npz', 'map.ply', 'map.png'}
FILES = {*MAPS, 'report.html', 'scans.csv', 'summary.json', 'trajectory.tum'}
PNG_MAGIC = b'\x89PNG\r\n\x1a\n'


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_rosbag2(tmp_path_factory.mktemp('bags') / 'drive', drive())


def settings_file(tmp_path, text):
    path = tmp_path / 'settings.yaml'
    path.write_text(text)
    return str(path)


def strict_json(text):
    """Return the content of JSON; KeyError for NaN and Infinity, which Python reads too."""
    return json.loads(text, parse_constant={}.__getitem__)


def summary_of(output):
    return strict_json((output / 'summary.json').read_text())


@pytest.mark.drawn
def test_a_replay_writes_map_picture_and_summary(bag, tmp_path, capsys):
    output = tmp_path / 'a' / 'b'

    assert main(['replay', str(bag), '--output', str(output)]) == 0

    assert {path.name for path in output.iterdir()} == FILES
    summary = summary_of(output)
    assert summary['scans']['received'] == summary['scans']['mapped'] == NUM_SCANS
    assert summary['points'] == NUM_SCANS * 4500
    vertices = PlyData.read(output / 'map.ply')['vertex']
    assert vertices.count == summary['surfels'] > 100
    # the floor is at z = 0 in odom, the wall at y = 3.1
    on_floor, on_wall = np.abs(vertices['z']) < 1e-3, np.abs(vertices['y'] - 3.1) < 1e-3
    assert (on_floor | on_wall).mean() > 0.9  # all but the voxels with both
    np.testing.assert_allclose(vertices['nz'][on_floor & ~on_wall], 1.0, atol=1e-4)
    np.testing.assert_allclose(vertices['ny'][on_wall & ~on_floor], -1.0, atol=1e-4)
    assert (output / 'map.png').read_bytes().startswith(PNG_MAGIC)
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert lines[0] == 'poses from tf: /tf has them'
    assert lines[1] == f'scans {NUM_SCANS}   points 27 k   surfels {summary["surfels"]}'
    assert lines[2].startswith('read ')
    assert lines[3] == f'digest {summary["digest"]}'
    assert printed.err == ''  # no progress without a terminal


def test_json_prints_the_summary_alone(bag, tmp_path, capsys):
    assert main(['replay', str(bag), '--json', '--output', str(tmp_path)]) == 0

    assert json.loads(capsys.readouterr().out) == summary_of(tmp_path)


def test_internal_errors_of_mapped_scans_are_no_success(bag, tmp_path, monkeypatch, capsys):
    def broken(self, *args):
        raise ZeroDivisionError

    monkeypatch.setattr(SurfelMap, 'surfels_of', broken)
    assert main(['replay', str(bag), '--output', str(tmp_path)]) == 4
    assert f'{NUM_SCANS} internal errors' in capsys.readouterr().err.splitlines()[-1]


def test_points_left_out_are_counted_by_cause_in_words(tmp_path, caplog):
    np.save(tmp_path / 'a.npy', [[np.nan] * 3] * 7)
    assert main(['replay', str(tmp_path / 'a.npy'), '--output', str(tmp_path / 'out')]) == 1
    assert 'dropped: points left out: not finite 7 (' in caplog.text


def test_the_default_output_is_named_after_the_bag(bag, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for path in (bag, bag / 'drive.mcap'):
        assert main(['replay', str(path), '--overwrite']) == 0

    assert [path.name for path in tmp_path.iterdir()] == ['drive_surfels']


def test_all_scans_stay_unless_the_window_is_asked_for(bag, tmp_path):
    config = settings_file(tmp_path, 'window: {max_scans: 2}')
    for options, left in (([], NUM_SCANS), (['--window'], 2)):
        arguments = ['replay', str(bag), '--config', config, '--output', str(tmp_path / 'out')]
        assert main([*arguments, '--overwrite', *options]) == 0
        assert summary_of(tmp_path / 'out')['window_scans'] == left


def test_topics_can_be_named(tmp_path, capsys):
    entries = drive()
    entries.cloud('/other', entries[-1][2] + 1, np.ones((9, 3)))
    path = str(write_rosbag2(tmp_path / 'two', entries))
    output = ['--output', str(tmp_path / 'out'), '--overwrite']

    assert main(['replay', path, *output]) == 1
    assert 'PointCloud2 topics: /other, /points' in capsys.readouterr().err
    assert main(['replay', path, '--topic', '/points', '--pose-topic', '/tf', *output]) == 0
    assert main(['replay', path, '--topic', '/points', '--pose-topic', '/t', *output]) == 1
    assert 'no poses on /t; the bag offers tf (/tf, /tf_static), ' in capsys.readouterr().err


def test_a_replay_that_maps_nothing_is_refused_with_the_causes(bag, tmp_path, capsys):
    config = settings_file(tmp_path, 'frames: {fixed: map}')

    code = main(['replay', str(bag), '--config', config, '--output', str(tmp_path / 'out')])

    assert code == 1
    said = capsys.readouterr().err
    assert 'none of 6 clouds of /points was mapped (no pose 6); `surfel-mapper info' in said
    assert not (tmp_path / 'out').exists()
    chain = settings_file(tmp_path, '- MaxDistDataPointsFilter: {maxDist: 0.01}')
    assert main(['replay', str(bag), '--filters', chain, '--output', str(tmp_path / 'out')]) == 1
    assert capsys.readouterr().err.endswith('was mapped (filtered out 6)\n')


def test_dropped_scans_are_reported_by_cause(tmp_path, capsys):
    entries = drive()
    entries[4][3].header.frame_id = ''

    bag = write_rosbag2(tmp_path / 'drive', entries)
    assert main(['replay', str(bag), '--output', str(tmp_path / 'out')]) == 4

    printed = capsys.readouterr()
    line = printed.out.splitlines()[1]
    assert line.startswith('scans 6 (1 dropped: empty frame id 1)   points 22')
    assert 'only 5 of 6 scans are in the map: empty frame id 1' in printed.err


@pytest.mark.parametrize(('num_dropped', 'code'), [(0, 0), (1, 0), (2, 4)])
def test_the_exit_code_is_0_if_95_percent_of_the_scans_are_mapped(tmp_path, num_dropped, code):
    entries = drive(num_scans=20)
    clouds = [message for _, type_, _, message in entries if type_ == CLOUD]
    for message in clouds[3 : 3 + num_dropped]:
        message.header.frame_id = ''
    bag = write_rosbag2(tmp_path / 'drive', entries)
    assert main(['replay', str(bag), '--output', str(tmp_path / 'out')]) == code


def test_a_damaged_bag_leaves_an_earlier_result_whole(tmp_path, capsys):
    bag, output = write_rosbag2(tmp_path / 'drive', drive(), 'sqlite3'), tmp_path / 'out'
    assert main(['replay', str(bag), '--output', str(output)]) == 0
    before = {path.name: path.read_bytes() for path in output.iterdir()}

    cut(bag / 'drive.db3', 0.02)

    assert main(['replay', str(bag), '--output', str(output), '--overwrite']) == 1
    assert 'drive' in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in output.iterdir()} == before


@pytest.mark.parametrize('name', ['out', 'out/a/b'])
def test_an_output_that_cannot_be_a_directory_is_refused_before_the_work(tmp_path, capsys, name):
    (tmp_path / 'out').write_text('mine')

    assert main(['replay', str(tmp_path / 'no.bag'), '--output', str(tmp_path / name)]) == 1
    assert 'out is a file, expected a directory' in capsys.readouterr().err
    assert (tmp_path / 'out').read_text() == 'mine'


@pytest.mark.drawn
def test_poses_are_held_against_the_truth_in_summary_and_report(bag, tmp_path, capsys):
    first, second = tmp_path / 'first', tmp_path / 'second'
    track = tmp_path / 'track.tum'
    assert main(['replay', str(bag), '--output', str(first), '--poses-out', str(track)]) == 0
    lines = track.read_text().splitlines()
    shifted = [line.split() for line in lines if not line.startswith('#')]
    for row, values in enumerate(shifted):
        values[1] = repr(float(values[1]) + 0.1 * (row % 2))  # every other pose is off by 10 cm
    track.write_text('\n'.join(' '.join(values) for values in shifted))

    assert 'errors of' not in capsys.readouterr().out
    assert main(['replay', str(bag), '--output', str(second), '--truth', str(track)]) == 0

    assert f'errors of {len(shifted)} poses   absolute 5' in capsys.readouterr().out
    assert 'pose_errors' not in summary_of(first)
    errors = summary_of(second)['pose_errors']
    assert errors['num_poses'] == len(shifted)
    steps = errors['relative']['translation_m']
    assert steps['max'] == pytest.approx(0.1, abs=1e-6)
    assert 'Errors of the poses' in (second / 'report.html').read_text()
    assert 'Errors of the poses' not in (first / 'report.html').read_text()


def test_an_invalid_truth_is_refused_before_the_work(bag, tmp_path, capsys):
    output = tmp_path / 'out'
    assert main(['replay', str(bag), '--output', str(output), '--truth', '/nowhere']) == 1
    assert '/nowhere' in capsys.readouterr().err
    assert main(['replay', str(bag), '--output', str(output), '--truth', str(bag)]) == 1
    assert 'not a simulated bag' in capsys.readouterr().err
    assert not output.exists()


REAL = ['hall_os0_full', 'hall_os0_long']
MOUNT = """
pose: {source: odometry}
frames: {base_to_sensor: [0.0, 0.0, 0.03618, 0.0, 0.0, 1.0, 0.0]}
"""


@pytest.mark.parametrize('name', REAL)
def test_a_real_bag_maps_whole_and_alike_with_transforms_and_odometry(name, data_folder, tmp_path):
    bag = Path(data_folder, 'data', 'bags', name)
    config = settings_file(tmp_path, MOUNT)

    summaries = []
    for options in ([], ['--config', config]):
        arguments = ['replay', str(bag), '--output', str(tmp_path / 'out'), '--overwrite']
        assert main([*arguments, *options]) == 0
        summaries.append(summary_of(tmp_path / 'out'))

    for summary in summaries:
        assert summary['scans']['mapped'] == summary['scans']['received'] > 20
        assert summary['scans']['dropped'] == {}
        assert summary['surfels'] > 5000
    assert summaries[0]['digest'] == summaries[1]['digest']
