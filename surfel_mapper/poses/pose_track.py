# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
PoseTrack: the transforms of one frame in its parent, over time or static.

A frame that gets a new parent moves, as in tf2: at a stamp it has the parent of its newest
transform up to there.

Odometry comes at 100 Hz and more, ten times as often as scans, so every transform is checked with
Python's own floats: numpy takes a microsecond for any operation on a few numbers.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from itertools import pairwise
import math

import numpy as np

from surfel_mapper.errors import PoseError, PoseNotYetError, PosesLateError
from surfel_mapper.geometry import interpolate, Transform

NS_PER_S = 1_000_000_000

MAX_SKEW = 1e-6
"""Largest entry of R R^T - I that a transform may have; rounding to float32 gives 1e-7."""


@dataclass(slots=True, eq=False)
class PoseTrack:
    """Transforms of a child frame in its parents by ascending stamp; one if static."""

    child: str
    is_static: bool
    stamps: list[int] = field(default_factory=list)
    transforms: list[Transform] = field(default_factory=list)
    parents: list[str] = field(default_factory=list)

    @property
    def parent(self) -> str:
        """The newest parent."""
        return self.parents[-1]

    def parent_at(self, stamp_ns: int | None) -> str:
        """Return the parent at a stamp, that of the oldest transform before it; None: newest."""
        if self.is_static or stamp_ns is None:
            return self.parents[-1]
        return self.parents[max(bisect_right(self.stamps, stamp_ns) - 1, 0)]

    def describe(self, stamp_ns: int) -> str:
        """Return the edge at a stamp and the span of its transforms."""
        edge = f'{self.parent_at(stamp_ns)} -> {self.child}'
        if self.is_static:
            return f'{edge} (static)'
        return f'{edge} (held from {seconds(self.stamps[0])} to {seconds(self.stamps[-1])} s)'

    def set_static(self, parent: str, T_parent_child: Transform) -> None:
        """Replace the static transform."""
        self.transforms, self.parents = [T_parent_child], [parent]

    def insert(self, stamp_ns: int, parent: str, T_parent_child: Transform) -> None:
        """Insert a transform by its stamp; it replaces one of the same stamp."""
        if not self.stamps or stamp_ns > self.stamps[-1]:  # nearly always
            self.stamps.append(stamp_ns)
            self.transforms.append(T_parent_child)
            self.parents.append(parent)
            return
        row = bisect_left(self.stamps, stamp_ns)
        if self.stamps[row] == stamp_ns:
            self.transforms[row], self.parents[row] = T_parent_child, parent
        else:
            self.stamps.insert(row, stamp_ns)
            self.transforms.insert(row, T_parent_child)
            self.parents.insert(row, parent)

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the transforms older than a stamp."""
        if self.stamps and self.stamps[0] < stamp_ns:
            self.forget_oldest(bisect_left(self.stamps, stamp_ns))

    def forget_oldest(self, number: int) -> None:
        """Drop the oldest transforms."""
        del self.stamps[:number], self.transforms[:number], self.parents[:number]

    def forget_former_parents(self) -> None:
        """Keep the transforms in the newest parent alone."""
        rows = [row for row, parent in enumerate(self.parents) if parent == self.parent]
        self.transforms = [self.transforms[row] for row in rows]
        self.stamps = [] if self.is_static else [self.stamps[row] for row in rows]
        self.parents = [self.parent] * len(rows)

    def rows_around(self, stamp_ns: int) -> tuple[int, int]:
        """
        Return the rows of the transforms to interpolate at a held stamp; equal at a stored one.

        Both have the parent at the stamp. Raises PoseNotYetError if it has none after it.
        """
        newer = bisect_left(self.stamps, stamp_ns)
        if self.stamps[newer] == stamp_ns:
            return newer, newer
        older = newer - 1
        for row in range(newer, len(self.stamps)):
            if self.parents[row] == self.parents[older]:
                return older, row
        raise PoseNotYetError(f'between the parents {self.parents[older]} and {self.parent}')

    def at(self, stamp_ns: int) -> Transform:
        """Return the transform at a stamp within those held."""
        if self.is_static:
            return self.transforms[0]
        older, newer = self.rows_around(stamp_ns)
        if older == newer:
            return self.transforms[older]
        start_ns = self.stamps[older]
        alpha = (stamp_ns - start_ns) / (self.stamps[newer] - start_ns)
        return interpolate(self.transforms[older], self.transforms[newer], alpha)


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
            raise PoseError(f'older than all of {edge.describe(stamp_ns)}')
    for edge in dynamic:
        if stamp_ns > edge.stamps[-1]:
            raise PosesLateError(f'newer than all of {edge.describe(stamp_ns)}')
    for edge in dynamic:
        older, newer = edge.rows_around(stamp_ns)
        check_gap(edge, edge.stamps[older], edge.stamps[newer], max_gap_s)


def check_within(edge: PoseTrack, start_ns: int, end_ns: int, max_gap_s: float) -> None:
    """Raise if the transforms of a span, ends included, are in two parents or too far apart."""
    first, last = bisect_left(edge.stamps, start_ns), bisect_right(edge.stamps, end_ns)
    if not {edge.parent_at(start_ns)}.issuperset(edge.parents[first:last]):
        raise PoseError(f'{edge.child!r} gets a new parent until {seconds(end_ns)} s')
    for older_ns, newer_ns in pairwise(edge.stamps[first:last]):
        check_gap(edge, older_ns, newer_ns, max_gap_s)


def check_gap(edge: PoseTrack, older_ns: int, newer_ns: int, max_gap_s: float) -> None:
    """Raise if two transforms of an edge are too far apart to interpolate between them."""
    gap_s = (newer_ns - older_ns) / NS_PER_S
    if gap_s > max_gap_s:
        raise PoseNotYetError(
            f'in a gap of {gap_s:.3f} s of {edge.describe(older_ns)}, longer than '
            f'{max_gap_s:g} s (pose.max_gap_s)'
        )
