# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Signals interrupt the main thread at any point; its tasks are answered in every case."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import os
import signal
import threading
import time

from llvmlite import binding as llvm
import pytest

from surfel_mapper.ros.main_thread import NUMBERS, Signals, TaskQueue

TIMEOUT_S = 120
HANDLED = (*NUMBERS, signal.SIGALRM)


@pytest.fixture(autouse=True)
def handlers():
    before = {number: signal.getsignal(number) for number in HANDLED}
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


class Freed:
    def __del__(self):
        send(signal.SIGINT)


def act_and_wait(action):
    action()
    threading.Event().wait(TIMEOUT_S)
    raise TimeoutError('no signal came')


def test_a_signal_within_a_destructor_is_found_by_check():
    with Signals() as signals:
        signals.check()
        Freed()
        with pytest.raises(KeyboardInterrupt):
            signals.check()
        assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0), 'another would come'


def test_a_signal_in_a_destructor_interrupts_after_it():
    with Signals(), pytest.raises(KeyboardInterrupt):
        act_and_wait(Freed)


def test_a_signal_in_a_callback_of_llvm_interrupts_after_it(capfd):
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    module = llvm.parse_assembly('define i32 @one() { ret i32 1 }')
    machine = llvm.Target.from_default_triple().create_target_machine()
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.set_object_cache(lambda *_: send(signal.SIGINT), None)
    with Signals(), pytest.raises(KeyboardInterrupt):
        act_and_wait(engine.finalize_object)
    assert 'KeyboardInterrupt' not in capfd.readouterr().err


def test_handlers_are_restored_without_a_signal():
    before = {number: signal.getsignal(number) for number in HANDLED}
    with Signals() as signals:
        signals.check()
    assert {number: signal.getsignal(number) for number in HANDLED} == before


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


@pytest.mark.parametrize('error', [MemoryError, KeyboardInterrupt])
def test_a_task_that_fails_is_a_failure_of_the_node_and_a_signal_is_none(error):
    """The map was saved only if another thread had failed."""

    def act():
        raise error

    tasks = TaskQueue()
    tasks.submit(act)
    with pytest.raises(error):
        tasks.run(nothing)
    assert tasks.has_failed == (error is MemoryError)


def test_tasks_after_closing_return_false():
    tasks = TaskQueue()
    before = tasks.submit(lambda: True)
    tasks.fail(RuntimeError('unheard'))
    tasks.close()
    assert before.result(TIMEOUT_S) is False
    assert tasks.submit(lambda: True).result(TIMEOUT_S) is False


def test_a_signal_taken_by_another_thread_ends_the_wait():
    asleep = threading.Thread(target=threading.Event().wait, daemon=True)
    asleep.start()  # takes the signal, as the main thread just before it waits

    def strike():
        time.sleep(0.1)  # until the main thread waits
        signal.pthread_kill(asleep.ident, signal.SIGTERM)

    tasks = TaskQueue()
    alarm = threading.Timer(TIMEOUT_S, tasks.submit, [nothing])
    alarm.start()
    threading.Thread(target=strike).start()
    with Signals() as signals, pytest.raises(KeyboardInterrupt):
        tasks.run(signals.check)
    assert alarm.is_alive(), 'heard only when something else woke it'
    alarm.cancel()


def test_interrupts_are_checked_before_every_wait():
    def check():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        TaskQueue().run(check)


class SignalledSemaphore:
    """Stands in for the count of a pool's idle threads: none is idle, and SIGTERM arrives."""

    def acquire(self, timeout):
        signal.raise_signal(signal.SIGTERM)
        return False

    def release(self):
        pass


def test_an_interrupt_while_a_pool_starts_a_thread_comes_after_it():
    pool = ThreadPoolExecutor(1)
    pool._idle_semaphore = SignalledSemaphore()
    with Signals(), pytest.raises(KeyboardInterrupt):
        act_and_wait(lambda: pool.submit(int, '7'))
    pool.shutdown()
    assert [thread.is_alive() for thread in pool._threads] == [False]
