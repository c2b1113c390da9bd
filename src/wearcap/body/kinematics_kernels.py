"""Forward kinematics of one sample after the other, and its gradient: loops compiled for the CPU.

Why lanes: one sample's chain of 3x3 products is too small for the compiler to vectorise, and scalar code spends an
instruction per number. Here a value is `Lanes`: four numbers in one register, a row of a rotation in lanes 0..2 and
in lane 3 the translation that goes through the same sum. So one multiply-add serves a row and its translation, as
if by 3x4 matrices [R | t], though memory holds R in nine numbers and t in three. The third row is read and written
from one number before it, so that four lanes never reach beyond the nine.

Arrays are flat, of one precision; indices are counted here and not checked. numba renews its cache only when this
file changes: what the kernels call stands in it too.
"""

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

from wearcap.geometry.compiled import compiled


class Lanes(types.Type):
    """Four floats in one register. The name stays as it is: compiled code in numba's cache is read by it."""

    def __init__(self, dtype):
        self.dtype = dtype
        super().__init__(name=f"Lanes({dtype})")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, lanes):
        number = manager.lookup(lanes.dtype).get_value_type()
        super().__init__(manager, lanes, ir.VectorType(number, 4))


def _address(context, builder, array_type, array, index, vector=True):
    """Pointer to array[index], to four numbers or to one."""
    data = context.make_array(array_type)(context, builder, array).data
    number = context.get_value_type(array_type.dtype)
    address = builder.gep(data, [index])
    return builder.bitcast(address, (ir.VectorType(number, 4) if vector else number).as_pointer())


@intrinsic
def _load(typingctx, array, index):
    """The four numbers array[index : index + 4]."""

    def codegen(context, builder, signature, args):
        address = _address(context, builder, signature.args[0], *args)
        return builder.load(address, align=signature.args[0].dtype.bitwidth // 8)

    return Lanes(array.dtype)(array, types.intp), codegen


@intrinsic
def _store(typingctx, array, index, lanes):
    """Put the lanes to array[index : index + 4]."""

    def codegen(context, builder, signature, args):
        address = _address(context, builder, signature.args[0], *args[:2])
        builder.store(args[2], address, align=signature.args[0].dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), codegen


@intrinsic
def _spread(typingctx, array, index):
    """The number array[index] in all four lanes."""

    def codegen(context, builder, signature, args):
        number = builder.load(_address(context, builder, signature.args[0], *args, vector=False))
        undefined = ir.Constant(ir.VectorType(number.type, 4), ir.Undefined)
        one = builder.insert_element(undefined, number, ir.IntType(32)(0))
        return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(ir.IntType(32), 4), [0] * 4))

    return Lanes(array.dtype)(array, types.intp), codegen


@intrinsic(prefer_literal=True)
def _shuffle(typingctx, low, high, a, b, c, d):
    """Four lanes picked, by literal numbers, from low's (0..3) and high's (4..7)."""
    picks = [pick.literal_value for pick in (a, b, c, d)]

    def codegen(context, builder, signature, args):
        return builder.shuffle_vector(*args[:2], ir.Constant(ir.VectorType(ir.IntType(32), 4), picks))

    return low(low, high, a, b, c, d), codegen


@intrinsic(prefer_literal=True)
def _store_lane(typingctx, array, index, lanes, which):
    """Put the lane of that literal number to array[index]."""

    def codegen(context, builder, signature, args):
        address = _address(context, builder, signature.args[0], *args[:2], vector=False)
        builder.store(builder.extract_element(args[2], ir.IntType(32)(which.literal_value)), address)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes, which), codegen


@intrinsic
def _plus(typingctx, a, b):
    """a + b."""

    def codegen(context, builder, signature, args):
        return builder.fadd(*args)

    return a(a, b), codegen


@intrinsic
def _times(typingctx, a, b):
    """a * b."""

    def codegen(context, builder, signature, args):
        return builder.fmul(*args)

    return a(a, b), codegen


@intrinsic
def _plus_times(typingctx, total, a, b):
    """total + a * b, rounded once where the processor can."""

    def codegen(context, builder, signature, args):
        kind = ir.FunctionType(args[0].type, [args[0].type] * 3)
        name = f"llvm.fmuladd.v4f{total.dtype.bitwidth}"
        multiply_add = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(multiply_add, [args[1], args[2], args[0]])

    return total(total, a, b), codegen


@compiled
def _load_rows(array, index):
    """Rows of the 3x3 matrix at array[index]; lane 3 is whatever stands there."""
    last = _load(array, index + 5)
    return _load(array, index), _load(array, index + 3), _shuffle(last, last, 1, 2, 3, 3)


@compiled
def _store_rows(array, index, rows):
    """Put lanes 0..2 of three rows to the 3x3 matrix at array[index]; a row's lane 3 gives way to the next row."""
    _store(array, index, rows[0])
    _store(array, index + 3, rows[1])
    _store(array, index + 5, _shuffle(rows[1], rows[2], 2, 4, 5, 6))


@compiled
def _with_last(rows, array, index):
    """The rows with the vector at array[index] in lane 3."""
    return (
        _shuffle(rows[0], _spread(array, index), 0, 1, 2, 7),
        _shuffle(rows[1], _spread(array, index + 1), 0, 1, 2, 7),
        _shuffle(rows[2], _spread(array, index + 2), 0, 1, 2, 7),
    )


@compiled
def _store_last(array, index, rows):
    """Put the rows' lanes 3 to the vector at array[index]."""
    _store_lane(array, index, rows[0], 3)
    _store_lane(array, index + 1, rows[1], 3)
    _store_lane(array, index + 2, rows[2], 3)


@compiled
def _plus_vector(rows, array, index):
    """The rows, to each of them the number of the vector at array[index] added: lane 3 is what counts."""
    return (
        _plus(rows[0], _spread(array, index)),
        _plus(rows[1], _spread(array, index + 1)),
        _plus(rows[2], _spread(array, index + 2)),
    )


@compiled
def _mixed(array, index, step, rows):
    """Sum over k of array[index + k * step] rows[k]."""
    total = _times(_spread(array, index), rows[0])
    total = _plus_times(total, _spread(array, index + step), rows[1])
    return _plus_times(total, _spread(array, index + 2 * step), rows[2])


@compiled
def forward(start, stop, parents, R_local, t_root, offsets, R, t):
    """World rotations R and positions t of the samples start..stop."""
    joints = len(parents)
    stride = 3 * joints if len(offsets) > 3 * joints else 0
    for sample in range(start, stop):
        first = sample * joints
        _store_rows(R, 9 * first, _load_rows(R_local, 9 * first))
        for axis in range(3):
            _store_lane(t, 3 * first + axis, _spread(t_root, 3 * sample + axis), 0)
        for joint in range(1, joints):
            own, above = first + joint, first + parents[joint]
            L = _with_last(_load_rows(R_local, 9 * own), offsets, stride * sample + 3 * joint)
            # R_p [L | o]
            at = 9 * above
            rows = _mixed(R, at, 1, L), _mixed(R, at + 3, 1, L), _mixed(R, at + 6, 1, L)
            _store_rows(R, 9 * own, rows)
            _store_last(t, 3 * own, _plus_vector(rows, t, 3 * above))


@compiled
def backward(start, stop, parents, R_local, offsets, R, grad_R, grad_t, grad_local, grad_root, grad_offsets):
    """Gradients of the samples start..stop. To grad_offsets they are added; it is empty where they are not wanted."""
    joints = len(parents)
    stride = 3 * joints if len(offsets) > 3 * joints else 0
    unit = np.zeros(4, R.dtype)
    unit[3] = 1
    last = _load(unit, 0)
    # One sample's gradients [g_R | g_t], to which the children add on the way to the root; they stay in the cache.
    g = np.empty(12 * joints, R.dtype)
    # From the last sample, as from the last joint: what is read in one direction is fetched ahead.
    for sample in range(stop - 1, start - 1, -1):
        first = sample * joints
        for joint in range(joints):
            rows = _with_last(_load_rows(grad_R, 9 * (first + joint)), grad_t, 3 * (first + joint))
            for row in range(3):
                _store(g, 12 * joint + 4 * row, rows[row])
        for joint in range(joints - 1, 0, -1):
            own, offset, mine = first + joint, stride * sample + 3 * joint, 12 * joint
            G = _load(g, mine), _load(g, mine + 4), _load(g, mine + 8)
            # R_pᵀ [g_R | g_t]
            at = 9 * (first + parents[joint])
            rows = _mixed(R, at, 3, G), _mixed(R, at + 1, 3, G), _mixed(R, at + 2, 3, G)
            _store_rows(grad_local, 9 * own, rows)
            if len(grad_offsets) > 0:
                _store_last(grad_offsets, offset, _plus_vector(rows, grad_offsets, offset))
            # Columns of L over 0, and o over 1: the parent receives [g_R Lᵀ + g_t oᵀ | g_t].
            x, y, z = _load_rows(R_local, 9 * own)
            xy, z = _shuffle(x, y, 0, 4, 1, 5), _shuffle(z, last, 0, 1, 2, 4)
            L_0, L_1 = _shuffle(xy, z, 0, 1, 4, 7), _shuffle(xy, z, 2, 3, 5, 7)
            L_2 = _shuffle(_shuffle(x, y, 2, 6, 2, 6), z, 0, 1, 6, 7)
            o = _shuffle(_load(offsets, offset - 1), last, 1, 2, 3, 7)
            above = 12 * parents[joint]
            for row in range(0, 12, 4):
                total = _plus_times(_load(g, above + row), _spread(g, mine + row), L_0)
                total = _plus_times(total, _spread(g, mine + row + 1), L_1)
                total = _plus_times(total, _spread(g, mine + row + 2), L_2)
                _store(g, above + row, _plus_times(total, _spread(g, mine + row + 3), o))
        G = _load(g, 0), _load(g, 4), _load(g, 8)
        _store_rows(grad_local, 9 * first, G)
        _store_last(grad_root, 3 * sample, G)
