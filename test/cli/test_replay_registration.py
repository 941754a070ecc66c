# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper replay`` of bags without odometry, and on a map that is frozen."""

import json
import re

import numpy as np
import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.evaluation.trajectory_errors import compare
from surfel_mapper.files.map_state import load_map, save_map
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.mapping.surfel_map import SurfelMap
from test.bags.recorded import Entries, PERIOD_NS, START_NS, write_rosbag2
from test.pipeline.test_registered_poses import in_hall, scan_at

pytestmark = pytest.mark.usefixtures('undrawn')

NUM_SCANS = 5
REGISTRATION = 'pose: {source: registration}\nregistration: {noise_m: 0.005}\n'


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    entries = Entries()
    for number in range(NUM_SCANS):
        points = scan_at(number).points
        entries.cloud('/points', START_NS + number * PERIOD_NS, points)
    return write_rosbag2(tmp_path_factory.mktemp('bags') / 'room', entries)


def settings_file(tmp_path, text):
    path = tmp_path / 'settings.yaml'
    path.write_text(text)
    return str(path)


def poses_in(path):
    found = read_trajectory(path)
    poses = [pose_matrix(*pose) for pose in zip(found.xyz, found.q_xyzw, strict=True)]
    return found.stamp_ns, np.array(poses)


def test_a_map_of_another_voxel_size_is_refused(bag, tmp_path, capsys):
    save_map(tmp_path / 'other.npz', SurfelMap(0.3))
    text = f'{REGISTRATION}map: {{load: {tmp_path / "other.npz"}}}\n'
    arguments = ['--config', settings_file(tmp_path, text), '--output', str(tmp_path / 'out')]

    assert main(['replay', str(bag), *arguments]) == 1

    assert 'voxel size 0.3 m, expected map.voxel_size_m = 0.5 m' in capsys.readouterr().err


@pytest.fixture(scope='module')
def recorded(request, data_folder, tmp_path_factory):
    """Return a bag of real scans, the number of its scans, and its recorded poses."""
    name, total = request.param
    bag, folder = data_folder / 'data' / 'bags' / name, tmp_path_factory.mktemp(name)
    poses = folder / 'recorded.tum'
    replay = ['replay', str(bag), '--output', str(folder / 'out'), '--poses-out', str(poses)]
    assert main(replay) == 0
    return bag, total, poses_in(poses)


FULL, LONG = ('hall_os0_full', 22), ('hall_os0_long', 118)


@pytest.mark.parametrize(
    ('recorded', 'every'),
    [(FULL, 1), (LONG, 3)],
    indirect=['recorded'],
    ids=str,
)
def test_real_scans_of_a_hand_that_turns_fast_are_followed(recorded, tmp_path, every):
    # up to 48 deg and 0.8 m between two scans, 90 deg in every third, and no times of points
    bag, total, expected = recorded
    found = tmp_path / 'found.tum'
    settings = settings_file(tmp_path, 'pose: {source: registration}\n')

    replay = ['replay', str(bag), '--every', str(every), '--config', settings]
    assert main([*replay, '--output', str(tmp_path / 'out'), '--poses-out', str(found)]) == 0

    errors = compare(*poses_in(found), *expected)
    assert errors['num_poses'] == -(-total // every)
    # the recorded odometry drifts itself: at all voxel sizes the difference is the same
    assert errors['relative']['translation_m']['max'] < 0.03
    assert errors['relative']['rotation_deg']['max'] < 0.5
    assert errors['absolute']['translation_m']['max'] < 0.1


def test_a_folder_of_real_scans_as_others_write_it_is_registered(data_folder, tmp_path):
    folder = data_folder / 'data' / 'folders' / 'kitti_city'  # PCD of PCL, without stamps
    assert main(['replay', str(folder), '--output', str(tmp_path)]) == 0
    positions = poses_in(tmp_path / 'trajectory.tum')[1][:, :3, 3]
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert len(positions) == 22
    assert steps_m.min() > 0.7  # a car at 7 to 8 m/s, 10 scans a second
    assert steps_m.max() < 0.9
    assert np.abs(np.diff(steps_m)).max() < 0.05


@pytest.mark.drawn
def test_scans_without_a_certain_place_become_a_map_of_their_own(tmp_path, capsys):
    entries = Entries()
    scans = [scan_at(number) for number in range(4)]
    scans += [in_hall(4 + n, pose_matrix((0.1 * n, 0, 0), (0, 0, 0, 1))) for n in range(4)]
    for number, scan in enumerate(scans):
        entries.cloud('/points', START_NS + number * PERIOD_NS, scan.points)
    bag, output = write_rosbag2(tmp_path / 'two', entries), tmp_path / 'out'
    arguments = ['--config', settings_file(tmp_path, REGISTRATION), '--output', str(output)]

    assert main(['replay', str(bag), *arguments]) == 4

    said = capsys.readouterr()
    assert '4 of 8 scans have no certain place on the map' in said.err
    assert '4 of 8 scans have no certain place on the map' in said.out
    assert re.search(r'registration: \d of 8 scans had no certain place on the map', said.out)
    assert 'apart_1: 4 scans' in (output / 'report.html').read_text()
    summary = json.loads((output / 'summary.json').read_text())
    assert summary['scans']['dropped'] == {'apart': 4}
    states = summary['registration']['tracking']
    assert states['lost']['scans'] + states['unconfirmed']['scans'] == 4
    found = load_map(output / 'apart_1.npz')[0]
    assert found.num_points == sum(len(scan.points) for scan in scans[4:])
    stamps, poses = poses_in(output / 'apart_1.tum')
    assert len(stamps) == 4
    np.testing.assert_allclose(poses[3][:3, 3], [0.3, 0.0, 0.0], atol=0.01)
