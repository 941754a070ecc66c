# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Deskewing: a pose of its own for every point of a sweep.

A lidar at 10 Hz on a car at 10 m/s sees the last point of a turn from 1 m ahead of the first.
Drivers write the time of each point in a field; ``point_times`` finds it and its unit,
``deskewed`` takes the points to the sensor frame at the stamp of the scan, as if all had been
measured then. All later stages (filters, map, window) see rigid scans only.

Poses are looked up at the stamps of the pose source, and between them at steps of at most
0.005 rad of rotation; within a step the motion is taken as straight, which at 1 m from the base
is 3 micrometres off. A lookup for every point would take seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise
import math
import re
from typing import Any

import numpy as np
import numpy.typing as npt

from surfel_mapper.errors import CloudFormatError
from surfel_mapper.geometry import compose, inverse, q_xyzw, Transform
from surfel_mapper.scan import PointTimes, Scan
from surfel_mapper.sensors.kernels.deskew import move_points
from surfel_mapper.sensors.time_fields import FIELDS, times_field

NAMED_UNIT = re.compile(r'_([mun]?s)(?:ecs?)?$', re.IGNORECASE)
"""Unit at the end of the name of a field: time_offset_ns."""

UNITS_NS = {'s': 10**9, 'ms': 10**6, 'us': 10**3, 'ns': 1}

REFERENCES = ('stamp', 'epoch', 'first')

UNTIMED = np.iinfo(np.int64).min
"""Offset of a point whose time is not finite; deskewing makes the point invalid."""

MAX_SWEEP_NS = 1_500_000_000
"""
Largest difference of a time from the stamp, ns; a larger one has another unit or clock. Seconds
since 1970, read as nanoseconds since the stamp, are 1.7 s and more.
"""

FRACTIONS_NS = 700_000_000, 1_001_000_000
"""Sweep of fractions of a scan read as seconds, ns, shorter if a sector is missing; no usual lidar
turns as slowly."""

MIN_SWEEP_NS = 500_000
"""Shortest sweep of which a unit is likely, ns: microseconds read as ns are shorter."""

WRAPS_AT = 2**31
"""Ouster's uint32 times from here on are negative ones that wrapped; 2.1 s is no sweep."""

MAX_TURN_RAD = 0.005
"""Largest rotation of the sensor between two poses that are looked up, rad."""


def point_times(
    scan: Scan, field: str = '', unit: str = 'auto', reference: str = 'auto'
) -> PointTimes:
    """
    Return the times of the points of a scan.

    Parameters
    ----------
    scan : Scan
        With a column of times.
    field : str
        Name of the column; empty: see ``times_field``.
    unit : str
        s, ms, us, ns; auto: the one that the name ends with, else the first with times within
        1.5 s of the stamp and a sweep of 0.5 ms or more. Floating point numbers are tried as s,
        ns, us, ms, integers as ns, us, ms.
    reference : str
        stamp: times count from the stamp of the scan; epoch: they are like stamps; first: the
        first point was measured at the stamp; auto: stamp or epoch, the one nearer to the stamp.

    Raises
    ------
    CloudFormatError
        If there is no such column, none of its times is finite, they are more than 1.5 s from the
        stamp in every unit, or they may be fractions of a scan.
    ValueError
        If the unit or the reference is none of these.

    """
    for key, value, allowed in (('unit', unit, UNITS_NS), ('reference', reference, REFERENCES)):
        if value != 'auto' and value not in allowed:
            raise ValueError(f'{key}: {value!r}, expected one of auto, {", ".join(allowed)}')
    name = field or times_field(scan.columns)
    if name not in scan.columns:
        raise CloudFormatError(
            f'no field {field or " or ".join(FIELDS)} among {", ".join(scan.columns) or "none"}; '
            'name the times of points in deskew.field'
        )
    column = np.asarray(scan.columns[name])
    seconds = scan.columns.get(name.replace('nsec', 'sec')) if 'nsec' in name else None
    if seconds is not None and seconds.dtype.kind in 'iu' and column.dtype.kind in 'iu':
        column, unit = 10**9 * seconds.astype(np.int64) + column.astype(np.int64), 'ns'
    if unit == 'auto' and (named := NAMED_UNIT.search(name)):
        unit = named[1].lower()
    if column.dtype.kind not in 'iuf':
        raise CloudFormatError(f'field {name}: {column.dtype}, expected numbers')
    if column.ndim != 1:
        raise CloudFormatError(f'field {name}: {column.shape[1]} values a point, expected a time')
    if column.dtype == np.uint64:  # beyond int64 there is no time, and it must not wrap around
        column = np.minimum(column, np.uint64(np.iinfo(np.int64).max))
    x, y, z = scan.xyz
    with np.errstate(over='ignore', invalid='ignore'):
        reach = (abs(x) + abs(y)) + abs(z)
    is_valid, is_finite = (reach > 0.0) & (reach < np.inf), np.isfinite(column)
    is_timed, num_untimed = is_valid & is_finite, np.count_nonzero(is_valid & ~is_finite)
    if num_untimed and not is_timed.any():
        raise CloudFormatError(f'field {name}: no finite time of {num_untimed} valid points')
    if not is_timed.any():
        return PointTimes(np.zeros(len(scan), np.int64), scan.stamp_ns, scan.stamp_ns)
    number = np.float64 if column.dtype.kind == 'f' else np.int64
    values: npt.NDArray[Any] = np.where(is_timed, column, column[np.argmax(is_timed)])
    values = values.astype(number)
    if column.dtype == np.uint32 and values.max() >= WRAPS_AT:
        values[values >= WRAPS_AT] -= 2**32
    ends = np.array([values.min(), values.max()])
    low, high = ends if values.dtype == np.int64 else ends.astype(column.dtype)
    reading = _likely_reading(ends, column.dtype, unit, reference, scan.stamp_ns)
    if reading is None:
        raise CloudFormatError(
            f'field {name}: times from {low} to {high} of type {column.dtype} are more than '
            f'{MAX_SWEEP_NS / 1e9:g} s from the stamp {scan.stamp_ns / 1e9:.6f} s with '
            f'deskew.unit {unit} and deskew.reference {reference}; deskew.reference first takes '
            'the stamp for the time of the first point'
        )
    first, last = _offsets(ends, *reading, scan.stamp_ns).tolist()
    is_unsure = unit == 'auto' and reading[:2] == (UNITS_NS['s'], 'stamp')
    if is_unsure and FRACTIONS_NS[0] <= last - first <= FRACTIONS_NS[1]:
        raise CloudFormatError(
            f'field {name}: times from {low:g} to {high:g} may be fractions of a scan, which are '
            'not read; if they are seconds, set deskew.unit: s'
        )
    offsets = _offsets(values, *reading, scan.stamp_ns)
    if num_untimed:
        offsets[~is_finite] = UNTIMED
    return PointTimes(offsets, scan.stamp_ns + first, scan.stamp_ns + last)


def deskewed(
    scan: Scan,
    pose_at: Callable[[int], Transform],
    stamps_ns: Iterable[int] = (),
    min_range_m: float = 0.0,
) -> Scan:
    """
    Return a scan with all points in the sensor frame at its stamp.

    Parameters
    ----------
    scan : Scan
        With times; its points are in the sensor frame, each at its own time.
    pose_at : callable
        Returns T_fixed_sensor at a time in nanoseconds, from the first point to the last.
    stamps_ns : iterable of int
        Stamps of the pose source; those not between first and last point are ignored.
    min_range_m : float
        Points nearer to the sensor are put into its origin instead of being moved.

    Returns
    -------
    Scan
        The points in the same order, (N, 3) float64; those without a time are nan.

    """
    times = scan.times
    assert times is not None, 'point_times comes before'
    stamps = [s for s in stamps_ns if times.first_ns < s < times.last_ns]
    ends = sorted({times.first_ns, *stamps, times.last_ns})
    knots, poses, turns = _track(ends, pose_at)
    at_stamp = dict(zip(knots, poses, strict=True)).get(scan.stamp_ns)
    to_stamp = inverse(pose_at(scan.stamp_ns) if at_stamp is None else at_stamp)
    transforms = np.ascontiguousarray([compose(to_stamp, pose)[:3] for pose in poses])

    moved = np.empty((len(scan), 3), order='F')
    move_points(
        np.require(scan.points, None, ['F', 'A', 'W']).T,
        times.offsets,
        np.array(knots) - scan.stamp_ns,
        transforms,
        np.array([*turns, np.zeros(3)]),
        min_range_m * min_range_m,
        moved.T,
    )
    if times.offsets.min(initial=0) == UNTIMED:
        moved[times.offsets == UNTIMED] = np.nan
    return replace(scan, points=moved, times=None)


def warm_up() -> None:
    """Compile the kernel, for points of either type."""
    times = PointTimes(np.zeros(2, np.int64), 0, 0)
    for dtype in (np.float32, np.float64):
        points = np.ones((2, 3), dtype, order='F')
        scan = Scan(points=points, stamp_ns=0, frame_id='', times=times)
        deskewed(scan, lambda _: np.eye(4))


def _likely_reading(
    ends: npt.NDArray[Any], dtype: np.dtype[Any], unit: str, reference: str, stamp_ns: int
) -> tuple[int, str, Any] | None:
    """
    Return unit in ns, reference, and origin of times in their unit; None if no reading fits.

    A reading fits if the earliest and the latest time are near the stamp. If no other fits, a
    sweep may be too short in the likeliest unit, or if its times count from 1970.
    """
    units = ['s', 'ns', 'us', 'ms'] if dtype.kind == 'f' else ['ns', 'us', 'ms']
    units = units if unit == 'auto' else [unit]
    if reference == 'auto' and dtype == np.float32:
        reference = 'stamp'  # since the epoch it would count in steps of 128 s
    low, short = int(ends[0].astype(dtype)), None
    for name in units:
        unit_ns = UNITS_NS[name]
        origins = {'stamp': 0, 'epoch': stamp_ns // unit_ns, 'first': ends[0]}
        is_epoch = abs(low * unit_ns) > abs(low * unit_ns - stamp_ns)
        likely = ['epoch', 'stamp'] if is_epoch else ['stamp', 'epoch']
        for kind in likely if reference == 'auto' else [reference]:
            reading = unit_ns, kind, origins[kind]
            first, last = _offsets(ends, *reading, stamp_ns).tolist()
            if first >= -MAX_SWEEP_NS and last <= MAX_SWEEP_NS:
                if last - first >= MIN_SWEEP_NS:
                    return reading
                is_likely = kind == 'epoch' or name == units[0]
                short = short or (reading if is_likely else None)
    return short


def _offsets(
    values: npt.NDArray[Any], unit_ns: int, kind: str, origin: Any, stamp_ns: int
) -> npt.NDArray[np.int64]:
    """Return times in nanoseconds after the stamp; the difference is taken before the factor."""
    limit = 4 * MAX_SWEEP_NS // unit_ns  # larger ones are refused, and must not overflow
    number = values.dtype.type
    shift_ns = int(number(origin)) * unit_ns - stamp_ns if kind == 'epoch' else 0
    ticks = np.clip(values - number(origin), -number(limit), number(limit)) * number(unit_ns)
    return np.asarray(np.rint(ticks).astype(np.int64) + shift_ns)


def _track(
    ends: list[int], pose_at: Callable[[int], Transform]
) -> tuple[list[int], list[Transform], list[npt.NDArray[np.float64]]]:
    """
    Return times, poses, and the turn from each to the next; see ``_turn``.

    There are further ones between the ends if the sensor turns much.
    """
    knots, poses, turns = ends[:1], [pose_at(ends[0])], []
    for start, end in pairwise(ends):
        pose = pose_at(end)
        turn = _turn(poses[-1], pose)
        chord = 2.0 * math.sqrt(float((turn * turn).sum()))
        num_steps = min(max(math.ceil(0.5 * math.pi * chord / MAX_TURN_RAD), 1), end - start)
        between = [start + (end - start) * step // num_steps for step in range(1, num_steps)]
        further = [*map(pose_at, between), pose]
        turns += [turn] if num_steps == 1 else [*map(_turn, [poses[-1], *further], further)]
        knots += [*between, end]
        poses += further
    return knots, poses, turns


def _turn(T_fixed_a: Transform, T_fixed_b: Transform) -> npt.NDArray[np.float64]:
    """Return the vector part of the quaternion of T_a_b."""
    return q_xyzw(compose(inverse(T_fixed_a), T_fixed_b))[:3]
