# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Prepared: a scan that is ready for the map, or for registration."""

from __future__ import annotations

from dataclasses import dataclass

from surfel_mapper.alignment.registration import RegistrationResult
from surfel_mapper.geometry import Transform
from surfel_mapper.scan import Scan


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """
    A scan that is ready for the map, or for registration.

    Attributes
    ----------
    scan : Scan
        Deskewed, before the filters.
    filtered : Scan
        After the filters; the same if there are none.
    T_map_sensor : (4, 4) float64
        Its pose; before registration the predicted one.
    registration : RegistrationResult, optional
        If poses come from registration to the map.
    T_fixed_body : (4, 4) float64, optional
        Pose of the tracked frame then.

    """

    scan: Scan
    filtered: Scan
    T_map_sensor: Transform
    registration: RegistrationResult | None = None
    T_fixed_body: Transform | None = None
