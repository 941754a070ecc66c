# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``replay`` of several bags or with workers, and ``merge``, make the map of one process."""

import json
import re
import signal

import numpy as np
import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.cluster import map_reduce
from surfel_mapper.cluster.shards import map_shard
from surfel_mapper.files import pcd
from surfel_mapper.files.parquet import read_map
from surfel_mapper.files.parquet_tiles import read_tiles
from surfel_mapper.mapping.surfel_map import SurfelMap
from test import extras
from test.cluster.bags import written

pytestmark = [pytest.mark.usefixtures('undrawn'), extras.needs('pyarrow', 'distributed')]

MAPS = {'map.ply', 'map.npz', 'map.png'}
FILES = {*MAPS, 'trajectory.tum', 'scans.csv', 'report.html', 'summary.json'}
TF = ['--pose-topic', '/tf']
DONE = (0, 4)  # the bag of faults loses over 5 % of its scans


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags')
    return [str(written(folder, name)[0]) for name in ('plain', 'faults')]


@pytest.fixture(scope='module')
def alone(bags, tmp_path_factory):
    """Return the output directories of each bag by one process."""
    outputs = [tmp_path_factory.mktemp('alone') for _ in bags]
    for bag, output in zip(bags, outputs, strict=True):
        arguments = ['replay', bag, '--formats', 'parquet', '--output', str(output)]
        assert main([*arguments, *TF]) in DONE
    return outputs


@pytest.fixture(scope='module')
def both(alone):
    """Return the digest of the map of both bags."""
    total = SurfelMap(0.5)
    for output in alone:
        total.merge(read_map(output / 'map.parquet'))
    return total.digest()


def summary_of(output):
    return json.loads((output / 'summary.json').read_text())


@pytest.mark.drawn
def test_several_bags_become_one_map(bags, both, alone, tmp_path, capsys):
    assert main(['replay', *bags, '--output', str(tmp_path), *TF]) in DONE

    assert {path.name for path in tmp_path.iterdir()} == FILES
    summary = summary_of(tmp_path)
    assert summary['digest'] == both == SurfelMap.load(tmp_path / 'map.npz').digest()
    assert summary['bags'] == bags
    received = [summary_of(output)['scans']['received'] for output in alone]
    assert summary['scans']['received'] == sum(received)
    printed = capsys.readouterr().out
    assert f'digest {both}' in printed
    assert str(tmp_path / 'report.html') in printed
    page = (tmp_path / 'report.html').read_text(encoding='utf-8')
    view = json.loads(re.search(r'<script [^>]*id="map">(.*?)</script>', page)[1])
    assert len(view['seconds']) == summary['scans']['mapped']  # the trajectory of all scans
    assert 'distance driven' not in page  # which has the way between the bags
    assert 'Voxels over time' not in page  # which no process knows
    assert 'window.max_scans' not in page.partition('<details>')[0]  # a default


@pytest.mark.drawn
def test_ctrl_c_leaves_the_map_of_the_shards_that_are_done(
    bags, alone, tmp_path, monkeypatch, capsys
):
    def pressing(*args):
        signal.raise_signal(signal.SIGINT)
        return map_shard(*args)

    monkeypatch.setattr(map_reduce, 'map_shard', pressing)
    assert main(['replay', *bags, '--output', str(tmp_path), '--json', *TF]) == 130

    assert {path.name for path in tmp_path.iterdir()} == FILES
    summary = json.loads(capsys.readouterr().out)
    assert summary['interrupted']
    assert summary['digest'] == summary_of(alone[0])['digest']
    assert summary['digest'] == SurfelMap.load(tmp_path / 'map.npz').digest()


def test_workers_make_the_map_of_one_process(bags, alone, tmp_path, capsys, caplog):
    arguments = ['replay', bags[0], '--workers', '2', '--output', str(tmp_path), '--json']
    assert main([*arguments, *TF]) in DONE

    summary = json.loads(capsys.readouterr().out)
    assert summary['workers'] == 2
    assert summary['digest'] == summary_of(alone[0])['digest']
    assert summary['surfels'] == summary_of(alone[0])['surfels']
    poses, expected = ((output / 'trajectory.tum').read_text() for output in (tmp_path, alone[0]))
    assert poses == expected

    assert main(['merge', str(alone[0]), str(tmp_path), '--output', str(tmp_path / 'sum')]) == 0
    number = summary['scans']['mapped']
    assert f'{number} of its {number} scans have stamps of scans in {alone[0]}' in caplog.text


def test_merging_finished_maps_is_mapping_them_together(alone, both, tmp_path, capsys):
    maps = [str(output) for output in alone]
    assert main(['merge', *maps, '--output', str(tmp_path / 'sum')]) == 0
    assert f'digest {both}' in capsys.readouterr().out
    assert read_tiles(tmp_path / 'sum' / 'map').digest() == both

    again = [str(tmp_path / 'sum'), str(alone[0] / 'map.parquet')]
    assert main(['merge', *again, '--output', str(tmp_path / 'more'), '--json']) == 0
    total = SurfelMap(0.5)
    for output in (*alone, alone[0]):
        total.merge(read_map(output / 'map.parquet'))
    assert json.loads(capsys.readouterr().out)['digest'] == total.digest()


@pytest.mark.parametrize('place', ['nowhere', 'empty'])
def test_a_directory_without_a_map_is_refused_by_name(tmp_path, capsys, place):
    (tmp_path / 'empty').mkdir()
    assert main(['merge', str(tmp_path / place), '--output', str(tmp_path / 'sum')]) == 1
    assert f'{place}: no map; expected' in capsys.readouterr().err


def test_tiles_poses_and_formats_are_written_where_asked(bags, both, tmp_path):
    poses = tmp_path / 'poses.tum'
    arguments = ['--formats', 'tiles,parquet', '--poses-out', str(poses)]
    assert main(['replay', *bags, '--output', str(tmp_path / 'out'), *arguments, *TF]) in DONE
    assert read_tiles(tmp_path / 'out' / 'map').digest() == both
    assert read_map(tmp_path / 'out' / 'map.parquet').digest() == both
    assert poses.read_text() == (tmp_path / 'out' / 'trajectory.tum').read_text()
    assert not (tmp_path / 'out' / 'map.npz').exists()


@pytest.mark.parametrize('name', ['bag', 'glb'])
def test_formats_of_all_scans_in_order_are_refused(bags, tmp_path, capsys, name):
    assert main(['replay', *bags, '--output', str(tmp_path), *TF, '--formats', name]) == 1
    assert f"'{name}' needs one recording" in capsys.readouterr().err


@pytest.mark.parametrize('option', [['--window'], ['--align'], ['--rrd', 'x'], ['--view']])
def test_options_that_need_one_process_are_refused(bags, tmp_path, capsys, option):
    assert main(['replay', *bags, '--output', str(tmp_path), *TF, *option]) == 2
    assert f'{option[0]}: not with several bags' in capsys.readouterr().err


@pytest.mark.parametrize('number', ['0', '-1', 'two', '1.5'])
def test_an_invalid_number_of_workers_is_refused(bags, number):
    with pytest.raises(SystemExit) as exit_info:
        main(['replay', bags[0], '--workers', number])
    assert exit_info.value.code == 2


def test_a_recording_without_poses_is_refused_among_several(bags, tmp_path, capsys):
    points = np.random.default_rng(1).uniform(-9.0, 9.0, (3, 500)).astype(np.float32)
    scan = tmp_path / 'scan.pcd'
    pcd.write_points(scan, dict(zip('xyz', points, strict=True)))

    assert main(['replay', bags[0], str(scan), '--output', str(tmp_path / 'out')]) == 1

    assert (
        f'{scan}: no poses; several recordings, or workers, need poses' in capsys.readouterr().err
    )
    assert not (tmp_path / 'out').exists()
