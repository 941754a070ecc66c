# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Signals end a node wherever they find it; what it is asked for meanwhile is answered."""

from __future__ import annotations

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
def test_a_signal_interrupts_and_those_that_follow_do_not(number):
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


def test_a_signal_within_a_destructor_interrupts_what_comes_after():
    with Signals(), pytest.raises(KeyboardInterrupt):
        act_and_wait(Freed)


def test_a_signal_while_llvm_calls_back_interrupts_what_comes_after(capfd):
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    module = llvm.parse_assembly('define i32 @one() { ret i32 1 }')
    machine = llvm.Target.from_default_triple().create_target_machine()
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.set_object_cache(lambda *_: send(signal.SIGINT), None)
    with Signals(), pytest.raises(KeyboardInterrupt):
        act_and_wait(engine.finalize_object)
    assert 'KeyboardInterrupt' not in capfd.readouterr().err


def test_without_a_signal_all_is_as_before():
    before = {number: signal.getsignal(number) for number in HANDLED}
    with Signals() as signals:
        signals.check()
    assert {number: signal.getsignal(number) for number in HANDLED} == before


def nothing():
    return None


def test_a_request_is_answered_by_the_thread_that_serves_and_an_error_ends_it():
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


def test_a_request_that_raises_is_answered_and_raises_where_it_is_served():
    tasks = TaskQueue()
    answer = tasks.submit(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        tasks.run(nothing)
    assert answer.result(TIMEOUT_S) is False


def test_what_is_asked_for_at_the_end_or_after_it_is_answered_with_no():
    tasks = TaskQueue()
    before = tasks.submit(lambda: True)
    tasks.fail(RuntimeError('unheard'))
    tasks.close()
    assert before.result(TIMEOUT_S) is False
    assert tasks.submit(lambda: True).result(TIMEOUT_S) is False


def test_a_signal_that_does_not_wake_whoever_waits_ends_the_service():
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


def test_an_interruption_is_noticed_before_the_next_wait():
    def check():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        TaskQueue().run(check)
