# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""``surfel-mapper compile``: no later run compiles anything."""

from __future__ import annotations

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


def run(folder, *commands):
    """Run commands in one process; return what it printed."""
    done = subprocess.run(
        [sys.executable, '-c', CALLS, *commands],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def test_no_verb_compiles_anything_after_compiling_everything(tmp_path):
    run(tmp_path, 'compile')
    (tmp_path / 'my.yaml').write_text('window: {max_scans: 2}\n')
    again, _ = run(tmp_path, 'compile --config my.yaml')
    assert again == 'all kernels are compiled\nkernels 0\n'
    stdout, stderr = run(
        tmp_path,
        'simulate street -o drive --scans 4 --beams 32 --columns 512',
        'replay drive -o mapped',
        'replay drive -o windowed --window',
        'replay drive -o registered --poses-from registration --align',
        'extract mapped -o models',
    )
    assert stdout.endswith('kernels 0\n'), stderr
