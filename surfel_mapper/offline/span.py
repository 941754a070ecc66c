# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which part of a recording is mapped, by record time.

A part needs poses from a little before its first cloud, to interpolate, and from after its last,
which come late. Static transforms hold for all time, wherever they were recorded.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

from surfel_mapper.errors import BagError

MARGIN_NS = 5_000_000_000
"""Poses this much before the part and after it are read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """
    Which clouds are mapped.

    Attributes
    ----------
    start_ns, stop_ns : int, optional
        Record time of the first one wanted, and of the first not wanted any more.
    every : int
        1: all of them; n: the first of every n of a topic.

    """

    start_ns: int | None = None
    stop_ns: int | None = None
    every: int = 1

    def holds(self, record_ns: int) -> bool:
        """Return whether a cloud recorded then is in the part."""
        begun = self.start_ns is None or record_ns >= self.start_ns
        return begun and (self.stop_ns is None or record_ns < self.stop_ns)

    @property
    def poses_start_ns(self) -> int | None:
        """From where on poses are read."""
        return None if self.start_ns is None else self.start_ns - MARGIN_NS

    @property
    def poses_stop_ns(self) -> int | None:
        """Up to where poses are read."""
        return None if self.stop_ns is None else self.stop_ns + MARGIN_NS

    def clipped(self, first_ns: int, last_ns: int) -> tuple[int, int]:
        """Return record time of first and last message of the part of a recording."""
        start_ns = first_ns if self.start_ns is None else max(self.start_ns, first_ns)
        stop_ns = last_ns if self.stop_ns is None else min(self.stop_ns, last_ns)
        return start_ns, max(stop_ns, start_ns)


WHOLE = Span()


def part(
    name: str,
    first_ns: int,
    last_ns: int,
    *,
    start_s: float = 0.0,
    duration_s: float = math.inf,
    every: int = 1,
) -> Span:
    """
    Return a part of a recording.

    Parameters
    ----------
    name : str
        What errors call the recording.
    first_ns, last_ns : int
        Record time of its first and last message.
    start_s : float
        Where the part begins, s after the first message.
    duration_s : float
        How long it is, s.
    every : int
        One cloud of so many is mapped.

    Raises
    ------
    BagError
        If it is empty, or begins outside of the recording.

    """
    whole_s = (last_ns - first_ns) / 1e9
    if not 0.0 <= start_s <= whole_s:
        raise BagError(f'{name}: start {start_s:g} s, expected 0 to {whole_s:.3f} s')
    if not duration_s > 0.0:
        raise BagError(f'{name}: duration {duration_s:g} s, expected more than 0')
    if every < 1:
        raise BagError(f'{name}: every {every}, expected 1 or more')
    start_ns = first_ns + round(start_s * 1e9)
    return Span(
        start_ns=start_ns if start_s > 0.0 else None,
        stop_ns=None if duration_s > whole_s else start_ns + round(duration_s * 1e9),
        every=every,
    )
