# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The benches of tracking and of drives with loops: scans, verdicts, rows."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from test.bench import long_drive, tracking
from test.bench.options import Options
from test.bench.peers import PeerSpec
from test.bench.peers.run import run_odometry
from test.bench.tracking import total, verdict

STEP_M = 0.3


class Odometry:
    """A peer that moves by STEP_M a scan, and prints as KISS-SLAM does."""

    def __init__(self, voxel_size_m):
        print(f'voxels of {voxel_size_m} m')
        self._poses = []

    def register(self, points):
        print(len(points), 'points')
        pose = np.eye(4)
        pose[0, 3] = STEP_M * len(self._poses)
        self._poses.append(pose)
        return pose


def figures(ours_m, kiss_m, vgicp_m, **counts):
    return {
        'ours_m': ours_m,
        'KISS-ICP_m': kiss_m,
        'small_gicp VGICP_m': vgicp_m,
        **dict.fromkeys(('ambiguous', 'degenerate', 'surrounded'), 0),
        **counts,
    }


@pytest.mark.parametrize(
    ('row', 'expected'),
    [
        (figures(0.010, 0.5, 0.012), 'better than both'),
        (figures(0.010, 0.5, 0.0101), 'as good as the best'),
        (figures(18.8, 18.9, 18.9, degenerate=78), 'as good as the best, reported'),
        (figures(17.7, 15.1, 17.7, surrounded=49), 'within twice the best, reported'),
        (figures(17.7, 15.1, 17.7, surrounded=1), 'within twice the best'),
        (figures(0.3, 0.1, 0.5), 'worse'),
        (figures(0.3, 0.1, 0.5, ambiguous=2), 'worse, reported'),
        (figures(0.3, 0.1, None), ''),
    ],
)
def test_tracking_is_compared_with_the_best_peer(row, expected):
    assert verdict(row) == expected


def test_sequences_in_which_ours_is_better_are_counted():
    rows = [{'ours is': text} for text in ('better than both', 'worse', 'better than both')]
    assert total(rows) == {'sequence': 'all', 'ours is': 'better than both on 2 of 3'}


def test_eleven_sequences_are_tracked():
    assert len(tracking.THINNED) + len(tracking.scenarios()) == 11


def test_progress_that_a_peer_prints_does_not_disturb_its_figures(tmp_path):
    scans = [tmp_path / f'{number}.npy' for number in range(3)]
    for path in scans:
        np.save(path, np.full((4, 3), np.nan, np.float32))
    peer = PeerSpec(name='a peer', module='test.bench.test_drives', requires=())
    times, poses = run_odometry(sys.executable, peer, scans, 1.0)
    assert len(times['cpu_ms']) == 3
    assert poses[:, 0, 3] == pytest.approx([0.0, STEP_M, 2.0 * STEP_M])


def test_the_peak_memory_of_a_peer_is_its_own(tmp_path):
    path = tmp_path / '0.npy'
    np.save(path, np.full((4, 3), np.nan, np.float32))
    peer = PeerSpec(name='a peer', module='test.bench.test_drives', requires=())
    held = np.ones(125_000_000)  # 1 GB
    times, _ = run_odometry(sys.executable, peer, [path], 1.0)
    assert 10.0 < times['peak_mb'] < 0.9 * held.nbytes / 1e6


def test_scans_between_simulated_ones_lie_on_the_surfaces_of_the_world():
    drive = long_drive.simulation()
    assert drive.num_scans == 20_000
    scans = list(long_drive.full_scans(drive, 3))
    for number, scan in enumerate(scans):
        pose = drive.drive.T_odom_sensor(scan.stamp_ns)
        places = scan.points @ pose[:3, :3].T + pose[:3, 3]
        off_m = drive.world.surface_at(places)[1]
        assert np.median(off_m) < long_drive.NOISE_M
        assert np.percentile(off_m, 99) < 3.0 * long_drive.NOISE_M
        assert scan.stamp_ns == drive.stamp_ns(number)
    way_m = np.linalg.norm(scans[0].points[0] - scans[2].points[0])
    assert way_m == pytest.approx(2.0 * long_drive.STEP_M, abs=0.3)


def test_a_long_drive_gives_errors_memory_and_seconds(tmp_path, capfd):
    (row,) = long_drive.run(Options(scans=12, cache=tmp_path))
    assert (row['scans'], row['mapped'], row['loops']) == (12, 12, 0)
    assert row['path_m'] == pytest.approx(11 * long_drive.STEP_M, rel=0.1)
    assert row['error_m'] < 0.01
    assert row['spool_mb'] == pytest.approx(12 * 78_000 * 12e-6, rel=0.02)
    assert row['peak_mb'] > 50.0
    # Linux counts pages by processor, so the peak that it tells later may be some pages lower
    before_end = json.loads(capfd.readouterr().err.splitlines()[-1])
    assert before_end['peak_mb'] <= row['peak_mb'] + 1.0
