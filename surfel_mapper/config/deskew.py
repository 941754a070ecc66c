# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The stage of deskewing: whether points have times of their own, and where they stand."""

from __future__ import annotations

from dataclasses import dataclass

from surfel_mapper.config.settings import setting, Stage

TIME_UNITS = ('auto', 's', 'ms', 'us', 'ns')

TIME_REFERENCES = ('auto', 'stamp', 'epoch')


@dataclass(frozen=True, slots=True, kw_only=True)
class DeskewConfig(Stage):
    """A pose of its own for every point of a sweep."""

    enabled: bool = setting(
        False,
        'Give each point the pose at its own time; a scan waits for the pose of its last point.',
    )
    field: str = setting(
        '',
        'Field of the times of points; empty: the first of t, time, timestamp, offset_time.',
    )
    unit: str = setting(
        'auto',
        'Unit of these times; auto: s for floating point numbers where that makes sense, else ns.',
        choices=TIME_UNITS,
    )
    reference: str = setting(
        'auto',
        'They count from the stamp of the scan, or are themselves like stamps (epoch).',
        choices=TIME_REFERENCES,
    )
