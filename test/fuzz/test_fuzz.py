# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The corpus of every harness and seeded mutations of it: our errors only, and bounded memory.

The same inputs in every run, about 20,000; ``make fuzz`` searches on.
"""

from __future__ import annotations

from importlib.util import find_spec
import logging
import time

import numpy as np
import pytest

from test.fuzz import files
from test.fuzz.harnesses import HARNESSES
from test.fuzz.memory import reset_peak, resident
from test.fuzz.mutations import mutations

NEEDED = {
    'parquet': 'pyarrow',
    'parquet_structure': 'pyarrow',
    'pcd': 'lzf',
    'mcap': 'mcap',
    'map_url': 'rclpy',
}

MOST_BYTES = 64 << 20
"""Memory that any input may take: the heap grows in steps, and chunks may unpack to 64 MiB."""

BUILT_BYTES = 32 << 20
"""Further memory of the harness that builds chunks of 20 MB in memory before they are read."""

MOST_RATIO = 20
"""Memory per input byte."""

MOST_S, MOST_S_PER_BYTE = 0.2, 100e-9
"""Processor time that any input may take, and per input byte."""

SLOW = {
    'drive': (20.0, 'maps up to 14 scans with their poses'),
    'chain': (20.0, 'applies the filters that it reads'),
    'yaml_structure': (20.0, 'PyYAML takes 10 us a token'),
    'mcap_structure': (20.0, 'a message of 31 bytes that packs to nothing takes 4 us'),
    'ros1_structure': (5.0, 'likewise'),
}
"""Readers that may take longer: factors of the time, and why. Their budgets limit them to 10 s."""


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
def test_inputs_give_results_or_our_errors_in_bounded_memory_and_time(name):
    one_input, corpus, number = harness(name)
    first, *others = mutations(corpus(), number)
    one_input(first)  # imports and compiled kernels are not counted
    worst = [0, 0.0]
    factor, _ = SLOW.get(name, (1.0, ''))
    most_bytes = MOST_BYTES + BUILT_BYTES * (name == 'mcap_structure')
    for data in others:
        used, seconds, share = cost(one_input, data)
        if share > factor:  # a collection of garbage, or a page fault, counts once
            used, seconds, share = cost(one_input, data)
        assert used < most_bytes + MOST_RATIO * len(data), (len(data), data[:100])
        assert share <= factor, (seconds, share, len(data), data[:100])
        worst = [max(worst[0], used), max(worst[1], seconds)]
    print(f'{name}: {len(others)} inputs, {worst[0] >> 20} MiB, {worst[1]:.3f} s')


def cost(one_input, data):
    """
    Return the memory, bytes, the processor time, s, and that time by the time allowed.

    Of harnesses that build files only the reads count, each by the size of its file.
    """
    reset_peak()
    files.READS.clear()
    before, start_s = resident('VmRSS'), time.process_time()
    one_input(data)
    used, seconds = resident('VmHWM') - before, time.process_time() - start_s
    reads = files.READS or [(seconds, len(data))]
    share = max(taken / (MOST_S + MOST_S_PER_BYTE * size) for taken, size in reads)
    return used, max(taken for taken, _ in reads), share
