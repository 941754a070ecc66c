# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Prefetch memory into the cache.

The kernels of the map visit rows in an order that the hardware cannot predict but the kernel
knows some iterations ahead. Prefetching hides most of the cache misses.

A line may be prefetched twice: early into the second level of the cache, which waits for more
lines at once, and later into the first. With the first level alone a look-up of 100,000 voxels in
a map of 10^6 took 1.6 times as long as with the second alone. With the early one alone adding took
twice as long for some milliseconds after other work had used much of the bandwidth of the memory,
and in some processes as long as they ran, so the later one is needed too. Prefetch no address
outside of an array: translating it takes longer than a miss.

Kernels that work in chunks read and write arrays in pieces too short for the hardware prefetcher.
Prefetches of the next piece must be spread over a loop: all at once gain a third, or nothing.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, type_callable

LINE_BYTES = 64
"""Bytes of a cache line."""

FIRST_LEVEL, SECOND_LEVEL = 3, 2
"""Localities of llvm.prefetch."""


def prefetch(array, index):
    """
    Prefetch the cache line of array[index]; changes nothing. The index is not checked.

    array  one-dimensional, contiguous
    index  int64 or uint64
    """


def prefetch_early(array, index):
    """Prefetch as ``prefetch`` does, but into the second level of the cache, if at all."""


def prefetch_to_write(array, index):
    """Prefetch as ``prefetch`` does, for writing where the processor tells it from reading."""


@type_callable(prefetch)
@type_callable(prefetch_to_write)
@type_callable(prefetch_early)
def _returns_nothing(context):
    return lambda array, index: types.none


# compiled code emits the instruction, the interpreter runs the empty functions above; overloads
# of them would be compiled once more for every kernel that calls them
@lower_builtin(prefetch, types.Array, types.Integer)
def _emit_prefetch(context, builder, signature, arguments):
    return _emit(context, builder, signature, arguments, FIRST_LEVEL)


@lower_builtin(prefetch_early, types.Array, types.Integer)
def _emit_prefetch_early(context, builder, signature, arguments):
    return _emit(context, builder, signature, arguments, SECOND_LEVEL)


@lower_builtin(prefetch_to_write, types.Array, types.Integer)
def _emit_prefetch_to_write(context, builder, signature, arguments):
    return _emit(context, builder, signature, arguments, FIRST_LEVEL, is_written=True)


def _emit(context, builder, signature, arguments, level, is_written=False):
    array_type, _ = signature.args
    struct = context.make_array(array_type)(context, builder, arguments[0])
    pointer = cgutils.get_item_pointer(
        context, builder, array_type, struct, [arguments[1]], wraparound=False
    )
    pointer = builder.bitcast(pointer, ir.IntType(8).as_pointer())
    number = ir.IntType(32)
    takes = ir.FunctionType(ir.VoidType(), [pointer.type, number, number, number])
    function = builder.module.declare_intrinsic('llvm.prefetch', [pointer.type], takes)
    data = number(1)
    builder.call(function, [pointer, number(int(is_written)), number(level), data])
    return context.get_dummy_value()
