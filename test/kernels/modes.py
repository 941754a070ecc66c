# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Run kernels compiled and interpreted.

Interpreted, a kernel shows its coverage and checks every index; the kernels that it calls are
compiled nevertheless. Where a whole program is to be interpreted, it runs in a Python of its own.
"""

import os
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest

QUIET = """
import numpy as np
np.seterr(all='ignore')  # hashes overflow and 0 / 0 is nan on purpose, as compiled
"""


def compiled(kernel, *arguments):
    return kernel(*arguments)


def interpreted(kernel, *arguments):
    with np.errstate(all='ignore'):  # hashes overflow and 0 / 0 is nan on purpose, as compiled
        return getattr(kernel, 'py_func', kernel)(*arguments)


def printed_alike(program):
    """Return the output of a program; assert that compiled and interpreted kernels agree."""
    text = printed(program, is_compiled=True)
    assert text == printed(program, is_compiled=False)
    return text


def saved_alike(program, folder, **tolerance):
    """Return the arrays that a program saves to a given file; assert that both modes agree."""
    paths = folder / 'compiled.npz', folder / 'interpreted.npz'
    text = printed(program, paths[0], is_compiled=True)
    assert text == printed(program, paths[1], is_compiled=False)
    arrays = [list(np.load(path).values()) for path in paths]
    for one, other in zip(*arrays, strict=True):
        np.testing.assert_allclose(one, other, **tolerance)
    return arrays[0]


def printed(program, *arguments, is_compiled):
    """Return the output of a program with its kernels compiled or interpreted."""
    done = subprocess.run(
        [sys.executable, '-c', QUIET + program, *map(str, arguments)],
        cwd=Path(__file__).parents[2],
        env={**os.environ, 'NUMBA_DISABLE_JIT': '0' if is_compiled else '1'},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


both = pytest.mark.parametrize('call', [compiled, interpreted])
