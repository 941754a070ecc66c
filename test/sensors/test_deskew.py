# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Times of points however drivers write them, and points moved to one place and time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from surfel_mapper.config import Config
from surfel_mapper.errors import CloudFormatError, ConfigError
from surfel_mapper.geometry import compose, inverse, pose_matrix, se3_exp
from surfel_mapper.pipeline import Mapper
from surfel_mapper.poses import TransformBuffer
from surfel_mapper.scan import PointTimes, Scan
from surfel_mapper.sensors.deskew import (
    deskewed,
    MAX_TURN_RAD,
    point_times,
    UNTIMED,
)
from surfel_mapper.sensors.kernels.deskew import move_points
from surfel_mapper.sensors.time_fields import times_field
from surfel_mapper.simulation import Lidar, Simulation, World
from test.kernels.modes import both

START_NS = 1_700_000_000_123_456_789
MS = 10**6


def sweep(times, name='t', stamp_ns=START_NS, points=None):
    points = np.ones((len(times), 3), np.float32) if points is None else points
    return Scan(points=points, stamp_ns=stamp_ns, frame_id='lidar', columns={name: times})


OFFSETS_MS = np.array([0, 25, 99])
OFFSETS_NS = OFFSETS_MS * MS
EPOCH_S = START_NS / 1e9 + OFFSETS_MS / 1e3


@pytest.mark.parametrize(
    ('times', 'settings', 'tolerance_ns'),
    [
        (OFFSETS_NS.astype(np.uint32), {}, 0),
        (OFFSETS_NS.astype(np.float32), {}, 8),  # of 8 ns is a step of float32 at 1e8
        ((OFFSETS_MS / 1e3).astype(np.float32), {}, 8),
        (EPOCH_S, {}, 240),  # of 238 ns is a step of float64 at 1.7e9 s
        ((START_NS + OFFSETS_NS).astype(np.uint64), {}, 0),
        ((START_NS + OFFSETS_NS).astype(np.float64), {}, 256),
        ((OFFSETS_MS * 1000).astype(np.uint32), {'unit': 'us'}, 0),
        (OFFSETS_MS.astype(np.uint16), {'unit': 'ms'}, 0),
        ((OFFSETS_MS * 1000).astype(np.uint32), {}, 0),
        (OFFSETS_MS.astype(np.uint16), {}, 0),
        (START_NS // 1000 + OFFSETS_MS * 1000, {}, 1000),
        (OFFSETS_NS + START_NS + 37 * 10**9, {'reference': 'first'}, 0),
        (EPOCH_S, {'unit': 's', 'reference': 'epoch'}, 240),
    ],
)
def test_times_are_understood_as_drivers_write_them(times, settings, tolerance_ns):
    found = point_times(sweep(times), **settings)
    np.testing.assert_allclose(found.offsets, OFFSETS_NS, atol=tolerance_ns, rtol=0)
    assert found.first_ns == START_NS + found.offsets[0]
    assert found.last_ns == START_NS + found.offsets[-1]


def test_times_before_the_stamp_are_negative_where_the_stamp_is_that_of_the_end():
    found = point_times(sweep(np.float32([-0.1, -0.05, 0.0]), 'time'))
    np.testing.assert_allclose(found.offsets, [-100 * MS, -50 * MS, 0], atol=8)
    assert found.last_ns == START_NS


def test_negative_times_that_wrapped_are_negative():
    times = np.array([2**32 - 300, 0, 99 * MS], np.uint32)
    found = point_times(sweep(times))
    assert found.offsets.tolist() == [-300, 0, 99 * MS]
    assert (found.first_ns, found.last_ns) == (START_NS - 300, START_NS + 99 * MS)


@pytest.mark.parametrize('dtype', ['>f4', '>f8', '>u4', 'f2', 'g', 'i1', 'u2', 'i8', 'u8'])
def test_times_of_any_type_and_byte_order_are_read(dtype):
    found = point_times(sweep(np.array([7, 5, 100], dtype)), unit='ns', reference='stamp')
    assert found.offsets.tolist() == [7, 5, 100]
    assert (found.first_ns, found.last_ns) == (START_NS + 5, START_NS + 100)


def test_near_time_zero_the_reference_nearer_to_the_stamp_is_used():
    stamp_ns = 1500 * MS
    since_start = point_times(sweep(np.array([1.5, 1.55]), 'timestamp', stamp_ns))
    since_stamp = point_times(sweep(np.array([0.0, 0.05]), 'timestamp', stamp_ns))
    assert since_start.offsets.tolist() == since_stamp.offsets.tolist() == [0, 50 * MS]


NAMES = ['t', 'time', 'timestamp', 'offset_time', 'time_stamp', 'timeStamp', 'times', 'ts']
NAMES += ['offset_ns', 't_offset']
NAMES += ['time_offset_ns', 'point_time_offset', 'relative_timestamp', 'when']


@pytest.mark.parametrize('name', NAMES)
def test_the_field_is_recognised_by_its_name_or_named(name):
    times = np.array([0, 50 * MS], np.uint32)
    field = 'when' if name == 'when' else ''
    assert point_times(sweep(times, name), field).offsets.tolist() == [0, 50 * MS]


@pytest.mark.parametrize(('unit', 'ns'), [('us', 10**3), ('usec', 10**3), ('ms', MS)])
def test_the_end_of_a_name_is_the_unit(unit, ns):
    assert point_times(sweep(np.array([0, 3]), f'dt_{unit}')).offsets.tolist() == [0, 3 * ns]


@pytest.mark.parametrize('columns', [['ring'], ['sec', 'usec'], ['intensity', 'second']])
def test_no_field_is_guessed_among_several_or_none(columns):
    assert times_field(columns) == ''


@pytest.mark.parametrize('name', ['sec', 'lidar_sec'])
@pytest.mark.parametrize('first_ns', [START_NS, START_NS // 10**9 * 10**9 - MS])
def test_seconds_and_nanoseconds_in_two_fields_are_one_time(name, first_ns):
    times = first_ns + OFFSETS_NS
    columns = {name: (times // 10**9).astype(np.uint32), 'ring': np.zeros(3)}
    columns[name.replace('sec', 'nsec')] = (times % 10**9).astype(np.uint32)
    scan = Scan(points=np.ones((3, 3)), stamp_ns=START_NS, frame_id='lidar', columns=columns)
    assert point_times(scan).offsets.tolist() == (times - START_NS).tolist()


@pytest.mark.parametrize('ends', [(0.0, 1.0), (0.0, 0.9994), (-1.0, 0.0), (-0.5, 0.5), (0.1, 0.9)])
@pytest.mark.parametrize('dtype', [np.float32, np.float64])
def test_fractions_of_a_scan_are_not_believed_as_seconds(ends, dtype):
    scan = sweep(np.linspace(*ends, 5, dtype=dtype))
    with pytest.raises(CloudFormatError, match=r'may be fractions of a scan.* deskew\.unit: s'):
        point_times(scan)
    seconds = point_times(scan, unit='s')
    assert abs(seconds.last_ns - seconds.first_ns - (ends[1] - ends[0]) * 1e9) < 100


def test_a_second_of_stamps_is_no_fraction():
    times = point_times(sweep(START_NS / 1e9 + np.linspace(0.0, 1.0, 5)))
    assert abs(times.last_ns - times.first_ns - 10**9) < 500


def test_invalid_points_do_not_affect_the_times():
    times = np.array([1e300, EPOCH_S[0], np.nan, 0.0, EPOCH_S[1], np.inf])
    points = np.ones((6, 3), np.float32)
    points[0], points[3] = np.nan, 0.0
    found = point_times(sweep(times, points=points))
    assert abs(found.first_ns - START_NS) < 240
    assert abs(found.last_ns - START_NS - 25 * MS) < 240
    assert np.flatnonzero(found.offsets == UNTIMED).tolist() == [2, 5]
    nothing = point_times(sweep(times, points=np.zeros((6, 3), np.float32)))
    assert (nothing.first_ns, nothing.last_ns) == (START_NS, START_NS)


@pytest.mark.parametrize(
    ('scan', 'settings', 'message'),
    [
        (sweep(np.zeros(2), 'ring'), {}, 'no field t or .* or time_stamp among'),
        (sweep(np.zeros(2)), {'field': 'when'}, 'no field when among t'),
        (sweep(np.zeros((2, 3))), {}, 'field t: 3 values a point'),
        (sweep(np.array([0.0, 5.0])), {'unit': 's'}, 'times from 0.0 to 5.0 .* 1.5 s from'),
        (sweep(np.full(2, 2**63 + 1, np.uint64)), {}, 'deskew.unit auto'),
        (sweep(OFFSETS_MS / 1e3), {'reference': 'epoch'}, 'deskew.reference epoch'),
        (sweep(37.0 + OFFSETS_MS / 1e3), {}, '37.099 .* deskew.reference first takes'),
        (sweep(EPOCH_S + 37.0), {}, 'deskew.reference first takes'),
        (sweep(np.full(2, 2**64 - 1, np.uint64)), {}, 'times from 9223372036854775807'),
        (sweep(np.full(2, np.nan)), {}, 'field t: no finite time of 2 valid points'),
        (sweep(np.array(['a', 'b'])), {}, 'field t: <U1, expected numbers'),
    ],
)
def test_implausible_times_are_refused(scan, settings, message):
    with pytest.raises(CloudFormatError, match=message):
        point_times(scan, **settings)


@pytest.mark.parametrize('dtype', [np.int64, np.float64])
def test_times_of_points_without_one_are_those_of_the_first_that_has_one(dtype):
    rng = np.random.default_rng(6)
    points = rng.normal(size=(40, 3)).astype(np.float32)
    times = rng.integers(0, 10**8, 40).astype(dtype)
    invalid = np.zeros(40, np.bool_)
    invalid[[0, 1, 7, 30]] = True
    points[0, 0], points[1, 1], points[7], points[30, 2] = np.nan, np.inf, 0.0, -np.inf
    expected = np.where(invalid, times[2], times)
    if dtype == np.float64:
        times[[5, 9]] = np.nan, -np.inf
        expected[[5, 9]] = UNTIMED
    found = point_times(sweep(times, points=points), unit='ns', reference='stamp')
    assert found.offsets.tolist() == expected.tolist()
    timed = expected[expected != UNTIMED]
    assert (found.first_ns - START_NS, found.last_ns - START_NS) == (timed.min(), timed.max())


def test_times_are_rounded_to_nanoseconds_a_half_to_the_even_one():
    found = point_times(sweep(np.array([0.0, 0.0005, 0.0015, 0.0025, 1e5])), unit='us')
    assert found.offsets.tolist() == [0, 0, 2, 2, 10**8]


def test_points_without_a_time_are_left_out():
    scan = sweep(np.array([0.0, np.nan, 0.1, np.inf]))
    still = deskewed(scan.with_times(point_times(scan)), lambda _: np.eye(4)).points
    assert np.isnan(still).all(axis=1).tolist() == [False, True, False, True]
    np.testing.assert_array_equal(still[[0, 2]], scan.points[[0, 2]])


@pytest.mark.parametrize('name', ['unit', 'reference'])
def test_unknown_units_and_references_are_refused(name):
    with pytest.raises(ValueError, match=f"{name}: 'h', expected one of auto, "):
        point_times(sweep(np.arange(2.0)), **{name: 'h'})


def moving(rate_hz, turn_rad_s=(0.3, -0.4, 0.9), speed_m_s=(12.0, 1.0, -0.5)):
    """Return a buffer of poses of a base that moves, and its lidar a metre off."""
    buffer = TransformBuffer()
    buffer.add_static('base', 'lidar', pose_matrix([1.0, 0.2, 1.5], [0.0, 0.6, 0.0, 0.8]))
    stamps = [START_NS + round(k * 1e9 / rate_hz) for k in range(-rate_hz, rate_hz)]
    for stamp_ns in stamps:
        t = (stamp_ns - START_NS) / 1e9
        buffer.add('odom', 'base', stamp_ns, se3_exp(np.array([*speed_m_s, *turn_rad_s]) * t))
    return buffer


def pose_at(buffer):
    return lambda stamp_ns: buffer.lookup('odom', 'lidar', stamp_ns)


def with_times(points, offsets, dtype=np.float32):
    times = PointTimes(offsets, START_NS + int(offsets.min()), START_NS + int(offsets.max()))
    return Scan(points=points.astype(dtype), stamp_ns=START_NS, frame_id='lidar', times=times)


@pytest.mark.parametrize('dtype', [np.float32, np.float64])
@pytest.mark.parametrize(
    ('rate_hz', 'span_ms'), [(10, (0, 100)), (50, (-100, 0)), (200, (-30, 70))]
)
def test_every_point_gets_the_pose_at_its_own_time(rate_hz, span_ms, dtype):
    rng = np.random.default_rng(rate_hz)
    buffer = moving(rate_hz)
    scan = with_times(
        rng.normal(scale=20.0, size=(300, 3)), rng.integers(*span_ms, 300) * MS, dtype
    )
    times = scan.times
    stamps = buffer.stamps('odom', 'lidar', times.first_ns, times.last_ns)

    found = deskewed(scan, pose_at(buffer), stamps)

    to_stamp = inverse(pose_at(buffer)(START_NS))
    for point, offset, moved in zip(scan.points, times.offsets, found.points, strict=True):
        T = compose(to_stamp, pose_at(buffer)(START_NS + int(offset)))
        expected = T[:3, :3] @ point.astype(np.float64) + T[:3, 3]
        # the lever of 1.8 m turns by 0.005 rad between poses: 1.8 * 0.005^2 / 8 off its arc
        np.testing.assert_allclose(moved, expected, atol=6e-6)
    assert (found.stamp_ns, found.times) == (START_NS, None)
    assert np.abs(found.points - scan.points).max() > 0.3


def test_without_motion_no_point_moves():
    buffer, pose = TransformBuffer(), pose_matrix([5.0, 6.0, 7.0], [0.0, 0.6, 0.0, 0.8])
    for offset in (0, 100 * MS):
        buffer.add('odom', 'lidar', START_NS + offset, pose)
    points = np.random.default_rng(1).normal(size=(50, 3))
    scan = with_times(points, np.arange(50) * MS, np.float64)
    found = deskewed(scan, pose_at(buffer))
    np.testing.assert_allclose(found.points, points, atol=1e-14)


def test_points_without_a_return_or_too_near_are_not_moved():
    points = np.array([[0, 0, 0], [0.05, 0, 0], [np.nan, 1, 1], [1, 1, np.inf], [3, 0, 0]])
    scan = with_times(points, np.full(5, 90 * MS))
    found = deskewed(scan, pose_at(moving(10)), min_range_m=0.1).points
    np.testing.assert_array_equal(found[:2], np.zeros((2, 3)))
    assert not np.isfinite(found[2:4]).all(axis=1).any()
    assert np.abs(found[4] - points[4]).max() > 1.0


def test_between_poses_far_apart_more_are_looked_up():
    asked = []

    def turning(stamp_ns):
        asked.append(stamp_ns)
        half = 0.5 * (stamp_ns - START_NS) / 1e9  # 1 rad/s
        return pose_matrix([0, 0, 0], [0, 0, np.sin(half), np.cos(half)])

    deskewed(with_times(np.ones((2, 3)), np.array([0, 100 * MS])), turning)
    assert len(set(asked)) >= 0.1 / MAX_TURN_RAD
    assert np.diff(sorted(set(asked))).max() <= MAX_TURN_RAD * 1e9


@both
@pytest.mark.parametrize('in_order', [True, False])
def test_the_kernel_moves_runs_and_single_points_as_scipy_does(call, in_order):
    rng = np.random.default_rng(4)
    knots = np.array([-90, -50, -20, 0]) * MS
    attitudes = Rotation.from_rotvec(np.cumsum(rng.normal(0.0, 0.002, (4, 3)), axis=0))
    shifts = rng.normal(size=(4, 3))
    poses = np.concatenate([attitudes.as_matrix(), shifts[:, :, None]], axis=2)
    turns = np.zeros((4, 3))
    turns[:3] = (attitudes[:-1].inv() * attitudes[1:]).as_quat()[:, :3]
    offsets = rng.integers(-99 * MS, 9 * MS, 2500)
    offsets = np.sort(offsets) if in_order else offsets
    points = rng.normal(scale=20.0, size=(3, 2500))
    points[:, ::7], points[:, 3] = 0.0, np.nan
    moved = np.empty((3, 2500))
    call(move_points, points, offsets, knots, poses, turns, 4.0, moved)
    within = np.clip(offsets, knots[0], knots[-1])
    expected = Slerp(knots, attitudes)(within).apply(points.T)
    expected += np.stack([np.interp(within, knots, shift) for shift in shifts.T], axis=1)
    expected[np.linalg.norm(points, axis=0) < 2.0] = 0.0
    np.testing.assert_allclose(moved.T, expected, atol=1e-12)


SETTINGS = {'pose.source': 'odometry', 'frames.fixed': 'odom', 'map.min_points': 5}


def add_pose(mapper, simulation, stamp_ns):
    mapper.add_pose('odom', 'base_link', stamp_ns, *simulation.drive.pose(stamp_ns))


def mapped(simulation, **settings):
    """Return a mapper that has mapped a simulation, its poses known every 5 ms."""
    mount = simulation.drive.base_to_sensor
    mapper = Mapper(Config.from_mapping({**SETTINGS, 'frames.base_to_sensor': mount, **settings}))
    start = simulation.stamp_ns(0)
    for stamp_ns in range(start, start + (simulation.num_scans + 1) * 100 * MS, 5 * MS):
        add_pose(mapper, simulation, stamp_ns)
    for scan in simulation.scans():
        mapper.add_scan(scan)
        list(mapper.insert_ready())
    assert mapper.counters.mapped == simulation.num_scans
    return mapper


def errors_deg(mapper, simulation):
    """Return the angles between normals of planar voxels and those of the nearest surface."""
    surfels = mapper.map.surfels(20)
    surfels = surfels.select((surfels.planarity > 0.3) & (surfels.curvature < 1e-4))
    true = simulation.world.normal_at(surfels.position)
    sine = np.linalg.norm(np.cross(surfels.normal, true), axis=1)
    return np.degrees(np.arcsin(np.minimum(sine, 1.0)))


def test_a_deskewed_rolling_lidar_maps_like_an_instantaneous_one():
    lidar = Lidar(beams=32, columns=512)
    world = World.street(seed=0, length_m=40.0)
    rolling = Simulation(world, lidar, num_scans=4, rolling=True)
    skewed = errors_deg(mapped(rolling), rolling)
    straight = mapped(rolling, **{'deskew.enabled': True})
    assert np.percentile(skewed, 95) > 0.5
    assert np.percentile(errors_deg(straight, rolling), 95) < 0.002
    assert len(errors_deg(straight, rolling)) > 2 * len(skewed)  # planes are flat again
    assert straight.counters.milliseconds['deskew']


def test_a_scan_waits_for_the_pose_of_its_last_point():
    simulation = Simulation(
        World.street(seed=0, length_m=40.0), Lidar(beams=4, columns=64), num_scans=1, rolling=True
    )
    mount = simulation.drive.base_to_sensor
    mapper = Mapper(
        Config.from_mapping({**SETTINGS, 'frames.base_to_sensor': mount, 'deskew.enabled': True})
    )
    stamp_ns = simulation.stamp_ns(0)
    mapper.add_scan(simulation.scan(0))
    for offset in (0, 50 * MS):
        add_pose(mapper, simulation, stamp_ns + offset)
        assert list(mapper.insert_ready()) == []
    add_pose(mapper, simulation, stamp_ns + 100 * MS)
    assert len(list(mapper.insert_ready())) == 1


def test_scans_without_times_are_dropped_and_counted():
    mapper = Mapper(Config.from_mapping({**SETTINGS, 'deskew.enabled': True}))
    mapper.add_scan(Scan(points=np.ones((5, 3)), stamp_ns=START_NS, frame_id='lidar'))
    assert mapper.counters.dropped == {'no_times': 1}


def test_clouds_in_the_fixed_frame_cannot_be_deskewed():
    with pytest.raises(ConfigError, match=r'deskew\.enabled: true, but .*identity'):
        Config.from_mapping({'pose.source': 'identity', 'deskew.enabled': True})
