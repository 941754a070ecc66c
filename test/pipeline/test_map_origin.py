# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""map.origin: poses in UTM or ECEF give, to the bit, the map of shifted poses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError, MapError
from surfel_mapper.files.map_state import load_map, save_map
from surfel_mapper.geometry import q_xyzw
from surfel_mapper.pipeline import Mapper
from surfel_mapper.pipeline.checkpoints import load_start
from surfel_mapper.scan import Scan
from test.alignment.street import drifted, street_scans
from test.fields import config_of

UTM = np.array([400_000.0, 5_400_000.0, 250.0])
ECEF = np.array([4_157_312.5, 664_128.25, 4_774_777.0])
PERIOD_NS = 100_000_000
MOUNT = (0.3, -0.1, 1.2, *Rotation.from_euler('xyz', [0.1, 0.2, 0.3]).as_quat())

SETTINGS = {
    'pose.source': 'odometry',
    'frames.fixed': 'utm',
    'frames.base_to_sensor': MOUNT,
    'pose.max_gap_s': 1.0,
}


def text_of(origin):
    return ' '.join(f'{value:.17g}' for value in origin)


def mapped(origin='', shift=(0.0, 0.0, 0.0), number=6, **settings):
    """Return a mapper that mapped scans between poses, all shifted by an exact amount."""
    mapper = Mapper(config_of({**SETTINGS, 'map.origin': origin, **settings}))
    drive(mapper, shift, number)
    return mapper


def drive(mapper, shift, number=6, start=0):
    rng = np.random.default_rng(7)
    for i in range(number + 1):
        # multiples of 2^-10 m, so that adding the shift is exact
        xyz = np.round(np.array([0.7 * i, -0.3 * i, 0.05 * i]) * 1024) / 1024 + shift
        q_xyzw = Rotation.from_euler('z', 0.03 * i).as_quat()
        mapper.add_pose('utm', 'base_link', start + i * PERIOD_NS, xyz, q_xyzw)
    for i in range(number):
        points = rng.uniform([-20, -20, -2], [20, 20, 3], (2000, 3)).astype(np.float32)
        stamp_ns = start + i * PERIOD_NS + PERIOD_NS // 3
        mapper.add_scan(Scan(points=points, stamp_ns=stamp_ns, frame_id='lidar'))
        list(mapper.insert_ready())
    assert mapper.counters.mapped >= number


@pytest.mark.parametrize('origin', [UTM, ECEF], ids=['utm', 'ecef'])
def test_the_digest_is_that_of_the_shifted_poses(origin):
    expected, found = mapped(), mapped(text_of(origin), origin)

    assert found.map.digest() == expected.map.digest()
    np.testing.assert_array_equal(found.map.origin_m, origin)
    last = list(found.window)[-1].T_map_sensor
    np.testing.assert_array_equal(last, list(expected.window)[-1].T_map_sensor)


@pytest.mark.parametrize('shift', [UTM, ECEF], ids=['utm', 'ecef'])
def test_auto_takes_the_first_pose_to_whole_blocks_of_voxels(shift):
    found = mapped('auto', shift)

    origin = found.map.origin_m
    assert (np.abs(origin - shift) <= 256.0).all()
    np.testing.assert_array_equal(origin % 512.0, 0.0)
    assert found.map.digest() == mapped('', shift - origin).map.digest()


def test_auto_is_no_origin_near_that_of_the_frame():
    found = mapped('auto', (100.0, -200.0, 0.0))

    np.testing.assert_array_equal(found.map.origin_m, np.zeros(3))
    assert found.map.digest() == mapped('', (100.0, -200.0, 0.0)).map.digest()


def test_poses_of_the_fixed_frame_in_another_are_shifted_too():
    # the tree is base_link -> utm, as some localisations publish it
    expected = mapped(number=1)
    for origin in (text_of(UTM), 'auto'):
        mapper = Mapper(config_of({**SETTINGS, 'map.origin': origin}))
        mapper.add_pose('earth', 'utm', 0, (5.0, 6.0, 7.0), (0, 0, 0, 1), static=True)
        drive(mapper, UTM, 1)
        place = mapper.T_map_of('earth', 0)[:3, 3]
        np.testing.assert_allclose(place + mapper.map.origin_m, [-5.0, -6.0, -7.0], atol=1e-9)
    assert mapped(text_of(UTM), UTM, number=1).map.digest() == expected.map.digest()


@pytest.mark.parametrize('origin', [text_of(ECEF), 'auto'])
def test_clouds_in_the_fixed_frame_are_moved_exactly(origin):
    rng = np.random.default_rng(3)
    points = np.round(rng.uniform(-30.0, 30.0, (4000, 3)) * 4096) / 4096
    maps = []
    for where, cloud in ((origin, points + ECEF), ('', None)):
        settings = {'pose.source': 'identity', 'map.origin': where, 'input.max_range_m': 0.0}
        mapper = Mapper(config_of(settings))
        cloud = points + ECEF - maps[0].origin_m if cloud is None else cloud
        mapper.add_scan(Scan(points=cloud, stamp_ns=1, frame_id='odom'))
        list(mapper.insert_ready())
        maps.append(mapper.map)
    assert maps[0].num_points == len(points)
    assert maps[0].digest() == maps[1].digest()


def test_the_map_has_a_frame_of_its_own():
    mapper = mapped(text_of(UTM), UTM)
    assert mapper.map_frame == 'utm_local'
    assert mapper.config.frames.fixed == 'utm'
    np.testing.assert_array_equal(mapper.T_map_fixed[:3, 3], -UTM)
    np.testing.assert_array_equal(mapper.T_map_of('utm', 0), mapper.T_map_fixed)
    assert mapped(text_of(UTM), UTM, **{'align.map_frame': 'site'}).map_frame == 'site'
    assert mapped().map_frame == 'utm'
    assert mapper.summary()['origin_m'] == UTM.tolist()


def test_an_alignment_corrects_in_the_map():
    scans, true = street_scans(30)
    poses = drifted(true[:4], 0.02, 0.2)
    poses[:, :3, 3] = np.round(poses[:, :3, 3] * 1024) / 1024
    settings = {'window.keep_points': True, 'align.key_distance_m': 0.0, 'frames.base': 'lidar'}
    mappers = []
    for shift in (np.zeros(3), UTM):
        mapper = Mapper(config_of({**SETTINGS, **settings, 'map.origin': text_of(shift)}))
        for scan, pose in zip(scans[:4], poses, strict=True):
            mapper.add_pose('utm', 'lidar', scan.stamp_ns, pose[:3, 3] + shift, q_xyzw(pose))
            mapper.add_scan(scan)
            list(mapper.insert_ready())
        assert mapper.align().num_moved > 0
        mappers.append(mapper)
    near, far = mappers

    assert near.map.digest() == far.map.digest()
    offset = np.array([1.0, 2.0, 3.0])
    place, moved = near.T_map_fixed @ [*offset, 1.0], far.T_map_fixed @ [*(UTM + offset), 1.0]
    np.testing.assert_allclose(moved, place, atol=1e-6)


@pytest.mark.parametrize(
    ('text', 'found'),
    [
        ('400000 5400000 0', (4e5, 5.4e6, 0.0)),
        ('[4e5, 5.4e6, -1.5]', (4e5, 5.4e6, -1.5)),
        ('auto', ()),
        ('', ()),
    ],
)
def test_origins_are_read(text, found):
    assert Config.from_mapping({'map.origin': text}).map.origin_m == found


@pytest.mark.parametrize('text', ['1 2', '1 2 x', 'nan 0 0', '0 0 2e9', 'Auto'])
def test_bad_origins_are_refused_by_name(text):
    with pytest.raises(ConfigError, match=r"map\.origin: .*such as '400000 5400000 0'"):
        Config.from_mapping({'map.origin': text})


def test_an_origin_with_poses_by_registration_is_refused():
    with pytest.raises(ConfigError, match=r'map\.origin: .* with pose\.source registration'):
        Mapper(config_of({'map.origin': '1 2 3', 'pose.source': 'registration'}))


def test_a_scan_beyond_the_map_is_dropped_with_the_setting_that_helps(caplog):
    with pytest.raises(AssertionError):
        mapped('', UTM, 1)
    assert 'map.origin: auto' in caplog.text


def test_a_loaded_map_gives_its_origin_and_goes_on(tmp_path):
    mapper = mapped(text_of(UTM), UTM)
    digest = save_map(tmp_path / 'map.npz', mapper.map)
    load = {'map.load': str(tmp_path / 'map.npz')}
    for origin in ('auto', text_of(UTM)):
        again = Mapper(config_of({**SETTINGS, 'map.origin': origin, **load}))
        load_start(again)
        assert again.map == mapper.map
        assert again.map.digest() == digest
        drive(again, UTM, 2, 10 * PERIOD_NS)
        assert again.map.num_points > mapper.map.num_points
        assert load_map(tmp_path / 'map.npz')[0].origin_m.tolist() == UTM.tolist()
    for origin, reason in (
        ('', 'map.origin: auto and this map'),
        ('0 0 8', "'400000 5400000 250'"),
    ):
        again = Mapper(config_of({**SETTINGS, 'map.origin': origin, **load}))
        with pytest.raises(MapError, match=reason):
            load_start(again)
        assert again.map.num_voxels == 0
