# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Work that threads share in kernels: every part once, and a change of another thread is seen."""

import re
from threading import Thread
import time

import numba
import numpy as np
import pytest

from surfel_mapper.kernels.compiling import kernel
from surfel_mapper.kernels.sharing import claim, latest, watch
from test.kernels.modes import both


@kernel()
def count_parts(claims, times):
    number = claim(claims)
    while number < len(times):
        times[number] += 1
        number = claim(claims)


@both
def test_parts_are_claimed_one_after_the_other(call):
    claims, times = np.array([2]), np.zeros(5, np.int64)
    call(count_parts, claims, times)
    assert times.tolist() == [0, 0, 1, 1, 1]
    assert claims.tolist() == [6]


def test_threads_claim_every_part_once():
    claims, times = np.zeros(1, np.int64), np.zeros(3_000_000, np.uint8)
    count_parts(np.ones(1, np.int64), times[:1])  # compiled before they start
    threads = [Thread(target=count_parts, args=(claims, times)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert np.all(times == 1)
    assert claims[0] == len(times) + len(threads)


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='there is no machine code')
def test_claiming_is_one_instruction():
    claims, times = np.zeros(1, np.int64), np.zeros(1, np.int64)
    count = numba.njit(count_parts.py_func)
    count(claims, times)
    (code,) = count.inspect_llvm().values()
    assert re.search(r'atomicrmw (volatile )?add .*, i64 1 seq_cst', code)


@both
def test_without_a_change_watching_ends_after_its_turns(call):
    numbers = np.array([7])
    for turns in (0, 1, 500):
        assert call(watch, numbers, 7, turns, 3)[0] is False


@both
def test_a_change_is_seen_at_the_first_look(call):
    assert call(watch, np.array([8]), 7, 1, 0)[0] is True
    assert call(watch, np.array([8]), 7, 0, 0)[0] is False  # none was taken
    assert latest(np.array([8])) == 8


def test_a_change_by_another_thread_is_seen():
    numbers, found = np.zeros(1, np.int64), []
    watch(numbers, 0, 1, 1)  # compiled before the thread starts
    forever = 2**34
    thread = Thread(target=lambda: found.append(watch(numbers, 0, forever, 5)[0]), daemon=True)
    thread.start()
    time.sleep(0.05)
    assert thread.is_alive()
    numbers[0] = 1
    thread.join(60.0)
    assert found == [True]
