# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Compiled kernels are cached until a source changes; stale ones are never used."""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

PACKAGE = Path(__file__).parents[2] / 'surfel_mapper'
WAIT_S = 300

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
    for name in ('__init__.py', 'errors.py', 'kernels/__init__.py'):
        (tmp_path / 'surfel_mapper' / name).parent.mkdir(exist_ok=True)
        shutil.copy(PACKAGE / name, tmp_path / 'surfel_mapper' / name)
    (tmp_path / 'surfel_mapper/kernels/callee.py').write_text(CALLEE.format(1))
    (tmp_path / 'surfel_mapper/kernels/caller.py').write_text(CALLER)
    (tmp_path / 'surfel_mapper/kernels/independent.py').write_text(INDEPENDENT)
    return tmp_path


def run(package, **environment):
    """Return a result, the numbers of cache loads of two kernels and the log of a new process."""
    program = (
        'from surfel_mapper.kernels.caller import twice\n'
        'from surfel_mapper.kernels.independent import half\n'
        'half(2)\n'
        'print(twice(0), *(sum(each.stats.cache_hits.values()) for each in (twice, half)))'
    )
    inherited = {name: os.environ[name] for name in os.environ if name != 'NUMBA_CACHE_DIR'}
    done = subprocess.run(
        [sys.executable, '-c', program],
        cwd=package,
        env={**inherited, 'PYTHONPATH': str(package), **environment},
        capture_output=True,
        text=True,
        check=True,
        timeout=WAIT_S,
    )
    return [int(word) for word in done.stdout.split()], done.stderr


@pytest.mark.parametrize('elsewhere', [False, True])
def test_a_kernel_is_cached_until_one_that_it_calls_changes(package, elsewhere):
    environment = {'NUMBA_CACHE_DIR': str(package / 'kept')} if elsewhere else {}
    assert run(package, **environment) == ([2, 0, 0], '')
    assert run(package, **environment) == ([2, 1, 1], '')
    (package / 'surfel_mapper/kernels/callee.py').write_text(CALLEE.format(10))
    assert run(package, **environment) == ([20, 0, 1], '')
    assert run(package, **environment) == ([20, 1, 1], '')


def test_kernels_are_compiled_if_their_hash_cannot_be_stored(package):
    (package / 'surfel_mapper/kernels/__pycache__/sources.sha256').mkdir(parents=True)
    answer, log = run(package)
    assert answer == [2, 0, 0]
    assert 'sources.sha256: kernels may be compiled at every start' in log
