# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Signals interrupt the main thread at any point; its tasks are answered in every case."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from surfel_mapper.ros.main_thread import NUMBERS, Signals, TaskQueue

TIMEOUT_S = 120


@pytest.fixture(autouse=True)
def handlers():
    before = {number: signal.getsignal(number) for number in NUMBERS}
    yield before
    for number, handler in before.items():
        signal.signal(number, handler)


def send(number):
    os.kill(os.getpid(), number)
    for _ in range(1000):  # the handler runs between two of these
        pass


@pytest.mark.parametrize('number', NUMBERS)
def test_only_the_first_signal_interrupts(number):
    signals = Signals()
    with pytest.raises(KeyboardInterrupt), signals:
        send(number)
    for later in NUMBERS:
        send(later)
    with pytest.raises(KeyboardInterrupt):
        signals.check()


def nothing():
    return None


def test_tasks_run_in_the_main_thread_until_an_error():
    tasks = TaskQueue()
    names = []

    def act():
        names.append(threading.current_thread().name)
        return True

    answers = [tasks.submit(act), tasks.submit(lambda: False)]
    tasks.fail(RuntimeError('the end'))
    with pytest.raises(RuntimeError, match='the end'):
        tasks.run(nothing)
    assert [answer.result(TIMEOUT_S) for answer in answers] == [True, False]
    assert names == [threading.current_thread().name]


def test_an_error_in_a_task_is_raised_in_the_main_thread():
    tasks = TaskQueue()
    answer = tasks.submit(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        tasks.run(nothing)
    assert answer.result(TIMEOUT_S) is False
