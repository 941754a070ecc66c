# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether the sensor has moved since the last scan that was mapped."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from surfel_mapper.config import WindowConfig
from surfel_mapper.geometry import compose, inverse, rotation_angle


def stands_still(
    T_map_last: npt.NDArray[np.float64],
    T_map_sensor: npt.NDArray[np.float64],
    gate: WindowConfig,
) -> bool:
    """Return whether two poses are nearer than the gate asks; never where there is no gate."""
    if not (gate.gate_distance_m or gate.gate_angle_deg):
        return False
    motion = compose(inverse(T_map_last), T_map_sensor)
    distance_m = float(np.sqrt((motion[:3, 3] ** 2).sum()))
    angle_deg = float(np.degrees(rotation_angle(motion)))
    moved = 0.0 < gate.gate_distance_m <= distance_m
    turned = 0.0 < gate.gate_angle_deg <= angle_deg
    return not (moved or turned)
