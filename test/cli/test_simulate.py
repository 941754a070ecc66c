# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper simulate``: its bag, its report, its defaults and refusals."""

import json

import pytest

from surfel_mapper.bags.reader import BagReader
from surfel_mapper.cli.main import main
from surfel_mapper.simulation import Drive, Lidar, load_simulation, World

SMALL = ('--beams', '8', '--columns', '64')


def run(path, *options):
    return main(['simulate', 'street', '--output', str(path), *SMALL, *options])


def counts(path):
    with BagReader(path) as reader:
        return {topic.name: topic.count for topic in reader.topics}


def test_a_simulation_writes_a_bag_and_reports_its_counts(tmp_path, capsys):
    assert run(tmp_path / 'street', '--scans', '3') == 0
    out, err = capsys.readouterr()
    assert out.startswith(f'{tmp_path}/street: scans 3   points 1.54 k (')
    assert err == ''
    assert counts(tmp_path / 'street') == {'/odom': 31, '/points': 3, '/tf': 31, '/tf_static': 1}


def test_the_report_for_machines_adds_up(tmp_path, capsys):
    assert run(tmp_path / 'street', '--duration', '0.35', '--rate', '20', '--json') == 0
    report = json.loads(capsys.readouterr().out)
    assert report['scans'] == 7
    assert report['points'] == 7 * 8 * 64
    assert 0.7 * report['points'] < report['returns'] < report['points']
    assert report['distance_m'] == pytest.approx(1.75)


def test_every_option_reaches_the_simulation(tmp_path):
    options = (
        '--scans',
        '2',
        '--speed',
        '3',
        '--rate',
        '5',
        '--noise',
        '0.02',
        '--seed',
        '4',
        '--max-range',
        '50',
        '--rolling',
        '--storage',
        'sqlite3',
    )
    assert run(tmp_path / 'street', *options) == 0
    assert (tmp_path / 'street' / 'street.db3').exists()
    simulation = load_simulation(tmp_path / 'street')
    assert simulation.lidar == Lidar(
        beams=8, columns=64, rate_hz=5.0, range_noise_m=0.02, seed=4, max_range_m=50.0
    )
    assert simulation.drive == Drive(start=simulation.world.start, speed_m_s=3.0)
    assert (simulation.num_scans, simulation.rolling) == (2, True)
    assert simulation.world.primitives == World.street(seed=4, length_m=21.2).primitives


def test_an_existing_bag_is_replaced_only_with_overwrite(tmp_path, capsys):
    assert run(tmp_path / 'street', '--scans', '1') == 0
    assert run(tmp_path / 'street', '--scans', '2') == 1
    assert 'surfel-mapper simulate: ' in capsys.readouterr().err
    assert counts(tmp_path / 'street')['/points'] == 1
    assert run(tmp_path / 'street', '--scans', '2', '--overwrite') == 0
    assert counts(tmp_path / 'street')['/points'] == 2


@pytest.mark.parametrize(
    ('options', 'says'),
    [
        (('--beams', '0'), 'beams: 0, expected'),
        (('--rate', '-10'), 'rate_hz: -10.0, expected'),
        (('--speed', '-1'), 'speed_m_s: -1.0, expected'),
        (('--noise', '-0.1'), 'range_noise_m: -0.1, expected'),
        (('--max-range', '0'), 'range_m'),
    ],
)
def test_values_out_of_bounds_are_refused_and_nothing_is_written(options, says, tmp_path, capsys):
    assert run(tmp_path / 'street', *options) == 2
    err = capsys.readouterr().err
    assert says in err
    assert 'Traceback' not in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    'arguments',
    [
        ('moon', '--output', 'x'),
        ('street',),
        ('street', '--output', 'x', '--storage', 'tape'),
        ('street', '--output', 'x', '--scans', '3', '--duration', '1'),
        ('street', '--output', 'x', '--scans', 'many'),
        ('street', '--output', 'x', '--duration', 'inf'),
    ],
)
def test_wrong_usage_exits_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(['simulate', *arguments])
    assert stopped.value.code == 2
    assert 'usage: surfel-mapper simulate' in capsys.readouterr().err
