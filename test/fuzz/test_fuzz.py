# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The corpus of every harness and seeded mutations of it: no error but ours, and bounded memory.

The same inputs in every run, a few thousand altogether; ``make fuzz`` searches on.
"""

from __future__ import annotations

import contextlib
from importlib.util import find_spec
import logging
from pathlib import Path

import numpy as np
import pytest

from test.fuzz.harnesses import HARNESSES
from test.fuzz.mutations import mutations

NEEDED = {'parquet': 'pyarrow', 'pcd': 'lzf', 'mcap': 'mcap', 'map_url': 'rclpy'}

MOST_BYTES = 64 << 20
"""What one input may take: the heap grows in steps, and packed bytes may unpack to so much."""

MOST_RATIO = 300
"""And for each byte of it: numbers in text become objects, zlib packs a hundredfold."""


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


def resident(what):
    """Return the bytes of memory in use, VmRSS, or their peak, VmHWM; 0 where nobody counts."""
    try:
        lines = Path('/proc/self/status').read_text(encoding='ascii').splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) << 10 for line in lines if line.startswith(what)), 0)


def reset_peak():
    with contextlib.suppress(OSError):
        Path('/proc/self/clear_refs').write_text('5', encoding='ascii')


@pytest.mark.filterwarnings('ignore::RuntimeWarning')
@pytest.mark.parametrize('name', HARNESSES)
def test_no_input_makes_anything_but_a_result_or_an_error_of_ours(name):
    one_input, corpus, number = harness(name)
    first, *others = mutations(corpus(), number)
    one_input(first)  # what is loaded once is no part of the input
    for data in others:
        reset_peak()
        before = resident('VmRSS')
        one_input(data)
        used = resident('VmHWM') - before
        assert used < MOST_BYTES + MOST_RATIO * len(data), (len(data), data[:100])
