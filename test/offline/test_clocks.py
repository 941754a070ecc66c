# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Offsets of clocks are measured from record times, named, and corrected by a setting."""

import json

import numpy as np
import pytest

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.cli.main import main
from surfel_mapper.offline.clocks import clock_offsets
from surfel_mapper.offline.survey import survey
from surfel_mapper.poses import ClockOffset, offset_s
from test import extras
from test.bags.recorded import CLOUD, drive, NUM_SCANS, TF, write_rosbag2

pytestmark = pytest.mark.usefixtures('undrawn')

MS = 10**6


def with_clouds_ahead(path, offset_ns, entries=None):
    """Write a drive whose clouds have stamps of another clock, recorded when they were sent."""
    entries = entries or drive()
    for _, type_, _, message in entries:
        if type_ == CLOUD:
            stamp = message.header.stamp
            stamp_ns = stamp.sec * 10**9 + stamp.nanosec + offset_ns
            stamp.sec, stamp.nanosec = divmod(stamp_ns, 10**9)
    return write_rosbag2(path, [row for row in entries if row[1] in (CLOUD, TF)])


def replayed(tmp_path, bag, *arguments):
    """Replay a bag; return the exit code and the summary."""
    code = main(['replay', str(bag), '-o', str(tmp_path / 'out'), '--overwrite', *arguments])
    return code, json.loads((tmp_path / 'out' / 'summary.json').read_text())


@pytest.mark.parametrize('seconds', [37.0, -3600.0, 0.9, -1_699_000_000.0])
def test_the_offset_is_the_difference_of_the_median_delays(seconds):
    rng = np.random.default_rng(3)
    poses = [-2 * MS - int(n) for n in rng.integers(0, 10 * MS, 100)]
    clouds = [round(seconds * 1e9) - 90 * MS - int(n) for n in rng.integers(0, 10 * MS, 30)]
    assert offset_s(clouds, poses) == pytest.approx(seconds - 0.088, abs=0.01)


@pytest.mark.parametrize(
    ('clouds', 'poses'),
    [
        ([], [0]),
        ([0], []),
        ([-400 * MS] * 9, [0] * 9),  # late, as after a long computation
        ([k * 10**9 for k in range(20)], [0] * 9),  # replayed at another speed
    ],
)
def test_delays_and_clocks_that_are_not_steady_are_no_offset(clouds, poses):
    assert offset_s(clouds, poses) is None


@pytest.mark.parametrize(
    ('seconds', 'text'),
    [
        (36.995, 'are 36.995 s ahead of those of /tf: the clocks differ (TAI is ahead of UTC'),
        (-7200.01, 'are 7200.010 s behind those of /tf: the clocks differ (another time zone)'),
        (-1.6e9, 's behind those of /tf: the clocks differ (one counts from its start)'),
        (
            5.5,
            'are 5.500 s ahead of those of /tf: the clocks differ (or /tf comes late, and its '
            'stamps are right); --time-offset /points=-5.500',
        ),
    ],
)
def test_an_offset_names_topics_seconds_cause_and_option(seconds, text):
    assert text in str(ClockOffset('/points', '/tf', seconds))


def test_info_names_record_times_that_are_the_stamps(tmp_path, capsys):
    bags = {True: with_clouds_ahead(tmp_path / 'converted', 0)}
    bags[False] = with_clouds_ahead(tmp_path / 'recorded', 37 * 10**9)
    for are_stamps, bag in bags.items():
        assert main(['info', str(bag)]) == 0
        assert ('clocks: record times are the stamps' in capsys.readouterr().out) == are_stamps


@pytest.mark.parametrize('seconds', [37, -3600, 1])
def test_an_offset_is_named_and_the_option_that_corrects_it_gives_the_right_map(
    tmp_path, capsys, seconds
):
    _, right = replayed(tmp_path, write_rosbag2(tmp_path / 'right', drive()))
    bag = with_clouds_ahead(tmp_path / 'bag', seconds * 10**9)
    capsys.readouterr()
    code, summary = replayed(tmp_path, bag)
    side = 'ahead of' if seconds > 0 else 'behind'
    says = f'stamps of /points are {abs(seconds)}.000 s {side} those of /tf'
    assert (code, summary['clock_offsets'][0]['seconds']) == (4, pytest.approx(seconds, abs=1e-3))
    assert says in capsys.readouterr().err
    assert main(['info', str(bag)]) == 0
    assert f'clocks: by the record times, {says}' in capsys.readouterr().out
    for option in (f'{-seconds}', f'/points={-seconds}'):
        code, summary = replayed(tmp_path, bag, '--time-offset', option)
        assert (code, summary['clock_offsets']) == (0, [])
        assert (summary['digest'], summary['poses_from']) == (right['digest'], 'tf')


def test_without_poses_clouds_are_compared_with_other_clouds(tmp_path):
    entries = drive()
    rows = [row for row in entries if row[1] == CLOUD]
    second = drive()
    with_clouds_ahead(tmp_path / 'unused', -(10**15), second)
    rows += [('/b', *row[1:]) for row in second if row[1] == CLOUD]
    bag = write_rosbag2(tmp_path / 'bag', sorted(rows, key=lambda row: row[2]))
    with BagReader(bag) as reader:
        (offset,) = clock_offsets(survey(reader), ['/points', '/b'])[:1]
    assert (offset.clouds, offset.reference) == ('/points', '/b')
    assert offset.seconds == pytest.approx(1e6, abs=0.1)


def test_stamps_that_are_not_set_are_replaced_by_record_times(tmp_path, caplog):
    entries = drive()
    for _, type_, _, message in entries:
        if type_ == CLOUD:
            message.header.stamp.sec = message.header.stamp.nanosec = 0
    rows = [(*r[:2], r[2] - 1000 * (r[1] == CLOUD), r[3]) for r in entries if r[1] in (CLOUD, TF)]
    _, right = replayed(tmp_path, write_rosbag2(tmp_path / 'right', drive()))
    code, summary = replayed(tmp_path, write_rosbag2(tmp_path / 'bag', rows))
    assert (code, summary['digest']) == (0, right['digest'])
    assert summary['scans']['mapped'] == NUM_SCANS
    assert '/points: header.stamp is 0, not set: the record times are used' in caplog.text


def test_a_single_stamp_of_0_is_not_replaced(tmp_path):
    entries = drive()
    first = next(row for row in entries if row[1] == CLOUD)
    first[3].header.stamp.sec = first[3].header.stamp.nanosec = 0
    code, summary = replayed(tmp_path, write_rosbag2(tmp_path / 'bag', entries))
    assert (code, summary['scans']['mapped']) == (4, NUM_SCANS - 1)


@pytest.mark.parametrize('option', ['abc', '/points=', 'nan', '1e11'])
def test_an_offset_that_is_no_number_of_seconds_is_wrong_usage(tmp_path, capsys, option):
    with pytest.raises(SystemExit, match='2'):
        main(['replay', str(tmp_path), '--time-offset', option])
    assert 'expected seconds, or TOPIC=SECONDS' in capsys.readouterr().err


def test_the_trajectory_is_written_in_the_order_of_time(tmp_path):
    entries = drive()
    clouds = [row for row in entries if row[1] == CLOUD]
    swapped = [row for row in entries if row[1] != CLOUD]
    for (*head, record_ns, _), (*_, message) in zip(
        clouds, [*clouds[1::2], *clouds[::2]], strict=True
    ):
        swapped.append((*head, record_ns, message))
    bag = write_rosbag2(tmp_path / 'bag', sorted(swapped, key=lambda row: row[2]))
    _, right = replayed(tmp_path, write_rosbag2(tmp_path / 'right', entries))
    expected = (tmp_path / 'out' / 'trajectory.tum').read_text()
    code, summary = replayed(tmp_path, bag)
    assert (code, summary['digest']) == (0, right['digest'])
    assert (tmp_path / 'out' / 'trajectory.tum').read_text() == expected


def test_several_bags_name_the_bag_of_an_offset(tmp_path, capsys):
    extras.load('distributed')
    right = write_rosbag2(tmp_path / 'right', drive())
    bag = with_clouds_ahead(tmp_path / 'ahead', 37 * 10**9)
    output = tmp_path / 'out'
    assert main(['replay', str(right), str(bag), '--pose-topic', '/tf', '-o', str(output)]) == 4
    summary = json.loads((output / 'summary.json').read_text())
    assert f'{bag}: by the record times, stamps of /points are 37.000 s' in capsys.readouterr().err
    assert len(summary['clock_offsets']) == 1
