# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""The pool of threads, and the scheduling of threads."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import os
from pathlib import Path
import subprocess
import sys
import threading

import pytest

from surfel_mapper import threads as threads_module
from surfel_mapper.threads import (
    BACKGROUND_NICE,
    share,
    split,
    usable_cores,
    yield_to_others,
)

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ('quota', 'expected'),
    [
        (None, 4),
        ('max 100000', 4),
        ('200000 100000', 2),
        ('150000 100000', 1),
        ('20000 100000', 1),
        ('100000 50000', 2),
    ],
)
def test_usable_cores_are_those_that_the_quota_of_a_container_fills(
    quota, expected, tmp_path, monkeypatch
):
    limit = tmp_path / 'cpu.max'
    if quota is not None:
        limit.write_text(f'{quota}\n', encoding='ascii')
    monkeypatch.setattr(threads_module, 'CGROUP_QUOTA', limit)
    monkeypatch.setattr(os, 'sched_getaffinity', lambda _: {0, 1, 2, 3})
    assert usable_cores() == expected


def test_every_row_is_in_one_part():
    for num_rows in range(7):
        rows = [row for part in split(num_rows, 3) for row in range(num_rows)[part]]
        assert rows == list(range(num_rows))


def test_an_error_of_a_helper_is_raised():
    has_begun = threading.Event()

    def work(rows):
        if threading.current_thread() is threading.main_thread():
            has_begun.wait(10.0)
        else:
            has_begun.set()
            raise OSError('of a helper')

    with pytest.raises(OSError, match='of a helper'):
        share(work, 100, 2)


@pytest.mark.skipif(sys.platform != 'linux', reason='threads have no priority of their own')
def test_background_thread_has_a_lower_priority_than_the_others():
    def nice():
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    with ThreadPoolExecutor(1, initializer=yield_to_others) as background:
        assert background.submit(nice).result() == min(nice() + BACKGROUND_NICE, 19)


def may_run_in_real_time():
    """Return whether the system permits this process real-time priority."""
    test = 'import os; os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))'
    command = [sys.executable, '-c', test]
    return not subprocess.run(command, stderr=subprocess.DEVNULL).returncode
