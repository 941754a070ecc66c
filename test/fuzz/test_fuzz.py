# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The corpus of every harness and seeded mutations of it: no error but ours, and bounded memory.

The same inputs in every run, a few thousand altogether; ``make fuzz`` searches on.
"""

from __future__ import annotations

from importlib.util import find_spec
import logging

import numpy as np
import pytest

from test.fuzz.harnesses import HARNESSES
from test.fuzz.memory import reset_peak, resident
from test.fuzz.mutations import mutations

NEEDED = {'parquet': 'pyarrow', 'pcd': 'lzf', 'mcap': 'mcap', 'map_url': 'rclpy'}

MOST_BYTES = 64 << 20
"""Memory that any input may take: the heap grows in steps, and chunks may unpack to 64 MiB."""

MOST_RATIO = 300
"""Memory per input byte: numbers in text become objects, zlib compresses a hundredfold."""


@pytest.fixture(autouse=True)
def quiet():
    logging.disable(logging.CRITICAL)
    with np.errstate(all='ignore'):
        yield
    logging.disable(logging.NOTSET)


def harness(name):
    if name in NEEDED and find_spec(NEEDED[name]) is None:
        pytest.skip(f'{NEEDED[name]} is not installed')
    return HARNESSES[name]


@pytest.mark.filterwarnings('ignore::RuntimeWarning')
@pytest.mark.parametrize('name', HARNESSES)
def test_inputs_give_results_or_our_errors_in_bounded_memory(name):
    one_input, corpus, number = harness(name)
    first, *others = mutations(corpus(), number)
    one_input(first)  # imports and compiled kernels are not counted
    for data in others:
        reset_peak()
        before = resident('VmRSS')
        one_input(data)
        used = resident('VmHWM') - before
        assert used < MOST_BYTES + MOST_RATIO * len(data), (len(data), data[:100])
