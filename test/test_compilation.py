# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Compilations are announced once a stage, and a clock stands still meanwhile."""

from __future__ import annotations

import gc
import logging
import os
import subprocess
import sys
import time

import numba
import pytest

from surfel_mapper import compilation
from surfel_mapper.compilation import clock, CompileStage, Progress, run_stages
import surfel_mapper.kernels  # reports what numba compiles

needs_compiler = pytest.mark.skipif(
    numba.config.DISABLE_JIT, reason='kernels are interpreted in this run'
)


def compile_another():
    """Compile a kernel that is not cached."""

    @numba.njit
    def twice(value):
        return 2 * value

    return twice(1)


@pytest.fixture
def progress(monkeypatch):
    """Return the state of a process that has compiled nothing."""
    fresh = Progress()
    monkeypatch.setattr(compilation, 'PROGRESS', fresh)
    monkeypatch.setattr(surfel_mapper.kernels, 'PROGRESS', fresh)
    return fresh


@needs_compiler
def test_the_clock_stands_still_while_a_kernel_compiles(progress):
    start, start_clock = time.perf_counter(), clock()
    compile_another()
    passed, passed_clock = time.perf_counter() - start, clock() - start_clock
    assert progress.num_kernels == 1
    assert 0.0 < progress.seconds < passed
    assert passed_clock == pytest.approx(passed - progress.seconds, abs=passed / 10)


@needs_compiler
@pytest.mark.parametrize('collects', [True, False])
def test_garbage_is_collected_again_after_a_compilation(progress, collects):
    try:
        if not collects:
            gc.disable()
        compile_another()
        assert gc.isenabled() == collects
    finally:
        gc.enable()


@needs_compiler
def test_no_garbage_is_collected_while_kernels_compile(progress):
    progress.begin()
    progress.begin()
    assert not gc.isenabled()
    progress.end()
    assert not gc.isenabled()
    progress.end()
    assert gc.isenabled()


@needs_compiler
def test_each_stage_that_compiles_is_announced_once(progress, caplog):
    caplog.set_level(logging.INFO, logger='surfel_mapper.compilation')
    run_stages(
        [
            CompileStage('adding scans', lambda: (compile_another(), compile_another())),
            CompileStage('nothing new', lambda: None),
            CompileStage('removing scans', compile_another),
        ]
    )
    assert [record.message for record in caplog.records] == [
        'compiling kernels, once on this machine: 1 of 3 (adding scans)',
        'compiling kernels, once on this machine: 3 of 3 (removing scans)',
        f'3 kernels compiled in {progress.seconds:.1f} s',
    ]
    assert [record.levelname for record in caplog.records] == ['INFO', 'INFO', 'INFO']
    assert (progress.is_active, progress.stage) == (False, '')


@needs_compiler
def test_a_long_stage_is_announced_again_with_its_kernels(progress, monkeypatch, caplog):
    caplog.set_level(logging.INFO, logger='surfel_mapper.compilation')
    monkeypatch.setattr(compilation, 'AGAIN_S', 0.0)
    run_stages([CompileStage('fitting', lambda: (compile_another(), compile_another()))])
    line = 'compiling kernels, once on this machine: 1 of 1 (fitting)'
    assert [record.message for record in caplog.records][:2] == [line, f'{line}, 2 kernels so far']


@needs_compiler
def test_kernels_beyond_the_stages_are_announced_once_as_a_warning(progress, caplog):
    caplog.set_level(logging.WARNING, logger='surfel_mapper.compilation')
    compile_another()
    compile_another()
    assert [record.message for record in caplog.records] == [
        'compiling kernels, once on this machine'
    ]


@needs_compiler
def test_a_failed_compilation_ends(progress):
    @numba.njit
    def impossible(value):
        return value.no_such_attribute

    with pytest.raises(numba.TypingError):
        impossible(1)
    assert not progress.is_active


PROGRAM = """
import numpy as np
from surfel_mapper import SurfelMap

SurfelMap(0.5).add(np.eye(3))
"""


@needs_compiler
def test_a_library_call_says_that_it_compiles_only_the_first_time(tmp_path):
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path)}
    errors = [
        subprocess.run(
            [sys.executable, '-c', PROGRAM],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stderr
        for _ in range(2)
    ]
    assert errors == ['compiling kernels, once on this machine\n', '']
