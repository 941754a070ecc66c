# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Several threads: the same bits as one, down to the order of the voxels."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import gc
import itertools
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time
import weakref

import numpy as np
import pytest

from surfel_mapper import threads as threads_module
from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.threads import (
    BACKGROUND_NICE,
    pool,
    real_time_threads,
    share,
    share_parts,
    split,
    together,
    usable_cores,
    yield_to_others,
)

ROOT = Path(__file__).parents[1]


def in_order(surfels):
    """Return the arrays of surfels, sorted by voxel."""
    return surfels.select(np.lexsort(surfels.voxel_index.T)).arrays


@pytest.mark.parametrize(
    ('quota', 'expected'),
    [
        (None, 4),
        ('', 4),
        ('max 100000', 4),
        ('800000 100000', 4),
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


@pytest.mark.parametrize('threads', [2, 3])
def test_the_result_does_not_depend_on_the_number_of_threads(threads):
    rng = np.random.default_rng(8)
    one, several = SurfelMap(0.3), SurfelMap(0.3, threads=threads)
    for num_points in (0, 1, 2, 500, 40_000):  # the last is shared: more than FEW surfels
        points = rng.uniform(-6.0, 6.0, (num_points, 3))
        points[::7] = np.nan
        expected = one.add(points, origin=(0.0, 0.0, 5.0))
        found = several.add(points, origin=(0.0, 0.0, 5.0))
        order, in_stripes = np.argsort(expected.key), np.argsort(found.key)
        for left, right in zip(found.arrays, expected.arrays, strict=True):
            np.testing.assert_array_equal(left[in_stripes], right[order])
        assert found.left_out == expected.left_out
        changed = in_order(several.surfels_changed()), in_order(one.surfels_changed())
        for left, right in zip(*changed, strict=True):
            np.testing.assert_array_equal(left, right)
    assert several == one


@pytest.fixture
def interrupts():
    """Let SIGINT interrupt, also in a process that a shell started in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures('interrupts')
def test_parts_that_others_have_begun_are_done_before_an_interrupt_is_raised():
    begun, done = threading.Event(), []

    def work(part):
        if threading.current_thread() is threading.main_thread():
            begun.wait(30.0)
            return
        begun.set()
        time.sleep(0.2)  # the main thread waits for this part by now
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        time.sleep(0.2)
        done.append(part)

    with pytest.raises(KeyboardInterrupt):
        share_parts(work, range(2), threads=2)
    assert len(done) == 1


def test_every_row_is_in_one_part():
    for num_rows in range(7):
        rows = [row for part in split(num_rows, 3) for row in range(num_rows)[part]]
        assert rows == list(range(num_rows))


def test_a_failed_part_ends_the_work_of_all_threads():
    begun, ended, may_end = threading.Event(), threading.Event(), threading.Event()

    def work(part):
        if threading.current_thread() is not threading.main_thread():
            begun.set()
            may_end.wait(10.0)
            ended.set()
        elif begun.wait(10.0):
            threading.Timer(0.05, may_end.set).start()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        share(work, 100, 2)
    assert ended.is_set()


def test_a_failed_helper_ends_the_work_after_the_other_helpers():
    may_begin, has_begun = ([threading.Event() for _ in range(2)] for _ in range(2))
    may_end, ended, numbers = threading.Event(), threading.Event(), itertools.count()
    for event in may_begin:  # the threads of the pool are busy until the caller sets it
        pool(3).submit(event.wait, 10.0)

    def work(part):
        if threading.current_thread() is threading.main_thread():
            for may, has in zip(may_begin, has_begun, strict=True):
                may.set()
                has.wait(10.0)
        elif (number := next(numbers)) < 2:
            has_begun[number].set()
            (has_begun[1], may_end)[number].wait(10.0)
            if number == 0:
                threading.Timer(0.05, may_end.set).start()
                raise OSError('the first helper')
            ended.set()

    with pytest.raises(OSError, match='the first helper'):
        share(work, 100, 3)
    assert ended.is_set()


def test_an_error_of_the_calling_thread_is_raised_before_those_of_helpers():
    both_have_begun = threading.Barrier(2)

    def work(part):
        both_have_begun.wait(10.0)
        is_main = threading.current_thread() is threading.main_thread()
        raise KeyboardInterrupt if is_main else OSError

    with pytest.raises(KeyboardInterrupt):
        share(work, 100, 2)


@pytest.mark.usefixtures('interrupts')
def test_after_any_interrupt_nothing_goes_on_and_the_threads_still_work():
    helpers, begun = pool(2), []

    def work():
        time.sleep(1e-4)  # both threads work for a while, so that interrupts come in between
        if threading.current_thread() is not threading.main_thread():
            begun.append(True)
            time.sleep(1e-4)

    def work_on():  # in a loop of the try statement, Python 3.11 may leave an interrupt uncaught
        while True:
            together(work, 2)

    together(work, 2)  # compiled, and the thread is there
    delays = np.random.default_rng(5).uniform(1e-6, 3e-4, 300)
    handler = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        for delay_s in delays.tolist():
            try:
                signal.setitimer(signal.ITIMER_REAL, delay_s)
                try:
                    work_on()
                finally:
                    signal.setitimer(signal.ITIMER_REAL, 0)
            except KeyboardInterrupt:
                num_begun = len(begun)
                assert helpers.submit(len, begun).result() == num_begun
    finally:
        signal.signal(signal.SIGALRM, handler)
    assert begun


def test_an_error_keeps_nothing_after_it_was_handled():
    class Scan:
        pass

    def failed():
        scan, both = Scan(), threading.Barrier(2)

        def work():
            both.wait(10.0)
            if threading.current_thread() is not threading.main_thread():
                raise OSError(scan is None)

        with pytest.raises(OSError, match='False'):
            together(work, 2)
        return weakref.ref(scan)

    gc.disable()
    try:
        assert failed()() is None
    finally:
        gc.enable()


@pytest.mark.skipif(not hasattr(os, 'fork'), reason='processes are not forked')
def test_a_forked_process_has_threads_of_its_own():
    assert pool(2).submit(int).result() == 0
    child = os.fork()
    if not child:
        os._exit(pool(2).submit(int, '7').result())
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7


AT_THE_END = """
import atexit
import time
from surfel_mapper.threads import pool, together
def work(number):
    time.sleep(0.05)
    print(number, flush=True)
atexit.register(lambda: together(lambda: print('late', flush=True), 2))  # after the pool's
for number in range(4):
    pool(2).submit(work, number)
"""


def test_jobs_that_are_left_are_done_before_the_process_ends_and_later_ones_by_the_caller():
    run = [sys.executable, '-c', AT_THE_END]
    done = subprocess.run(run, capture_output=True, text=True, cwd=ROOT, timeout=60, check=True)
    assert done.stdout.split() == ['0', '1', '2', '3', 'late', 'late']
    assert done.stderr == ''


def test_no_thread_at_all_is_refused():
    with pytest.raises(ValueError, match='threads: 0'):
        SurfelMap(0.5, threads=0)


@pytest.mark.skipif(sys.platform != 'linux', reason='threads have no priority of their own')
def test_background_thread_has_a_lower_priority_than_the_others():
    def nice():
        return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    with ThreadPoolExecutor(1, initializer=yield_to_others) as background:
        assert background.submit(nice).result() == min(nice() + BACKGROUND_NICE, 19)


def policies():
    """Return the scheduling of a thread started in the with-block, and of the caller after it."""
    found = []
    with real_time_threads():
        thread = threading.Thread(target=lambda: found.append(os.sched_getscheduler(0)))
        thread.start()
        thread.join()
    return [*found, os.sched_getscheduler(0)]


def may_run_in_real_time():
    """Return whether the system permits this process real-time priority."""
    test = 'import os; os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))'
    command = [sys.executable, '-c', test]
    return not subprocess.run(command, stderr=subprocess.DEVNULL).returncode


@pytest.mark.skipif(sys.platform != 'linux', reason='threads have no priority of their own')
def test_threads_get_real_time_priority_if_permitted_and_their_starter_loses_it():
    expected = os.SCHED_RR if may_run_in_real_time() else os.SCHED_OTHER
    assert policies() == [expected, os.SCHED_OTHER]


WITHOUT_PERMISSION = """
import os, resource
from test.test_threads import policies
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
if os.getuid() == 0:
    os.setuid(65_534)
assert policies() == [os.SCHED_OTHER, os.SCHED_OTHER]
"""


@pytest.mark.skipif(sys.platform != 'linux', reason='threads have no priority of their own')
def test_threads_stay_ordinary_without_permission():
    subprocess.run([sys.executable, '-c', WITHOUT_PERMISSION], cwd=ROOT, check=True)
