# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Filters with a model of the sensor: noise, bias at grazing angles, points between two surfaces.

Sources: Pomerleau et al. 2012, Noise characterization of depth sensors for surface inspections,
for the noise; Laconte et al. 2019, Lidar measurement bias estimation via return waveform
modelling in a context of 3D mapping, for the bias; constants as in libpointmatcher.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.filters.base import Filter, Mask, parameter, select, with_columns, with_points
from surfel_mapper.filters.columns import (
    INCIDENCE_ANGLES,
    NORMALS,
    OBSERVATION_DIRECTIONS,
    SENSOR_NOISE,
    with_normals,
)
from surfel_mapper.filters.descriptors import dot, unit
from surfel_mapper.filters.limits import range_sq
from surfel_mapper.filters.registry import register
from surfel_mapper.scan import Scan

Array = npt.NDArray[Any]

BEAMS = {
    0: (0.012, 0.0068, 0.0008),  # Sick LMS-1xx
    1: (0.028, 0.0013, 0.0001),  # Hokuyo URG-04LX
    2: (0.018, 0.0006, 0.0015),  # Hokuyo UTM-30LX
    4: (0.004, 0.0053, -0.0092),  # Sick TiM3xx
}
"""Least noise (m), half the angle of the beam (rad) and its width at the sensor (m)."""

KINECT = 3
KINECT_PER_M = 0.5 * 0.00285
"""Noise of a depth camera over the squared distance, 1/m."""


@register(libpointmatcher='SimpleSensorNoiseDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class SimpleSensorNoise(Filter):
    """Add simpleSensorNoise, the noise radius of each point, m."""

    sensor_type: int = parameter(
        0,
        '0: Sick LMS-1xx; 1: Hokuyo URG-04LX; 2: Hokuyo UTM-30LX; 3: Kinect, Xtion; '
        '4: Sick TiM3xx.',
        low=0,
        high=4,
        libpointmatcher='sensorType',
    )
    gain: float = parameter(1.0, 'Factor on the noise.', low=1.0, libpointmatcher='gain')

    def apply(self, scan: Scan) -> Scan:
        """Return the scan with the column."""
        distance_sq = range_sq(scan.points.astype(np.float64))
        if self.sensor_type == KINECT:
            noise = KINECT_PER_M * distance_sq
        else:
            least, angle, width = BEAMS[self.sensor_type]
            noise = np.maximum(least, angle * np.sqrt(distance_sq) + width)
        noise = (self.gain * noise).astype(scan.points.dtype)
        return with_columns(scan, **{SENSOR_NOISE: noise})


@register(libpointmatcher='ShadowDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class Shadow(Filter):
    """Drop the points on surfaces seen edge-on, often between two objects; needs normals."""

    max_angle_rad: float = parameter(
        0.1,
        'Points whose surface is within this angle of the line of sight are dropped, rad.',
        low=0.0,
        high=3.1416,
        libpointmatcher='eps',
    )

    def keep(self, scan: Scan) -> Mask:
        """Return which points stay; those without a normal or at the origin do not."""
        normals = self.column(with_normals(scan), NORMALS)
        sine = np.abs(dot(unit(normals), unit(scan.points)))
        return np.asarray(sine > math.sin(min(self.max_angle_rad, math.pi / 2)), np.bool_)


LIGHT_M_PER_S = 299_792_458.0
PULSE_S = 50e-9
"""Length of the pulse."""
PULSE_SIGMA_S = PULSE_S / math.sqrt(2.0 * math.pi)

BIASED = {
    0: (7.5049e-3, 6.08040951, 3.17921789e-3),  # Sick LMS-1xx
    1: (1.4835e-3, 10.3211569, 7.07893371e-3),  # Velodyne HDL-32E
}
"""Aperture (rad), gain on the shift of the peak, gain on the change of its curvature (m)."""


@register(libpointmatcher='RemoveSensorBiasDataPointsFilter')
@dataclass(frozen=True, slots=True, kw_only=True)
class RemoveSensorBias(Filter):
    """
    Undo the bias of range at grazing angles; needs incidenceAngles and observationDirections.

    The pulse of a beam of finite width returns stretched from an inclined surface. A lidar times
    its peak, which is not that of the beam's axis.
    """

    sensor_type: int = parameter(
        0, '0: Sick LMS-1xx; 1: Velodyne HDL-32E.', low=0, high=1, libpointmatcher='sensorType'
    )
    max_angle_deg: float = parameter(
        88.0,
        'Points with this angle of incidence or more are dropped, deg.',
        low=0.0,
        high=90.0,
        libpointmatcher='angleThreshold',
    )

    def apply(self, scan: Scan) -> Scan:
        """Return the points that have an angle, moved along their observation directions."""
        angles = self.column(scan, INCIDENCE_ANGLES)
        self.column(scan, OBSERVATION_DIRECTIONS)
        scan = select(scan, (angles >= 0.0) & (angles < math.radians(self.max_angle_deg)))
        angles = scan.columns[INCIDENCE_ANGLES].astype(np.float64)
        directions = scan.columns[OBSERVATION_DIRECTIONS].astype(np.float64)
        shift_m = bias_m(np.sqrt(dot(directions, directions)), angles, *BIASED[self.sensor_type])
        points = scan.points + shift_m[:, None] * unit(directions)
        return with_points(scan, points, scan.columns)


def bias_m(depth_m: Array, angle: Array, aperture: float, shift: float, bend: float) -> Array:
    """
    Return the bias of the measured range, m.

    Parameters
    ----------
    depth_m, angle : (N,) float64
        Distance, and angle between normal and line of sight, rad.
    aperture, shift, bend : float
        Constants of the sensor, see BIASED.

    """
    a1, a2, a3 = waveform(depth_m, angle, aperture)
    _, flat, _ = waveform(depth_m, np.zeros_like(angle), aperture)
    with np.errstate(divide='ignore', invalid='ignore'):
        peak_s = (-2.0 * a2 - np.sqrt(4.0 * a2**2 - 12.0 * a1 * a3)) / (6.0 * a3)
    peak_s = np.where(angle < 1e-5, 0.0, peak_s)
    curvature = 1.0 - 2.0 * flat / (2.0 * a2 + 6.0 * peak_s * a3)
    return np.asarray(shift * peak_s * LIGHT_M_PER_S / 2.0 + bend * curvature)


def waveform(depth_m: Array, angle: Array, aperture: float) -> tuple[Array, Array, Array]:
    """
    Return the coefficients of the returning pulse as a cubic in time, without the constant.

    Intensity and waist of the pulse scale all of them and are left out: only ratios are used.
    """
    from scipy.special import erf  # 0.1 s, only for chains that use it

    length = PULSE_SIGMA_S * LIGHT_M_PER_S
    tan, cos, sin = np.tan(angle), np.cos(angle), np.sin(angle)
    spread = 2.0 * (depth_m * tan / length) ** 2 + 2.0 / aperture**2
    even, odd = cos**3, 3.0 * cos**2 * sin
    first = math.sqrt(math.pi) * erf(aperture * np.sqrt(spread)) / (2.0 * spread**1.5) / cos**2
    second = odd / (2.0 * spread) / cos**2
    edge = 2.0 * second * aperture * np.exp(-spread * aperture**2)
    a1 = -2.0 * tan * depth_m * (first * odd - edge) / (PULSE_SIGMA_S**2 * LIGHT_M_PER_S)
    widened = (length * cos) ** 2 * spread + 2.0 * (cos * depth_m) ** 2 - 2.0 * depth_m**2
    a2 = -first * even * widened / ((LIGHT_M_PER_S * cos) ** 2 * PULSE_SIGMA_S**4)
    skew = length**2 * spread - 2.0 * (depth_m * tan) ** 2
    a3 = first * odd * depth_m * tan * skew / (PULSE_SIGMA_S**6 * LIGHT_M_PER_S**3 * spread)
    return a1, a2, a3
