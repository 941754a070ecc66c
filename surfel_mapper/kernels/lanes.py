# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Eight words of 64 bits in vector registers: sums of a voxel, a bucket, and columns of eight rows.

A reduction needs ten sums of each voxel of a scan: count, places (3) and products of places (6).
Packed into eight words they fill one cache line, which one instruction reads and one writes where
registers have 512 bits, two or four elsewhere. Ten sums in float64 would take two lines and ten
instructions each.

    word 0        sum of z << 32 | sum of x, with x, y, z in [0, 65536)
    word 1        count << 32 | sum of y
    words 2 to 7  sums of xx, xy, xz, yy, yz, zz

All are exact up to FULL points. With more, up to WIDEST, the upper half of word 1 is the count or
slightly more, so that such voxels are noticed. A place arrives in one word, as quantise writes it.
It is spread over all lanes and shifted to the factors of the products.

A bucket of the hash table of a map has eight entries. Compilers turn the loop over them into a
chain of 16 conditional moves, and a look-up takes 1.2 times as long.

Surfels are derived from columns of the rows of a map, eight rows at once. Exchanging blocks of
words between rows takes three quarters of the time of moving each word to its column.

Interpreted, the functions work on arrays; compiled, the sums are a type of their own. Compilers do
not find these instructions in loops, so they are spelled in the language of LLVM here, as are
those of prefetch.py.

Stands alone: one of the two places that emit instructions of LLVM.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable
import numpy as np

from surfel_mapper.kernels.layout import BITS, HIGH_BITS, ROW

WORDS = 8
"""Words of the sums of a voxel, and entries of a bucket."""

FULL = (1 << 16) - 1
"""Number of points of a voxel up to which the sums are exact."""

WIDEST = (1 << 23) - 1
"""Number of points of a voxel up to which the count does not overflow."""

_PRODUCTS = (0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)
"""Factors of words 2 to 7, as axes."""

_HALF = (1 << HIGH_BITS) - 1
"""Mask of the lower half of a word."""

_Z_AND_X = ((1 << BITS) - 1) * (1 + (1 << HIGH_BITS))
"""Mask of the pieces of a place that word 0 sums."""

_ONE_AND_Y = (1 << HIGH_BITS) + (1 << BITS) - 1
"""Mask of those that word 1 sums, of the place moved by a piece."""


def load_sums(words, at):
    """
    Return words[at : at + 8] as lanes. The index is not checked.

    words  (8 M,) int64; fastest if aligned to 64 bytes
    at     uint64
    """
    return words[int(at) : int(at) + WORDS].copy()


def store_sums(words, at, sums):
    """Set words[at : at + 8] to lanes. The index is not checked."""
    words[int(at) : int(at) + WORDS] = sums


def masked_sum(sums, mask, others):
    """Return (sums & mask) + others; the mask, int64, is -1 or 0."""
    return (sums & mask) + others


def plus_place(sums, place):
    """Return sums with one point more; its place as an int64, see kernels/layout.py."""
    x, y, z, one = (int(place) >> axis * BITS & (1 << BITS) - 1 for axis in range(4))
    products = [(x, y, z)[a] * (x, y, z)[b] for a, b in _PRODUCTS]
    return sums + np.array([z << HIGH_BITS | x, one << HIGH_BITS | y, *products])


def highest_match(words, at, upper):
    """
    Return the highest lower half among words[at : at + 8] that have an upper half, or 0.

    words  (8 M,) int64; the index is not checked
    at     int64
    upper  int64 in [0, 2^32)
    """
    chosen = words[int(at) : int(at) + WORDS].view(np.uint64)
    lower = chosen & np.uint64(_HALF)
    return np.int64(lower[chosen >> np.uint64(HIGH_BITS) == np.uint64(upper)].max(initial=0))


def num_used(words, at):
    """Return the number of words[at : at + 8] that are not 0; the index is not checked."""
    return np.int64(np.count_nonzero(words[int(at) : int(at) + WORDS]))


def place_of_half(words, at, lower):
    """
    Return the first of words[at : at + 8] with a lower half, from 0, or 8.

    words  (8 M,) int64; the index is not checked
    at     int64
    lower  int64 in [0, 2^32)
    """
    equal = words[int(at) : int(at) + WORDS] & _HALF == lower
    return np.int64(equal.argmax() if equal.any() else WORDS)


def transpose_rows(words, offsets, first, columns):
    """
    Write eight rows of ROW words as columns; no index is checked.

    words    (R * ROW,) int64
    offsets  (N,) int64, first word of each row
    first    int64, the first of the eight in offsets and columns
    columns  (ROW, N) int64, out
    """
    for row in range(int(first), int(first) + WORDS):
        at = int(offsets[row])
        columns[:, row] = words[at : at + ROW]


class Lanes(types.Type):
    """Eight words in vector registers; the type that compiled kernels give them."""

    def __init__(self):
        super().__init__(name='Lanes')


_LANES = Lanes()
_MASK, _HALF_WORD, _WORD = ir.IntType(WORDS), ir.IntType(32), ir.IntType(64)
_VECTOR, _HALF_VECTOR = ir.VectorType(_WORD, WORDS), ir.VectorType(_WORD, WORDS // 2)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, lanes_type):
        super().__init__(manager, lanes_type, _VECTOR)


@type_callable(load_sums)
def _type_of_loaded(context):
    return lambda words, at: _LANES


@type_callable(store_sums)
def _type_of_stored(context):
    return lambda words, at, sums: types.none


@type_callable(masked_sum)
def _type_of_masked_sum(context):
    return lambda sums, mask, others: _LANES


@type_callable(plus_place)
def _type_of_sum(context):
    return lambda sums, place: _LANES


@type_callable(highest_match)
def _type_of_match(context):
    return lambda words, at, upper: types.int64


@type_callable(num_used)
def _type_of_number(context):
    return lambda words, at: types.int64


@type_callable(place_of_half)
def _type_of_place(context):
    return lambda words, at, lower: types.int64


@type_callable(transpose_rows)
def _type_of_transposed(context):
    return lambda words, offsets, first, columns: types.none


@lower_builtin(load_sums, types.Array, types.Integer)
def _emit_load(context, builder, signature, arguments):
    return builder.load(_address(context, builder, signature, arguments), align=8)


@lower_builtin(store_sums, types.Array, types.Integer, Lanes)
def _emit_store(context, builder, signature, arguments):
    builder.store(arguments[2], _address(context, builder, signature, arguments), align=8)
    return context.get_dummy_value()


@lower_builtin(masked_sum, Lanes, types.int64, Lanes)
def _emit_masked_sum(context, builder, signature, arguments):
    sums, mask, others = arguments
    return builder.add(builder.and_(sums, _spread(builder, mask)), others)


@lower_builtin(plus_place, Lanes, types.int64)
def _emit_plus_place(context, builder, signature, arguments):
    sums, place = arguments
    spread = _spread(builder, place)
    first, second = (
        builder.lshr(spread, _constant([BITS * axis for axis in (0, 1, *axes)]))
        for axes in zip(*_PRODUCTS, strict=True)
    )
    factor = _constant([0, 0, *[(1 << BITS) - 1] * len(_PRODUCTS)])
    products = builder.mul(builder.and_(first, factor), builder.and_(second, factor))
    halves = _constant([_Z_AND_X, _ONE_AND_Y, *[0] * len(_PRODUCTS)])
    return builder.add(sums, builder.or_(products, builder.and_(first, halves)))


@lower_builtin(highest_match, types.Array, types.Integer, types.Integer)
def _emit_highest_match(context, builder, signature, arguments):
    words = _emit_load(context, builder, signature, arguments)
    upper = builder.shl(arguments[2], _WORD(HIGH_BITS))
    rest = builder.xor(words, _spread(builder, upper))
    zeros = _constant([0] * WORDS)
    differs = builder.lshr(rest, _constant([HIGH_BITS] * WORDS))
    lower = builder.select(builder.icmp_unsigned('==', differs, zeros), rest, zeros)
    halves = ir.VectorType(_HALF_WORD, 2 * WORDS)  # processors have maxima of 32 bits
    takes = ir.FunctionType(_HALF_WORD, [halves])
    name = 'llvm.vector.reduce.umax.v16i32'
    highest = cgutils.get_or_insert_function(builder.module, takes, name)
    return builder.zext(builder.call(highest, [builder.bitcast(lower, halves)]), _WORD)


@lower_builtin(num_used, types.Array, types.Integer)
def _emit_num_used(context, builder, signature, arguments):
    words = _emit_load(context, builder, signature, arguments)
    used = builder.icmp_unsigned('!=', words, _constant([0] * WORDS))
    return builder.zext(builder.ctpop(builder.bitcast(used, _MASK)), _WORD)


@lower_builtin(place_of_half, types.Array, types.Integer, types.Integer)
def _emit_place_of_half(context, builder, signature, arguments):
    words = _emit_load(context, builder, signature, arguments)
    lower = builder.and_(words, _constant([_HALF] * WORDS))
    equal = builder.icmp_unsigned('==', lower, _spread(builder, arguments[2]))
    of_zero_too = ir.Constant(ir.IntType(1), 0)
    return builder.zext(builder.cttz(builder.bitcast(equal, _MASK), of_zero_too), _WORD)


@lower_builtin(transpose_rows, types.Array, types.Array, types.Integer, types.Array)
def _emit_transpose_rows(context, builder, signature, arguments):
    words_type, offsets_type, _, columns_type = signature.args
    words, offsets, first, columns = arguments
    wide, narrow = [], []  # words 0 to 7 of each row, words 8 to 11
    for row in range(WORDS):
        index = [builder.add(first, _WORD(row))]
        at = builder.load(_pointer(context, builder, offsets_type, offsets, index, _WORD))
        address = _pointer(context, builder, words_type, words, [at], _VECTOR)
        wide.append(builder.load(address, align=8))
        at = builder.add(at, _WORD(WORDS))
        address = _pointer(context, builder, words_type, words, [at], _HALF_VECTOR)
        narrow.append(builder.load(address, align=8))
    paired = [
        builder.shuffle_vector(narrow[row], narrow[row + 4], _indices(range(WORDS)))
        for row in range(4)
    ]
    transposed = [*_transposed(builder, wide, 4), *_transposed(builder, paired, 2)]
    for column, lanes in enumerate(transposed):
        index = [_WORD(column), first]
        address = _pointer(context, builder, columns_type, columns, index, _VECTOR)
        builder.store(lanes, address, align=8)
    return context.get_dummy_value()


def _transposed(builder, rows, block):
    """
    Return the columns of rows that are lanes, by exchanging blocks of 1, 2, ... words.

    rows   8 lanes, or 4 that hold two rows of four words each
    block  size of the last blocks: 4, or 2 for rows of four words
    """
    size = 1
    while size <= block:
        low = [lane & ~size | (WORDS if lane & size else 0) for lane in range(WORDS)]
        high = [lane | size if not lane & size else WORDS + lane for lane in range(WORDS)]
        rows = list(rows)
        for row in range(len(rows)):
            if not row & size:
                pair = rows[row], rows[row | size]
                rows[row] = builder.shuffle_vector(*pair, _indices(low))
                rows[row | size] = builder.shuffle_vector(*pair, _indices(high))
        size *= 2
    return rows


def _address(context, builder, signature, arguments):
    """Return the address of the words from an index on."""
    return _pointer(context, builder, signature.args[0], arguments[0], [arguments[1]], _VECTOR)


def _pointer(context, builder, array_type, array, index, pointee):
    """Return the address of an element as that of another type; the index is not checked."""
    struct = context.make_array(array_type)(context, builder, array)
    address = cgutils.get_item_pointer(
        context, builder, array_type, struct, index, wraparound=False
    )
    return builder.bitcast(address, pointee.as_pointer())


def _spread(builder, word):
    """Return lanes that all hold a word."""
    lanes = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), word, _HALF_WORD(0))
    return builder.shuffle_vector(lanes, lanes, _indices([0] * WORDS))


def _indices(lanes):
    """Return the constant that selects lanes."""
    return ir.Constant(ir.VectorType(_HALF_WORD, len(lanes)), [_HALF_WORD(lane) for lane in lanes])


def _constant(words):
    """Return constant lanes."""
    return ir.Constant(_VECTOR, [_WORD(word) for word in words])
