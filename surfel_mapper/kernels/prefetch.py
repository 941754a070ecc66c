# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Ask for a row of memory ahead of its use.

The kernels of the map visit rows in an order that no hardware predicts, and know it some
iterations ahead. Asking early hides most of the cache misses.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload


def prefetch(array, index):
    """
    Ask for the cache line of array[index]; changes nothing. The index is not checked.

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
    # the instruction where it is compiled; the interpreter runs the empty function above
    return lambda array, index: _prefetch(array, index)
