# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Mutations of bytes, the same for the same seed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import random

EDGES = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)

MAX_BYTES = 1 << 16
"""Size limit of mutated inputs, bytes."""


def mutations(corpus: Sequence[bytes], number: int, seed: int = 1) -> Iterator[bytes]:
    """Yield the corpus and then ``number`` mutations of it."""
    yield from corpus
    rng = random.Random(seed)
    for _ in range(number):
        data = bytearray(rng.choice(corpus))
        for _ in range(rng.choice((1, 1, 2, 4, 8))):
            rng.choice(WAYS)(rng, data, corpus)
        yield bytes(data[:MAX_BYTES])


def flip(rng, data, corpus):
    """Flip a bit."""
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def overwrite(rng, data, corpus):
    """Insert an integer at the limit of a type."""
    size = rng.choice((1, 2, 4, 8))
    value = rng.choice(EDGES) & ((1 << 8 * size) - 1)
    at = rng.randrange(len(data) + 1)
    data[at : at + size] = value.to_bytes(size, rng.choice(('little', 'big')))


def randomise(rng, data, corpus):
    """Overwrite some bytes at random."""
    at = rng.randrange(len(data) + 1)
    data[at : at + rng.randrange(1, 9)] = rng.randbytes(rng.randrange(1, 9))


def cut(rng, data, corpus):
    """Remove a slice, or the end."""
    at = rng.randrange(len(data) + 1)
    del data[at : at + rng.choice((1, 4, 16, len(data)))]


def repeat(rng, data, corpus):
    """Repeat a slice."""
    at = rng.randrange(len(data) + 1)
    piece = data[at : at + rng.randrange(1, 65)]
    data[at:at] = piece * rng.choice((1, 2, 50))


def splice(rng, data, corpus):
    """Append the end of another input."""
    other = rng.choice(corpus)
    data[rng.randrange(len(data) + 1) :] = other[rng.randrange(len(other) + 1) :]


WAYS = (flip, flip, overwrite, overwrite, randomise, cut, repeat, splice)
