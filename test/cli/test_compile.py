# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper compile``: no later run compiles anything."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import numba
import pytest

pytestmark = pytest.mark.skipif(
    numba.config.DISABLE_JIT, reason='kernels are interpreted in this run'
)

CALLS = """
import sys
from surfel_mapper.cli.main import main
from surfel_mapper.compilation import PROGRESS

for words in sys.argv[1:]:
    code = main(words.split())
    assert code == 0, (words, code)
print('kernels', PROGRESS.num_kernels)
"""
"""Runs one command after the other, and prints how many kernels were compiled."""


def run(folder, *commands, **environment):
    """Run commands in one process; return what it printed."""
    done = subprocess.run(
        [sys.executable, '-c', CALLS, *commands],
        env={**os.environ, **environment},
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


MAPPED = """
from pathlib import Path

from surfel_mapper import load_config, Mapper
from surfel_mapper.compilation import PROGRESS
from surfel_mapper.offline.recording import open_recording
from surfel_mapper.offline.request import Request

with open_recording(Request(path=Path('drive')), load_config('my.yaml')) as recording:
    mapper = Mapper(recording.config)
    list(recording.replay(mapper))
print(mapper.counters.mapped, PROGRESS.num_kernels)
"""


def test_mapping_compiles_nothing_after_compiling_for_its_configuration(tmp_path):
    (tmp_path / 'my.yaml').write_text('window: {max_scans: 2}\n')
    run(tmp_path, 'simulate street -o drive --scans 4 --beams 16 --columns 256')
    kernels = {'NUMBA_CACHE_DIR': str(tmp_path / 'kernels')}

    stdout, stderr = run(tmp_path, 'compile --config my.yaml', **kernels)
    assert re.search(r'compiling kernels, once on this machine: 1 of \d \(adding scans\)', stderr)
    assert stdout.startswith('kernels compiled ')

    done = subprocess.run(
        [sys.executable, '-c', MAPPED],
        env={**os.environ, **kernels},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == ('4 0\n', '')
    again, _ = run(tmp_path, 'compile --config my.yaml', **kernels)
    assert again == 'all kernels are compiled\nkernels 0\n'


def test_no_verb_compiles_anything_after_compiling_everything(tmp_path):
    run(tmp_path, 'compile')
    stdout, stderr = run(
        tmp_path,
        'simulate street -o drive --scans 4 --beams 32 --columns 512',
        'replay drive -o mapped',
        'replay drive -o windowed --window',
        'replay drive -o registered --poses-from registration --align',
        'extract mapped -o models',
    )
    assert stdout.endswith('kernels 0\n'), stderr
