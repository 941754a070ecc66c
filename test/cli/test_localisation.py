# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper replay`` on a cloud as a frozen map, from an initial pose that is unknown."""

import json

import numpy as np
import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.geometry import pose_matrix
from test.alignment.test_registration import points_on, ROOM
from test.bags.recorded import Entries, PERIOD_NS, START_NS, write_rosbag2
from test.pipeline.test_registered_poses import in_hall, pose_at, scan_at

pytestmark = pytest.mark.usefixtures('undrawn')

NUM_SCANS = 6


def localised(bag, cloud, tmp_path, *more):
    """Replay a bag on a frozen map; return the exit code, the summary and the poses."""
    settings = ('pose.source=registration', 'map.mode=frozen', f'map.load={cloud}', *more)
    arguments = [word for setting in settings for word in ('--set', setting)]
    code = main(['replay', str(bag), '--output', str(tmp_path / 'out'), *arguments])
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    if not summary['scans'].get('localised'):
        return code, summary, []
    trajectory = read_trajectory(tmp_path / 'out' / 'trajectory.tum')
    rows = zip(trajectory.xyz, trajectory.q_xyzw, strict=True)
    return code, summary, [pose_matrix(*row) for row in rows]


def bag_of(scans, path):
    entries = Entries()
    for number, scan in enumerate(scans):
        entries.cloud('/points', START_NS + number * PERIOD_NS, scan.points)
    return write_rosbag2(path, entries)


def columns_of(points):
    return dict(zip('xyz', points.astype(np.float32).T, strict=True))


@pytest.mark.parametrize(('name', 'write'), [('room.ply', ply), ('room.pcd', pcd)])
def test_scans_are_localised_on_a_cloud_of_points(tmp_path, name, write):
    write.write_points(tmp_path / name, columns_of(points_on(ROOM, 100, seed=50)))
    bag = bag_of([scan_at(number) for number in range(NUM_SCANS)], tmp_path / 'bag')

    code, summary, poses = localised(bag, tmp_path / name, tmp_path, 'registration.noise_m=0.005')

    assert (code, summary['scans']['localised'], summary['scans']['mapped']) == (0, NUM_SCANS, 0)
    for number, pose in enumerate(poses):
        np.testing.assert_allclose(pose, pose_at(number), atol=3e-3)


@pytest.mark.parametrize('number', [6, 2])
def test_scans_of_another_place_end_with_4_and_are_named(tmp_path, capsys, number):
    ply.write_points(tmp_path / 'room.ply', columns_of(points_on(ROOM, 100, seed=50)))
    poses = [pose_matrix((0.1 * n, 0, 0), (0, 0, 0, 1)) for n in range(number)]
    bag = bag_of([in_hall(n, pose) for n, pose in enumerate(poses)], tmp_path / 'bag')

    code, _, poses = localised(bag, tmp_path / 'room.ply', tmp_path)

    assert (code, poses) == (4, [])
    cause = 'apart' if number == 6 else 'not aligned'
    said = capsys.readouterr().err
    assert f'only 0 of {number} scans are in the map: {cause} {number}' in said
    if number == 6:
        first_s, last_s = START_NS / 1e9, (START_NS + 5 * PERIOD_NS) / 1e9
        assert f'apart_1 (6 scans from {first_s:.3f} to {last_s:.3f} s: its initial pose' in said


def test_a_cloud_that_does_not_exist_is_refused(tmp_path, capsys):
    bag = bag_of([scan_at(0)], tmp_path / 'bag')
    arguments = ['--set', 'map.load=nowhere.ply', '--set', 'map.mode=frozen']
    arguments += ['--set', 'pose.source=registration']

    assert main(['replay', str(bag), '--output', str(tmp_path / 'out'), *arguments]) == 1

    assert 'nowhere.ply: cannot be read: No such file' in capsys.readouterr().err


def test_real_scans_are_localised_on_the_surfels_of_the_first_half(data_folder, tmp_path):
    bag = data_folder / 'data' / 'bags' / 'hall_os0_long'
    first, whole = tmp_path / 'first', tmp_path / 'whole'
    for output, more in ((first, ['--duration', '29']), (whole, [])):
        assert main(['replay', str(bag), '--output', str(output), *more]) == 0
    recorded = read_trajectory(whole / 'trajectory.tum')

    code, summary, poses = localised(bag, first / 'map.ply', tmp_path)

    assert (code, summary['scans']['localised'], len(poses)) == (0, 118, 118)
    off_m = np.linalg.norm([pose[:3, 3] for pose in poses] - recorded.xyz, axis=1)
    assert np.median(off_m) < 0.05
    assert off_m.max() < 0.13  # the recorded odometry of the second half has drifted by 0.1 m
