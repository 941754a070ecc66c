# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks run, on a lidar of 512 points; times are not tested."""

from __future__ import annotations

from dataclasses import replace
import json
import os
import sys

import numpy as np
import pytest

from surfel_mapper.messages.pointcloud2 import to_scan
from test.bench import __main__ as bench
from test.bench import accuracy, compare, decode, filters, real, scaling
from test.bench.machine import one_core
from test.bench.numpy_map import NumpyMap
from test.bench.options import Options
from test.bench.peers import PeerSpec
from test.bench.peers.run import PeerError, run_peer
from test.bench.report import spread, table
from test.bench.street import MovedScan, Street

SCANS, WINDOW = 3, 4


class Peer:
    """A peer for the driver that needs no environment of its own."""

    def __init__(self, voxel_size_m, window):
        self._map = NumpyMap(voxel_size_m, window)

    def step(self, points, T_map_sensor):
        self._map.step(list(points.T), T_map_sensor)

    @property
    def num_voxels(self):
        return len(self._map.state()[0])


@pytest.fixture(scope='module')
def options(tmp_path_factory):
    return Options(
        scans=SCANS,
        window=WINDOW,
        windows=(2, 5),
        map_voxels=(100, 20_000),
        real_windows=(1, 2),
        real_map_voxels=(100, 20_000),
        beams=8,
        columns=64,
        cache=tmp_path_factory.mktemp('cache'),
    )


def test_the_voxel_grid_is_timed_and_others_beside_it(options, monkeypatch):
    monkeypatch.setattr(filters, 'REPEATS', 2)
    points = np.random.default_rng(3).uniform(-5.0, 5.0, (500, 3)).astype(np.float32)

    (row,) = filters.voxel_grids('cube', points, None, options)

    lowest = points.min(axis=0).astype(np.float64)
    occupied = np.unique(np.floor(points / 0.5 - lowest / 0.5), axis=0)
    assert (row['points'], row['left']) == (500, len(occupied))
    assert row['median_ms'] > 0.0

    def missing(spec, points, options):
        raise PeerError(f'no {spec.name} here')

    monkeypatch.setattr(filters, 'peer', missing)
    found = list(filters.voxel_grids('cube', points, None, replace(options, peers=True)))
    assert [row.get('note') for row in found[1:]] == [
        'not measured: no small_gicp here',
        'not measured: no Open3D here',
    ]


def test_the_layouts_of_drivers_are_decoded_and_compared_with_numpy(options, monkeypatch):
    monkeypatch.setattr(decode, 'SIZE', 1 << 16)
    monkeypatch.setattr(decode, 'REPEATS', 2)
    rows = bench.run(['decode'], options)
    assert [row['driver'] for row in rows] == [*decode.LAYOUTS]
    assert all(row['points'] * row['B_point'] <= 1 << 16 for row in rows)


def test_normals_and_outliers_are_timed_beside_those_of_peers(options, monkeypatch):
    points = np.random.default_rng(3).uniform(-5.0, 5.0, (500, 3)).astype(np.float32)
    monkeypatch.setattr(filters, 'run_peer', lambda *_: '{"normals 10": [1.0, 3.0, 2.0]}')
    rows = list(filters.searches('cube', points, replace(options, peers=True)))
    names = ['normals 10', 'small_gicp normals 10', 'Open3D normals 10']
    assert [row['filter'] for row in rows] == [*names, 'normals 30', 'outliers 20']
    assert rows[1]['x_ours'] == pytest.approx(2.0 / rows[0]['median_ms'])


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


@pytest.fixture
def driven(monkeypatch):
    """Replace the real scans by a small one; return the names of the drives."""
    points = np.random.default_rng(2).uniform(-5.0, 5.0, (500, 3)).astype(np.float32)
    scans = [(name, np.asfortranarray(points)) for name in ('another', real.DRIVEN[0])]
    monkeypatch.setattr(real, 'real_scans', lambda: scans)
    return 'simulated street', real.DRIVEN[0]


@pytest.mark.parametrize('name', ['mapping', 'scaling', 'compare'])
def test_every_bench_of_times_gives_rows_of_figures(options, name, driven, capsys):
    rows = bench.run([name], options)

    assert {row['voxel_m'] for row in rows} == {0.5, 0.2}
    for row in rows:
        assert row['bench'] == name
        assert 0.0 < row['p10_ms'] <= row['median_ms'] <= row['p99_ms'] <= row['slowest_ms']
        assert json.loads(json.dumps(row)) == row
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == f'{name}: {bench.summary(name)}'
    assert len(printed) == len(rows) + 4


def test_two_threads_are_compared_with_one_on_the_same_scans(options, driven):
    rows = bench.run(['threads'], options)
    assert [(row['scan'], row['voxel_m'], row['way']) for row in rows] == [
        (scan, size_m, way)
        for scan in driven
        for size_m in (0.5, 0.2)
        for way in ('calls', 'Mapper', 'prepared')
    ]
    for row in rows:
        assert row['turns'] == (options.untimed + SCANS) // SCANS - options.untimed // SCANS
        assert min(row['one_ms'], row['two_ms'], row['ratio']) > 0.0


def test_every_bench_is_a_module_that_says_what_it_is():
    for name in bench.BENCHES:
        assert bench.summary(name).endswith('.')


def test_a_full_map_after_the_last_cloud_does_not_count_for_its_age_under_load():
    pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')
    from test.bench import live

    stamps = [0, 50_000_000, 100_000_000]
    normals = [(30_000_000, 0), (95_000_000, 50_000_000), (530_000_000, 100_000_000)]
    found = live.normals_ages(stamps, normals)
    assert found == {'normals': 3, 'normals_max_ms': 45.0, 'normals_last_ms': 430.0}
    empty = {'normals': 0, 'normals_max_ms': None, 'normals_last_ms': None}
    assert live.normals_ages(stamps, []) == empty


def test_normals_are_compared_with_the_true_ones(options):
    rows = bench.run(['accuracy'], options)
    assert [(row['voxel_m'], row['at']) for row in rows] == [
        (size_m, at) for size_m in (0.5, 0.2) for at in ('surfels', 'points')
    ]
    for row in rows:
        assert 0.0 < row['median_deg'] < row['p95_deg'] <= 90.0


def test_errors_are_angles_between_axes():
    normals = np.array([[0, 0, 1.0], [0, 0, -1], [1, 0, 0], [0, 0.6, 0.8], [np.nan] * 3])
    found = accuracy.errors(normals, np.tile([0.0, 0.0, 1.0], (5, 1)))
    assert (found['num'], found['unknown']) == (4, 1)
    assert found['mean_deg'] == pytest.approx((90.0 + np.degrees(np.arctan(0.75))) / 4)


def test_the_stages_of_mapping_are_all_there(options, driven):
    rows = bench.run(['mapping'], options)
    stages = [
        *(('calls', s) for s in ('decode', 'reduce', 'insert', 'evict', 'normals', 'total')),
        *(('Mapper', s) for s in ('decode', 'reduce', 'insert', 'normals', 'total')),
    ]
    found = [(row['scan'], row['way'], row['stage']) for row in rows if row['voxel_m'] == 0.5]
    assert found == [(scan, *stage) for scan in driven for stage in stages]
    street, moved = (row for row in rows if 'B_voxel' in row and row['voxel_m'] == 0.5)
    assert min(street['B_voxel'], moved['B_voxel']) > 128.0  # a row, and its share of the table
    assert moved['B_scan_voxel'] == 82.0  # moments of 78 bytes, and a row


def test_a_moved_scan_is_the_same_at_every_pose(options):
    points = np.random.default_rng(4).uniform(-5.0, 5.0, (77, 3)).astype(np.float32)
    moved = MovedScan(options, points)
    moved.prepare(3)
    np.testing.assert_array_equal(np.load(moved.path(2)), points)
    np.testing.assert_array_equal(to_scan(moved.message(1)).points, points)
    assert moved.options.num_points == 77
    np.testing.assert_array_equal(moved.pose(2), Street(options).pose(2))


def test_the_windows_and_maps_compared_are_as_long_and_large_as_asked(options, monkeypatch):
    monkeypatch.delenv('SURFEL_MAPPER_TEST_DATA', raising=False)
    rows = [row for row in bench.run(['scaling'], options) if row['voxel_m'] == 0.5]
    assert [row['window'] for row in rows] == [2, 5, WINDOW, WINDOW]
    small, large = (row['voxels'] for row in rows if row['varied'] == 'map')
    assert large - small == 20_000 - 100


def test_windows_and_maps_of_a_real_scan_are_compared(options, monkeypatch):
    points = np.random.default_rng(3).uniform(-5.0, 5.0, (500, 3)).astype(np.float32)
    scans = [('another', points[:9]), (scaling.REAL, np.asfortranarray(points))]
    monkeypatch.setattr(scaling, 'real_scans', lambda: scans)
    rows = scaling.real_rows(options, 0.5)
    assert [row['window'] for row in rows] == [1, 2, scaling.REAL_WINDOW, scaling.REAL_WINDOW]
    assert rows[3]['voxels'] - rows[2]['voxels'] == 20_000 - 100
    assert rows[0]['ratio'] == rows[2]['ratio'] == 1.0


def test_scans_are_simulated_once_and_kept(options):
    street = Street(options)
    first = street.points(0)
    written_ns = street.path(0).stat().st_mtime_ns

    again = Street(options)
    np.testing.assert_array_equal(again.points(0), first)
    assert again.path(0).stat().st_mtime_ns == written_ns
    assert first.shape == (512, 3)
    assert np.isfinite(first).all(axis=1).mean() > 0.5


def test_a_peer_is_given_the_same_scans_in_a_process_of_its_own(options):
    street = Street(options)
    street.prepare(options.untimed + SCANS)
    expected = Peer(0.5, WINDOW)
    for number in range(options.untimed + SCANS):
        expected.step(street.points(number), street.pose(number))

    peer = PeerSpec(name='numpy', module='test.bench.test_bench', requires=())
    milliseconds, num_voxels = run_peer(sys.executable, peer, options, street, 0.5)

    assert len(milliseconds) == SCANS
    assert num_voxels == expected.num_voxels > 0


def test_a_peer_may_fill_its_window_without_a_result(options, tmp_path, monkeypatch):
    module = """class Peer:
    def __init__(self, voxel_size_m, window):
        self.calls = []
    def fill(self, points, T_map_sensor):
        self.calls.append('f')
    def step(self, points, T_map_sensor):
        self.calls.append('s')
    @property
    def num_voxels(self):
        return ''.join(self.calls)
"""
    (tmp_path / 'filled.py').write_text(module, encoding='utf-8')
    monkeypatch.setenv('PYTHONPATH', str(tmp_path))
    street = Street(options)
    street.prepare(options.untimed + SCANS)

    peer = PeerSpec(name='filled', module='filled', requires=())
    milliseconds, calls = run_peer(sys.executable, peer, options, street, 0.5)

    assert len(milliseconds) == SCANS
    assert calls == 'f' * (options.untimed - 1) + 's' * (1 + SCANS)


def test_a_peer_that_fails_says_why(options):
    street = Street(options)
    street.prepare(options.untimed + SCANS)
    peer = PeerSpec(name='absent', module='test.bench.peers.absent', requires=())
    with pytest.raises(PeerError, match=r'^ModuleNotFoundError: .*absent'):
        run_peer(sys.executable, peer, options, street, 0.5)


@pytest.mark.skipif(not hasattr(os, 'sched_getaffinity'), reason='the system cannot pin')
def test_one_core_is_one_core_and_no_longer_than_asked():
    before = os.sched_getaffinity(0)
    with one_core():
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


def test_the_command_line_chooses_size_and_benches(tmp_path):
    args = bench.parser().parse_args(
        ['--only', 'scaling', '--quick', '--scans', '7', '--cache', str(tmp_path)]
    )
    chosen = bench.options(args)
    assert args.only == ['scaling']
    assert (chosen.scans, chosen.cache, chosen.peers) == (7, tmp_path, False)
    assert chosen.window < Options().window
    assert bench.options(bench.parser().parse_args([])) == Options()


def test_a_number_of_scans_that_is_not_positive_is_refused(capsys):
    with pytest.raises(SystemExit) as exit_info:
        bench.main(['--scans', '0'])
    assert exit_info.value.code == 2
    assert '--scans: 0, expected one or more' in capsys.readouterr().err


def test_ratios_that_fell_since_an_earlier_run_are_printed(options, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(bench, 'options', lambda _: options)
    monkeypatch.setattr(compare, 'run', lambda _: [dict(row) for row in rows])
    rows = [
        {'voxel_m': 0.5, 'who': 'numpy', 'x_ours': 10.0, 'less': None},
        {'voxel_m': 0.2, 'who': 'numpy', 'x_ours': 12.0, 'less': None},
        {'voxel_m': 0.2, 'who': 'Open3D', 'x_ours': 3.0, 'less': 'no normals'},
    ]
    assert bench.main(['--only', 'compare']) == 0
    earlier = tmp_path / 'earlier.txt'
    earlier.write_text(capsys.readouterr().out)
    rows[0]['x_ours'] = 8.6  # a fall of 14 %
    rows[1]['x_ours'] = 10.1  # of 16 %
    del rows[2]

    assert bench.main(['--only', 'compare', '--since', str(earlier)]) == 0

    printed = capsys.readouterr().out.splitlines()
    assert printed[-3] == f'ratios that fell by more than 15 % since {earlier}:'
    assert printed[-2].split(': ') == [
        f'compare numpy voxel_m 0.2 window {WINDOW} x_ours',
        '12 before, 10.1 now',
    ]
    assert printed[-1].startswith('compare Open3D voxel_m 0.2')
    assert printed[-1].endswith(': 3 before, not measured now')


def test_an_earlier_run_without_ratios_of_the_benches_is_refused(tmp_path, capsys):
    earlier = tmp_path / 'earlier.txt'
    earlier.write_text('a table\n{"bench": "real", "x_numpy": 2.0}\n')
    with pytest.raises(SystemExit) as exit_info:
        bench.main(['--only', 'compare', '--since', str(earlier)])
    assert exit_info.value.code == 2
    assert f'--since: {earlier}: no ratio of compare' in capsys.readouterr().err


def test_spread_is_of_the_times_given():
    figures = spread([float(value) for value in range(101)])
    assert figures == {'median_ms': 50.0, 'p10_ms': 10.0, 'p99_ms': 99.0, 'slowest_ms': 100.0}


def test_a_table_is_aligned_and_leaves_missing_values_empty():
    rows = [{'who': 'a', 'ms': 0.12345}, {'who': 'bcd', 'less': 'no normals'}]
    assert table(rows) == 'who     ms  less\na    0.123\nbcd         no normals'
