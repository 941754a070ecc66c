# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Kernels and their parts: callers, and options of the compilation."""

import math

import numba
import numpy as np
import pytest

from surfel_mapper.kernels.compiling import inlined, kernel

needs_compiler = pytest.mark.skipif(
    numba.config.DISABLE_JIT, reason='kernels are interpreted in this run'
)


@inlined(cache=False)
def reciprocal(value):
    """Return 1 / value."""
    return 1.0 / value


@kernel(cache=False, error_model='numpy')
def reciprocals(values, found):
    """Write 1 / value of each value."""
    for i in range(len(values)):
        found[i] = reciprocal(values[i])


@needs_compiler
def test_a_part_is_compiled_with_the_options_of_its_kernel():
    found = np.empty(3)

    reciprocals(np.array([4.0, 0.0, -0.0]), found)

    assert found.tolist() == [0.25, math.inf, -math.inf]  # Python would raise
