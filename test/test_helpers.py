# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Helpers: jobs are done once, their results and errors arrive, and nothing is kept."""

import threading
import time
import weakref

import pytest

from surfel_mapper.helpers import Helpers, Signal


def test_results_and_errors_of_jobs_are_returned_to_who_asks():
    helpers = Helpers(2)
    jobs = [helpers.submit(divmod, number, 7) for number in range(200)]
    failed = helpers.submit(divmod, 1, 0)
    assert [job.result() for job in jobs] == [divmod(number, 7) for number in range(200)]
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            failed.result()


def test_threads_that_fell_asleep_do_the_next_job():
    helpers = Helpers(1)
    for _ in range(3):
        assert helpers.submit(threading.get_ident).result() != threading.get_ident()
        time.sleep(0.05)  # it stays awake for a third of a millisecond


def test_waiting_for_a_long_job_takes_no_processor_time():
    helpers = Helpers(1)
    helpers.submit(int).result()  # compiled
    used_s = time.thread_time()
    helpers.submit(time.sleep, 0.3).result()
    assert time.thread_time() - used_s < 0.15


def test_a_signal_is_seen_by_who_looks_for_it():
    signal_, found = Signal(2**34), []
    looking = threading.Thread(target=lambda: found.append(signal_.changes(0)), daemon=True)
    looking.start()
    time.sleep(0.05)
    assert looking.is_alive()
    signal_.send()
    looking.join(60.0)
    assert found == [True]
    assert not Signal(100).changes(0)


def test_jobs_and_their_ends_are_signalled():
    helpers = Helpers(1)
    posted, ended = (getattr(helpers, name).seen() for name in ('_posted', '_ended'))
    helpers.submit(int).result()
    helpers.submit(int).result()  # the end of the first was signalled before this one began
    assert helpers._posted.seen() == posted + 2
    assert helpers._ended.seen() > ended


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


def test_a_thread_that_cannot_start_is_an_error_and_may_start_later():
    helpers, before = Helpers(1), threading.stack_size(1 << 46)
    try:
        with pytest.raises(RuntimeError, match='new thread'):
            helpers.submit(int)
    finally:
        threading.stack_size(before)
    assert helpers.submit(int).result() == 0
