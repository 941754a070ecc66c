# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Decorators for kernels that a start waits for: nothing is compiled that no one calls.

A function of eight arrays takes 0.3 s to compile, of which 0.1 s is the wrapper for calls from
Python and 0.04 s the one for calls from C. A ``kernel`` has the former only. A ``part`` is
compiled inside the kernels that call it; on its own it would be optimised and translated once
more, which took a quarter of the time to the first scan. A kernel that calls ``stay_apart`` is
a function of its own in the machine code too; ``use_widest_vectors`` chooses the registers.

Stands alone: kernels of any folder may use it.
"""

from functools import partial

from numba import njit, types
from numba.extending import lower_builtin, type_callable
import numpy as np

kernel = partial(njit, cache=True, nogil=True, no_cfunc_wrapper=True)
"""Compile a function that Python calls; takes the options of njit."""

part = partial(kernel, inline='always')
"""Compile a function as lines of each kernel that calls it, with the options of that kernel."""

U = np.uint64
"""Unsigned indices: numba tests signed ones for being negative, and loops are not vectorised."""


def stay_apart():
    """
    Compile the function that calls this as one of its own, never as lines of its callers.

    In a long kernel a loop competes for registers with the loops around it: adding points took
    1.1 times as long, as the addresses of constants were moved from register to register.
    """


def use_widest_vectors():
    """
    Compile the loops of the function that calls this for registers of 512 bits, if there are any.

    LLVM prefers 256 bits on processors of Intel, as older ones slow down with 512. Reducing a scan
    takes 0.93 of the time with 512 there, but deriving surfels 1.1 of it: measure before you use
    this.
    """


@type_callable(stay_apart)
@type_callable(use_widest_vectors)
def _returns_nothing(context):
    return lambda: types.none


@lower_builtin(stay_apart)
def _mark_noinline(context, builder, signature, arguments):
    builder.function.attributes.add('noinline')
    return context.get_dummy_value()


@lower_builtin(use_widest_vectors)
def _mark_widest(context, builder, signature, arguments):
    # add of llvmlite knows only attributes without a value
    set.add(builder.function.attributes, '"prefer-vector-width"="512"')
    return context.get_dummy_value()
