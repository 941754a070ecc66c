# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels are cached until a source changes; stale ones are never used."""

from __future__ import annotations

from contextlib import contextmanager
import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

PACKAGE = Path(__file__).parents[2] / 'surfel_mapper'

CALLEE = """from numba import njit


@njit(cache=True)
def added(number):
    return number + {}
"""
CALLER = """from numba import njit

from surfel_mapper.kernels.callee import added


@njit(cache=True)
def twice(number):
    return added(added(number))
"""

INDEPENDENT = """from numba import njit


@njit(cache=True)
def half(number):
    return number // 2
"""


@pytest.fixture
def package(tmp_path):
    """Return a copy of the package with a kernel that calls another."""
    for name in ('__init__.py', 'compilation.py', 'errors.py', 'kernels/__init__.py'):
        (tmp_path / 'surfel_mapper' / name).parent.mkdir(exist_ok=True)
        shutil.copy(PACKAGE / name, tmp_path / 'surfel_mapper' / name)
    (tmp_path / 'surfel_mapper/kernels/callee.py').write_text(CALLEE.format(1))
    (tmp_path / 'surfel_mapper/kernels/caller.py').write_text(CALLER)
    (tmp_path / 'surfel_mapper/kernels/independent.py').write_text(INDEPENDENT)
    return tmp_path


FORKING = """
import os, sys, traceback

import numba

numba.njit(lambda number: number + 1)(1)
for _ in sys.stdin:
    pid = os.fork()
    if pid:
        os.waitpid(pid, 0)
        continue
    try:
        from surfel_mapper.kernels.caller import twice
        from surfel_mapper.kernels.independent import half

        half(2)
        answer = twice(0)
        hits = [sum(each.stats.cache_hits.values()) for each in (twice, half)]
        print(answer, *hits, flush=True)
    except BaseException:
        traceback.print_exc()
        print(flush=True)
    os._exit(0)
"""
"""
Runs the kernels once for each line, in a process that has loaded numba and nothing of ours.

Loading numba and its first compilation take 1 s of processor time, the kernels .1 s.
"""


@contextmanager
def runs(package, **environment):
    """Yield a function that returns a result and the cache loads of two kernels in a new run."""
    inherited = {name: os.environ[name] for name in os.environ if name != 'NUMBA_CACHE_DIR'}
    with subprocess.Popen(
        [sys.executable, '-c', FORKING],
        cwd=package,
        env={**inherited, 'PYTHONPATH': str(package), **environment},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:

        def run():
            process.stdin.write('\n')
            process.stdin.flush()
            return [int(word) for word in process.stdout.readline().split()]

        yield run


@pytest.mark.parametrize('elsewhere', [False, True])
def test_a_kernel_is_cached_until_one_that_it_calls_changes(package, elsewhere, capfd):
    environment = {'NUMBA_CACHE_DIR': str(package / 'kept')} if elsewhere else {}
    with runs(package, **environment) as run:
        assert run() == [2, 0, 0]
        assert run() == [2, 1, 1]
        (package / 'surfel_mapper/kernels/callee.py').write_text(CALLEE.format(10))
        assert run() == [20, 0, 1]
        assert run() == [20, 1, 1]
    announced = capfd.readouterr().err.splitlines()
    assert announced == 2 * ['compiling kernels, once on this machine']  # of four runs
