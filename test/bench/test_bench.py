# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The benchmarks run, on a lidar of 512 points; times are not tested."""

from __future__ import annotations

import numpy as np
import pytest

from test.bench import __main__ as bench
from test.bench import real
from test.bench.options import Options

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


def test_every_bench_is_a_module_that_says_what_it_is():
    for name in bench.BENCHES:
        assert bench.summary(name).endswith('.')


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
