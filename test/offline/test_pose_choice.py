# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording without poses is registered; one with poses is mapped by them, without settings."""

import json
from pathlib import Path

import numpy as np
import pytest

from surfel_mapper import Config
from surfel_mapper.cli.main import main
from surfel_mapper.errors import BagError
from surfel_mapper.files import pcd
from surfel_mapper.files.trajectory import read_trajectory
from surfel_mapper.offline.pose_choice import why_not_deskewed
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.request import Request
from surfel_mapper.scan import Scan
from surfel_mapper.simulation import Lidar, Simulation, World
from test.bags.recorded import (
    CLOUD,
    drive,
    Entries,
    MOUNT_M,
    ODOMETRY,
    PERIOD_NS,
    POSE,
    START_NS,
    TF,
    write_rosbag2,
)

pytestmark = pytest.mark.usefixtures('undrawn')

STAMPED = 'geometry_msgs/msg/TransformStamped'

MOUNTED = {'frames.base_to_sensor': (*MOUNT_M, 0.0, 0.0, 0.0, 1.0)}


def chosen(path, config=None, **request):
    """Return the settings that differ from the default, and the reason."""
    default = Config().to_mapping()
    given = Config.from_mapping(config or {})
    with open_recording(Request(path=path, **request), given) as recording:
        settings, found = recording.config.to_mapping(), recording.describe()
    return {k: v for k, v in settings.items() if v != default[k]}, found['poses_reason']


def plain(settings):
    """Return settings with tuples for lists."""
    return {k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()}


def bag_of(tmp_path, *kept, entries=None):
    """Write the messages of a drive whose topic or type is among some."""
    rows = [row for row in entries or drive() if row[0] in kept or row[1] in kept]
    return write_rosbag2(tmp_path / 'bag', rows)


@pytest.mark.parametrize(
    ('kept', 'expected', 'says'),
    [
        ((CLOUD, TF, ODOMETRY, POSE), {'pose.source': 'tf'}, '/tf has them'),
        ((CLOUD, TF), {'pose.source': 'tf'}, '/tf has them'),
        (
            (CLOUD, ODOMETRY, POSE, '/tf_static'),
            {'pose.source': 'odometry', **MOUNTED},
            '/odom has them (frames.base_to_sensor: [0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0]); not '
            'from tf: /tf_static: none of them moves',
        ),
        (
            (CLOUD, POSE, '/tf_static'),
            {'pose.source': 'pose', **MOUNTED},
            'not from odometry: no topic',
        ),
        ((CLOUD,), {'pose.source': 'registration'}, 'the recording has no poses'),
        ((CLOUD, '/tf_static'), {'pose.source': 'registration'}, 'no topic gives the poses'),
        ((CLOUD, ODOMETRY), {'pose.source': 'registration'}, 'no place of lidar in base_link'),
    ],
)
def test_the_first_source_that_covers_the_clouds_is_taken(tmp_path, kept, expected, says):
    settings, reason = chosen(bag_of(tmp_path, *kept))

    assert plain(settings) == expected
    assert says in reason


def test_poses_of_types_that_are_not_read_are_named(tmp_path):
    entries = drive()
    entries += [
        ('/vicon', STAMPED, stamp_ns, message.transforms[0])
        for topic, _, stamp_ns, message in entries
        if topic == '/tf'
    ]

    _, reason = chosen(bag_of(tmp_path, CLOUD, '/tf_static', STAMPED, entries=entries))

    assert reason.endswith(f'not read: /vicon ({STAMPED})')


@pytest.mark.parametrize(
    ('source', 'times', 'says'),
    [
        ('tf', (0.0, 0.1), 'points have times (timestamp), which deskew.enabled: true uses'),
        ('tf', (0.0, 0.0), 'all points have one time'),
        ('tf', (614.0, 614.1), 'field timestamp: times from 614.0 to 614.1'),
        ('identity', (614.0, 614.1), ''),  # points at rest
    ],
)
def test_times_that_cannot_be_used_are_not_recommended(source, times, says):
    scan = Scan(
        points=np.ones((2, 3)),
        stamp_ns=START_NS,
        frame_id='',
        columns={'timestamp': np.array(times)},
    )

    reason = why_not_deskewed(Config.from_mapping({'pose.source': source}), [scan])

    assert reason.startswith(says) if says else reason == ''


def test_times_in_two_fields_are_named():
    columns = {'sec': np.array([1, 1]), 'usec': np.array([0, 10**5])}
    scan = Scan(points=np.ones((2, 3)), stamp_ns=START_NS, frame_id='', columns=columns)

    reason = why_not_deskewed(Config.from_mapping({'pose.source': 'tf'}), [scan])

    assert reason.startswith('no field t or time or timestamp')
    assert 'among sec, usec' in reason


def test_a_tree_with_another_root_is_taken_with_its_root(tmp_path):
    entries = drive()
    for topic, _, _, message in entries:
        if topic == '/tf':
            message.transforms[0].header.frame_id = 'world'

    settings, reason = chosen(bag_of(tmp_path, CLOUD, TF, entries=entries))

    assert settings == {'pose.source': 'tf', 'frames.fixed': 'world'}
    assert reason == '/tf has them (frames.fixed: world)'


def test_settings_of_the_user_are_kept(tmp_path):
    bag = bag_of(tmp_path, CLOUD, TF, ODOMETRY)
    mapped_in = {'pose.source': 'tf', 'frames.fixed': 'map'}
    assert chosen(bag, mapped_in) == (mapped_in, '')
    assert chosen(bag, {'pose.source': 'tf'}) == ({'pose.source': 'tf'}, '')
    assert chosen(bag, {'pose.source': 'pose'}, poses_from='auto') == chosen(bag)
    assert chosen(bag, {'pose.source': 'identity'}) == ({'pose.source': 'identity'}, '')
    assert chosen(bag, poses_from='identity') == ({'pose.source': 'identity'}, '')
    assert chosen(bag, poses_from='registration') == ({'pose.source': 'registration'}, '')
    assert chosen(bag, poses_from='odometry')[0]['pose.source'] == 'odometry'


def test_the_topic_of_the_poses_decides_their_source(tmp_path):
    bag = bag_of(tmp_path, CLOUD, TF, ODOMETRY)
    settings, reason = chosen(bag, pose_topic='/odom')
    assert settings == {'pose.source': 'odometry'}
    assert reason == '/odom has them'  # not that there is no /tf
    with pytest.raises(BagError, match='no poses on /odom; the bag offers no poses at all'):
        chosen(bag_of(tmp_path / 'clouds', CLOUD), pose_topic='/odom')


def test_contradicting_sources_are_refused(tmp_path):
    bag = bag_of(tmp_path, CLOUD, TF)
    with pytest.raises(BagError, match='expected the file with --poses'):
        chosen(bag, poses_from='file')
    with pytest.raises(BagError, match='expected one of them'):
        chosen(bag, poses_from='tf', poses=write_poses(tmp_path))
    with pytest.raises(BagError, match='no topic is of type'):
        chosen(bag, poses_from='odometry')


def write_poses(tmp_path):
    path = tmp_path / 'poses.tum'
    path.write_text('1.0 0 0 0 0 0 0 1\n')
    return path


def write_scans(folder, times_s=None, num_scans=3):
    folder.mkdir()
    points = np.random.default_rng(1).uniform(-5.0, 5.0, (100, 3)).astype(np.float32)
    columns = dict(zip('xyz', points.T, strict=True))
    if times_s is not None:
        columns['time'] = np.float32(times_s)
    for number in range(num_scans):
        pcd.write_points(folder / f'{number:010}.pcd', columns)
    return folder


def test_a_single_scan_with_times_is_mapped_as_at_rest(tmp_path, capsys):
    folder = write_scans(tmp_path / 'swept', np.linspace(0.0, 0.1, 100), num_scans=1)
    assert main(['info', str(folder)]) == 0
    assert 'scans in files, 1 scan, 0.0 s' in capsys.readouterr().out
    assert main(['replay', str(folder), '--output', str(tmp_path / 'out')]) == 4
    assert 'the map has no surfels' in capsys.readouterr().err  # its points are random
    summary = json.loads((tmp_path / 'out' / 'summary.json').read_text())
    assert (summary['scans']['mapped'], summary['points'], summary['deskewed']) == (1, 100, True)


@pytest.mark.parametrize('verb', ['info', 'replay'])
def test_surfels_of_a_map_are_not_taken_for_a_scan(tmp_path, capsys, verb):
    folder = write_scans(tmp_path / 'still')
    assert main(['replay', str(folder), '--output', str(tmp_path / 'out')]) == 4
    file = tmp_path / 'out' / 'map.ply'
    for path in (file.parent, file):
        assert main([verb, str(path)]) == 1
        assert f'{file}: surfels of a map, expected scans' in capsys.readouterr().err


def test_scans_with_times_of_their_points_are_deskewed(tmp_path):
    still = write_scans(tmp_path / 'still')
    equal = write_scans(tmp_path / 'equal', np.zeros(100))
    swept = write_scans(tmp_path / 'swept', np.linspace(0.0, 0.1, 100))

    found = [chosen(folder)[0] for folder in (still, equal, swept)]

    registered = {'pose.source': 'registration'}
    assert found == [registered, registered, {**registered, 'deskew.enabled': True}]


def test_a_folder_has_no_messages_with_poses(tmp_path):
    folder = write_scans(tmp_path / 'scans')
    with pytest.raises(BagError, match='--poses-from registration or identity'):
        chosen(folder, poses_from='tf')
    assert chosen(folder, poses_from='identity') == ({'pose.source': 'identity'}, '')


@pytest.fixture(scope='module')
def street():
    """Return eight scans of a street and the positions of the sensor from the first one on."""
    simulation = Simulation(
        World.street(length_m=60.0), Lidar(beams=32, columns=1024), num_scans=8
    )
    poses = [simulation.drive.T_odom_sensor(scan.stamp_ns) for scan in simulation.scans()]
    first = np.linalg.inv(poses[0])
    return list(simulation.scans()), np.array([(first @ pose)[:3, 3] for pose in poses])


@pytest.mark.parametrize('kind', ['bag', 'folder'])
def test_scans_without_poses_are_registered(street, tmp_path, capsys, kind):
    scans, expected = street
    if kind == 'bag':
        entries = Entries()
        for number, scan in enumerate(scans):
            entries.cloud('/points', START_NS + number * PERIOD_NS, scan.points)
        path = write_rosbag2(tmp_path / 'bag', entries)
    else:
        path = tmp_path / 'scans'
        path.mkdir()
        for number, scan in enumerate(scans):
            points = dict(zip('xyz', scan.points.T, strict=True))
            pcd.write_points(path / f'{number:010}.pcd', points)
    output = tmp_path / 'out'
    poses = ['--poses-out', str(tmp_path / 'poses.tum')]

    assert main(['replay', str(path), '--output', str(output), *poses]) == 0

    first_line = capsys.readouterr().out.splitlines()[0]
    assert first_line.startswith('poses from registration: ')
    summary = json.loads((output / 'summary.json').read_text())
    assert summary['poses_from'] == 'registration'
    assert summary['scans']['mapped'] == len(scans)
    found = read_trajectory(tmp_path / 'poses.tum').xyz
    assert np.abs(found - expected).max() < 0.02  # 3.5 m travelled, ranges without noise


def test_info_of_a_folder_states_scans_and_choice(tmp_path, capsys):
    folder = write_scans(tmp_path / 'scans', np.linspace(0.0, 0.1, 100))
    expected = {'poses_from': 'registration', 'deskewed': True}

    assert main(['info', str(folder), '--json']) == 0
    content = json.loads(capsys.readouterr().out)
    assert (content['scans'], content['points'], content['columns']) == (3, 100, ['time'])
    assert expected.items() <= content['replay'].items()

    for path, number in ((folder, 3), (folder / '0000000001.pcd', 1)):
        assert main(['info', str(path)]) == 0
        printed = capsys.readouterr().out
        assert f'scans in files, {number} scan' in printed
        assert 'replay takes poses from registration, deskewed' in printed


def test_las_and_laz_files_are_scans(tmp_path, capsys):
    laspy = pytest.importorskip('laspy', reason='laspy is not installed (extra las)')
    points = np.random.default_rng(2).uniform(
        [5e5, 4e6, 0.0], [500020.0, 4000020.0, 0.1], (500, 3)
    )
    header = laspy.LasHeader(point_format=3, version='1.2')
    header.offsets, header.scales = [5e5, 4e6, 0.0], [0.001] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.intensity = np.arange(500)
    las.red = las.green = las.blue = np.full(500, 255 << 8)
    folder = tmp_path / 'scans'
    folder.mkdir()
    for name in ('0.las', '1.laz'):
        las.write(folder / name)
        assert main(['info', str(folder / name), '--json']) == 0
        content = json.loads(capsys.readouterr().out)
        assert {'intensity', 'rgb', 'timestamp', 'classification'} <= {*content['columns']}
    with open_recording(Request(path=folder, poses_from='identity'), Config()) as recording:
        scan = recording.first_scan()
    np.testing.assert_allclose(scan.points, points, atol=6e-4)
    assert scan.columns['rgb'].max() == scan.columns['rgb'].min() == 255

    (tmp_path / 'bad.laz').write_bytes(b'LASF' + bytes(500))
    assert main(['replay', str(tmp_path / 'bad.laz'), '--output', str(tmp_path / 'out')]) == 1
    assert not Path(tmp_path / 'out').exists()
