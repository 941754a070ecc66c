# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
MountChanges: sensors that moved on the robot while mapping, and jumps of poses, in words.

The map then holds scans of the old place, at poses that the new one contradicts.
"""

from __future__ import annotations

from dataclasses import dataclass

from surfel_mapper.poses.buffer import ALTERNATING, FrameMove

MAX_FRAMES = 100
"""Frames whose changes are kept."""


@dataclass(slots=True)
class _Change:
    """The latest move of a frame, the number of its moves, and the last scan before it, ns."""

    move: FrameMove
    number: int
    last_ns: int


class MountChanges:
    """The changes of mounts since the map was cleared."""

    def __init__(self) -> None:
        self._changes: dict[str, _Change] = {}

    def add(self, move: FrameMove, last_ns: int) -> str:
        """
        Add a move; return it in words.

        Parameters
        ----------
        move : FrameMove
            The move, of a frame that carries a sensor.
        last_ns : int
            Stamp of the last scan before it.

        """
        change = self._changes.pop(move.child, None)
        number = 1 if change is None else change.number + 1
        self._changes[move.child] = _Change(move, number, last_ns)
        if len(self._changes) > MAX_FRAMES:
            del self._changes[next(iter(self._changes))]
        return _described(move, number)

    def clear(self) -> None:
        """Forget all changes, as the map holds no scan of an old mount."""
        self._changes.clear()

    def warning(self, oldest_ns: int) -> str:
        """Return the changes after the oldest scan of the map; empty if there are none."""
        texts = [
            _described(change.move, change.number)
            for change in self._changes.values()
            if change.last_ns >= oldest_ns
        ]
        if not texts:
            return ''
        return f'{"; ".join(texts)}; the map holds scans of the old place'


def _described(move: FrameMove, number: int) -> str:
    """Return the two mounts of a frame, or that two publishers contradict each other."""
    old, new = (
        f'({x:.3f}, {y:.3f}, {z:.3f}) m in {parent!r}'
        for parent, (x, y, z) in zip(move.parents, move.positions, strict=True)
    )
    if number < ALTERNATING:
        return f'{move.child!r} has moved from {old} to {new}'
    return (
        f'{move.child!r} alternates between {old} and {new}: two publishers contradict each other'
    )
