# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper extract``: clouds and maps to files, and bad input refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from surfel_mapper.cli.main import main
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.map_state import save_map
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.models import read
from test import extras
from test.models.scenes import room, sheet, VIEW
from test.offline.test_depth_folders import tum

FILES = ('models.smm', 'models.json', 'models.png')


def write_cloud(path, points):
    ply.write_points(path, {name: points[:, k] for k, name in enumerate('xyz')})


def test_a_cloud_becomes_models_and_a_picture(tmp_path, capsys):
    write_cloud(tmp_path / 'room.ply', room(160, 120)[0])
    place = ['--viewpoint', *map(str, VIEW), '--voxel-size', '0.03', '--overwrite']
    arguments = [str(tmp_path / 'room.ply'), '--output', str(tmp_path / 'out'), *place]
    assert main(['extract', *arguments, '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['planes'] >= 5
    assert found['surfaces'] >= 2
    assert found['coverage'] > 0.94
    assert all((tmp_path / 'out' / name).stat().st_size > 0 for name in FILES)
    assert main(['extract', *arguments, '--formats', 'json']) == 0
    assert 'planes' in capsys.readouterr().out
    extras.load('trimesh')
    assert main(['extract', *arguments, '--overwrite', '--formats', 'obj,glb']) == 0
    assert (tmp_path / 'out' / 'models.obj').stat().st_size > 0
    assert (tmp_path / 'out' / 'models.glb').stat().st_size > 0


def test_a_map_becomes_models_of_its_surfels(tmp_path, capsys):
    surfel_map = SurfelMap(voxel_size_m=0.2)
    floor = sheet(8.0, 6.0, 0.04, centre=(3.0, 1.0, 0.31), sigma=0.005)
    wall = sheet(2.4, 6.0, 0.04, (1.0, 0.0, 0.0), (-0.91, 1.0, 1.6))
    surfel_map.add(np.concatenate([floor, wall]), origin=(3.0, 1.0, 1.5))
    save_map(tmp_path / 'map.npz', surfel_map)
    out = str(tmp_path / 'out')
    assert main(['extract', str(tmp_path / 'map.npz'), '--output', out, '--json']) == 0
    assert json.loads(capsys.readouterr().out)['planes'] == 2
    planes = json.loads((tmp_path / 'out' / 'models.json').read_text())['planes']
    offsets = sorted(abs(plane['offset_m']) for plane in planes)
    assert offsets == pytest.approx([0.31, 0.91], abs=0.01)

    extras.load('pyarrow')
    tiled, again = str(tmp_path / 'tiled'), tmp_path / 'again'
    assert main(['merge', str(tmp_path / 'map.npz'), '--output', tiled]) == 0
    assert main(['extract', tiled, '--output', str(again)]) == 0
    assert json.loads((again / 'models.json').read_text())['planes'] == planes


@pytest.mark.parametrize('name', ['room.json', 'missing.ply', 'missing.npz'])
def test_a_file_that_is_no_cloud_is_refused_by_name(tmp_path, capsys, name):
    if name == 'room.json':
        (tmp_path / name).write_text('1 2 3\n')
    assert main(['extract', str(tmp_path / name), '--output', str(tmp_path / 'out')]) == 1
    assert name in capsys.readouterr().err


@pytest.mark.parametrize('size', [['--voxel-size', '0.1'], ['--set', 'models.voxel_size_m=0.1']])
def test_settings_are_options(tmp_path, capsys, size):
    cloud, out = tmp_path / 'a.ply', tmp_path / 'out'
    write_cloud(cloud, sheet(1.0, 1.0, 0.02).astype(np.float32))
    arguments = [*size, '--set', 'models.kinds=gaussians']
    assert main(['extract', str(cloud), '-o', str(out), '--json', *arguments]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert 10**2 <= figures['thinned'] <= 11**2  # a square of 1 m in voxels of 0.1 m
    assert figures['planes'] == 0 < figures['gaussians']


@pytest.mark.parametrize(('side_m', 'voxel_size_m'), [(2.0, 0.04), (20.0, 0.16), (80.0, 0.3)])
def test_default_voxels_follow_the_extent_of_a_cloud(tmp_path, capsys, side_m, voxel_size_m):
    # half of a square of 20 m is within sqrt(2 / pi) * 10 m = 8.0 m of its middle
    square = sheet(side_m, side_m, 0.01 * side_m, centre=(3.0, 0.0, 1.0)).astype(np.float32)
    no_return = np.zeros((2 * len(square), 3), np.float32)
    write_cloud(tmp_path / 'a.ply', np.concatenate([square, no_return]))
    arguments = ['extract', str(tmp_path / 'a.ply'), '-o', str(tmp_path / 'out'), '--overwrite']
    assert main([*arguments, '--json']) == 0
    assert json.loads(capsys.readouterr().out)['voxel_size_m'] == pytest.approx(voxel_size_m)
    assert main([*arguments, '--voxel-size', '0.25']) == 0
    assert 'in voxels of 0.25 m)' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('setting', 'message'),
    [
        ('models.kind=all', 'models.kind: no such setting'),
        ('models.profile=best', "models.profile: 'best'"),
    ],
)
def test_settings_are_checked_before_anything_is_read(tmp_path, capsys, setting, message):
    out = str(tmp_path / 'out')
    assert main(['extract', str(tmp_path / 'nothere.ply'), '-o', out, '--set', setting]) == 1
    assert message in capsys.readouterr().err


def plane(tmp_path):
    rng = np.random.default_rng(1)
    points = np.column_stack([*rng.uniform(0.0, 0.4, (2, 20_000)), np.ones(20_000)])
    return points.astype(np.float32)


def normals_of(path, output, *options):
    assert main(['extract', str(path), '-o', str(output), *options]) == 0
    models = json.loads((output / 'models.json').read_text())
    return [primitive['normal'][2] for primitive in models['planes']]


def test_normals_face_the_viewpoint_of_a_pcd(tmp_path):
    columns = dict(zip('xyz', plane(tmp_path).T, strict=True))
    for z, sign in ((0.0, -1.0), (3.0, 1.0)):
        pcd.write_points(tmp_path / 'a.pcd', columns, (0.0, 0.0, z, 1.0, 0.0, 0.0, 0.0))
        normals = normals_of(tmp_path / 'a.pcd', tmp_path / f'out_{z}')
        assert normals
        np.testing.assert_allclose(normals, sign, atol=1e-3)


def test_a_bag_is_mapped_as_by_replay_first(tmp_path, capsys, caplog):
    size = ['--beams', '16', '--columns', '512', '--scans', '5', '-q']
    bag, mapped, models = (str(tmp_path / name) for name in ('bag', 'mapped', 'models'))
    assert main(['simulate', 'street', '-o', bag, *size]) == 0
    assert main(['replay', bag, '-o', mapped, '-q']) == 0
    capsys.readouterr()
    assert main(['extract', bag, '-o', models, '--json', '-v']) == 0
    of_bag = json.loads(capsys.readouterr().out)
    assert '5 scans mapped, voxels of 0.5 m' in caplog.text
    assert main(['extract', mapped, '-o', models, '--json', '--overwrite']) == 0
    assert of_bag == json.loads(capsys.readouterr().out)
    assert of_bag['planes'] > 2
    arguments = ['-o', models, '--overwrite', '--voxel-size', '0.1', '--json', '-v']
    assert main(['extract', bag, *arguments]) == 0
    assert 'voxels of 0.2 m' in caplog.text
    assert json.loads(capsys.readouterr().out)['points'] > of_bag['points']


def test_depth_images_are_mapped_in_voxels_for_a_room(tmp_path, capsys, caplog):
    tum(tmp_path / 'frames')
    out = str(tmp_path / 'out')
    assert main(['extract', str(tmp_path / 'frames'), '-o', out, '--json', '-v']) == 0
    assert '3 scans mapped, voxels of 0.08 m' in caplog.text
    assert json.loads(capsys.readouterr().out)['planes'] == 1
    (plane,) = read(tmp_path / 'out' / 'models.smm').planes
    assert abs(plane.normal[2]) > 0.9999
    assert plane.mean[2] == pytest.approx(3.0, abs=0.002)  # the wall of the images


@pytest.mark.parametrize('number', [0, 7])
def test_a_cloud_without_finite_points_is_refused(tmp_path, capsys, number):
    np.save(tmp_path / 'a.npy', np.full((number, 3), np.nan, np.float32))
    assert main(['extract', str(tmp_path / 'a.npy'), '-o', str(tmp_path / 'out')]) == 1
    assert f'none of its {number} points is finite' in capsys.readouterr().err


def test_a_directory_of_neither_map_nor_scans_is_refused(tmp_path, capsys):
    (tmp_path / 'in').mkdir()
    (tmp_path / 'in' / 'notes.md').write_text('nothing')
    assert main(['extract', str(tmp_path / 'in'), '-o', str(tmp_path / 'out')]) == 1
    assert 'in this directory, nor a bag or scans' in capsys.readouterr().err
