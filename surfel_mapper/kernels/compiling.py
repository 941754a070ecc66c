# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Decorators for kernels that a start waits for: nothing is compiled that no one calls.

A function of eight arrays takes 0.3 s to compile, of which 0.1 s is the wrapper for calls from
Python and 0.04 s the one for calls from C. A ``kernel`` has the former only. An ``inlined``
one is compiled inside the kernels that call it. On its own it would be optimised and translated
once more, which took a quarter of the time to the first scan.
"""

from functools import partial

from numba import njit
import numpy as np

kernel = partial(njit, cache=True, nogil=True, no_cfunc_wrapper=True)
"""Compile a function that Python calls; takes the options of njit."""

inlined = partial(kernel, inline='always')
"""Compile a function as lines of each kernel that calls it, with the options of that kernel."""

U = np.uint64
"""Unsigned indices: numba tests signed ones for being negative, and loops are not vectorised."""
