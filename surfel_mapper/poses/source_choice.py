# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The choice of ``pose.source: auto``: its order and its reason, the same in node and replay.

The node knows candidates from the graph and the first messages, a replay from a sample of the bag.
The first candidate that can give the poses is taken, and the reason names those before it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

AUTO = 'auto'
"""The pose.source that is chosen from the data."""

REGISTRATION = 'registration'

ORDER = ('tf', 'odometry', 'pose')
"""A tree of transforms comes first: it has the mounts of the sensors as well."""


@dataclass(frozen=True, slots=True)
class PoseCandidate:
    """
    A source that may give the poses of the scans.

    Attributes
    ----------
    source : str
        Its ``pose.source``.
    topic : str
        Its topic.
    missing : str
        Why it cannot give them; empty if it can.
    settings : str
        The settings that it needs, for the reason.

    """

    source: str
    topic: str
    missing: str = ''
    settings: str = ''


@dataclass(frozen=True, slots=True)
class SourceChoice:
    """
    The source that was chosen.

    Attributes
    ----------
    source : str
        Its ``pose.source``; registration if no candidate gives poses.
    reason : str
        Why, with the candidates before it.
    topic : str
        Its topic; empty for registration.

    """

    source: str
    reason: str
    topic: str = ''

    def __str__(self) -> str:
        return f'pose.source auto takes {self.source}: {self.reason}'


def choose_source(candidates: Iterable[PoseCandidate]) -> SourceChoice:
    """Return the first candidate, in ``ORDER``, that can give the poses, else registration."""
    refused: list[str] = []
    for candidate in sorted(candidates, key=lambda c: ORDER.index(c.source)):
        if not candidate.missing:
            settings = f' ({candidate.settings})' if candidate.settings else ''
            reason = '; '.join([f'{candidate.topic} has them{settings}', *refused])
            return SourceChoice(candidate.source, reason, candidate.topic)
        refused.append(f'not from {candidate.source}: {candidate.missing}')
    reason = '; '.join(['no topic gives the poses of the clouds', *refused])
    return SourceChoice(REGISTRATION, reason)


def has_chain(parents: Mapping[str, str], fixed: str, frame: str) -> bool:
    """Return whether transforms lead from a frame to the fixed one; parents are by child."""
    return not set(above(parents, fixed)).isdisjoint(above(parents, frame))


def above(parents: Mapping[str, str], frame: str) -> list[str]:
    """Return a frame and all frames above it; a loop ends at its first frame."""
    frames = [frame]
    while (parent := parents.get(frames[-1])) is not None and parent not in frames:
        frames.append(parent)
    return frames


def without_chain(fixed: str, frames: Iterable[str]) -> str:
    """Return the text for transforms that do not lead from a fixed frame to those of clouds."""
    return f'no transforms lead from {fixed} to {", ".join(sorted(frames))}'
