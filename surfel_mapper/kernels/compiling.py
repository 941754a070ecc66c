# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Decorators for kernels that a start waits for: numba compiles no wrappers that nothing calls.

A function of eight arrays takes 0.3 s to compile, of which 0.1 s is the wrapper for calls from
Python and 0.04 s the one for calls from C. A ``kernel`` has the former only. A ``part`` has none:
only kernels call it compiled; from Python it runs interpreted.

Stands alone: kernels of any folder may use it.
"""

from functools import partial

from numba import njit
from numba.extending import register_jitable

kernel = partial(njit, cache=True, nogil=True, no_cfunc_wrapper=True)
"""Compile a function that Python calls; takes the options of njit."""

part = partial(register_jitable, nogil=True)
"""Compile a function that only kernels call, as a part of each of them."""
