# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
A layer that fails at random, once or until it is switched off, for soaks of the node.

A package of its own registers it by an entry point, as other packages register theirs; importing
this module adds its setting to those of the process.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
import random

from surfel_mapper.config import register_stage, setting, Stage
from surfel_mapper.layers import Layer, Publication, register
from test.soak.heap import write_heap

FAILURES = (MemoryError, RuntimeError, ValueError, KeyError, ZeroDivisionError, OSError)

REPORTED = 50
"""Calls between two reports of the heap."""

ONCE, FOR_GOOD = 0.02, 0.003
"""Probabilities that a call fails, and that all further calls do until the map is cleared."""


@register_stage
@dataclass(frozen=True, slots=True, kw_only=True)
class UnreliableConfig(Stage):
    """A layer that fails."""

    STAGE = 'layers.unreliable'
    enabled: bool = setting(False, 'Fail at random.')


class UnreliableLayer(Layer):
    """A layer each of whose methods may fail."""

    name = 'unreliable'

    def __init__(self, config, around):
        super().__init__(config, around)
        self._rng = random.Random(1)
        self._fails = False
        self._calls = 0

    def follow(self, inserted):
        """Follow a scan, or fail; report the heap of the process now and then."""
        self._calls += 1
        if self._calls % REPORTED == 0:
            write_heap(Path.cwd())
        self._fails |= self._rng.random() < FOR_GOOD
        return self._fail()

    def voxels_to_clear(self, inserted):
        """Clear nothing, or fail."""
        self._fail()
        return super().voxels_to_clear(inserted)

    def clear(self):
        """Begin again, or fail."""
        self._fails = False
        self._fail()

    def publications(self):
        """Return a topic whose messages may fail."""
        kind = 'std_msgs/msg/Int64'
        return [Publication(topic='~/unreliable', type_name=kind, messages=self._messages)]

    def _messages(self, now):
        self._fail()
        return [bytes((0, 1, 0, 0)) + bytes(8)]

    def _fail(self):
        if self._fails or self._rng.random() < ONCE:
            raise self._rng.choice(FAILURES)('the layer fails, as it is made to')


register('unreliable', f'{__name__}:UnreliableLayer', switch='layers.unreliable.enabled')
