# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Names of the columns in which drivers write the times of points."""

from __future__ import annotations

from collections.abc import Iterable
import re

FIELDS = ('t', 'time', 'timestamp', 'offset_time', 'time_stamp')
"""Names of the times of points: Ouster, Velodyne, Hesai, Livox, Autoware and Nebula."""

TIME_NAME = re.compile(
    r'time|stamp|^(t|ts|dt|(t_?)?off(set)?)(_?[mun]?s(ec)?)?$|(^|_)([mun]|milli|micro|nano)?sec(s|onds)?$',
    re.IGNORECASE,
)
"""Names of further drivers; used if a cloud has one such field."""


def times_field(columns: Iterable[str]) -> str:
    """Return the column with the times of points by its name; empty if none or several may be."""
    names = time_fields(columns)
    return names[0] if len(names) == 1 else ''


def time_fields(columns: Iterable[str]) -> list[str]:
    """
    Return the columns that may hold the times of points: the first usual name, else others.

    Of seconds and nanoseconds in two columns (sec, nsec) the nanoseconds stand for both.
    """
    names = [*columns]
    usual = [name for name in FIELDS if name in names]
    seconds = {name.replace('nsec', 'sec') for name in names if 'nsec' in name}
    names = [name for name in names if name not in seconds]
    return usual[:1] or [name for name in names if TIME_NAME.search(name)]
