# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper info`` prints the topics of a bag and settings that work unchanged."""

import json
import shlex

import numpy as np
import pytest
import yaml

from surfel_mapper.cli.main import main
from test.bags.recorded import (
    CLOUD,
    cut,
    drive,
    MOUNT_M,
    NUM_SCANS,
    ODOMETRY,
    ROS1,
    write_mcap,
    write_ros1,
    write_rosbag2,
)

pytestmark = pytest.mark.usefixtures('undrawn')


@pytest.mark.parametrize('write', [write_rosbag2, write_ros1])
def test_topics_and_poses_are_printed(tmp_path, capsys, write):
    name, store = ('a', {}) if write is write_rosbag2 else ('a.bag', {'store': ROS1})
    path = write(tmp_path / name, drive(**store))

    assert main(['info', str(path)]) == 0

    lines = capsys.readouterr().out.splitlines()
    version = 'ROS 1' if store else 'ROS 2'
    assert lines[0] == f'{path}: {version}, from 2023-11-14 22:13:20 UTC, 0.5 s, 25 messages'
    assert lines[1].split() == [
        *('/odom', ODOMETRY, str(NUM_SCANS), '10.0', 'Hz'),
        *('odom', '->', 'base_link'),
    ]
    assert lines[2].split() == ['/points', CLOUD, str(NUM_SCANS), '10.0', 'Hz', 'lidar']
    assert f'  /tf: {NUM_SCANS} of {NUM_SCANS}, in the frame odom' in lines


def test_printed_settings_replay_the_bag(tmp_path, capsys):
    path = write_rosbag2(tmp_path / 'a', drive())
    assert main(['info', str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()

    start = lines.index(f'  /odom: {NUM_SCANS} of {NUM_SCANS}, in the frame odom') + 1
    stop = next(i for i in range(start, len(lines)) if not lines[i].startswith('      '))
    config = tmp_path / 'settings.yaml'
    config.write_text('\n'.join(lines[start:stop]))

    mount = [*MOUNT_M, 0.0, 0.0, 0.0, 1.0]
    expected = {'pose': {'source': 'odometry'}, 'frames': {'base_to_sensor': mount}}
    assert yaml.safe_load(config.read_text()) == expected
    output = ['--output', str(tmp_path / 'out')]
    assert main(['replay', str(path), '--config', str(config), *output]) == 0


def test_json_holds_the_same(tmp_path, capsys):
    path = write_rosbag2(tmp_path / 'a', drive())

    assert main(['info', str(path), '--json']) == 0

    content = json.loads(capsys.readouterr().out)
    assert {row['topic']: row['messages'] for row in content['topics']} == {
        **dict.fromkeys(('/odom', '/points', '/pose', '/tf'), NUM_SCANS),
        '/tf_static': 1,
    }
    assert [offer['settings']['pose.source'] for offer in content['poses']] == [
        *('tf', 'odometry', 'pose')
    ]


def test_a_bag_without_clouds_gets_no_advice_on_their_frame(tmp_path, capsys):
    path = write_rosbag2(tmp_path / 'a', [row for row in drive() if row[1] != CLOUD])
    assert main(['info', str(path)]) == 0
    printed = capsys.readouterr().out
    assert 'a replay without options is refused: ' in printed
    assert 'identity' not in printed


def test_a_bag_that_is_cut_off_is_shown_as_far_as_it_goes(tmp_path, capsys, caplog):
    path = write_mcap(tmp_path / 'a.mcap', drive())
    cut(path, 0.5)

    assert main(['info', str(path)]) == 0
    assert 'damaged: ' in capsys.readouterr().out
    assert caplog.text.count('is cut off or damaged') == 1
    assert main(['info', str(path), '--strict', '--json']) == 3
    content = json.loads(capsys.readouterr().out)
    assert 'a.mcap: the file is cut off or damaged at byte ' in content['cut'][0]
    assert 0 < sum(row['messages'] for row in content['topics']) < 4 * NUM_SCANS + 1


def test_frames_are_shown_without_the_slash_of_ros1(tmp_path, capsys):
    entries = drive(ROS1)
    for row in entries:
        if row[1] == CLOUD:
            row[3].header.frame_id = '/lidar'

    assert main(['info', str(write_ros1(tmp_path / 'a.bag', entries))]) == 0
    assert f'  /tf: {NUM_SCANS} of {NUM_SCANS}, in the frame odom' in capsys.readouterr().out


def test_names_of_columns_cannot_write_to_the_terminal(tmp_path, capsys):
    """A PLY has its columns' names, and a file its own, from outside."""
    folder = tmp_path / 'scans\x1b[2J\nforged: line'
    folder.mkdir()
    properties = ''.join(f'property float {name}\n' for name in ('x', 'y', 'z', '\x1b[31m'))
    (folder / '1.ply').write_text(
        f'ply\nformat ascii 1.0\nelement vertex 1\n{properties}end_header\n1 2 3 4\n'
    )
    assert main(['info', str(folder)]) == 0
    text = capsys.readouterr().out
    assert 'further columns: \\x1b[31m' in text
    assert 'scans\\x1b[2J\\nforged: line: scans in files' in text
    assert '\x1b' not in text
    assert not any(line.startswith('forged') for line in text.splitlines())


@pytest.mark.parametrize(
    ('names', 'times', 'words'),
    [
        (['12.5', '12.6'], 'names', 'names'),
        (['first', 'second'], 'none: 10 Hz', 'none in the files, taken as 10 Hz'),
    ],
)
def test_a_folder_of_scans_says_where_its_times_come_from(names, times, words, tmp_path, capsys):
    for name in names:
        np.ones((2, 4), np.float32).tofile(tmp_path / f'{name}.bin')
    assert main(['info', str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith(f'2 scans, 0.1 s; times: {words}')
    assert shlex.split(lines[-1])[1:] == [
        'replay',
        str(tmp_path),
        '--output',
        f'{tmp_path.name}_map',
    ]
    assert main(['info', '--json', str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out)['times_from'] == times


def test_the_error_of_the_first_scan_is_shown(tmp_path, capsys):
    (tmp_path / '1.ply').touch()
    (tmp_path / '2.bin').write_bytes(bytes(17))
    for path in (tmp_path, tmp_path / '1.ply'):
        assert main(['info', str(path)]) == 1
        assert '1.ply: not a PLY file' in capsys.readouterr().err

    np.ones((2, 4), np.float32).tofile(tmp_path / '3.bin')
    assert main(['info', str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert 'first scan that can be read: 2 points' in printed
    assert f'damaged: {tmp_path}/1.ply: not a PLY file' in printed


def test_options_of_each_robot_are_printed(tmp_path, capsys):
    rows = [(f'/{name}{row[0]}', *row[1:]) for name in ('a', 'b') for row in drive()]
    bag = write_rosbag2(tmp_path / 'bag', sorted(rows, key=lambda row: row[2]))
    assert main(['info', str(bag)]) == 0
    printed = capsys.readouterr().out
    for name in ('a', 'b'):
        assert f'(--topic /{name}/points --pose-topic /{name}/tf)' in printed
    assert '--topic /a/points --pose-topic /b' not in printed
    assert 'a replay without options is refused' in printed
    assert 'several topics to choose from' in printed
