# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
PoseTrack: the transforms of one frame in its parent, over time or static.

Odometry comes at 100 Hz and more, ten times as often as scans, so every transform is checked with
Python's own floats: numpy takes a microsecond for any operation on a few numbers.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
import math

import numpy as np

from surfel_mapper.errors import PoseError, PoseNotYetError, PosesLateError
from surfel_mapper.geometry import interpolate, Transform

NS_PER_S = 1_000_000_000

MAX_SKEW = 1e-6
"""Largest entry of R R^T - I that a transform may have; rounding to float32 gives 1e-7."""


@dataclass(slots=True, eq=False)
class PoseTrack:
    """Transforms of a child frame in its parent by ascending stamp; one if static."""

    parent: str
    child: str
    is_static: bool
    stamps: list[int] = field(default_factory=list)
    transforms: list[Transform] = field(default_factory=list)

    def __str__(self) -> str:
        if self.is_static:
            return f'{self.parent} -> {self.child} (static)'
        oldest, newest = seconds(self.stamps[0]), seconds(self.stamps[-1])
        return f'{self.parent} -> {self.child} (held from {oldest} to {newest} s)'

    def insert(self, stamp_ns: int, T_parent_child: Transform) -> None:
        """Insert a transform by its stamp; it replaces one of the same stamp."""
        if not self.stamps or stamp_ns > self.stamps[-1]:  # nearly always
            self.stamps.append(stamp_ns)
            self.transforms.append(T_parent_child)
            return
        row = bisect_left(self.stamps, stamp_ns)
        if self.stamps[row] == stamp_ns:
            self.transforms[row] = T_parent_child
        else:
            self.stamps.insert(row, stamp_ns)
            self.transforms.insert(row, T_parent_child)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the transforms older than a stamp."""
        if self.stamps and self.stamps[0] < stamp_ns:
            self.forget_oldest(bisect_left(self.stamps, stamp_ns))

    def forget_oldest(self, number: int) -> None:
        """Drop the oldest transforms."""
        del self.stamps[:number], self.transforms[:number]

    def gap_ns(self, stamp_ns: int) -> int:
        """Return the gap between the transforms around a held stamp, ns; 0 at a stored stamp."""
        if self.is_static:
            return 0
        row = bisect_left(self.stamps, stamp_ns)
        newer = self.stamps[row]
        return 0 if newer == stamp_ns else newer - self.stamps[row - 1]

    def at(self, stamp_ns: int) -> Transform:
        """Return the transform at a stamp within those held."""
        if self.is_static:
            return self.transforms[0]
        row = bisect_left(self.stamps, stamp_ns)
        newer = self.stamps[row]
        if newer == stamp_ns:
            return self.transforms[row]
        older = self.stamps[row - 1]
        alpha = (stamp_ns - older) / (newer - older)
        return interpolate(self.transforms[row - 1], self.transforms[row], alpha)


def rigid(parent: str, child: str, T_parent_child: Transform) -> Transform:
    """Return a copy of a transform, or raise PoseError if it is not rigid."""
    transform = np.array(T_parent_child, dtype=np.float64)
    if transform.shape != (4, 4):
        raise not_rigid(parent, child, f'shape {transform.shape}, expected (4, 4)')
    rows = transform.tolist()
    if not all(map(math.isfinite, [*rows[0], *rows[1], *rows[2]])):
        raise not_rigid(parent, child, f'not finite, {rows[:3]}')
    if rows[3] != [0.0, 0.0, 0.0, 1.0] or not is_rotation(*(row[:3] for row in rows[:3])):
        raise not_rigid(parent, child, f'not a rotation and a translation, {rows}')
    return transform


def not_rigid(parent: str, child: str, why: str) -> PoseError:
    """Return the error for a transform that is refused."""
    return PoseError(f'transform {parent!r} -> {child!r}: {why}')


def is_rotation(a: list[float], b: list[float], c: list[float]) -> bool:
    """Return whether three finite rows are orthonormal but for rounding, and no mirror."""
    (a0, a1, a2), (b0, b1, b2), (c0, c1, c2) = a, b, c
    if max(*map(abs, a), *map(abs, b), *map(abs, c)) > 2.0:
        return False  # and its square may overflow
    skew = max(
        abs(a0 * a0 + a1 * a1 + a2 * a2 - 1.0),
        abs(b0 * b0 + b1 * b1 + b2 * b2 - 1.0),
        abs(c0 * c0 + c1 * c1 + c2 * c2 - 1.0),
        abs(a0 * b0 + a1 * b1 + a2 * b2),
        abs(a0 * c0 + a1 * c1 + a2 * c2),
        abs(b0 * c0 + b1 * c1 + b2 * c2),
    )
    volume = a0 * (b1 * c2 - b2 * c1) + a1 * (b2 * c0 - b0 * c2) + a2 * (b0 * c1 - b1 * c0)
    return skew <= MAX_SKEW and volume > 0.0


def seconds(stamp_ns: int) -> str:
    """Return a stamp in seconds with all its digits."""
    whole, rest = divmod(abs(stamp_ns), NS_PER_S)
    return f'{"-" if stamp_ns < 0 else ""}{whole}.{rest:09d}'


def check_held(edges: list[PoseTrack], stamp_ns: int, max_gap_s: float) -> None:
    """Raise if a dynamic edge has no transforms around a stamp; too old comes before too new."""
    dynamic = [edge for edge in edges if not edge.is_static]
    for edge in dynamic:
        if stamp_ns < edge.stamps[0]:
            raise PoseError(f'older than all of {edge}')
    for edge in dynamic:
        if stamp_ns > edge.stamps[-1]:
            raise PosesLateError(f'newer than all of {edge}')
    for edge in dynamic:
        check_gap(edge, edge.gap_ns(stamp_ns), max_gap_s)


def check_gap(edge: PoseTrack, gap_ns: int, max_gap_s: float) -> None:
    """Raise if two transforms of an edge are too far apart to interpolate between them."""
    gap_s = gap_ns / NS_PER_S
    if gap_s > max_gap_s:
        raise PoseNotYetError(
            f'in a gap of {gap_s:.3f} s of {edge}, longer than {max_gap_s:g} s (pose.max_gap_s)'
        )
