# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""Kernels and their parts: callers, and options of the compilation."""

import math
import re

import numba
import numpy as np
import pytest

from surfel_mapper.kernels.compiling import (
    before_compiling,
    kernel,
    part,
    stay_apart,
    use_widest_vectors,
)

needs_compiler = pytest.mark.skipif(
    numba.config.DISABLE_JIT, reason='kernels are interpreted in this run'
)


@part(cache=False)
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


@needs_compiler
def test_a_part_is_not_compiled_on_its_own():
    reciprocals(np.ones(1), np.empty(1))

    assert not reciprocal.overloads


@needs_compiler
def test_a_kernel_is_no_function_of_c():
    reciprocals(np.ones(1), np.empty(1))
    (compiled,) = reciprocals.overloads.values()

    names = [function.name for function in compiled.library.get_defined_functions()]

    assert any(name.startswith('_ZN7cpython') for name in names)
    assert not any(name.startswith('cfunc.') for name in names)


@kernel(cache=False)
def doubled(values):
    """Double all values, with the widest vectors that there are."""
    use_widest_vectors()
    for i in range(len(values)):
        values[i] *= 2.0


@needs_compiler
def test_a_kernel_uses_registers_of_512_bits_if_there_are_any():
    values = np.arange(20.0)

    doubled(values)

    assert values.tolist() == list(range(0, 40, 2))
    features = numba.core.codegen.get_host_cpu_features().split(',')
    (code,) = doubled.inspect_llvm().values()
    assert ('<8 x double>' in code) == ('+avx512f' in features)


@kernel(cache=False)
def increased(value):
    """Return 4 more."""
    return value + 4


@kernel(cache=False)
def increased_apart(value):
    """Return 4 more, as a function of its own."""
    stay_apart()
    return value + 4


@needs_compiler
@pytest.mark.parametrize(('increase', 'num_calls'), [(increased, 0), (increased_apart, 2)])
def test_a_kernel_that_stays_apart_is_called(increase, num_calls):
    @numba.njit
    def twice(value):
        return increase(increase(value))

    assert twice(3) == twice.py_func(3) == 11
    (code,) = twice.inspect_llvm().values()
    assert len(re.findall(r'call .*increased', code)) == num_calls


@needs_compiler
def test_a_call_comes_once_before_the_first_compilation():
    @numba.njit
    def twice(value):
        return 2 * value

    calls = []
    with before_compiling(lambda: calls.append(len(twice.overloads))):
        twice(1)
        twice(1.0)
    assert calls == [0]
    with before_compiling(lambda: calls.append('compiled')):
        twice(2)
    assert calls == [0]
    twice('not heard of')
    assert len(twice.overloads) == 3
