# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Several threads: the same bits as one, down to the order of the voxels."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
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

from surfel_mapper.mapping.surfel_map import SurfelMap
from surfel_mapper.threads import (
    BACKGROUND_NICE,
    Helpers,
    pool,
    real_time_threads,
    share,
    share_parts,
    split,
    yield_to_others,
)

ROOT = Path(__file__).parents[1]


def in_order(surfels):
    """Return the arrays of surfels, sorted by voxel."""
    return surfels.select(np.lexsort(surfels.voxel_index.T)).arrays


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


def test_results_and_errors_of_jobs_are_returned_to_who_asks():
    helpers = Helpers(2)
    jobs = [helpers.submit(divmod, number, 7) for number in range(200)]
    failed = helpers.submit(divmod, 1, 0)
    assert [job.result() for job in jobs] == [divmod(number, 7) for number in range(200)]
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            failed.result()


def test_threads_that_fell_asleep_do_the_next_job():
    helpers = Helpers(2)
    for _ in range(3):
        assert helpers.submit(threading.get_ident).result() != threading.get_ident()
        time.sleep(0.05)  # they stay awake for a third of a millisecond


def test_waiting_for_a_long_job_takes_no_processor_time():
    used_s = time.thread_time()
    job = Helpers(1).submit(time.sleep, 0.3)
    job.result()
    assert job.done()
    assert time.thread_time() - used_s < 0.15


def test_a_result_is_not_waited_for_longer_than_asked():
    may_end = threading.Event()
    job = Helpers(1).submit(may_end.wait, 30.0)
    with pytest.raises(TimeoutError):
        job.result(timeout=0.01)
    may_end.set()
    assert job.result() is True


def test_cancelled_jobs_are_not_done():
    helpers, may_end, done = Helpers(1), threading.Event(), []
    first = helpers.submit(may_end.wait, 30.0)
    second, third = (helpers.submit(done.append, number) for number in (2, 3))
    assert second.cancel()
    may_end.set()
    third.result()
    assert done == [3]
    assert first.result()


def test_jobs_keep_neither_arguments_nor_results_once_they_are_done():
    class Scan:
        pass

    helpers, scan = Helpers(1), Scan()
    alive = weakref.ref(scan)
    assert helpers.submit(id, scan).result()
    failed = helpers.submit(divmod, scan, 1)
    with pytest.raises(TypeError):
        failed.result()
    may_end = threading.Event()
    helpers.submit(may_end.wait, 30.0)
    assert helpers.submit(id, scan).cancel()  # it stays in the queue
    del scan, failed
    assert alive() is None
    may_end.set()


def test_a_thread_that_cannot_start_is_an_error_and_may_start_later(monkeypatch):
    def fail(thread):
        raise RuntimeError("can't start new thread")

    helpers = Helpers(1)
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, 'start', fail)
        with pytest.raises(RuntimeError, match='new thread'):
            helpers.submit(int)
    assert helpers.submit(int).result() == 0


AT_THE_END = """
import time
from surfel_mapper.threads import pool
def work(number):
    time.sleep(0.05)
    print(number, flush=True)
for number in range(4):
    pool(2).submit(work, number)
"""


def test_jobs_that_are_left_are_done_before_the_process_ends():
    run = [sys.executable, '-c', AT_THE_END]
    done = subprocess.run(run, capture_output=True, text=True, cwd=ROOT, timeout=60, check=True)
    assert done.stdout.split() == ['0', '1', '2', '3']
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
