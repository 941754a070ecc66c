# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Search the eight entries of a bucket of the hash table in vector registers.

Compilers turn the loop over the entries into a chain of 16 conditional moves, and a look-up takes
1.2 times as long. So the instructions are spelled in the language of LLVM here, as are those of
prefetch.py.

Stands alone: one of the places that emit instructions of LLVM.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, type_callable
import numpy as np

BUCKET = 8
"""Entries of a bucket: a line of the cache."""

_HALF, _WORD = ir.IntType(32), ir.IntType(64)
_ENTRIES, _HALVES = ir.VectorType(_WORD, BUCKET), ir.VectorType(_HALF, 2 * BUCKET)


def highest_match(entries, first, upper):
    """
    Return the highest lower half of those entries of a bucket that have an upper half, or 0.

    entries  (8 M,) int64
    first    int64, first entry of the bucket; not checked
    upper    int64 in [0, 2^32)
    """
    bucket = entries[int(first) : int(first) + BUCKET].view(np.uint64)
    lower = bucket & np.uint64(0xFFFFFFFF)
    return np.int64(lower[bucket >> np.uint64(32) == np.uint64(upper)].max(initial=0))


@type_callable(highest_match)
def _returns_word(context):
    return lambda entries, first, upper: types.int64


# compiled code emits the instructions, the interpreter runs the function above
@lower_builtin(highest_match, types.Array, types.Integer, types.Integer)
def _emit_highest_match(context, builder, signature, arguments):
    array_type = signature.args[0]
    struct = context.make_array(array_type)(context, builder, arguments[0])
    address = cgutils.get_item_pointer(
        context, builder, array_type, struct, [arguments[1]], wraparound=False
    )
    bucket = builder.load(builder.bitcast(address, _ENTRIES.as_pointer()), align=8)
    rest = builder.xor(bucket, _spread(builder, builder.shl(arguments[2], _WORD(32))))
    matches = builder.icmp_unsigned('==', builder.lshr(rest, _constant(32)), _constant(0))
    lower = builder.bitcast(builder.select(matches, rest, _constant(0)), _HALVES)
    takes = ir.FunctionType(_HALF, [_HALVES])
    name = 'llvm.vector.reduce.umax.v16i32'
    highest = cgutils.get_or_insert_function(builder.module, takes, name)
    return builder.zext(builder.call(highest, [lower]), _WORD)


def _spread(builder, word):
    """Return a vector of eight times a word."""
    words = builder.insert_element(ir.Constant(_ENTRIES, ir.Undefined), word, _HALF(0))
    firsts = ir.Constant(ir.VectorType(_HALF, BUCKET), [_HALF(0)] * BUCKET)
    return builder.shuffle_vector(words, words, firsts)


def _constant(word):
    """Return the constant vector of eight times a number."""
    return ir.Constant(_ENTRIES, [_WORD(word)] * BUCKET)
