# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Offsets between the clocks of sensors and of poses, measured by a third clock.

A recorder, or a node that receives, has one clock for all messages, some milliseconds after they
were sent. If stamps of clouds lie seconds further from those times than stamps of poses do, and
steadily, two clocks were used: TAI against UTC, a device that counts from its start, another time
zone. The difference of the two medians is the offset, as exact as the delays of both are alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

LEAST_OFFSET_S = 0.5
"""Smaller offsets are not told from delays: odometry of a SLAM comes some 0.3 s late."""

MOST_SPREAD = 0.3
"""Largest spread of the delays of a topic, as a share of the offset: a clock is steady."""

HINTS = ((37.0, 1.0, 'TAI is ahead of UTC by 37 s'), (1e8, 1e30, 'one counts from its start'))
"""Usual offsets: the least, the width, and their cause."""

MOST_DELAY_S = 10.0
"""Messages that come later than this have another clock, not a delay."""

ZONE_S = 1800.0
"""Clocks of other time zones differ by multiples of this, s."""


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """
    Offset of the stamps of clouds from those of poses.

    Attributes
    ----------
    clouds, reference : str
        Topic of the clouds; topic of the poses, or of other clouds if there are no poses.
    seconds : float
        Positive if the clouds are ahead.
    measured_by : str
        Times or motions that show it.
    added_s : float
        Seconds that ``--time-offset`` has already added to the stamps.

    """

    clouds: str
    reference: str
    seconds: float
    measured_by: str = 'record times'
    added_s: float = 0.0

    def __str__(self) -> str:
        topic = f'{self.clouds}=' if self.clouds.startswith('/') else ''
        return self.described(
            f'--time-offset {topic}{self.added_s - self.seconds:.3f} (or input.time_offset_s)'
        )

    def described(self, remedy: str) -> str:
        """Return the offset in words, with the settings that correct it."""
        side = 'ahead of' if self.seconds > 0.0 else 'behind'
        return (
            f'by the {self.measured_by}, stamps of {self.clouds} are {abs(self.seconds):.3f} s '
            f'{side} those of {self.reference}: the clocks differ{self._hint()}; {remedy} '
            'corrects them'
        )

    def _hint(self) -> str:
        """Return the usual cause of such an offset, in brackets; empty if there is none."""
        size = abs(self.seconds)
        causes = [text for least, width, text in HINTS if least - 0.5 <= size < least + width]
        if size < HINTS[1][0] and size > 1.0 and abs(size / ZONE_S - round(size / ZONE_S)) < 1e-3:
            causes = ['another time zone']
        if not causes and size < MOST_DELAY_S and self.measured_by.endswith('times'):
            late = self.reference if self.seconds > 0.0 else self.clouds
            causes = [f'or {late} comes late, and its stamps are right']
        return f' ({causes[0]})' if causes else ''


def offset_s(leads_ns: Sequence[int], reference_ns: Sequence[int]) -> float | None:
    """
    Return the offset of two clocks, s; None if it is small or not steady.

    Parameters
    ----------
    leads_ns, reference_ns : sequence of int
        Times by which stamps are ahead of the third clock, of the messages of two topics.

    """
    if not leads_ns or not reference_ns:
        return None
    quantiles = [
        np.quantile(np.array(leads), (0.1, 0.5, 0.9)) for leads in (leads_ns, reference_ns)
    ]
    seconds = float(quantiles[0][1] - quantiles[1][1]) / 1e9
    spread_s = max(float(high - low) for low, _, high in quantiles) / 1e9
    is_steady = spread_s <= MOST_SPREAD * abs(seconds)
    return seconds if abs(seconds) >= LEAST_OFFSET_S and is_steady else None
