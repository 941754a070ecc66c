# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Noise, shadows and bias: against the models' own properties and values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from surfel_mapper.filters.sensor_models import bias_m, BIASED, waveform
from test.filters.examples import filter_of, scan_of


@pytest.mark.parametrize(
    ('sensor', 'at_0_m', 'at_10_m'),
    [
        (0, 0.012, 0.0688),  # at least 12 mm, else half the beam 6.8 mrad wide and 0.8 mm
        (1, 0.028, 0.028),
        (2, 0.018, 0.018),
        (3, 0.0, 0.1425),  # grows with the square of the distance
        (4, 0.004, 0.0438),
    ],
)
def test_the_noise_of_a_sensor_grows_with_distance(sensor, at_0_m, at_10_m):
    scan = scan_of([[0.0, 0.0, 0.0], [0.0, 6.0, 8.0], [np.nan, 0.0, 0.0]])
    one = filter_of('SimpleSensorNoiseDataPointsFilter', sensorType=sensor).apply(scan)
    two = filter_of('SimpleSensorNoiseDataPointsFilter', sensorType=sensor, gain=2).apply(scan)
    noise = one.columns['simpleSensorNoise']
    np.testing.assert_allclose(noise, [at_0_m, at_10_m, np.nan], rtol=1e-12)
    np.testing.assert_allclose(two.columns['simpleSensorNoise'], 2.0 * noise)


def test_shadow_drops_points_on_surfaces_seen_edge_on():
    tilt = np.radians([0.0, 5.0, 6.0, 90.0, 175.0])  # of the surface to the line of sight
    normals = np.stack([np.sin(tilt), np.cos(tilt), 0.0 * tilt], axis=1)
    scan = scan_of(
        [[9.0, 0.0, 0.0]] * 5 + [[0.0, 0.0, 0.0], [9.0, 0.0, 0.0]],
        normals=[*(3.0 * normals), [1.0, 0.0, 0.0], [np.nan] * 3],
        row=range(7),
    )
    found = filter_of('ShadowDataPointsFilter', eps=np.radians(5.5)).apply(scan)
    assert found.columns['row'].tolist() == [2, 3]
    assert len(filter_of('ShadowDataPointsFilter', eps=3.1416).apply(scan)) == 0


@pytest.mark.parametrize('sensor', [0, 1])
def test_seen_at_a_right_angle_a_surface_has_no_bias_and_more_the_more_slanted(sensor):
    angles = np.radians([0.0, 10.0, 30.0, 50.0, 70.0, 85.0])
    bias = bias_m(np.full(6, 10.0), angles, *BIASED[sensor])
    assert bias[0] == pytest.approx(0.0, abs=1e-9)
    assert (np.abs(np.diff(np.abs(bias))) > 0.0).all()
    assert (np.diff(np.abs(bias)) > 0.0).all()
    assert np.abs(bias).max() < 1.0


@pytest.mark.parametrize('sensor', [0, 1])
def test_points_move_along_the_line_of_sight_and_those_too_slanted_go(sensor):
    points = np.array([[10.0, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 10.0], [10.0, 0.0, 0.0]])
    angles = np.radians([0.0, 60.0, 89.0, np.nan])
    scan = scan_of(points, incidenceAngles=angles, observationDirections=-points, row=range(4))
    found = filter_of('RemoveSensorBiasDataPointsFilter', sensorType=sensor).apply(scan)
    assert found.columns['row'].tolist() == [0, 1]
    shift = bias_m(np.array([10.0]), np.radians([60.0]), *BIASED[sensor])[0]
    np.testing.assert_allclose(
        found.points, [[10.0, 0.0, 0.0], [0.0, 10.0 - shift, 0.0]], rtol=0.0, atol=1e-8
    )


@pytest.mark.parametrize('tilt_deg', [5.0, 40.0, 75.0])
@pytest.mark.parametrize('depth', [1.0, 10.0, 40.0])
@pytest.mark.parametrize('sensor', [0, 1])
def test_the_returning_pulse_is_the_sum_of_those_of_all_rays_of_the_beam(sensor, depth, tilt_deg):
    aperture, tilt = BIASED[sensor][0], np.radians(tilt_deg)
    a1, a2, a3 = waveform(np.array([depth]), np.array([tilt]), aperture)
    within, whole = (slow_waveform(depth, tilt, aperture, reach) for reach in (1.0, 8.0))
    # linear in time: over the beam; the others leave out that it ends, which their ratio forgets
    np.testing.assert_allclose(a1, within[0], rtol=1e-6)
    np.testing.assert_allclose(a3 / a2, whole[2] / whole[1], rtol=1e-6)


def slow_waveform(depth, tilt, aperture, reach):
    """
    Return the pulse from a slanted plane as a cubic in time, without its constant part.

    A ray at angle a from the middle of the beam has strength exp(-2 (a / aperture)^2), hits the
    plane later by 2 depth a tan(tilt) / c, and is reflected by cos(tilt - a)^3, to first order.
    """
    c, sigma = 299_792_458.0, 50e-9 / np.sqrt(2.0 * np.pi)
    angle = np.linspace(-reach * aperture, reach * aperture, 200_001)
    late = -2.0 * depth * angle * np.tan(tilt) / c / sigma
    reflected = np.cos(tilt) + 3.0 * np.sin(tilt) * angle
    strength = reflected * np.exp(-2.0 * (angle / aperture) ** 2) * np.exp(-0.5 * late**2)
    powers = (late, 0.5 * late**2 - 0.5, late**3 / 6.0 - 0.5 * late)  # of exp(late t - t^2 / 2)
    strength[[0, -1]] *= 0.5  # the trapezoidal rule
    step = angle[1] - angle[0]
    return [(strength * each).sum() * step / sigma**n for n, each in enumerate(powers, start=1)]
