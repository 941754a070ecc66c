# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The two ways to run kernels: compiled, and as the Python they are written in.

Interpreted, a kernel shows its coverage and checks every index; the kernels that it calls are
compiled nevertheless. Where a whole program is to be interpreted, it runs in a Python of its own.
"""

import os
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest


def compiled(kernel, *arguments):
    return kernel(*arguments)


def interpreted(kernel, *arguments):
    with np.errstate(all='ignore'):  # hashes overflow and 0 / 0 is nan on purpose, as compiled
        return getattr(kernel, 'py_func', kernel)(*arguments)


def printed(program, *arguments, compiled):
    """Return what a program prints with its kernels compiled or interpreted."""
    done = subprocess.run(
        [sys.executable, '-c', program, *map(str, arguments)],
        cwd=Path(__file__).parents[2],
        env={**os.environ, 'NUMBA_DISABLE_JIT': '0' if compiled else '1'},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


both = pytest.mark.parametrize('call', [compiled, interpreted])
