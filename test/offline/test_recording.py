# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Parts of bags, several sensors, poses from files and folders of scans give the same maps.

(Longer than other files: every test replays the same recordings.)
"""

import math

import numpy as np
import pytest

from surfel_mapper import Config, Mapper, SurfelMap
from surfel_mapper.errors import BagError, FileFormatError
from surfel_mapper.files import pcd, ply
from surfel_mapper.files.trajectory import write_tum
from surfel_mapper.geometry import pose_matrix
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.replay import all_scans
from surfel_mapper.offline.request import Request
from test.bags.recorded import (
    CLOUD,
    cut,
    drive,
    HEIGHT_M,
    MOUNT_M,
    NUM_SCANS,
    PERIOD_NS,
    ROS1,
    START_NS,
    write_mcap,
    write_ros1,
    write_rosbag2,
)
from test.offline.test_bag_recording import expected_digest, points_of

NO_TURN = (0.0, 0.0, 0.0, 1.0)
STAMPS = START_NS + PERIOD_NS * np.arange(NUM_SCANS)
MOUNTED = {'frames.base_to_sensor': [*MOUNT_M, *NO_TURN]}


def mapped(path, settings=None, **request):
    """Map a recording and return the mapper."""
    config = Config.from_mapping({**all_scans(), **(settings or {})})
    with open_recording(Request(path=path, **request), config) as recording:
        mapper = Mapper(recording.config)
        for _ in recording.replay(mapper):
            pass
        assert recording.num_scans >= 0
    return mapper


def clouds(entries):
    return [points_of(message) for _, type_, _, message in entries if type_ == CLOUD]


def digest_of(numbers, entries=None):
    """Map some scans of the drive by hand."""
    surfel_map = SurfelMap(Config().map.voxel_size_m)
    for i, points in enumerate(clouds(entries or drive())):
        if i in numbers:
            origin = np.array([0.5 * i, 0.0, HEIGHT_M]) + MOUNT_M
            surfel_map.add(points + origin, origin=origin)
    return surfel_map.digest()


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return write_rosbag2(tmp_path_factory.mktemp('bags') / 'drive', drive())


@pytest.mark.parametrize(
    ('span', 'numbers'),
    [
        ({}, range(6)),
        ({'start_s': 0.15}, [2, 3, 4, 5]),
        ({'duration_s': 0.25}, [0, 1, 2]),
        ({'start_s': 0.15, 'duration_s': 0.2}, [2, 3]),
        ({'every': 2}, [0, 2, 4]),
        ({'start_s': 0.15, 'every': 3}, [2, 5]),
        ({'duration_s': 99.0, 'every': 99}, [0]),
    ],
)
def test_a_part_maps_its_scans_at_their_poses(bag, span, numbers):
    mapper = mapped(bag, **span)

    assert mapper.counters.mapped == len(numbers)
    assert mapper.map.digest() == digest_of(numbers)


@pytest.mark.parametrize(
    ('span', 'says'),
    [
        ({'start_s': 99.0}, 'start 99 s, expected 0 to 0.5'),
        ({'start_s': -1.0}, 'start -1 s, expected'),
        ({'start_s': math.nan}, 'start nan s, expected'),
        ({'duration_s': 0.0}, 'duration 0 s, expected more than 0'),
        ({'duration_s': math.nan}, 'duration nan s, expected'),
        ({'every': 0}, 'every 0, expected 1 or more'),
    ],
)
def test_an_impossible_part_is_refused(bag, span, says):
    with pytest.raises(BagError, match=says):
        mapped(bag, **span)


REAR_M = (-1.0, 0.5, 0.25)


def two_sensors(frames=('lidar', 'rear')):
    """Return the drive with a second sensor, which sees the same points from its own place."""
    entries = drive()
    entries.transform('/tf_static', START_NS, 'base_link', 'rear', REAR_M)
    for points, stamp_ns in zip(clouds(entries), STAMPS.tolist(), strict=True):
        entries.cloud('/rear', stamp_ns, points, frames[1])
    entries.sort(key=lambda row: row[2])
    for row in entries:
        if row[0] == '/points':
            row[3].header.frame_id = frames[0]
    return entries


def digest_of_two():
    surfel_map = SurfelMap(Config().map.voxel_size_m)
    for i, points in enumerate(clouds(drive())):
        for mount in (MOUNT_M, REAR_M):
            origin = np.array([0.5 * i, 0.0, HEIGHT_M]) + mount
            surfel_map.add(points + origin, origin=origin)
    return surfel_map.digest()


BOTH = ('/points', '/rear')


def test_several_topics_are_mapped_each_from_its_place_in_the_tree(tmp_path):
    path = write_rosbag2(tmp_path / 'two', two_sensors())

    mapper = mapped(path, topics=BOTH)

    assert mapper.counters.mapped == 2 * NUM_SCANS
    assert mapper.map.digest() == digest_of_two()


@pytest.mark.parametrize(
    ('settings', 'request_', 'says'),
    [
        ({}, {'topics': BOTH, 'mounts': {'/points': (*MOUNT_M, *NO_TURN)}}, 'one for each of'),
        ({}, {'topics': ('/points',), 'mounts': {'/rear': (*MOUNT_M, *NO_TURN)}}, 'for each of'),
        (MOUNTED, {'topics': BOTH}, 'is the pose of one sensor, not of 2'),
        ({}, {'topics': ('/points', '/front')}, 'no topic /front'),
        (
            {},
            {'topics': BOTH, 'time_offsets': {'/front': 1.0}},
            'time offset of /front, expected of /points, /rear',
        ),
    ],
)
def test_places_that_leave_a_sensor_out_are_refused(tmp_path, settings, request_, says):
    path = write_rosbag2(tmp_path / 'two', two_sensors())

    with pytest.raises(BagError, match=says):
        mapped(path, settings, **request_)


def test_a_ros1_bag_whose_frames_begin_with_a_slash_gives_the_same_map(tmp_path):
    entries = drive(ROS1)
    for _, _, _, message in entries:
        for part in getattr(message, 'transforms', [message]):
            part.header.frame_id = f'/{part.header.frame_id}'
            if hasattr(part, 'child_frame_id'):
                part.child_frame_id = f'/{part.child_frame_id}'

    mapper = mapped(write_ros1(tmp_path / 'a.bag', entries))

    assert mapper.map.digest() == expected_digest(drive())


def poses(numbers=range(NUM_SCANS)):
    return np.array([pose_matrix((0.5 * i, 0.0, HEIGHT_M), NO_TURN) for i in numbers])


def pose_file(tmp_path, format_, numbers=range(NUM_SCANS)):
    """Write the poses of the base; a KITTI file has no times."""
    path = tmp_path / f'poses.{format_}'
    if format_ == 'tum':
        write_tum(path, STAMPS[list(numbers)], poses(numbers))
    elif format_ == 'csv':
        rows = [f'{STAMPS[i]},{0.5 * i},0,{HEIGHT_M},0,0,0,1\n' for i in numbers]
        path.write_text(''.join(['stamp_ns,x,y,z,qx,qy,qz,qw\n', *rows]))
    else:
        path.write_text(''.join(f'1 0 0 {0.5 * i} 0 1 0 0 0 0 1 {HEIGHT_M}\n' for i in numbers))
    return path


@pytest.mark.parametrize('mount', [{}, MOUNTED])
@pytest.mark.parametrize('format_', ['tum', 'csv', 'kitti'])
def test_poses_from_a_file_give_the_map_of_those_in_the_bag(tmp_path, format_, mount):
    kept = ('/points',) if mount else ('/points', '/tf_static')
    entries = [row for row in drive() if row[0] in kept]
    path = write_rosbag2(tmp_path / 'a', entries)

    mapper = mapped(path, mount, poses=pose_file(tmp_path, format_), poses_format=format_)

    assert mapper.map.digest() == digest_of(range(6))


@pytest.mark.parametrize('format_', ['tum', 'kitti'])
def test_a_part_takes_the_poses_of_its_scans(tmp_path, bag, format_):
    file = pose_file(tmp_path, format_)

    mapper = mapped(bag, {'pose.source': 'tf'}, poses=file, start_s=0.15, every=2)

    assert mapper.map.digest() == digest_of([2, 4])


def test_between_the_poses_of_a_file_is_interpolated_and_beyond_nothing_is_mapped(tmp_path, bag):
    mapper = mapped(bag, poses=pose_file(tmp_path, 'tum', [1, 3]))

    assert mapper.map.digest() == digest_of([1, 2, 3])
    assert dict(mapper.counters.dropped) == {'no_pose': 3}


def test_poses_of_the_sensor_do_not_need_the_tree_of_the_bag(tmp_path, bag):
    sensor = poses()
    sensor[:, :3, 3] += MOUNT_M
    write_tum(tmp_path / 'poses.tum', STAMPS, sensor)

    mapper = mapped(bag, {'frames.base': 'lidar'}, poses=tmp_path / 'poses.tum')

    assert mapper.map.digest() == digest_of(range(6))
    assert dict(mapper.counters.messages_ignored) == {}


def test_fewer_poses_without_times_than_clouds_are_refused(tmp_path, bag):
    with pytest.raises(BagError, match=r'kitti: 5 poses, none for scan 6'):
        mapped(bag, poses=pose_file(tmp_path, 'kitti', range(5)))


@pytest.mark.parametrize('span', [{}, {'start_s': 0.15, 'every': 2}])
def test_more_poses_without_times_than_clouds_are_refused(tmp_path, bag, span):
    says = r'kitti: 7 poses without times for 6 clouds in .*, expected one for each'
    with pytest.raises(BagError, match=says):
        mapped(bag, poses=pose_file(tmp_path, 'kitti', range(7)), **span)


def test_a_bag_that_is_cut_off_takes_the_first_of_more_poses(tmp_path):
    bag = write_mcap(tmp_path / 'bag.mcap', drive())
    cut(bag, 0.7)

    mapper = mapped(bag, poses=pose_file(tmp_path, 'kitti'))

    number = mapper.counters.mapped
    assert 0 < number < 6
    assert mapper.map.digest() == digest_of(range(number))


def test_two_sources_of_poses_are_refused(tmp_path, bag):
    with pytest.raises(BagError, match='poses of /odom and of'):
        mapped(bag, poses=pose_file(tmp_path, 'tum'), pose_topic='/odom')


def test_an_invalid_file_of_poses_is_refused(tmp_path, bag):
    (tmp_path / 'poses').write_text('nothing')

    with pytest.raises(FileFormatError, match='poses: 1 columns in the first line'):
        mapped(bag, poses=tmp_path / 'poses')


def scan_folder(tmp_path, suffix, names=None):
    """Write the scans of the drive as files of their own."""
    folder = tmp_path / 'scans'
    folder.mkdir()
    for i, points in enumerate(clouds(drive())):
        columns = dict(zip('xyz', points.astype(np.float32).T, strict=True))
        path = folder / (f'scan{i}{suffix}' if names is None else f'{names[i]}{suffix}')
        if suffix == '.bin':
            table = np.column_stack([*columns.values(), np.zeros(len(points))])
            table.astype('<f4').tofile(path)
        else:
            (ply if suffix == '.ply' else pcd).write_points(path, columns)
    return folder


@pytest.mark.parametrize('suffix', ['.ply', '.pcd', '.bin'])
@pytest.mark.parametrize('format_', ['tum', 'kitti'])
def test_a_folder_of_scans_gives_the_map_of_the_bag(tmp_path, suffix, format_):
    folder = scan_folder(tmp_path, suffix)

    mapper = mapped(folder, MOUNTED, poses=pose_file(tmp_path, format_))

    assert mapper.map.digest() == digest_of(range(6))


def test_scans_in_the_fixed_frame_need_no_poses(tmp_path):
    folder = scan_folder(tmp_path, '.ply')

    mapper = mapped(folder, {'pose.source': 'identity'})

    expected = SurfelMap(Config().map.voxel_size_m)
    for points in clouds(drive()):
        expected.add(points)
    assert mapper.map.digest() == expected.digest()


def test_a_scan_that_does_not_read_is_counted(tmp_path):
    folder, file = scan_folder(tmp_path, '.ply'), pose_file(tmp_path, 'tum')
    cut(folder / 'scan3.ply', 0.5)

    mapper = mapped(folder, MOUNTED, poses=file)

    assert mapper.map.digest() == digest_of([0, 1, 2, 4, 5])
    assert dict(mapper.counters.dropped) == {'bad_cloud': 1}


@pytest.mark.parametrize(
    ('number', 'format_', 'request_', 'says'),
    [
        (6, None, {'poses_from': 'tf'}, 'no messages with poses'),
        (7, 'kitti', {}, '7 poses without times for 6 scans in .*scans, expected one for each, '),
        (5, 'kitti', {}, 'kitti: 5 poses, none for scan 6; expected one for every scan'),
        (5, 'kitti', {'start_s': 0.15}, 'kitti: 5 poses, none for scan 6'),
        (4, 'kitti', {'every': 2}, 'kitti: 4 poses, none for scan 5'),
        (5, 'tum', {}, '5 poses for 6 scans in .*scans, expected as many, or times of the scans'),
        (6, 'tum', {'topics': ('/points',)}, 'files of scans have no topic /points'),
        (6, 'tum', {'time_offsets': {'/points': 1.0}}, 'files of scans have no topic /points'),
    ],
)
def test_scans_whose_poses_are_not_known_are_refused(tmp_path, number, format_, request_, says):
    folder = scan_folder(tmp_path, '.ply')
    file = pose_file(tmp_path, format_, range(number)) if format_ else None

    with pytest.raises(BagError, match=says):
        mapped(folder, poses=file, **request_)
