# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Numbers in vector registers: words of 64 bits, sums of a voxel or a bucket; distances.

A reduction needs ten sums of each voxel of a scan: count, places (3) and products of places (6).
Packed into eight words they fill one cache line, which one instruction reads and one writes where
registers have 512 bits, two or four elsewhere. Ten sums in float64 would take two lines and ten
instructions each.

    word 0        count << 40 | sum of x, with x, y, z in [0, 65536)
    word 1        sum of z << 32 | sum of y
    words 2 to 7  sums of xx, xy, xz, yy, yz, zz

All are exact up to FULL points. The count is exact up to WIDEST, so that voxels with more than
FULL points are noticed. A place arrives in one word, as quantise writes it. It is spread over all
lanes, and one instruction picks from its bytes what each lane needs: the first factors of the
products, the second ones, or the first two words.

A bucket of the hash table of a map has eight entries. Compilers turn the loop over them into a
chain of 16 conditional moves, and a look-up takes 1.2 times as long.

A search for neighbours goes on with the nearest of 16 points.

Interpreted, the functions work on arrays; compiled, the sums are a type of their own. Compilers do
not find these instructions in loops, so they are spelled in the language of LLVM here, as are
those of prefetch.py.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable
import numpy as np

from surfel_mapper.kernels.layout import BITS, COUNT_BITS, HIGH_BITS

WORDS = 8
"""Words of the sums of a voxel, and entries of a bucket."""

NUMBERS = 16
"""Number of distances of which the least is found at once."""

FULL = (1 << 16) - 1
"""Number of points of a voxel up to which the sums are exact."""

WIDEST = (1 << 23) - 1
"""Number of points of a voxel up to which the count is exact."""

_X, _Y, _Z = (0, 1), (2, 3), (4, 5)
"""Bytes of a place that hold a coordinate."""

_NO_BYTE = WORDS
"""Stands for a byte of zeros."""

_PLACES = (*_X, *[_NO_BYTE] * 3, 6), (*_Y, *[_NO_BYTE] * 2, *_Z)
"""Bytes of a place in words 0 and 1; byte 6 is the count of one."""

_FACTORS = (_X, _X, _X, _Y, _Y, _Z), (_X, _Y, _Z, _Y, _Z, _Z)
"""Bytes of a place in the factors of words 2 to 7."""

_HALF = (1 << HIGH_BITS) - 1
"""Mask of the lower half of a word."""


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


def sum_unless(is_dropped, sums, base):
    """Return base plus sums, or base alone if the sums are dropped."""
    return base if is_dropped else sums + base


def plus_place(sums, packed):
    """Return sums with one point more, an int64 packed by quantise."""
    x, y, z, count = (int(packed) >> BITS * i & (1 << BITS) - 1 for i in range(4))
    words = count << COUNT_BITS | x, z << HIGH_BITS | y
    return sums + np.array([*words, x * x, x * y, x * z, y * y, y * z, z * z])


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


def place_of_least(numbers, passed):
    """
    Return the place of the least of numbers[:16] that are not passed over; 15 if all are.

    numbers  (16,) float64, no nan, none negative; of those whose first 28 bits agree (1.5e-5 of
             their size) the first is the least
    passed   uint64: bit i is set if numbers[i] is passed over
    """
    indices = np.arange(NUMBERS)
    upper = numbers[:NUMBERS].view(np.int64) >> HIGH_BITS
    ranked = (upper & -NUMBERS | indices)[int(passed) >> indices & 1 == 0]
    return np.int64(ranked.min(initial=_HALF) % NUMBERS)


class Lanes(types.Type):
    """Eight words in vector registers; the type that compiled kernels give them."""

    def __init__(self):
        super().__init__(name='Lanes')


_LANES = Lanes()
_MASK, _HALF_WORD, _WORD = ir.IntType(WORDS), ir.IntType(32), ir.IntType(64)
_VECTOR, _BYTES = ir.VectorType(_WORD, WORDS), ir.VectorType(ir.IntType(8), 8 * WORDS)


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


@type_callable(sum_unless)
def _type_of_sum_unless(context):
    return lambda is_dropped, sums, base: _LANES


@type_callable(plus_place)
def _type_of_sum(context):
    return lambda sums, packed: _LANES


@type_callable(highest_match)
def _type_of_match(context):
    return lambda words, at, upper: types.int64


@type_callable(num_used)
def _type_of_number(context):
    return lambda words, at: types.int64


@type_callable(place_of_half)
def _type_of_place(context):
    return lambda words, at, lower: types.int64


@type_callable(place_of_least)
def _type_of_least(context):
    return lambda numbers, passed: types.int64


@lower_builtin(load_sums, types.Array, types.Integer)
def _emit_load(context, builder, signature, arguments):
    return builder.load(_address(context, builder, signature, arguments), align=8)


@lower_builtin(store_sums, types.Array, types.Integer, Lanes)
def _emit_store(context, builder, signature, arguments):
    builder.store(arguments[2], _address(context, builder, signature, arguments), align=8)
    return context.get_dummy_value()


@lower_builtin(sum_unless, types.boolean, Lanes, Lanes)
def _emit_sum_unless(context, builder, signature, arguments):
    is_dropped, sums, base = arguments
    both = ir.Constant(ir.ArrayType(_VECTOR, 2), [_constant([-1] * WORDS), _constant([0] * WORDS)])
    masks = cgutils.global_constant(builder, 'masks', both)
    masks.align = 8 * WORDS
    # loaded: spreading a number over lanes needs the execution port that picks bytes of places
    mask = builder.load(builder.gep(masks, [_WORD(0), builder.zext(is_dropped, _WORD)]))
    return builder.add(builder.and_(sums, mask), base)


@lower_builtin(plus_place, Lanes, types.int64)
def _emit_plus_place(context, builder, signature, arguments):
    sums, packed = arguments
    # the fence keeps spreading and picking apart: LLVM merges them into an instruction of three
    # micro-operations on Intel, and adding took 1.2 times as long
    spread = builder.bitcast(_fenced(builder, _spread(builder, packed)), _BYTES)
    first, second = (_pick(builder, spread, ((), (), *bytes_)) for bytes_ in _FACTORS)
    lower_halves = _constant([_HALF] * WORDS)  # the compiler has to know that factors are short
    product = builder.mul(builder.and_(first, lower_halves), builder.and_(second, lower_halves))
    words = _pick(builder, spread, (*_PLACES, *[()] * (WORDS - 2)))
    return _fenced(builder, builder.add(builder.add(sums, words), product))


@lower_builtin(highest_match, types.Array, types.Integer, types.Integer)
def _emit_highest_match(context, builder, signature, arguments):
    words = _emit_load(context, builder, signature, arguments)
    upper = builder.shl(arguments[2], _WORD(HIGH_BITS))
    difference = builder.xor(words, _spread(builder, upper))
    zeros = _constant([0] * WORDS)
    differs = builder.lshr(difference, _constant([HIGH_BITS] * WORDS))
    lower = builder.select(builder.icmp_unsigned('==', differs, zeros), difference, zeros)
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


@lower_builtin(place_of_least, types.Array, types.Integer)
def _emit_place_of_least(context, builder, signature, arguments):
    struct = context.make_array(signature.args[0])(context, builder, arguments[0])
    halves = ir.VectorType(_HALF_WORD, NUMBERS)  # numbers of one sign have the order of their bits
    both = ir.VectorType(_HALF_WORD, 2 * NUMBERS)
    loaded = builder.load(builder.bitcast(struct.data, both.as_pointer()), align=8)
    upper = builder.shuffle_vector(loaded, loaded, _indices(range(1, 2 * NUMBERS, 2)))
    all_but_place = ir.Constant(halves, [_HALF_WORD(-NUMBERS)] * NUMBERS)
    ranked = builder.or_(builder.and_(upper, all_but_place), _indices(range(NUMBERS)))
    passed = builder.trunc(arguments[1], ir.IntType(NUMBERS))
    passed = builder.bitcast(passed, ir.VectorType(ir.IntType(1), NUMBERS))
    highest = ir.Constant(halves, [_HALF_WORD(-1)] * NUMBERS)
    takes = ir.FunctionType(_HALF_WORD, [halves])
    name = 'llvm.vector.reduce.umin.v16i32'
    least = cgutils.get_or_insert_function(builder.module, takes, name)
    minimum = builder.call(least, [builder.select(passed, highest, ranked)])
    return builder.zext(builder.and_(minimum, _HALF_WORD(NUMBERS - 1)), _WORD)


def _address(context, builder, signature, arguments):
    """Return the address of the words from an index on."""
    array_type = signature.args[0]
    struct = context.make_array(array_type)(context, builder, arguments[0])
    address = cgutils.get_item_pointer(
        context, builder, array_type, struct, [arguments[1]], wraparound=False
    )
    return builder.bitcast(address, _VECTOR.as_pointer())


def _pick(builder, spread, bytes_of_lanes):
    """Return lanes of some bytes each, lowest first, of a word that is spread over all lanes."""
    chosen = []
    for lane, bytes_ in enumerate(bytes_of_lanes):
        filled = (*bytes_, *[_NO_BYTE] * (WORDS - len(bytes_)))
        chosen += [_BYTES.count if b == _NO_BYTE else WORDS * lane + b for b in filled]
    zeros = ir.Constant(_BYTES, None)
    return builder.bitcast(builder.shuffle_vector(spread, zeros, _indices(chosen)), _VECTOR)


def _fenced(builder, lanes):
    """
    Return lanes behind a fence: the compiler may not reorder additions across it.

    It would compute the product last, in the chain of sums, so that each point waits for the
    product of the one before it: adding took 1.8 times as long.
    """
    floats = ir.VectorType(ir.DoubleType(), WORDS)  # the fence exists for these only
    takes = ir.FunctionType(floats, [floats])
    name = 'llvm.arithmetic.fence.v8f64'
    fence = cgutils.get_or_insert_function(builder.module, takes, name)
    return builder.bitcast(builder.call(fence, [builder.bitcast(lanes, floats)]), _VECTOR)


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
