# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""VIEWPOINT of PCD files is the pose of each scan, or the place that normals are turned to."""

import json

import numpy as np
import pytest

from surfel_mapper import Config
from surfel_mapper.cli.main import main
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.trajectory import Trajectory
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.request import Request

PLACES = [(0.3 * k, -0.1 * k, 0.0, 0.0, 0.0, np.sin(0.05 * k), np.cos(0.05 * k)) for k in range(3)]


def wall(number=2000):
    """Return points on the planes x = 5 and y = -4, in the frame of the room."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-5.0, 5.0, (2, number))
    z = rng.uniform(-1.0, 1.0, number)
    half = number // 2
    return np.column_stack([np.where(np.arange(number) < half, 5.0, x), y, z]) * [1.0, 1.0, 1.0]


def write(path, points, place):
    x, y, z, qx, qy, qz, qw = place
    columns = dict(zip('xyz', points.T.astype('f4'), strict=True))
    pcd.write_points(path, columns, (x, y, z, qw, qx, qy, qz))


@pytest.fixture
def scans(tmp_path):
    """Return a folder of three scans whose viewpoints differ."""
    folder = tmp_path / 'scans'
    folder.mkdir()
    for number, place in enumerate(PLACES):
        T = pose_matrix(place[:3], place[3:])
        write(folder / f'{number}.pcd', (wall() - T[:3, 3]) @ T[:3, :3], place)
    return folder


def replayed(path, output, *options):
    assert main(['replay', str(path), '-o', str(output), '--formats', 'ply', *options]) in (0, 4)
    return json.loads((output / 'summary.json').read_text())


def test_viewpoints_that_differ_are_the_poses(scans, tmp_path, capsys):
    summary = replayed(scans, tmp_path / 'out')

    assert 'VIEWPOINT of the PCD files differs and is the pose' in capsys.readouterr().out
    table = np.array(PLACES)
    stamps = [0, 10**8, 2 * 10**8]
    Trajectory(stamps, table[:, :3], table[:, 3:]).save(tmp_path / 'poses.tum')
    by_file = replayed(scans, tmp_path / 'by_file', '--poses', str(tmp_path / 'poses.tum'))
    assert summary['digest'] == by_file['digest']
    assert summary['scans']['mapped'] == 3


def test_viewpoints_are_named_if_settings_of_frames_keep_them_from_use(scans):
    config = Config.from_mapping({'frames.base': 'robot'})

    with open_recording(Request(path=scans), config) as recording:
        described = recording.describe()

    assert described['poses_from'] == 'registration'
    assert 'VIEWPOINT of the PCD files differs, but pose.source' in described['poses_reason']


@pytest.mark.parametrize('options', [(), ('--poses-from', 'identity')])
def test_normals_of_one_scan_are_turned_to_its_viewpoint(tmp_path, capsys, options):
    write(tmp_path / 'a.pcd', wall(), (20.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))  # behind the wall

    replayed(tmp_path / 'a.pcd', tmp_path / 'out', *options)

    assert 'VIEWPOINT is the place of the sensor' in capsys.readouterr().out
    surfels = ply.read_points(tmp_path / 'out' / 'map.ply')
    on_wall = surfels['x'] > 4.99
    assert surfels['nx'][on_wall].min() > 0.9
    assert surfels['x'].max() == pytest.approx(5.0)


def test_filter_keeps_the_viewpoint(tmp_path):
    place = (20.0, 0.5, -1.0, 0.0, 0.0, 0.6, 0.8)
    write(tmp_path / 'a.pcd', wall(), place)
    (tmp_path / 'chain.yaml').write_text('- identity\n')

    command = ['filter', str(tmp_path / 'chain.yaml'), str(tmp_path / 'a.pcd'), '-o']
    assert main([*command, str(tmp_path / 'b.pcd')]) == 0

    assert pcd.read_viewpoint(tmp_path / 'b.pcd') == (*place[:3], 0.8, 0.0, 0.0, 0.6)
