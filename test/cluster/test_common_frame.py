# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings without poses are registered alone and mapped in the frame of the first."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.cluster.replay import replay_bags
from surfel_mapper.config import Config
from surfel_mapper.files import pcd
from surfel_mapper.files.map_state import load_map
from surfel_mapper.files.trajectory import Trajectory
from surfel_mapper.geometry import inverse, rotation_angle
from surfel_mapper.offline.request import Request
from surfel_mapper.simulation import Drive, Lidar, Simulation, World
from test import extras

pytestmark = [pytest.mark.usefixtures('undrawn'), extras.needs('pyarrow', 'distributed')]

LIDAR = Lidar(beams=32, columns=256, range_noise_m=0.01)
NUM_SCANS = 12


@pytest.fixture(scope='module')
def world():
    return World.street(seed=3)


def recorded(folder, world, first, heading=1.0):
    """Write scans of a drive from a number on; return the true poses of the sensor."""
    folder.mkdir(parents=True)
    simulation = Simulation(world, LIDAR, Drive(start=world.start), num_scans=60)
    found = []
    for number in range(first, first + NUM_SCANS):
        scan = simulation.scan(number)
        points = scan.points[np.isfinite(scan.points).all(axis=1)].astype(np.float32)
        points[:, :2] *= heading  # -1: a lidar that is mounted backwards
        pcd.write_points(folder / f'{number:06}.pcd', dict(zip('xyz', points.T, strict=True)))
        pose = simulation.drive.T_odom_sensor(simulation.stamp_ns(number))
        found.append(pose @ np.diag([heading, heading, 1.0, 1.0]))
    return np.array(found)


class Placed(NamedTuple):
    """Two recordings, a and b, that were replayed together in two processes."""

    folder: Path
    output: Path
    true: list
    """True poses of the sensor in each."""

    summary: dict


@pytest.fixture(scope='module')
def placed(tmp_path_factory, world):
    folder = tmp_path_factory.mktemp('placed')
    true = [recorded(folder / name, world, at) for name, at in (('a', 0), ('b', 3))]
    requests = [Request(path=folder / name) for name in 'ab']
    found = replay_bags(requests, Config(), folder / 'out', workers=2)
    return Placed(folder, folder / 'out', true, found.summary)


def test_two_recordings_are_mapped_in_the_frame_of_the_first(placed):
    _, output, true, _ = placed
    summary = json.loads((output / 'summary.json').read_text())
    assert summary['scans']['mapped'] == 2 * NUM_SCANS
    assert summary['registration']['apart'] == []
    for number, poses in enumerate(true, start=1):
        found = Trajectory.load(output / f'registered_{number}' / 'poses.tum')
        # at 10 Hz; the last one is beyond the last scan, and a scan may have no certain place
        rows = found.stamp_ns[:-1] // 10**8
        assert len(rows) >= NUM_SCANS - 1
        for mine, right in zip(found.matrices[:-1], poses[rows], strict=True):
            off = inverse(mine) @ inverse(true[0][0]) @ right
            assert np.linalg.norm(off[:3, 3]) < 0.05
            assert rotation_angle(off) < 0.01


def test_the_map_is_that_of_the_recordings_at_these_poses(placed, tmp_path):
    expected = None
    for number, name in enumerate('ab', start=1):
        poses = placed.output / f'registered_{number}' / 'poses.tum'
        command = ['replay', str(placed.folder / name), '--poses', str(poses)]
        assert main([*command, '--output', str(tmp_path / f'out_{name}')]) == 0
        surfel_map = load_map(tmp_path / f'out_{name}')[0]
        if expected is None:
            expected = surfel_map
        else:
            expected.merge(surfel_map)
    assert placed.summary['digest'] == expected.digest()


@extras.needs('kiss_matcher')
def test_a_recording_that_begins_with_another_heading_is_placed(tmp_path, world):
    recorded(tmp_path / 'a', world, 0)
    true = recorded(tmp_path / 'b', world, 4, heading=-1.0)
    first = recorded(tmp_path / 'again', world, 0)[0]
    requests = [Request(path=tmp_path / name) for name in 'ab']

    found = replay_bags(requests, Config(), tmp_path / 'out')

    motion = found.summary['registration']['recordings'][1]['motion']
    off = np.array(motion['T_truth_map']) @ inverse(inverse(first) @ true[0])
    assert motion['start'] == 'features'
    assert np.linalg.norm(off[:3, 3]) < 0.1
    assert rotation_angle(off) < 0.01


def test_a_recording_of_another_place_stays_apart(tmp_path, world, capsys):
    recorded(tmp_path / 'a', world, 0)
    recorded(tmp_path / 'b', World.street(seed=9), 40)
    output = tmp_path / 'out'

    assert main(['replay', str(tmp_path / 'a'), str(tmp_path / 'b'), '--output', str(output)]) == 4

    printed = capsys.readouterr()
    assert '2 recordings without poses' in printed.out
    assert 'registered_2 (12 scans' in printed.err
    summary = json.loads((output / 'summary.json').read_text())
    assert summary['scans']['received'] == 2 * NUM_SCANS
    assert summary['scans']['mapped'] == summary['scans']['dropped']['apart'] == NUM_SCANS
    (part,) = summary['registration']['apart']
    assert (part['map'], part['first_s']) == ('registered_2', 0.0)
    assert part['last_s'] == pytest.approx(0.1 * (NUM_SCANS - 1))
    assert load_map(output / 'registered_2')[0].num_voxels


def test_poses_of_some_recordings_alone_are_refused(tmp_path, world, capsys):
    from test.bags.recorded import drive, write_rosbag2

    recorded(tmp_path / 'a', world, 0)
    bag = write_rosbag2(tmp_path / 'drive', drive())

    assert main(['replay', str(tmp_path / 'a'), str(bag), '--output', str(tmp_path / 'out')]) == 1

    assert 'has no poses, but' in capsys.readouterr().err
