# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Folders of depth images of data sets give the wall that their camera saw."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image
import pytest

from surfel_mapper import Config, Mapper, SurfelMap
from surfel_mapper.cli.main import main
from surfel_mapper.errors import FileFormatError
from surfel_mapper.files.trajectory import Trajectory
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.offline.depth_folders import find_depth_folder
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.request import Request

SIZE = (60, 80)
K = (70.0, 72.0, 39.5, 29.5)
WALL_M = 3.0
NUM = 3


def poses():
    """Return poses of a camera that approaches the wall z = 3 m and turns about its axis."""
    turns = 0.1 * np.arange(NUM)
    return [
        pose_matrix((0.1, -0.2, 0.5 * k), (0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)))
        for k, turn in enumerate(turns)
    ]


def write_depth(path, number, units_per_m):
    """Write the depth of the wall as a PNG of 16 bits, with two pixels without depth."""
    path.parent.mkdir(parents=True, exist_ok=True)
    depth = np.full(SIZE, round((WALL_M - 0.5 * number) * units_per_m), np.uint16)
    depth[0, :2] = [0, 65535]
    Image.fromarray(depth).save(path)


def matrix_of(k):
    fx, fy, cx, cy = k
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def tum(path):
    stamps = [f'{1305031102 + k / 30:.6f}' for k in range(NUM)]
    for k, stamp in enumerate(stamps):
        write_depth(path / 'depth' / f'{stamp}.png', k, 5000.0)
    lines = [f'{stamp} depth/{stamp}.png' for stamp in stamps]
    (path / 'depth.txt').write_text('# depth maps\n' + '\n'.join(lines))
    stamps_ns = [round(float(stamp) * 1e6) * 1000 for stamp in stamps]
    Trajectory.from_matrices(poses(), stamps_ns).save(path / 'groundtruth.txt')
    np.savetxt(path / 'intrinsics.txt', matrix_of(K))
    return 'TUM RGB-D'


def seven_scenes(path):
    for k, pose in enumerate(poses()):
        write_depth(path / f'frame-{10 * k:06}.depth.png', k, 1000.0)
        np.savetxt(path / f'frame-{10 * k:06}.pose.txt', pose)
    np.savetxt(path / 'camera-intrinsics.txt', matrix_of(K))
    return '7-Scenes'


def replica(path):
    for k in range(NUM):
        write_depth(path / 'results' / f'depth{k:06}.png', k, 6553.5)
    np.savetxt(path / 'traj.txt', [pose.ravel() for pose in poses()])
    fx, fy, cx, cy = K
    camera = {'w': 80, 'h': 60, 'fx': fx, 'fy': fy, 'cx': cx, 'cy': cy, 'scale': 6553.5}
    (path / 'cam_params.json').write_text(json.dumps({'camera': camera}))
    return 'Replica'


def scannet(path):
    for k, pose in enumerate(poses()):
        write_depth(path / 'depth' / f'{k}.png', k, 1000.0)
        (path / 'pose').mkdir(exist_ok=True)
        np.savetxt(path / 'pose' / f'{k}.txt', pose)
    (path / 'intrinsic').mkdir()
    matrix = np.eye(4)
    matrix[:3, :3] = matrix_of(K)
    np.savetxt(path / 'intrinsic' / 'intrinsic_depth.txt', matrix)
    return 'ScanNet'


ALL = (tum, seven_scenes, replica, scannet)


def mapped(path, **request):
    with open_recording(Request(path=path, **request), Config()) as recording:
        mapper = Mapper(recording.config)
        list(recording.replay(mapper))
        return mapper


@pytest.mark.parametrize('make', ALL)
def test_a_folder_gives_the_wall_at_its_poses(tmp_path, make, capsys):
    name = make(tmp_path)

    mapper = mapped(tmp_path)

    assert mapper.counters.mapped == NUM
    assert mapper.map.num_points == NUM * (SIZE[0] * SIZE[1] - 2)
    surfels = mapper.map.surfels(5)
    np.testing.assert_allclose(surfels.position[:, 2], WALL_M, atol=2e-4)  # 1 / 6553.5 m
    half = (WALL_M - np.array([0.0, 0.5, 1.0])) * 40.0 / K[0]
    width = np.ptp(surfels.position[:, 0])
    assert width < 2.0 * half[0] + 0.4
    assert width > 2.0 * half[0] - 1.0
    assert main(['info', str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert f'{name}, 3 scans' in printed
    assert 'replay takes poses from file' in printed


def in_json(path, scale):
    fx, fy, cx, cy = K
    camera = {'fx': fx, 'fy': fy, 'cx': cx, 'cy': cy, 'scale': scale}
    (path / 'cam_params.json').write_text(json.dumps({'camera': camera}))


@pytest.mark.parametrize(('make', 'written', 'scale'), [(scannet, 1000.0, 1e4), (tum, 5e3, 1e3)])
def test_an_unusual_depth_is_named_and_the_scale_of_a_file_corrects_it(
    tmp_path, caplog, make, written, scale
):
    make(tmp_path)
    mapped(tmp_path)
    assert not caplog.records
    for file in sorted(tmp_path.glob('depth/*.png')):
        values = np.array(Image.open(file))
        Image.fromarray(np.uint16(values * (scale / written))).save(file)
    mapped(tmp_path)
    unusual_m = WALL_M * scale / written
    (warning,) = caplog.records
    assert f'90% of the depth is below {unusual_m:.2f} m, which is unusual' in warning.message
    assert f'is a metre not {written:g} values' in warning.message
    assert 'scale in cam_params.json' in warning.message
    caplog.clear()
    in_json(tmp_path, scale)
    surfels = mapped(tmp_path).map.surfels(5)
    assert not caplog.records
    np.testing.assert_allclose(surfels.position[:, 2], WALL_M, atol=1e-3)


@pytest.mark.parametrize('make', [seven_scenes, scannet])
def test_images_whose_pose_is_lost_are_dropped(tmp_path, make):
    make(tmp_path)
    last = sorted(
        tmp_path.rglob('*.pose.txt') if make is seven_scenes else tmp_path.rglob('2.txt')
    )
    np.savetxt(last[-1], np.full((4, 4), -np.inf))

    mapper = mapped(tmp_path)

    assert mapper.counters.mapped == NUM - 1


def test_images_without_poses_are_registered(tmp_path):
    tum(tmp_path)
    (tmp_path / 'groundtruth.txt').unlink()

    with open_recording(Request(path=tmp_path), Config()) as recording:
        assert recording.config.pose.source == 'registration'
        assert recording.config.input.kind == 'depth'


@pytest.mark.parametrize(('set_m', 'size_m'), [(0.5, 0.08), (0.2, 0.2)])
def test_voxels_of_depth_images_are_small_if_no_size_is_set(tmp_path, capsys, set_m, size_m):
    tum(tmp_path / 'images')
    settings = ['--voxel-size', str(set_m)] if set_m != 0.5 else []

    code = main(['replay', str(tmp_path / 'images'), '--output', str(tmp_path / 'out'), *settings])

    assert code == 0
    assert f'in voxels of {size_m} m' in capsys.readouterr().out
    assert SurfelMap.load(tmp_path / 'out' / 'map.npz').voxel_size_m == size_m


@pytest.mark.parametrize(
    ('name', 'focal'),
    [('rgbd_dataset_freiburg1_desk', 517.3), ('fr3_office', 535.4), ('other', 525.0)],
)
def test_cameras_of_tum_follow_from_the_name_with_a_warning(tmp_path, caplog, name, focal):
    tum(tmp_path / name)
    (tmp_path / name / 'intrinsics.txt').unlink()

    assert find_depth_folder(tmp_path / name).intrinsics[0] == focal
    assert 'no file of intrinsics' in caplog.text


def damage(pattern, content):
    def change(path):
        next(iter(sorted(path.rglob(pattern)))).write_bytes(content)

    return change


@pytest.mark.parametrize(
    ('make', 'change', 'says'),
    [
        (tum, damage('depth.txt', b'1 2 3\n'), r'depth\.txt:1: 3 columns, expected 2'),
        (tum, damage('intrinsics.txt', b'1 2\n'), '2 numbers, expected 4 or 9 or 16'),
        (tum, damage('intrinsics.txt', b'a b c d\n'), 'could not convert'),
        (seven_scenes, damage('*.pose.txt', b'1 2 3\n'), '3 numbers, expected 16'),
        (seven_scenes, damage('*.pose.txt', b'2 ' * 16), 'a matrix that is no rotation'),
        (replica, damage('cam_params.json', b'{}'), 'no camera with fx, fy, cx, cy'),
        (
            replica,
            lambda path: (path / 'results' / 'depth000002.png').rename(
                path / 'results' / 'depth000007.png'
            ),
            '3 poses, none for depth000007.png',
        ),
        (
            scannet,
            lambda path: (path / 'intrinsic' / 'intrinsic_depth.txt').unlink(),
            'no intrinsics of its camera',
        ),
    ],
)
def test_damaged_folders_are_refused(tmp_path, make, change, says):
    make(tmp_path)
    change(tmp_path)

    with pytest.raises(FileFormatError, match=says):
        find_depth_folder(tmp_path)


@pytest.mark.parametrize('content', [b'', b'\x89PNG\r\n\x1a\n', b'colour'])
def test_an_image_that_is_no_depth_is_counted(tmp_path, content):
    seven_scenes(tmp_path)
    file = tmp_path / 'frame-000000.depth.png'
    if content == b'colour':
        Image.fromarray(np.zeros((*SIZE, 3), np.uint8)).save(file)
    else:
        file.write_bytes(content)

    mapper = mapped(tmp_path)

    assert mapper.counters.mapped == NUM - 1
    assert mapper.counters.dropped['bad_cloud'] == 1


def test_real_images_of_seven_scenes_fit_at_their_poses(data_folder, tmp_path, caplog):
    source = Path(data_folder, 'data', 'rgbd')
    table = np.load(source / 'sevenscenes_poses.npz')
    poses_of = dict(zip(table['frame'].tolist(), table['T_world_cam'], strict=True))
    for file in sorted((source / 'sevenscenes').glob('*.depth.png'))[:20]:
        (tmp_path / file.name).symlink_to(file)
        number = int(file.name[6:12])
        np.savetxt(tmp_path / f'frame-{number:06}.pose.txt', poses_of[number])

    mapper = mapped(tmp_path)

    assert mapper.counters.mapped == 20
    surfels = mapper.map.surfels(200)
    assert np.median(surfels.planarity) > 0.3  # a kitchen in voxels of 0.5 m
    assert np.ptp(surfels.position, axis=0).max() < 8.0
    assert 'no file of intrinsics' in caplog.text
    assert len(caplog.records) == 1
