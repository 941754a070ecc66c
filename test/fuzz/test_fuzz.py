# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The corpus of every harness and seeded mutations of it: our errors only, and bounded memory.

The same inputs in every run, about 10,000.
"""

from __future__ import annotations

import logging

import numpy as np
import pytest

from test import extras
from test.fuzz.harnesses import HARNESSES
from test.fuzz.memory import reset_peak, resident
from test.fuzz.mutations import mutations

NEEDED = {
    'parquet': 'pyarrow',
    'pcd': 'lzf',
    'mcap': 'mcap',
    'map_url': 'rclpy',
}

MOST_BYTES = 256 << 20
"""Memory that the inputs of a harness may take: chunks may unpack to 64 MiB, the heap grows."""


@pytest.fixture(autouse=True)
def quiet():
    logging.disable(logging.CRITICAL)
    with np.errstate(all='ignore'):
        yield
    logging.disable(logging.NOTSET)


def harness(name):
    if name in NEEDED:
        extras.load(NEEDED[name])
    return HARNESSES[name]


@pytest.mark.filterwarnings('ignore::RuntimeWarning')
@pytest.mark.parametrize('name', HARNESSES)
def test_inputs_give_results_or_our_errors_in_bounded_memory(name):
    one_input, corpus, number = harness(name)
    first, *others = mutations(corpus(), number)
    one_input(first)  # imports and compiled kernels are not counted
    reset_peak()
    before = resident('VmRSS')
    for data in others:
        one_input(data)
    assert resident('VmHWM') - before < MOST_BYTES
