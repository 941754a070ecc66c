# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""An offset between the clocks of scans and poses is measured from the motion, or not at all."""

from dataclasses import replace
import json

import numpy as np
import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.files.trajectory import Trajectory
from surfel_mapper.geometry import compose, inverse, pose_matrix, q_xyzw, se3_exp
from surfel_mapper.offline.motion_clock import PosedMotions
from surfel_mapper.simulation import Drive, Lidar, record, Simulation, World

pytestmark = pytest.mark.usefixtures('undrawn')

S = 10**9
START_NS = 1_700_000_000 * S
NUM_SCANS = 150
SPEED_M_S = 4.0
LEVEL = (0.0, 0.0, 0.0, 1.0)
LIDAR = Lidar(beams=16, columns=360, rate_hz=2.0, range_noise_m=0.01)


def street():
    return World.street(seed=3, length_m=400.0)


def straight(world, stamp_ns):
    """Return the pose of a lidar that moves straight on at constant speed."""
    way_m = SPEED_M_S * (stamp_ns - START_NS) / S
    return compose(world.T_world_start, pose_matrix((way_m, 0.0, 2.0), LEVEL))


def write_drive(folder, course):
    """Write scans named by their times, and poses at 10 Hz as a file beside the folder."""
    world = street()
    (folder / 'scans').mkdir()
    stamps_ns = START_NS + np.arange(-50, 5 * NUM_SCANS + 50) * S // 10
    poses = np.array([course(world, stamp_ns) for stamp_ns in stamps_ns.tolist()])
    Trajectory.from_matrices(poses, stamps_ns).save(folder / 'poses.tum')
    for number in range(NUM_SCANS):
        seconds, tenths = divmod(5 * number, 10)
        stamp_ns = START_NS + seconds * S + tenths * S // 10
        scan = LIDAR.scan(world, course(world, stamp_ns), stamp_ns=stamp_ns, number=number)
        np.save(folder / 'scans' / f'{stamp_ns // S}.{tenths}00000.npy', scan.points)
    return folder


@pytest.fixture(scope='module')
def weaving(tmp_path_factory):
    """Return the folder of a drive with curves."""
    drive = Drive(start=street().start, speed_m_s=SPEED_M_S, start_ns=START_NS)
    folder = tmp_path_factory.mktemp('weaving')
    return write_drive(folder, lambda world, stamp_ns: drive.T_odom_sensor(stamp_ns))


def replayed(folder, output, seconds, *arguments):
    """Replay a drive with scans that are seconds ahead of poses; return exit code and summary."""
    poses = Trajectory.load(folder / 'poses.tum')
    shifted = output.parent / 'shifted.tum'
    stamps_ns = poses.stamp_ns - round(seconds * S)
    Trajectory.from_matrices(poses.matrices, stamps_ns).save(shifted)
    run = ['replay', str(folder / 'scans'), '--poses', str(shifted), '-o', str(output)]
    code = main([*run, '--overwrite', *arguments])
    return code, json.loads((output / 'summary.json').read_text())


@pytest.mark.parametrize('seconds', [0.2, -0.2, 1.0, 37.0])
def test_an_offset_is_named_and_the_option_that_corrects_it_gives_the_right_map(
    weaving, tmp_path, capsys, seconds
):
    _, right = replayed(weaving, tmp_path / 'right', 0.0)
    code, summary = replayed(weaving, tmp_path / 'out', seconds)
    (offset,) = summary['clock_offsets']
    assert (code, offset['seconds']) == (4, pytest.approx(seconds, abs=0.03))
    said = capsys.readouterr().err
    side = 'ahead of' if seconds > 0 else 'behind'
    assert (
        f'by the motion of the scans, stamps of the scans are {abs(offset["seconds"]):.3f}' in said
    )
    assert f's {side} those of {tmp_path / "shifted.tum"}' in said
    assert f'--time-offset {-offset["seconds"]:.3f} (or input.time_offset_s)' in said
    code, summary = replayed(weaving, tmp_path / 'out', seconds, '--time-offset', f'{-seconds}')
    assert (code, summary['clock_offsets']) == (0, [])
    assert summary['digest'] == right['digest']


def test_equal_clocks_are_no_offset(weaving, tmp_path):
    code, summary = replayed(weaving, tmp_path / 'out', 0.0)
    assert (code, summary['clock_offsets']) == (0, [])


@pytest.mark.parametrize(
    'change',
    [
        lambda pose: pose @ se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.25])),
        lambda pose: pose_matrix(0.5 * pose[:3, 3], q_xyzw(pose)),
    ],
    ids=['turned mount', 'half the way'],
)
def test_poses_with_other_motions_than_the_scans_leave_the_map_in_doubt(
    weaving, tmp_path, capsys, change
):
    poses = Trajectory.load(weaving / 'poses.tum')
    wrong = tmp_path / 'wrong.tum'
    Trajectory.from_matrices([*map(change, poses.matrices)], poses.stamp_ns).save(wrong)
    command = ['replay', str(weaving / 'scans'), '-o', str(tmp_path / 'out'), '--poses']
    assert main([*command, str(wrong)]) == 4
    assert 'motions of the scans differ from those of their poses' in capsys.readouterr().err


def test_a_straight_drive_at_constant_speed_determines_no_offset(tmp_path):
    write_drive(tmp_path, straight)
    code, summary = replayed(tmp_path, tmp_path / 'out', 1.0)
    assert (code, summary['clock_offsets']) == (0, [])


def test_an_offset_of_a_bag_names_the_topic_and_the_option_in_its_place(tmp_path, capsys):
    drive, lidar = Drive(start=street().start, speed_m_s=8.0), replace(LIDAR, rate_hz=10.0)
    record(Simulation(street(), lidar, drive, num_scans=90), tmp_path / 'bag')
    run = ['replay', str(tmp_path / 'bag'), '-o', str(tmp_path / 'out'), '--overwrite']
    assert main(run) == 0
    assert main([*run, '--time-offset', '/points=0.3']) == 4
    (offset,) = json.loads((tmp_path / 'out' / 'summary.json').read_text())['clock_offsets']
    assert (offset['clouds'], offset['reference']) == ('/points', '/tf')
    assert offset['seconds'] == pytest.approx(0.3, abs=0.03)
    assert f'--time-offset /points={0.3 - offset["seconds"]:.3f} ' in capsys.readouterr().err


@pytest.mark.parametrize('name', ['hall_os0_full', 'hall_os0_long'])
def test_poses_of_a_real_hall_have_the_clock_of_its_scans(data_folder, tmp_path, name):
    run = ['replay', str(data_folder / 'data' / 'bags' / name), '-o', str(tmp_path / 'out')]
    assert main(run) == 0
    assert json.loads((tmp_path / 'out' / 'summary.json').read_text())['clock_offsets'] == []


def course(num=400, rate_hz=10.0):
    """Return poses of a path that turns to both sides at changing rates."""
    poses, step = [np.eye(4)], 1.0 / rate_hz
    for time_s in np.arange(1, num) * step:
        rate = 0.4 * np.sin(0.9 * time_s) + 0.3 * np.sin(0.37 * time_s + 1.0)
        poses.append(compose(poses[-1], se3_exp(np.array([2.0, 0, 0, 0, 0, rate]) * step)))
    return Trajectory.from_matrices(np.array(poses), np.arange(num) * round(S * step))


@pytest.mark.parametrize('seconds', [0.2, -0.2, 0.7, -5.0])
def test_the_shift_is_the_time_between_equal_motions(seconds):
    path = course()
    rows = np.array([(row, row + 5) for row in range(60, 340, 7)])
    motions = [compose(inverse(path[start]), path[end]) for start, end in rows.tolist()]
    spans_ns = path.stamp_ns[rows] - round(seconds * S)
    shift_s = PosedMotions(path, spans_ns, np.array(motions)).shift_s()
    assert shift_s == pytest.approx(seconds, abs=0.01)


@pytest.mark.parametrize('seconds', [0.0, 0.2, -37.0, 3600.0])
def test_the_clocks_of_two_trajectories_are_compared_by_the_motion(tmp_path, caplog, seconds):
    path = course()
    truth = Trajectory.from_matrices(path.matrices, path.stamp_ns + 10**12)
    estimated = Trajectory.from_matrices(
        path.matrices[20:], truth.stamp_ns[20:] + round(S * seconds)
    )
    truth.save(tmp_path / 'true.tum')
    estimated.save(tmp_path / 'estimated.tum')
    main(['evaluate', str(tmp_path / 'estimated.tum'), '--truth', str(tmp_path / 'true.tum')])
    said = ''.join(record.message for record in caplog.records)
    side = 'ahead of' if seconds > 0.0 else 'behind'
    assert (f'its times are {abs(seconds):.3f} s {side} those of' in said) == bool(seconds)
    assert (f'Add {-seconds:.3f} s to its times' in said) == bool(seconds)


def test_motions_of_another_drive_determine_no_offset():
    path, other = course(), course(rate_hz=9.1)
    rows = np.array([(row, row + 5) for row in range(60, 340, 7)])
    motions = [compose(inverse(other[start]), other[end]) for start, end in rows.tolist()]
    assert PosedMotions(path, path.stamp_ns[rows], np.array(motions)).shift_s() is None


def test_motions_that_repeat_determine_no_offset():
    turn = np.concatenate([np.full(10, 0.2), np.full(10, -0.2)])
    steps = np.tile(turn, 30)
    poses = [np.eye(4)]
    for rate in steps.tolist():
        poses.append(compose(poses[-1], se3_exp(np.array([0.2, 0, 0, 0, 0, rate]))))
    path = Trajectory.from_matrices(np.array(poses), np.arange(len(poses)) * S // 10)
    rows = np.array([(row, row + 5) for row in range(100, 500, 7)])
    motions = [compose(inverse(path[start]), path[end]) for start, end in rows.tolist()]
    spans_ns = path.stamp_ns[rows] - 7 * S // 10
    assert PosedMotions(path, spans_ns, np.array(motions)).shift_s() is None
