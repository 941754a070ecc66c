# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Run kernels compiled and interpreted.

Interpreted, a kernel shows its coverage and checks every index; the kernels that it calls are
compiled nevertheless. A whole program that is to be interpreted runs in a Python of its own.
"""

from contextlib import redirect_stdout
import io
import os
from pathlib import Path
import subprocess
import sys

import numba
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
    text = printed_compiled(program)
    assert text == printed_interpreted(program)
    return text


def saved_alike(program, folder, **tolerance):
    """Return the arrays that a program saves to a given file; assert that both modes agree."""
    paths = folder / 'compiled.npz', folder / 'interpreted.npz'
    text = printed_compiled(program, paths[0])
    assert text == printed_interpreted(program, paths[1])
    arrays = [list(np.load(path).values()) for path in paths]
    for one, other in zip(*arrays, strict=True):
        np.testing.assert_allclose(one, other, **tolerance)
    return arrays[0]


def printed_compiled(program, *arguments):
    """Return the output of a program that runs in this process."""
    if numba.config.DISABLE_JIT:
        pytest.skip('kernels are not compiled in this run')
    output = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(output):
        patch.setattr(sys, 'argv', ['-c', *map(str, arguments)])
        exec(program, {'__name__': '__main__'})
    return output.getvalue()


def printed_interpreted(program, *arguments):
    """Return the output of a program whose kernels are not compiled, in a Python of its own."""
    done = subprocess.run(
        [sys.executable, '-c', QUIET + program, *map(str, arguments)],
        cwd=Path(__file__).parents[2],
        env={**os.environ, 'NUMBA_DISABLE_JIT': '1'},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


both = pytest.mark.parametrize('call', [compiled, interpreted])
