# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The stages that concern the running node alone: clearing on request, and its health."""

from __future__ import annotations

from dataclasses import dataclass

from surfel_mapper.config.settings import setting, Stage
from surfel_mapper.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class ClearConfig(Stage):
    """What ~/clear_box and ~/clear_radius empty."""

    box: tuple[float, ...] = setting(
        (0.0,) * 6,
        'The box of ~/clear_box in the fixed frame, m: least x y z, then greatest.',
        live=True,
    )
    radius_m: float = setting(
        2.0,
        'The radius of ~/clear_radius about the newest place of the sensor, m.',
        low=0.0,
        high=1e6,
        live=True,
    )

    def check(self, stage: str) -> None:
        """Refuse what is no box."""
        if len(self.box) != 6:
            raise ConfigError(
                f'{stage}.box: {len(self.box)} values, expected 6 (least x y z, greatest x y z)'
            )
        for axis, least, greatest in zip('xyz', self.box[:3], self.box[3:], strict=True):
            if least > greatest:
                raise ConfigError(
                    f'{stage}.box: least {axis} {least} is above the greatest, {greatest}'
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class DiagnosticsConfig(Stage):
    """Where /diagnostics goes from ok to a warning, and from there to an error."""

    silence_s: float = setting(
        2.0,
        'No cloud for longer than this is an error, s; 0: never.',
        low=0.0,
        high=1e6,
        live=True,
    )
    warn_latency_s: float = setting(
        0.3,
        'A warning where the 99th percentile from stamp to publication is above this, s; '
        '0: never.',
        low=0.0,
        high=1e6,
        live=True,
    )
    error_latency_s: float = setting(
        1.0, 'An error where it is above this, s; 0: never.', low=0.0, high=1e6, live=True
    )
    warn_dropped_ratio: float = setting(
        0.0,
        'A warning where a larger share of the clouds since the last report was dropped.',
        low=0.0,
        high=1.0,
        live=True,
    )
    error_dropped_ratio: float = setting(
        0.5, 'An error where a larger share was dropped.', low=0.0, high=1.0, live=True
    )
