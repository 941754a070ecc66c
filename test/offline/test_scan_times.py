# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Scans in files have their own times, and of a table without times their own poses."""

import json
from pathlib import Path

import pytest

from surfel_mapper import Config
from surfel_mapper.cli.main import main
from surfel_mapper.errors import BagError, FileFormatError
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.request import Request
from surfel_mapper.offline.scan_times import times_in_names
from test.bags.recorded import HEIGHT_M
from test.offline.test_recording import digest_of, mapped, MOUNTED, pose_file, scan_folder

FRACTIONS = ('7.250', '7.500', '7.625', '8.125', '8.250', '9.000')
"""Irregular times of the six scans, s after 1532402920, which is 03:28:40."""

SECONDS = [f'153240292{text}' for text in FRACTIONS]
TIMES_NS = [int(text.replace('.', '')) * 10**6 for text in SECONDS]
DATES = [f'2018-07-24 03:28:4{text}' for text in FRACTIONS]
AFTER_NS = [time_ns - TIMES_NS[0] for time_ns in TIMES_NS]
MILLISECONDS, NANOSECONDS = ([str(ns // unit) for ns in TIMES_NS] for unit in (10**6, 1))


def write_lines(path, lines):
    path.write_text(''.join(f'{line}\n' for line in lines))
    return path


def opened(folder, **request):
    """Return the stamps of the scans of a folder, and the description of the recording."""
    with open_recording(Request(path=folder, **request), Config()) as recording:
        return recording.stamps, recording.describe()


@pytest.mark.parametrize('poses', ['kitti', None])
@pytest.mark.parametrize('names', [SECONDS, MILLISECONDS, NANOSECONDS])
def test_times_in_names_are_those_of_the_scans_also_at_poses_without_times(tmp_path, names, poses):
    folder = scan_folder(tmp_path, '.bin', names)
    file = None if poses is None else pose_file(tmp_path, poses)

    stamps, found = opened(folder, poses=file)

    assert stamps == TIMES_NS
    assert found['times_from'] == 'names'


@pytest.mark.parametrize('place', ['scans', '.'])
@pytest.mark.parametrize(
    ('name', 'lines', 'expected'),
    [
        ('times.txt', [f'{ns / 1e9:.6e}' for ns in AFTER_NS], AFTER_NS),
        ('times.txt', NANOSECONDS, TIMES_NS),
        ('times.txt', [f'{ns:.18e}' for ns in TIMES_NS], [*map(int, map(float, TIMES_NS))]),
        ('timestamps.txt', DATES, TIMES_NS),
        ('timestamps.txt', ['# of the lidar', '', *MILLISECONDS], TIMES_NS),
    ],
)
def test_times_in_a_file_are_those_of_the_scans(tmp_path, place, name, lines, expected):
    (tmp_path / 'elsewhere').mkdir()  # times beside poses would be stamps of the poses
    folder, poses = scan_folder(tmp_path, '.bin'), pose_file(tmp_path / 'elsewhere', 'kitti')
    path = write_lines(tmp_path / place / name, lines)

    for file in (None, poses):
        stamps, found = opened(folder, poses=file)
        assert stamps == expected
        assert Path(found['times_from']).samefile(path)

    assert mapped(folder, MOUNTED, poses=poses).map.digest() == digest_of(range(6))


def test_names_that_are_times_come_before_a_file_of_times(tmp_path):
    folder = scan_folder(tmp_path, '.bin', SECONDS)
    write_lines(folder / 'times.txt', ['no', 'times'])

    assert opened(folder)[0] == TIMES_NS


def test_scans_without_times_follow_each_other_at_10_hz(tmp_path):
    folder = scan_folder(tmp_path, '.bin')

    stamps, found = opened(folder, poses=pose_file(tmp_path, 'kitti'))

    assert stamps == [n * 10**8 for n in range(6)]
    assert found['times_from'] == 'none: 10 Hz'


def test_a_part_is_that_of_the_times(tmp_path):
    folder, file = scan_folder(tmp_path, '.bin', SECONDS), pose_file(tmp_path, 'kitti')

    mapper = mapped(folder, MOUNTED, poses=file, start_s=0.3, duration_s=0.6)  # to .9 s

    assert mapper.map.digest() == digest_of([2, 3])


@pytest.mark.parametrize(
    ('texts', 'times_ns'),
    [
        (['1532402927.25', '1532402927.50'], [1532402927250000000, 1532402927500000000]),
        (['1532402927.25000000'], [1532402927250000000]),  # as many characters as ns have digits
        (['9.95', '9.9', '10.0', '9.855'], [9855000000, 9900000000, 9950000000, 10000000000]),
        (['1532402927_000000025', '1532402927-250000000'], [1532402927000000025, TIMES_NS[0]]),
        (['1532402927', '1532402928'], [1532402927000000000, 1532402928000000000]),
        (['0000000000', '0000000001'], []),
        (['000000', '000001'], []),
        (['1', '1.5'], []),
        (['scan1.5'], []),
    ],
)
def test_names_are_times_if_they_are_seconds_with_a_point_or_have_as_many_digits(texts, times_ns):
    files = [Path(f'{text}.pcd.bin') for text in texts]

    found = times_in_names(files)

    assert list(found.values()) == times_ns
    assert not times_ns or sorted(found) == sorted(files)


def test_scans_are_read_in_the_order_of_their_times(tmp_path):
    names = ['9.85', '9.855', '9.9', '9.95', '10.0', '10.05']  # 85 < 855, but 9 < 95 < 855
    folder = scan_folder(tmp_path, '.bin', names)

    mapper = mapped(folder, MOUNTED, poses=pose_file(tmp_path, 'kitti'))

    assert mapper.map.digest() == digest_of(range(6))


@pytest.mark.parametrize('rows', [range(6), range(3, 9), range(1, 7), [0, 2, 3, 5, 7, 9]])
@pytest.mark.parametrize('digits', [1, 6, 10])
def test_each_scan_has_the_pose_of_its_number_if_there_are_more_poses(tmp_path, rows, digits):
    folder = scan_folder(tmp_path, '.bin', [f'{row:0{digits}}' for row in rows])
    placed = [rows.index(row) if row in rows else 99 for row in range(10)]  # 99: far away

    mapper = mapped(folder, MOUNTED, poses=pose_file(tmp_path, 'kitti', placed))

    assert mapper.map.digest() == digest_of(range(6))


@pytest.mark.parametrize('kind', ['g2o', 'kitti360'])
def test_numbered_poses_are_those_of_the_scans_of_these_numbers(tmp_path, kind):
    folder, numbers = scan_folder(tmp_path, '.bin', range(10, 16)), [15, 11, 12, 10]
    lines = [
        f'VERTEX_SE3:QUAT {n} {0.5 * (n - 10)} 0 {HEIGHT_M} 0 0 0 1'
        if kind == 'g2o'
        else f'{n} 1 0 0 {0.5 * (n - 10)} 0 1 0 0 0 0 1 {HEIGHT_M}'
        for n in (numbers if kind == 'g2o' else sorted(numbers))
    ]
    config = {**MOUNTED, 'pose.max_gap_s': 0.15}

    mapper = mapped(folder, config, poses=write_lines(tmp_path / 'poses.txt', lines))

    assert mapper.map.digest() == digest_of([0, 1, 2, 5])


def test_poses_of_other_numbers_than_the_scans_are_refused(tmp_path):
    folder = scan_folder(tmp_path, '.bin', range(10, 16))
    poses = write_lines(tmp_path / 'poses.txt', ['VERTEX_SE3:QUAT 30 0 0 0 0 0 0 1'])

    with pytest.raises(BagError, match='scans 10 to 15, poses of 30 to 30'):
        opened(folder, poses=poses)


def test_as_many_poses_as_scans_are_taken_in_order_whatever_the_names(tmp_path):
    folder = scan_folder(tmp_path, '.bin', [0, 1, 2, 3, 4, 6])

    mapper = mapped(folder, MOUNTED, poses=pose_file(tmp_path, 'kitti'))

    assert mapper.map.digest() == digest_of(range(6))


@pytest.mark.parametrize(
    'names',
    [
        None,  # scan0 to scan5
        [2, 3, 4, 5, 6, 7],  # seven poses have the numbers 0 to 6
        [0, 1, 2, 3, 4, '004'],
        [-1, 0, 1, 2, 3, 4],
        SECONDS,
    ],
)
def test_more_poses_without_times_are_refused_unless_all_names_are_numbers_of_poses(
    tmp_path, capsys, names
):
    folder, file = scan_folder(tmp_path, '.bin', names), pose_file(tmp_path, 'kitti', range(7))
    output = tmp_path / 'out'

    assert main(['replay', str(folder), '--poses', str(file), '--output', str(output)]) == 1

    assert capsys.readouterr().err == (
        f'surfel-mapper replay: {file}: 7 poses without times for 6 scans in {folder}, expected '
        'one for each, scans named by the numbers of their rows, 0 to 6, or poses with times '
        '(TUM)\n'
    )
    assert not output.exists()


@pytest.mark.parametrize('number', [4, 9])
def test_poses_of_other_times_are_interpolated_at_those_of_a_file(tmp_path, number):
    folder = scan_folder(tmp_path, '.bin')
    write_lines(folder / 'times.txt', [f'{0.25 * n + 0.125}' for n in range(6)])
    # a pose each .25 s and .5 m, so that scan n is half way between poses n and n + 1
    rows = [f'{0.25 * n} {0.5 * n - 0.25} 0 {HEIGHT_M} 0 0 0 1' for n in range(number)]
    poses = write_lines(tmp_path / 'poses.tum', rows)

    with open_recording(Request(path=folder, poses=poses), Config()) as recording:
        found = recording.times_from
    mapper = mapped(folder, MOUNTED, poses=poses)

    assert found == str(folder / 'times.txt')
    assert mapper.map.digest() == digest_of(range(min(number - 1, 6)))
    assert dict(mapper.counters.dropped) == ({} if number == 9 else {'no_pose': 3})


@pytest.mark.parametrize(
    ('lines', 'says'),
    [
        (SECONDS[:5], 'times.txt: 5 times for 6 scans in .*scans, expected as many, or scans n'),
        ([*SECONDS, '1532402930'], 'times.txt: 7 times for 6 scans in .*, 0 to 6; rename it to'),
        (SECONDS[::-1], 'times.txt: row 2: time 1532402928250000000 ns is not after that of the'),
        ([*SECONDS[:5], 'noon'], "times.txt:6: 'noon' is no time, expected a number"),
        ([*SECONDS[:5], '1 2'], 'times.txt:6: 2 columns, expected 1: a time'),
        ([*DATES[:5], '2018-07-24 25:28:49.0'], 'times.txt:6: .* is no time'),
        (['1 2 3'], 'times.txt:1: 3 columns, expected 1'),
        (['# none'], 'times.txt: no times in it'),
    ],
)
def test_a_file_without_the_times_of_all_scans_is_refused(tmp_path, lines, says):
    folder = scan_folder(tmp_path, '.bin')
    write_lines(folder / 'times.txt', lines)

    with pytest.raises(FileFormatError, match=says):
        opened(folder)


@pytest.mark.usefixtures('undrawn')
def test_the_report_states_the_first_number_and_the_trajectory_has_the_times(tmp_path, capsys):
    folder = scan_folder(tmp_path, '.bin', [f'{row:06}' for row in range(3, 9)])
    write_lines(folder / 'times.txt', [f'{0.25 * row}' for row in range(10)])
    file, output = pose_file(tmp_path, 'kitti', range(-3, 7)), tmp_path / 'out'

    assert main(['replay', str(folder), '--poses', str(file), '--output', str(output)]) == 0

    first_line = capsys.readouterr().out.splitlines()[0]
    assert first_line == 'poses from file: 000003.bin has pose 3, counted from 0, of 10'
    found = read_trajectory(output / 'trajectory.tum')
    assert found.stamp_ns.tolist() == [row * 250_000_000 for row in range(3, 9)]
    assert found.xyz[:, 0].tolist() == [0.5 * n for n in range(6)]
    summary = json.loads((output / 'summary.json').read_text())
    assert summary['times_from'] == str(folder / 'times.txt')
