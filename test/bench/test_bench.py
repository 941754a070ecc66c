# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks run, on a lidar of 512 points; times are not tested."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surfel_mapper.bags.writer import BagWriter
from surfel_mapper.messages.pointcloud2 import from_columns
from test.bench import __main__ as bench
from test.bench import quality, real, robot
from test.bench.options import Options
from test.models.scenes import sheet
from test.offline.test_depth_folders import tum

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


def test_adaptive_surfels_give_rows_of_scans_and_the_job(options, monkeypatch, tmp_path):
    monkeypatch.delenv('SURFEL_MAPPER_TEST_DATA', raising=False)
    assert [row['every'] for row in bench.run(['adaptive'], options)] == [1, 10]

    folder = tmp_path / 'data' / 'scans'
    folder.mkdir(parents=True)
    points = np.random.default_rng(1).uniform(-4.0, 4.0, (60_000, 5)).astype(np.float32)
    points[:, 2] = 0.06
    points.tofile(folder / 'nuscenes_hdl32_1532402927647951.pcd.bin')
    monkeypatch.setenv('SURFEL_MAPPER_TEST_DATA', str(tmp_path))
    row, *_ = bench.run(['adaptive'], options)
    assert row['surfels'] == 16  # a floor of 8 m in cells of 2 m
    assert row['median_deg'] == pytest.approx(0.0, abs=1e-3)
    assert row['off_%'] == 0.0


def test_the_table_of_the_paper_has_rows_for_frames_of_the_user(options, monkeypatch, tmp_path):
    monkeypatch.delenv('SURFEL_MAPPER_TEST_DATA', raising=False)
    assert bench.run(['paper'], options) == []

    tum(tmp_path / 'fr1_teddy')
    wall = sheet(1.0, 1.0, 0.005, centre=(0.0, 0.0, 2.0)).astype(np.float32)
    cloud = from_columns(dict(zip('xyz', wall.T, strict=True)))
    with BagWriter(tmp_path / 'cow') as writer:
        for stamp_ns in (1, 2, 3):
            writer.write_cloud('/points', stamp_ns, stamp_ns, 'camera', cloud)
    data = tmp_path / 'fr1_teddy', tmp_path / 'cow'
    rows = bench.run(['paper'], replace(options, data=data, frames=2))

    assert [(row['data'], row['voxel_m'], row['models']) for row in rows] == [
        (name, size_m, models)
        for name in ('fr1_teddy', 'cow')
        for size_m in (0.03, 0.04)
        for models in ('paper', 'default', 'gaussians')
    ]
    assert all(row['frames'] == 2 and row['bytes'] > 90 for row in rows)
    for default, alone in (rows[row : row + 2] for row in (4, 7, 10)):
        assert default['planes'] >= 1.0
        assert (alone['planes'], alone['gain']) == (0.0, 1.0)
        ratio = alone['precision_mm'] / default['precision_mm']
        assert default['gain'] == pytest.approx(ratio, abs=1e-3)
        assert ratio > 5.0
    # the grid of the cloud is 5 mm: its points are at most 3.6 mm from any on the plane
    assert rows[7]['precision_mm'] < 6.0


def test_every_bench_is_a_module_that_says_what_it_is():
    for name in bench.BENCHES:
        assert bench.summary(name).endswith('.')


def test_the_command_line_chooses_size_and_benches(tmp_path):
    args = bench.parser().parse_args(['--only', 'real', '--scans', '7', '--cache', str(tmp_path)])
    chosen = bench.options(args)
    assert args.only == ['real']
    assert (chosen.scans, chosen.cache, chosen.peers) == (7, tmp_path, False)
    assert bench.options(bench.parser().parse_args([])) == Options()


def test_a_number_of_scans_that_is_not_positive_is_refused(capsys):
    with pytest.raises(SystemExit) as exit_info:
        bench.main(['--scans', '0'])
    assert exit_info.value.code == 2
    assert '--scans: 0, expected one or more' in capsys.readouterr().err


def test_references_tell_one_plane_from_two_and_from_undetermined_ones():
    rng = np.random.default_rng(3)
    flat = rng.uniform(0.0, 0.5, (200, 3)) * [1.0, 1.0, 0.0] + rng.normal(0.0, 0.005, (200, 3))
    wall = np.roll(flat, 1, axis=1)
    line = np.column_stack([flat[:, 0], rng.normal(0.0, 0.005, (200, 2))])
    fits = [
        quality.fitted(points, rng) for points in (flat, np.concatenate([flat, wall[:90]]), line)
    ]

    for normal, _, _ in fits[:2]:
        assert abs(normal[2]) > 0.999
    assert [(is_one, is_sure) for _, is_one, is_sure in fits] == [
        (True, True),
        (False, True),
        (True, False),
    ]


def test_the_floor_of_the_robot_is_measured_over_dds(options, monkeypatch):
    pytest.importorskip('rclpy', reason='rclpy is not installed: no ROS')
    monkeypatch.setattr(robot, 'FLOORS', robot.FLOORS[:1])
    monkeypatch.setattr(robot, 'CASES', ())
    (row,) = bench.run(['robot'], options)
    assert [row[name] for name in ('case', 'hz', 'clouds')] == ['bare subscriber', '10', 9]
    assert 0.0 < row['p50_ms'] <= row['p99_ms']
