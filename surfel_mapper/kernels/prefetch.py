# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Prefetch memory into the cache.

The kernels of the map visit rows in an order that the hardware cannot predict but the kernel
knows some iterations ahead. Prefetching hides most of the cache misses.

Stands alone: it is the one place that emits an instruction of LLVM.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload


def prefetch(array, index):
    """
    Prefetch the cache line of array[index]; changes nothing. The index is not checked.

    array  one-dimensional, contiguous
    index  int64
    """


@intrinsic
def _prefetch(typingctx, array, index):
    """Emit the prefetch instruction of the machine."""

    def codegen(context, builder, signature, arguments):
        array_type, _ = signature.args
        struct = context.make_array(array_type)(context, builder, arguments[0])
        pointer = cgutils.get_item_pointer(
            context, builder, array_type, struct, [arguments[1]], wraparound=False
        )
        pointer = builder.bitcast(pointer, ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        takes = ir.FunctionType(ir.VoidType(), [pointer.type, number, number, number])
        function = builder.module.declare_intrinsic('llvm.prefetch', [pointer.type], takes)
        for_write, keep_close, data = number(1), number(3), number(1)
        builder.call(function, [pointer, for_write, keep_close, data])
        return context.get_dummy_value()

    return types.none(array, index), codegen


@overload(prefetch, inline='always')
def _compiled_prefetch(array, index):
    # compiled code emits the instruction; the interpreter runs the empty function above
    return lambda array, index: _prefetch(array, index)
