# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Share work among threads without Python's lock: claim parts, watch a number for a change.

Threads that call the same kernel claim the parts of its work one by one. For a part handed out by
Python a thread needs the lock twice, and if it finds the lock taken it goes to sleep.

Stands alone: one of the three places that emit instructions of LLVM.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, type_callable
import numpy as np

from surfel_mapper.kernels.compiling import kernel, U


def claim(claims):
    """
    Return claims[0] and increase it by one, in one step: no two threads get the same number.

    claims  (1,) int64
    """
    number = claims[0]
    claims[0] = number + 1
    return number


@type_callable(claim)
def _returns_number(context):
    return lambda claims: types.int64


@lower_builtin(claim, types.Array)
def _emit_claim(context, builder, signature, arguments):
    pointer = _first(context, builder, signature, arguments)
    return builder.atomic_rmw('add', pointer, ir.IntType(64)(1), 'seq_cst')


def latest(numbers):
    """
    Return numbers[0] as other threads left it: a loop reads it from memory every time.

    numbers  (N,) int64
    """
    return numbers[0]


@type_callable(latest)
def _returns_latest(context):
    return lambda numbers: types.int64


@lower_builtin(latest, types.Array)
def _emit_latest(context, builder, signature, arguments):
    pointer = _first(context, builder, signature, arguments)
    return builder.load_atomic(pointer, 'seq_cst', 8)


def _first(context, builder, signature, arguments):
    """Return the address of the first number of an array."""
    (array_type,) = signature.args
    struct = context.make_array(array_type)(context, builder, arguments[0])
    zero = context.get_constant(types.intp, 0)
    return cgutils.get_item_pointer(context, builder, array_type, struct, [zero], wraparound=False)


@kernel()
def watch(numbers, seen, turns, more):
    """
    Look until another thread has changed a number, then wait some turns more.

    numbers  (1,) int64
    seen     int64, the number before the change
    turns    times to look, at most
    more     turns after the change

    Returns whether it changed, and a number without meaning.

    A turn takes 6 ns: a square root that depends on the last one and is part of the result, else
    it would not be computed. Meanwhile another thread on the core finds its units idle.
    """
    left, changed, value = U(turns), False, float(turns)
    while left > U(0):
        left -= U(1)
        value = np.sqrt(value + 2.0)
        if not changed and latest(numbers) != seen:
            changed, left = True, U(more)
    return changed, value
