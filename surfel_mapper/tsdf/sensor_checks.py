# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""What cameras and lidars have in common that can be wrong."""

from __future__ import annotations

from collections.abc import Iterable
import math
from typing import Protocol

from surfel_mapper.errors import ConfigError

Check = tuple[str, bool, str]
"""A property, whether it is as it has to be, and how that is."""

MAX_PIXELS = 1 << 26


class Ranging(Protocol):
    """What every sensor has."""

    @property
    def rows(self) -> int:
        """Rows of its images."""

    @property
    def columns(self) -> int:
        """Columns of its images."""

    @property
    def min_range_m(self) -> float:
        """What is nearer is ignored."""

    @property
    def max_range_m(self) -> float:
        """What is farther says that there is nothing up to here."""


def refuse_unless(sensor: object, checks: Iterable[Check]) -> None:
    """Raise ConfigError for the first property that does not hold."""
    for name, holds, expected in checks:
        if not holds:
            kind = type(sensor).__name__
            raise ConfigError(f'{kind}.{name}: {getattr(sensor, name)}, expected {expected}')


def range_checks(sensor: Ranging) -> list[Check]:
    """Return the checks of what all sensors have."""
    return [
        ('rows', sensor.rows >= 1, 'at least 1'),
        ('columns', sensor.columns >= 1, 'at least 1'),
        ('columns', sensor.rows * sensor.columns <= MAX_PIXELS, f'at most {MAX_PIXELS} pixels'),
        ('min_range_m', 0.0 < sensor.min_range_m < math.inf, 'positive, finite'),
        (
            'max_range_m',
            sensor.min_range_m < sensor.max_range_m < math.inf,
            'more than min_range_m, finite',
        ),
    ]
