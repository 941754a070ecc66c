# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Drive and simulation: poses and stamps, and scans that depend on nothing else."""

import numpy as np
import pytest

from surfel_mapper.errors import ConfigError
from surfel_mapper.geometry import compose, inverse, rotation_angle
from surfel_mapper.simulation import Drive, Lidar, Simulation, World
from surfel_mapper.simulation.drive import START_NS

LEVEL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
TINY = Lidar(beams=8, columns=64)


@pytest.fixture(scope='module')
def street():
    return World.street(seed=0, length_m=30.0)


def test_the_vehicle_goes_along_the_road_at_its_speed_with_gentle_curves():
    drive = Drive(start=LEVEL, speed_m_s=5.0)
    places = np.array([drive.pose(START_NS + k * 10**8)[0] for k in range(600)])
    np.testing.assert_allclose(places[:, 0], 0.5 * np.arange(600), atol=1e-9)
    assert 1.0 < np.abs(places[:, 1]).max() < 1.6
    assert np.abs(places[:, 2]).max() < 0.04
    way = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    assert 1.0 < way / 299.5 < 1.02
    turns = [rotation_angle(drive.T_odom_base(START_NS + k * 10**8)) for k in range(600)]
    assert np.deg2rad(5.0) < max(turns) < np.deg2rad(12.0)


def test_the_vehicle_points_along_its_path():
    drive = Drive(start=LEVEL)
    for k in range(0, 300, 7):
        stamp_ns = START_NS + k * 10**8
        start, end = (drive.T_odom_base(stamp_ns + side * 10**6) for side in (-1, 1))
        linear = compose(inverse(start), end)[:3, 3] / 2e-3
        assert linear[0] > 4.9
        # rocking and bumps tilt it by less than 3 deg against its way
        assert np.hypot(linear[1], linear[2]) < 5.0 * np.sin(np.deg2rad(3.0))


def test_a_vehicle_at_rest_keeps_its_pose():
    drive = Drive(start=LEVEL, speed_m_s=0.0)
    later = drive.T_odom_base(START_NS + 10**10)
    np.testing.assert_array_equal(later, drive.T_odom_base(START_NS))


def test_stamps_follow_the_rate_and_the_start(street):
    drive = Drive(start=street.start, start_ns=17)
    simulation = Simulation(street, Lidar(rate_hz=3.0), drive)
    assert [simulation.stamp_ns(k) for k in range(4)] == [17, 333333350, 666666684, 1000000017]


def test_points_of_a_scan_lie_on_their_true_surface(street):
    simulation = Simulation(street, TINY, num_scans=3)
    for scan in simulation.scans():
        T = simulation.drive.T_odom_sensor(scan.stamp_ns)
        hit = scan.columns['surface'] >= 0
        points = scan.points[hit].astype(np.float64)
        surface, distance_m, _ = street.surface_at(points @ T[:3, :3].T + T[:3, 3])
        assert hit.mean() > 0.7
        assert (surface == scan.columns['surface'][hit]).mean() > 0.999
        assert (distance_m <= np.abs(points).sum(axis=1) * 2.0**-24).all()


def test_points_of_a_rolling_scan_lie_on_their_true_surface_at_their_own_time(street):
    simulation = Simulation(street, TINY, num_scans=2, rolling=True)
    scan = simulation.scan(1)
    surface = scan.columns['surface']
    moved = 0.0
    for row in np.flatnonzero(surface >= 0)[::7]:
        time_ns = round(float(scan.columns['time'][row]) * 1e9)
        T = simulation.drive.T_odom_sensor(scan.stamp_ns + time_ns)
        place = T[:3, :3] @ scan.points[row].astype(np.float64) + T[:3, 3]
        # float32 of the time moves the sensor by 4e-9 s * 5 m/s, of the point by its own rounding
        assert street.surface_at(place)[1][0] < np.abs(scan.points[row]).sum() * 2.0**-24 + 1e-7
        moved = max(moved, time_ns)
    assert moved > 0.09e9


def test_a_scan_does_not_depend_on_what_was_simulated_before(street):
    lidar = Lidar(beams=8, columns=64, range_noise_m=0.05)
    after = list(Simulation(street, lidar, num_scans=4).scans())[3]
    alone = Simulation(street, lidar, num_scans=4).scan(3)
    np.testing.assert_array_equal(after.points, alone.points)
    assert after.stamp_ns == alone.stamp_ns


@pytest.mark.parametrize(
    'setting',
    [
        dict(speed_m_s=-1.0),
        dict(speed_m_s=np.nan),
        dict(start_ns=-1),
        dict(start_ns=2**31 * 10**9),
        dict(base_to_sensor=(0.0,) * 7),
        dict(start=(0.0, 0.0)),
    ],
)
def test_an_invalid_drive_is_refused_by_its_setting(setting):
    with pytest.raises(ConfigError, match=next(iter(setting))):
        Drive(**{'start': LEVEL, **setting})


@pytest.mark.parametrize('num_scans', [0, -3])
def test_a_simulation_without_scans_is_refused(street, num_scans):
    with pytest.raises(ConfigError, match='expected one or more'):
        Simulation(street, num_scans=num_scans)
