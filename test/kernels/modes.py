# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The two ways to run a kernel: compiled, and as the Python it is written in.

Interpreted, a kernel shows its coverage and checks every index; the kernels that it calls are
compiled nevertheless. Everything interpreted at once is in test_interpreted.py.
"""

import numpy as np
import pytest


def compiled(kernel, *arguments):
    return kernel(*arguments)


def interpreted(kernel, *arguments):
    with np.errstate(all='ignore'):  # hashes overflow and 0 / 0 is nan on purpose, as compiled
        return getattr(kernel, 'py_func', kernel)(*arguments)


both = pytest.mark.parametrize('call', [compiled, interpreted])
