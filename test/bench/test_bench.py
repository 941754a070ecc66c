# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks run, on a lidar of 512 points; times are not tested."""

from __future__ import annotations

from dataclasses import replace
import os
import sys

import numpy as np
import pytest

from test.bench import __main__ as bench
from test.bench import filters, real
from test.bench.machine import one_core
from test.bench.options import Options
from test.bench.peers import PeerSpec
from test.bench.peers.run import PeerError, run_odometry
from test.bench.street import Street

SCANS, WINDOW = 3, 4


@pytest.fixture(scope='module')
def options(tmp_path_factory):
    return Options(
        scans=SCANS,
        window=WINDOW,
        beams=8,
        columns=64,
        cache=tmp_path_factory.mktemp('cache'),
    )


def test_the_voxel_grid_is_timed_and_others_beside_it(options, monkeypatch):
    points = np.random.default_rng(3).uniform(-5.0, 5.0, (500, 3)).astype(np.float32)

    (row,) = filters.voxel_grids('cube', points, options)

    lowest = points.min(axis=0).astype(np.float64)
    occupied = np.unique(np.floor(points / 0.5 - lowest / 0.5), axis=0)
    assert (row['points'], row['left']) == (500, len(occupied))
    assert row['median_ms'] > 0.0

    def missing(spec, points, options):
        raise PeerError(f'no {spec.name} here')

    monkeypatch.setattr(filters, 'peer', missing)
    found = list(filters.voxel_grids('cube', points, replace(options, peers=True)))
    assert [row.get('note') for row in found[1:]] == [
        'not measured: no small_gicp here',
        'not measured: no Open3D here',
    ]


def test_real_scans_give_rows_with_the_ratio_to_numpy(options, monkeypatch, tmp_path):
    monkeypatch.delenv('SURFEL_MAPPER_TEST_DATA', raising=False)
    street = ['simulated street', 'simulated street']
    assert [row['scan'] for row in bench.run(['real'], options)] == street

    name, file = list(real.SCANS.items())[-1]
    folder = tmp_path / 'data' / 'scans'
    folder.mkdir(parents=True)
    points = np.random.default_rng(1).uniform(-5.0, 5.0, (300, 5)).astype(np.float32)
    points[::9, :3] = 0.0
    points[::7, 1] = np.nan
    points.tofile(folder / file)
    monkeypatch.setenv('SURFEL_MAPPER_TEST_DATA', str(tmp_path))
    rows = bench.run(['real'], options)

    assert [(row['scan'], row['voxel_m']) for row in rows] == [
        (scan, size_m)
        for size_m in (0.5, 0.2)
        for scan in (name, 'geometric mean', 'simulated street')
    ]
    assert rows[0]['points'] == (np.isfinite(points).all(1) & points[:, :3].any(1)).sum()
    assert all(row['x_numpy'] > 0.0 and row['first_x'] > 0.0 for row in rows)


def test_every_bench_is_a_module_that_says_what_it_is():
    for name in bench.BENCHES:
        assert bench.summary(name).endswith('.')


def test_scans_are_simulated_once_and_kept(options):
    street = Street(options)
    first = street.points(0)
    written_ns = street.path(0).stat().st_mtime_ns

    again = Street(options)
    np.testing.assert_array_equal(again.points(0), first)
    assert again.path(0).stat().st_mtime_ns == written_ns
    assert first.shape == (512, 3)
    assert np.isfinite(first).all(axis=1).mean() > 0.5


def test_a_peer_that_fails_says_why():
    peer = PeerSpec(name='absent', module='test.bench.peers.absent', requires=())
    with pytest.raises(PeerError, match=r'^ModuleNotFoundError: .*absent'):
        run_odometry(sys.executable, peer, [], 0.5)


@pytest.mark.skipif(not hasattr(os, 'sched_getaffinity'), reason='the system cannot pin')
def test_one_core_is_one_core_and_no_longer_than_asked():
    before = os.sched_getaffinity(0)
    with one_core():
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


def test_the_command_line_chooses_size_and_benches(tmp_path):
    args = bench.parser().parse_args(
        ['--only', 'real', '--quick', '--scans', '7', '--cache', str(tmp_path)]
    )
    chosen = bench.options(args)
    assert args.only == ['real']
    assert (chosen.scans, chosen.cache, chosen.peers) == (7, tmp_path, False)
    assert chosen.window < Options().window
    assert bench.options(bench.parser().parse_args([])) == Options()


def test_a_number_of_scans_that_is_not_positive_is_refused(capsys):
    with pytest.raises(SystemExit) as exit_info:
        bench.main(['--scans', '0'])
    assert exit_info.value.code == 2
    assert '--scans: 0, expected one or more' in capsys.readouterr().err
