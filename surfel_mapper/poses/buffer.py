# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
TransformBuffer: the tree of coordinate frames over time, asked for one transform at a stamp.

A frame has one parent at a time, so an edge of the tree is stored by its child. A dynamic edge
holds transforms sorted by stamp, a static one a single transform for all time. As in tf2, a new
parent holds from its stamp on, and a static one for all time. Node and replay use this one class:
a lookup depends only on the transforms held, not on the order they came in, and is composed in a
fixed order (geometry.py), so both compute the same pose to the last bit.
Nothing is extrapolated: a robot that turns by 1 rad/s moves a point at 50 m by 5 m in the 0.1 s
of a sweep.

Callers act on two kinds of failure: after PoseNotYetError later data may answer the lookup, so the
scan should wait; after any other PoseError none can, so it should be dropped.

Odometry comes at 100 Hz and more, ten times as often as scans. Every transform is checked with
Python's own floats: numpy takes a microsecond for any operation on a few numbers.

Frames and stamps come from messages, so the numbers of frames and transforms are limited. A lookup
climbs a limited number of edges, and costs the same however many other frames there are.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from itertools import count, filterfalse, islice, pairwise
import math
from operator import attrgetter

import numpy as np

from surfel_mapper.errors import PoseError, PoseNotYetError, PosesLateError
from surfel_mapper.geometry import compose, interpolate, inverse, Transform

NS_PER_S = 1_000_000_000

MAX_EDGES = 10_000
"""Largest number of edges; a robot has some hundred, and new names must not fill the memory."""

MAX_DEPTH = 100
"""Limit of the edges that a lookup climbs from a frame; an arm on a truck has some twenty."""

MAX_TRANSFORMS = 500_000
"""Limit of the transforms held, 170 MB; 80 joints at 100 Hz have 480,000 a minute."""

SAME_MOUNT = 1e-5
"""Static transforms whose entries differ by less are the same; 10 um and 10 urad."""

ALTERNATING = 4
"""Changes of parent that one restarted publisher, or one stray message, cannot make."""

JUMP_M, JUMP_M_S, JUMP_NS = 0.2, 60.0, 100_000_000
"""Least step, m, and speed, m/s, of a jump between two poses at most this far apart, ns. Odometry
that restarts jumps, and two publishers of one transform. Poses without times have 0.1 s each."""

MAX_NAMES = 12
"""Number of frames named in a message."""


@dataclass(frozen=True, slots=True)
class FrameMove:
    """
    A frame that got a new parent, or another static transform in its parent, or jumped.

    Attributes
    ----------
    child : str
        The frame.
    parents : (str, str)
        Its parent until then, and its parent now.
    positions : ((3,) tuple, (3,) tuple)
        Its last position in the one, and its position in the other, m.

    """

    child: str
    parents: tuple[str, str]
    positions: tuple[tuple[float, ...], tuple[float, ...]]


@dataclass(slots=True, eq=False)
class PoseTrack:
    """
    Transforms of a child frame in its parents by ascending stamp; one if static.

    A frame that gets a new parent moves, as in tf2: at a stamp it has the parent of its newest
    transform up to there.
    """

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


class TransformBuffer:
    """
    The transforms between coordinate frames over time.

    Beyond MAX_TRANSFORMS the older half of the edge that has the most is dropped.

    Parameters
    ----------
    history_s : float
        Every dynamic edge keeps the transforms up to this much older than its newest. At 1 kHz,
        60 s are 60,000 transforms, some 20 MB.
    reset_after_s : float
        A transform older than the newest of its edge by more than this means that time was set
        back: the older transforms of the edge are dropped. One older by less is inserted.
    max_gap_s : float
        Transforms are interpolated between two of an edge that are at most this far apart.

    Attributes
    ----------
    max_gap_s : float
        May be changed at any time.
    num_transforms : int
        Transforms held of all dynamic edges.
    num_forgotten : int
        Transforms dropped so far because there were too many.
    move : FrameMove, optional
        The last frame that moved; readers set it to None.

    """

    def __init__(
        self,
        history_s: float = 60.0,
        reset_after_s: float = 1.0,
        max_gap_s: float = math.inf,
    ) -> None:
        self._history_ns = round(history_s * NS_PER_S)
        self._reset_after_ns = round(reset_after_s * NS_PER_S)
        self.max_gap_s = max_gap_s
        self.num_transforms = 0
        self.num_forgotten = 0
        self.move: FrameMove | None = None
        self._edges: dict[str, PoseTrack] = {}
        self._frames: dict[str, None] = {}  # all that have an edge, in the order of arrival
        self._newest: PoseTrack | None = None

    @property
    def newest_ns(self) -> int | None:
        """Newest stamp of any dynamic edge; None while there is none."""
        return None if self._newest is None else self._newest.stamps[-1]

    def newest_of(self, child: str) -> int | None:
        """Return the newest stamp of the edge above a frame; None if it is static or unknown."""
        edge = self._edges.get(child)
        return None if edge is None or edge.is_static else edge.stamps[-1]

    def newest_between(self, target: str, source: str) -> int | None:
        """
        Return the newest stamp at which the transform between two frames is known.

        None if they are the same, or static edges alone lie between them.
        """
        return min((edge.stamps[-1] for edge in self._dynamic(target, source)), default=None)

    def newest_beside(self, target: str, source: str) -> int | None:
        """
        Return the newest stamp, which tells how long a transform between two frames is awaited.

        That of any edge; but an edge between the two may be stamped ahead, as by a localisation,
        and counts only as far as they all reach.
        """
        if self._newest is None:
            return None
        dynamic, newest_ns = self._dynamic(target, source), self._newest.stamps[-1]
        if self._newest in dynamic:
            for edge in dynamic:
                newest_ns = min(newest_ns, edge.stamps[-1])
        return newest_ns

    def is_between(self, frame: str, target: str, source: str) -> bool:
        """Return whether a frame has its edge on the way between two frames, or to the roots."""
        between = {*self._above(source)[0]} ^ {*self._above(target)[0]}
        return any(edge.child == frame for edge in between)

    def _dynamic(self, target: str, source: str, stamp_ns: int | None = None) -> list[PoseTrack]:
        """Return the dynamic edges between two frames, at a stamp or now."""
        up, down = self._above(source, stamp_ns)[0], self._above(target, stamp_ns)[0]
        return [*filterfalse(attrgetter('is_static'), {*up} ^ {*down})]

    def add(
        self,
        parent: str,
        child: str,
        stamp_ns: int,
        T_parent_child: Transform,
    ) -> None:
        """
        Add the transform of an edge at one stamp.

        Parameters
        ----------
        parent, child : str
            Names of the frames.
        stamp_ns : int
            Time of the transform.
        T_parent_child : (4, 4) float64
            Takes points in the child frame to the parent frame; made by ``pose_matrix``, and not
            changed later.

        Raises
        ------
        PoseError
            If a name is empty, the child has a static transform in this parent, the edge would
            close a loop, or there would be more than MAX_EDGES edges, or more than MAX_DEPTH above
            the child. The buffer is unchanged then.

        """
        edge = self._edges.get(child)
        if edge is None or edge.is_static or edge.parent != parent:
            edge = self._edge(parent, child, is_static=False)
        num_before, is_back = len(edge.stamps), False
        if edge.stamps and stamp_ns < edge.stamps[-1] - self._reset_after_ns:
            edge.forget_oldest(num_before)
            is_back = edge is self._newest
        if not edge.stamps or stamp_ns >= edge.stamps[-1]:
            self._note_move(edge, parent, T_parent_child, stamp_ns)
        edge.insert(stamp_ns, parent, T_parent_child)
        edge.forget_before(edge.stamps[-1] - self._history_ns)
        self.num_transforms += len(edge.stamps) - num_before
        self._enter(edge, parent)
        if is_back:
            self._newest = self._edge_of_newest()
        elif self._newest is None or edge.stamps[-1] > self._newest.stamps[-1]:
            self._newest = edge
        if self.num_transforms > MAX_TRANSFORMS:
            self._forget_half_of_longest()

    def add_static(self, parent: str, child: str, T_parent_child: Transform) -> None:
        """Set the transform of an edge for all time, in the place of an earlier one; see add."""
        edge = self._edge(parent, child, is_static=True)
        self._note_move(edge, parent, T_parent_child)
        edge.set_static(parent, T_parent_child)
        self._enter(edge, parent)

    def lookup(self, target: str, source: str, stamp_ns: int) -> Transform:
        """
        Return the transform that takes points in one frame to another at a stamp.

        A stored transform is returned bit for bit at its own stamp; between two stamps it is
        interpolated. Two equal names give the identity, known or not.

        Returns
        -------
        (4, 4) float64
            T_target_source, a copy.

        Raises
        ------
        PoseNotYetError
            If a frame was never seen, no edges lead from one to the other, or the stamp is in a
            gap longer than ``max_gap_s``: the missing transforms may still come.
        PosesLateError
            If the newest transform of an edge between them is older than the stamp.
        PoseError
            If the stamp is before the oldest transform held of an edge between them.

        """
        up, down = self._edges_between(target, source, stamp_ns)
        try:
            check_held([*up, *down], stamp_ns, self.max_gap_s)
        except PoseError as error:
            raise type(error)(f'{_request(target, source, stamp_ns)}: {error}') from None
        T_common_source, T_common_target = _chained(up, stamp_ns), _chained(down, stamp_ns)
        if T_common_target is None:
            return np.eye(4) if T_common_source is None else np.array(T_common_source)
        T_target_common = inverse(T_common_target)
        if T_common_source is None:
            return T_target_common
        return compose(T_target_common, T_common_source)

    def check_span(self, target: str, source: str, start_ns: int, end_ns: int) -> None:
        """
        Raise an error unless ``lookup`` gives the transform at every stamp of a span.

        Raises
        ------
        PoseNotYetError, PosesLateError, PoseError
            As lookup does.

        """
        up, down = self._edges_between(target, source, start_ns)
        edges, stamp_ns = [*up, *down], start_ns
        try:
            for stamp_ns in (start_ns, end_ns):
                check_held(edges, stamp_ns, self.max_gap_s)
            for edge in edges:
                if not edge.is_static:
                    check_within(edge, start_ns, end_ns, self.max_gap_s)
        except PoseError as error:
            raise type(error)(f'{_request(target, source, stamp_ns)}: {error}') from None

    def stamps(self, target: str, source: str, start_ns: int, end_ns: int) -> list[int]:
        """Return the stamps of transforms between two frames in a span, ends included."""
        per_edge = (edge.stamps for edge in self._dynamic(target, source, start_ns))
        return sorted({s for stamps in per_edge for s in _within(stamps, start_ns, end_ns)})

    def clear(self) -> None:
        """Drop the dynamic edges; static ones stay."""
        self._keep([edge for edge in self._edges.values() if edge.is_static])

    def forget_former_parents(self) -> None:
        """Drop the transforms of frames in parents that they have no more."""
        for edge in self._edges.values():
            edge.forget_former_parents()
        self._keep([*self._edges.values()])

    def _keep(self, edges: list[PoseTrack]) -> None:
        """Keep these edges and their frames alone."""
        self._edges = {edge.child: edge for edge in edges}
        self._frames = {name: None for edge in edges for name in (edge.child, edge.parent)}
        self.num_transforms = sum(len(edge.stamps) for edge in edges)
        self._newest = self._edge_of_newest()

    def _enter(self, edge: PoseTrack, parent: str) -> None:
        """Keep an edge; it replaces one of the other kind."""
        former = self._edges.get(edge.child)
        if former is edge and parent in self._frames:
            return  # nearly always
        self._edges[edge.child] = edge
        self._frames.setdefault(edge.child)
        self._frames.setdefault(parent)
        if former is not None and former is not edge:
            self.num_transforms -= len(former.stamps)
            self._newest = self._edge_of_newest()

    def _note_move(
        self, edge: PoseTrack, parent: str, transform: Transform, stamp_ns: int = 0
    ) -> None:
        """Set ``move`` if an edge had another parent, or another static transform, or jumps."""
        former = self._edges.get(edge.child)
        if former is None or not former.parents:
            return
        T_former = former.transforms[-1]
        positions = tuple(T_former[:3, 3].tolist()), tuple(transform[:3, 3].tolist())
        if former.parent == parent and former.is_static == edge.is_static:
            if edge.is_static and np.allclose(T_former, transform, 0.0, SAME_MOUNT):
                return
            if not edge.is_static and not is_jump(positions, stamp_ns - former.stamps[-1]):
                return
        self.move = FrameMove(edge.child, (former.parent, parent), positions)

    def _edge_of_newest(self) -> PoseTrack | None:
        """Return the dynamic edge with the newest stamp."""
        dynamic = [edge for edge in self._edges.values() if not edge.is_static]
        return max(dynamic, key=lambda edge: edge.stamps[-1], default=None)

    def _forget_half_of_longest(self) -> None:
        """Drop the older half of the edge with the most transforms."""
        longest = max(self._edges.values(), key=lambda edge: len(edge.stamps))
        dropped = len(longest.stamps) // 2
        longest.forget_oldest(dropped)
        self.num_transforms -= dropped
        self.num_forgotten += dropped

    def _edge(self, parent: str, child: str, *, is_static: bool) -> PoseTrack:
        """Return the edge of a child, or a new one; refuse edges that form no tree."""
        name = f'transform {parent!r} -> {child!r}'
        if not parent or not child:
            raise PoseError(f'{name}: the name of a frame is empty')
        if parent == child:
            raise PoseError(f'{name}: a frame cannot be its own parent')
        edge = self._edges.get(child)
        if edge is not None and edge.parent == parent:
            if edge.is_static != is_static:
                kind, came = ('static', 'dynamic') if edge.is_static else ('dynamic', 'static')
                raise PoseError(f'{name}: known as {kind}, a {came} transform came')
            return edge
        edges, frames = self._above(parent)
        if len(edges) >= MAX_DEPTH:
            raise PoseError(f'{name}: over {MAX_DEPTH} transforms above {child!r}')
        if child in frames:
            loop = frames[: frames.index(child)]
            raise PoseError(f'{name}: closes the loop {" -> ".join([child, *loop[::-1], child])}')
        if (edge is None and len(self._edges) >= MAX_EDGES) or (
            parent not in self._frames and len(self._frames) >= 2 * MAX_EDGES
        ):
            raise PoseError(f'{name}: {MAX_EDGES} frames are known, no more are taken')
        if edge is not None and edge.is_static == is_static:
            return edge
        return PoseTrack(child, is_static)

    def _edges_between(
        self, target: str, source: str, stamp_ns: int
    ) -> tuple[list[PoseTrack], list[PoseTrack]]:
        """Return the edges from source and from target up to their first common frame."""
        (up, sources), (down, targets) = (
            self._above(source, stamp_ns),
            self._above(target, stamp_ns),
        )
        rows = dict(zip(targets, count()))
        for row, frame in enumerate(sources):
            if frame in rows:
                return up[:row], down[: rows[frame]]
        raise PoseNotYetError(
            f'{_request(target, source, stamp_ns)}: {self._why_not_connected(target, source)}'
            f'{"".join(map(_parents_in_turn, [*up, *down]))}'
        )

    def _above(self, frame: str, stamp_ns: int | None = None) -> tuple[list[PoseTrack], list[str]]:
        """Return up to MAX_DEPTH edges from a frame upwards, at a stamp or now, and the frames."""
        edges, frames = list[PoseTrack](), [frame]
        while len(edges) < MAX_DEPTH and (edge := self._edges.get(frames[-1])) is not None:
            edges.append(edge)
            frames.append(edge.parent_at(stamp_ns))
        return edges, frames

    def _why_not_connected(self, target: str, source: str) -> str:
        """Return which of two frames is unknown, or that they are in two trees."""
        frames = self._frames
        first = sorted(islice(frames, MAX_NAMES))
        names = ', '.join(first) + (', ...' if len(frames) > MAX_NAMES else '')
        unseen = ' and '.join(frame for frame in (target, source) if frame not in frames)
        if unseen:
            return f'no transform of {unseen} yet; frames seen: {names or "none"}'
        return f'no transforms lead from one to the other yet; frames seen: {names}'


def is_jump(positions: tuple[tuple[float, ...], ...], duration_ns: int) -> bool:
    """Return whether no robot moves so far in so short a time."""
    least_m = max(JUMP_M, JUMP_M_S * duration_ns / NS_PER_S)
    return duration_ns < JUMP_NS and math.dist(*positions) > least_m


def _parents_in_turn(edge: PoseTrack) -> str:
    """Return that publishers contradict each other in the parent of a frame; empty if not."""
    changes = sum(older != newer for older, newer in pairwise(edge.parents))
    if changes < ALTERNATING:
        return ''
    parents = ' and '.join(sorted({*edge.parents}))
    return (
        f'; {edge.child} has in turn the parents {parents}: two publishers contradict each other'
    )


def _request(target: str, source: str, stamp_ns: int) -> str:
    """Return the request of a lookup, for errors."""
    return f'{target} <- {source} at {seconds(stamp_ns)} s'


def _within(stamps: list[int], start_ns: int, end_ns: int) -> list[int]:
    """Return the ascending stamps within a span, ends included."""
    return stamps[bisect_left(stamps, start_ns) : bisect_right(stamps, end_ns)]


def _chained(edges: list[PoseTrack], stamp_ns: int) -> Transform | None:
    """Return the product of edges that lead upwards, from the lowest on; None without any."""
    product: Transform | None = None
    for edge in edges:
        T_parent_child = edge.at(stamp_ns)
        product = T_parent_child if product is None else compose(T_parent_child, product)
    return product


def seconds(stamp_ns: int) -> str:
    """Return a stamp in seconds with all its digits."""
    whole, remainder_ns = divmod(abs(stamp_ns), NS_PER_S)
    return f'{"-" if stamp_ns < 0 else ""}{whole}.{remainder_ns:09d}'


def check_held(edges: list[PoseTrack], stamp_ns: int, max_gap_s: float) -> None:
    """Raise if a dynamic edge has no transforms around a stamp; too old comes before too new."""
    dynamic = [*filterfalse(attrgetter('is_static'), edges)]
    for edge in dynamic:
        if stamp_ns < edge.stamps[0]:
            raise PoseError(f'older than all of {edge.describe(stamp_ns)}')
    for edge in dynamic:
        if stamp_ns > edge.stamps[-1]:
            raise PosesLateError(f'newer than all of {edge.describe(stamp_ns)}')
    for edge in dynamic:
        older, newer = edge.rows_around(stamp_ns)
        older_ns, newer_ns = edge.stamps[older], edge.stamps[newer]
        if (newer_ns - older_ns) / NS_PER_S > max_gap_s:
            raise long_gap(edge, older_ns, newer_ns, max_gap_s)


def check_within(edge: PoseTrack, start_ns: int, end_ns: int, max_gap_s: float) -> None:
    """Raise if the transforms of a span, ends included, are in two parents or too far apart."""
    first, last = bisect_left(edge.stamps, start_ns), bisect_right(edge.stamps, end_ns)
    if not {edge.parent_at(start_ns)}.issuperset(edge.parents[first:last]):
        raise PoseError(f'{edge.child!r} gets a new parent until {seconds(end_ns)} s')
    for older_ns, newer_ns in pairwise(edge.stamps[first:last]):
        if (newer_ns - older_ns) / NS_PER_S > max_gap_s:
            raise long_gap(edge, older_ns, newer_ns, max_gap_s)


def long_gap(edge: PoseTrack, older_ns: int, newer_ns: int, max_gap_s: float) -> PoseNotYetError:
    """Return the error for two transforms too far apart to interpolate between them."""
    return PoseNotYetError(
        f'in a gap of {(newer_ns - older_ns) / NS_PER_S:.3f} s of {edge.describe(older_ns)}, '
        f'longer than {max_gap_s:g} s (pose.max_gap_s)'
    )
