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
from test.fuzz.mutations import mutations
from test.fuzz.oracle import checked_cost, Cost

NEEDED = {
    'parquet': 'pyarrow',
    'pcd': 'lzf',
    'mcap': 'mcap',
    'las': 'laspy',
    'packets': 'ouster.sdk',
    'map_url': 'rclpy',
}


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
def test_inputs_give_results_or_our_errors_in_bounded_memory_and_time(name):
    one_input, corpus, number = harness(name)
    first, *others = mutations(corpus(), number)
    one_input(first)  # imports and compiled kernels are not counted
    worst = Cost(0, 0.0, 0.0, 0.0)
    for data in others:
        worst = Cost(*map(max, worst, checked_cost(name, one_input, data)))
    print(f'{name}: {len(others)} inputs, {worst.used >> 20} MiB, {worst.seconds:.3f} s')
