# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Bytes as a source of choices, so that mutated bytes also generate messages and files."""

from __future__ import annotations

import math
import struct

NUMBERS = (
    0,
    1,
    -1,
    2,
    3,
    7,
    8,
    12,
    255,
    256,
    2**15,
    2**16,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**32,
    2**62,
    2**63 - 1,
    -(2**31),
    -(2**63),
    10**9 - 1,
    10**9,
)
FLOATS = (
    0.0,
    -0.0,
    1.0,
    -1.0,
    0.5,
    1e-320,
    1e-30,
    1e30,
    1e154,
    1.7e308,
    -1.7e308,
    math.inf,
    -math.inf,
    math.nan,
    524_288.0,
    3.4e38,
)
TEXTS = (
    '',
    'lidar',
    'odom',
    'base_link',
    'map',
    '/lidar',
    ' ',
    'x' * 300,
    '\0',
    '../..',
    'ä',
    '\ud7ff',
    '<b>',
    '%s{0}',
    'a\nb',
)


class Source:
    """Gives one choice after another; zeros when the bytes are used up."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def bytes(self, size: int) -> bytes:
        """Return the next bytes, filled up with zeros."""
        found = self._data[self._at : self._at + size]
        self._at += size
        return found.ljust(size, b'\0')

    def rest(self) -> bytes:
        """Return the remaining bytes."""
        return self._data[self._at :]

    def below(self, end: int) -> int:
        """Return a number from 0 up to an end."""
        return int.from_bytes(self.bytes(2), 'little') % end

    def pick(self, items):
        """Return one of some items."""
        return items[self.below(len(items))]

    def chance(self, one_in: int) -> bool:
        """Return whether to take a rare choice; False when the bytes are used up."""
        return self.below(one_in) == one_in - 1

    def number(self) -> int:
        """Return a whole number, often one at the edge of a type."""
        return self.pick(NUMBERS) if self.below(2) else self.below(1 << 16)

    def real(self) -> float:
        """Return a number, often one at the limits of arithmetic."""
        if self.below(2):
            return self.pick(FLOATS)
        return struct.unpack('<d', self.bytes(8))[0]

    def text(self) -> str:
        """Return a text with special characters."""
        return self.pick(TEXTS)
