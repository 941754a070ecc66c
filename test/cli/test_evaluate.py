# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper evaluate`` compares maps of all formats with the truth, and trajectories."""

import json

import numpy as np
import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.files.ply import write_points
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.simulation import load_simulation
from test import extras
from test.cli.test_replay import strict_json

pytestmark = pytest.mark.usefixtures('undrawn')

FORMATS = 'ply,pcd,parquet,npz' if extras.has('pyarrow') else 'ply,pcd,npz'


@pytest.fixture(scope='module')
def street(tmp_path_factory):
    """Return a simulated bag and the output of its replay in all formats."""
    folder = tmp_path_factory.mktemp('street')
    bag, output = folder / 'street', folder / 'out'
    size = ['--beams', '16', '--columns', '512', '--noise', '0.01', '--scans', '12']
    assert main(['simulate', 'street', '--output', str(bag), *size]) == 0
    poses = ['--poses-out', str(folder / 'poses.tum')]
    arguments = ['replay', str(bag), '--formats', FORMATS, '--output', str(output), *poses]
    assert main(arguments) == 0
    return bag, output


def evaluated(capsys, *arguments):
    capsys.readouterr()
    assert main(['evaluate', *map(str, arguments), '--json']) == 0
    return strict_json(capsys.readouterr().out)


def test_a_map_of_a_simulated_street_is_near_its_truth(street, capsys):
    bag, output = street
    result = evaluated(capsys, output, '--truth', bag)

    assert result['surfels'] == json.loads((output / 'summary.json').read_text())['surfels']
    assert result['compared'] == result['surfels'] > 500
    assert 0.0 < result['position_m']['median'] < 0.005
    assert 0.0 < result['normal_deg']['median'] < 3.0
    assert 0.5 < result['completeness'] <= 1.0
    assert result == {
        **evaluated(capsys, output, '--truth', bag / 'world.json'),
        'truth': str(bag),
    }


def test_a_map_against_itself_is_equal_to_the_bit(street, capsys):
    extras.load('pyarrow')
    _, output = street
    result = evaluated(capsys, output / 'map.npz', '--truth', output / 'map.parquet')
    assert result['equal'] is True
    assert result['position_m']['max'] == 0.0
    assert result['completeness'] == 1.0
    assert 'equal' not in evaluated(capsys, output / 'map.npz', '--truth', output / 'map.ply')


def test_points_without_normals_are_a_truth_too(street, capsys, tmp_path):
    bag, output = street
    scan = load_simulation(bag).scan(0)
    points = scan.points[np.isfinite(scan.points).all(axis=1)]
    columns = dict(zip('xyz', points.T, strict=True))
    unfilled = dict.fromkeys(('nx', 'ny', 'nz'), np.zeros(len(points), np.float32))  # as PCL does
    write_points(tmp_path / 'truth.ply', columns)
    write_points(tmp_path / 'unfilled.ply', columns | unfilled)
    result, same = (
        evaluated(capsys, output, '--truth', tmp_path / name, '--max-distance', '50')
        for name in ('truth.ply', 'unfilled.ply')
    )
    assert 'normal_deg' not in result
    assert result['position_m']['mean'] > 0.0
    assert same['position_m'] == result['position_m']
    assert 'normal_deg' not in same


def test_a_map_in_another_frame_is_moved_onto_its_truth_if_asked(street, capsys, tmp_path, caplog):
    bag, _ = street
    registered = str(tmp_path / 'registered')
    arguments = ['--poses-from', 'registration', '--no-align', '--output', registered]
    assert main(['replay', str(bag), *arguments]) in (0, 4)  # 1 of 12 scans is not aligned

    apart = evaluated(capsys, registered, '--truth', bag)
    assert 'frames differ?' in caplog.text
    assert '--align' in caplog.text
    result = evaluated(capsys, registered, '--truth', bag, '--align')

    assert apart['compared'] < 0.5 * apart['surfels']
    assert result['aligned']['start'] == 'trajectories'
    assert result['aligned']['moved_m'] > 5.0
    assert result['compared'] > 0.95 * result['surfels']
    assert result['position_m']['median'] < 0.01


def test_the_poses_of_a_replay_are_those_of_the_simulation(street, capsys):
    bag, output = street
    result = evaluated(capsys, output.parent / 'poses.tum', '--truth', bag)
    assert result['num_poses'] == 12
    for kind in ('absolute', 'relative'):
        assert result[kind]['translation_m']['max'] < 1e-6
        assert result[kind]['rotation_deg']['max'] < 1e-5


def test_the_report_says_it_in_a_few_lines(street, capsys):
    bag, output = street
    for arguments in ([output], [output.parent / 'poses.tum']):
        capsys.readouterr()
        assert main(['evaluate', *map(str, arguments), '--truth', str(bag)]) == 0
        assert 2 < len(capsys.readouterr().out.splitlines()) < 9


@pytest.mark.parametrize(
    ('name', 'text'),
    [
        ('nothing', 'no such file or directory; expected a directory'),
        ('empty', 'no map in this directory'),
        ('a.json', 'No such file'),
        ('other.ply', 'No such file'),
    ],
)
def test_a_file_that_is_no_map_or_truth_is_refused_by_name(street, tmp_path, capsys, name, text):
    bag, output = street
    (tmp_path / 'empty').mkdir()
    assert main(['evaluate', str(output), '--truth', str(tmp_path / name)]) == 1
    error = capsys.readouterr().err
    assert name in error
    assert text in error
    assert main(['evaluate', str(tmp_path / name), '--truth', str(bag)]) == 1


def test_poses_without_times_are_compared_by_their_numbers(tmp_path, capsys):
    poses = [pose_matrix((k, 0.2 * k * k, 0.0), (0.0, 0.0, 0.0, 1.0)) for k in range(6)]
    np.savetxt(tmp_path / 'truth.txt', [pose[:3].ravel() for pose in poses])
    lines = [
        f'VERTEX_SE3:QUAT {k} {poses[k][0, 3]} {poses[k][1, 3]} 0 0 0 0 1' for k in (1, 2, 3, 5)
    ]
    (tmp_path / 'some.g2o').write_text('\n'.join(lines))

    command = ['evaluate', str(tmp_path / 'some.g2o'), '--truth', str(tmp_path / 'truth.txt')]
    assert main([*command, '--json']) == 0

    result = json.loads(capsys.readouterr().out)
    assert result['num_poses'] == 4
    assert result['absolute']['translation_m']['max'] < 1e-9


def test_a_bag_is_mapped_as_by_replay_and_compared(street, capsys):
    bag, output = street
    same = evaluated(capsys, bag, '--truth', output)
    assert same['equal'] is True
    assert same['position_m']['max'] == 0.0
    finer = evaluated(capsys, bag, '--truth', bag, '--voxel-size', '0.25')
    assert finer['surfels'] > same['surfels']
