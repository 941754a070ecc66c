# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
StampGuard: one message with an odd stamp does not set time back or forward.

A stamp is odd if it is before the newest of its source by more than ``input.reset_after_s``, or
ahead of all data by more than MAX_AHEAD_S. The message is held until the next one, of any source,
agrees with its stamp; then both are used, and time continues from their stamps. Otherwise it is
dropped. After a message ahead, any later stamp agrees: time went on. If that one is further than
MAX_AHEAD_S again, as of a sensor that stops to scan, steps up to twice as long are no longer odd.
The clock is not read, so that a replay decides as the node did.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

MAX_AHEAD_S = 60.0
"""A message whose stamp is further ahead of all data needs a second one that agrees, s."""


class HeldMessage(NamedTuple):
    """A message with an odd stamp, and what to do with it."""

    stamp_ns: int
    accept: Callable[[], None]
    refuse: Callable[[str], None]


class StampGuard:
    """
    Decides which stamps of scans and poses are used.

    Parameters
    ----------
    reset_after_s : float
        A stamp further back than this is odd.

    Attributes
    ----------
    newest_ns : int or None
        The newest stamp accepted since time was set back.
    ahead_ns : int
        A stamp further ahead than this is odd.

    """

    def __init__(self, reset_after_s: float) -> None:
        self._back_ns = round(reset_after_s * 1e9)
        self.ahead_ns = round(MAX_AHEAD_S * 1e9)
        self._held: HeldMessage | None = None
        self.newest_ns: int | None = None

    @property
    def held_ns(self) -> int | None:
        """Stamp of the message that is held, if any."""
        return None if self._held is None else self._held.stamp_ns

    def take(
        self,
        stamp_ns: int,
        own_ns: int | None,
        other_ns: int | None,
        accept: Callable[[], None],
        refuse: Callable[[str], None],
    ) -> None:
        """
        Accept a message, or hold it until the next one.

        Parameters
        ----------
        stamp_ns : int
            Its stamp.
        own_ns, other_ns : int, optional
            Newest stamps of its source, and of data of the other kind.
        accept : callable
            Uses the message.
        refuse : callable
            Drops it; takes the reason.

        """
        is_odd = self._is_odd(stamp_ns, own_ns, other_ns)
        held, self._held = self._held, None
        if held is not None and self._agree(stamp_ns, held.stamp_ns, is_odd):
            self.ahead_ns = max(round(MAX_AHEAD_S * 1e9), 2 * (stamp_ns - held.stamp_ns))
            self.newest_ns = held.stamp_ns
            held.accept()
            is_odd = False
        elif held is not None:
            held.refuse(self._reason(held.stamp_ns))
        if is_odd:
            self._held = HeldMessage(stamp_ns, accept, refuse)
            return
        if self.newest_ns is None or stamp_ns > self.newest_ns:
            self.newest_ns = stamp_ns
        accept()

    def drop_held(self) -> None:
        """Drop the message that is held: no other comes."""
        held, self._held = self._held, None
        if held is not None:
            held.refuse(self._reason(held.stamp_ns))

    def _is_odd(self, stamp_ns: int, own_ns: int | None, other_ns: int | None) -> bool:
        if self.newest_ns is not None and stamp_ns - self.newest_ns > self.ahead_ns:
            return True
        if own_ns is None or own_ns - stamp_ns <= self._back_ns:
            return False
        return other_ns is None or abs(stamp_ns - other_ns) > self._back_ns

    def _agree(self, stamp_ns: int, held_ns: int, is_odd: bool) -> bool:
        """Return whether a message is about as old as the held one, or follows it if odd too."""
        step_ns = stamp_ns - held_ns
        if is_odd and self.newest_ns is not None and held_ns > self.newest_ns:
            return step_ns >= -self._back_ns
        return -self._back_ns <= step_ns <= (self.ahead_ns if is_odd else self._back_ns)

    def _reason(self, stamp_ns: int) -> str:
        """Return why a message was not used."""
        newest_ns = stamp_ns if self.newest_ns is None else self.newest_ns
        off_s = (stamp_ns - newest_ns) / 1e9
        where = f'{off_s:.3f} s ahead of' if off_s > 0.0 else f'{-off_s:.3f} s before'
        return f'its stamp is {where} the newest data, and the next message does not agree with it'
