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
    """Four floats in one register."""

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
def load(typingctx, array, index):
    """Array[index : index + 4]."""

    def codegen(context, builder, signature, args):
        address = _address(context, builder, signature.args[0], *args)
        return builder.load(address, align=signature.args[0].dtype.bitwidth // 8)

    return Lanes(array.dtype)(array, types.intp), codegen


@intrinsic
def store(typingctx, array, index, lanes):
    """array[index : index + 4] = lanes."""

    def codegen(context, builder, signature, args):
        address = _address(context, builder, signature.args[0], *args[:2])
        builder.store(args[2], address, align=signature.args[0].dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), codegen


@intrinsic
def spread(typingctx, array, index):
    """array[index] in all four lanes."""

    def codegen(context, builder, signature, args):
        number = builder.load(_address(context, builder, signature.args[0], *args, vector=False))
        undefined = ir.Constant(ir.VectorType(number.type, 4), ir.Undefined)
        one = builder.insert_element(undefined, number, ir.IntType(32)(0))
        return builder.shuffle_vector(one, undefined, ir.Constant(ir.VectorType(ir.IntType(32), 4), [0] * 4))

    return Lanes(array.dtype)(array, types.intp), codegen


@intrinsic(prefer_literal=True)
def shuffle(typingctx, low, high, a, b, c, d):
    """Four lanes picked, by literal numbers, from low's (0..3) and high's (4..7)."""
    picks = [pick.literal_value for pick in (a, b, c, d)]

    def codegen(context, builder, signature, args):
        return builder.shuffle_vector(*args[:2], ir.Constant(ir.VectorType(ir.IntType(32), 4), picks))

    return low(low, high, a, b, c, d), codegen


@intrinsic(prefer_literal=True)
def store_lane(typingctx, array, index, lanes, which):
    """array[index] = the lane of that literal number."""

    def codegen(context, builder, signature, args):
        address = _address(context, builder, signature.args[0], *args[:2], vector=False)
        builder.store(builder.extract_element(args[2], ir.IntType(32)(which.literal_value)), address)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes, which), codegen


@intrinsic
def plus(typingctx, a, b):
    """a + b."""

    def codegen(context, builder, signature, args):
        return builder.fadd(*args)

    return a(a, b), codegen


@intrinsic
def times(typingctx, a, b):
    """a * b."""

    def codegen(context, builder, signature, args):
        return builder.fmul(*args)

    return a(a, b), codegen


@intrinsic
def plus_times(typingctx, total, a, b):
    """total + a * b, rounded once where the processor can."""

    def codegen(context, builder, signature, args):
        kind = ir.FunctionType(args[0].type, [args[0].type] * 3)
        name = f"llvm.fmuladd.v4f{total.dtype.bitwidth}"
        multiply_add = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(multiply_add, [args[1], args[2], args[0]])

    return total(total, a, b), codegen


@compiled
def load_rows(array, index):
    """Rows of the 3x3 matrix at array[index:]; lane 3 is whatever."""
    last = load(array, index + 5)
    return load(array, index), load(array, index + 3), shuffle(last, last, 1, 2, 3, 3)


@compiled
def store_rows(array, index, x, y, z):
    """Lanes 0..2 of three rows to the 3x3 matrix at array[index:]; each row's lane 3 gives way to the next row."""
    store(array, index, x)
    store(array, index + 3, y)
    store(array, index + 5, shuffle(y, z, 2, 4, 5, 6))


@compiled
def with_last(rows, array, index):
    """The rows with array[index : index + 3] in lane 3."""
    x, y, z = rows
    return (
        shuffle(x, spread(array, index), 0, 1, 2, 7),
        shuffle(y, spread(array, index + 1), 0, 1, 2, 7),
        shuffle(z, spread(array, index + 2), 0, 1, 2, 7),
    )


@compiled
def store_last(array, index, rows):
    """array[index : index + 3] = the rows' lanes 3."""
    store_lane(array, index, rows[0], 3)
    store_lane(array, index + 1, rows[1], 3)
    store_lane(array, index + 2, rows[2], 3)


@compiled
def store_last_added(array, index, rows, base, at):
    """array[index : index + 3] = base[at : at + 3] + the rows' lanes 3."""
    store_lane(array, index, plus(rows[0], spread(base, at)), 3)
    store_lane(array, index + 1, plus(rows[1], spread(base, at + 1)), 3)
    store_lane(array, index + 2, plus(rows[2], spread(base, at + 2)), 3)


@compiled
def mix(array, index, step, rows):
    """Sum over k of array[index + k * step] rows[k]."""
    total = times(spread(array, index), rows[0])
    total = plus_times(total, spread(array, index + step), rows[1])
    return plus_times(total, spread(array, index + 2 * step), rows[2])


@compiled
def forward(start, stop, parents, R_local, t_root, offsets, R, t):
    """World rotations R and positions t of the samples start..stop."""
    joints = len(parents)
    stride = 3 * joints if len(offsets) > 3 * joints else 0
    for sample in range(start, stop):
        first = sample * joints
        x, y, z = load_rows(R_local, 9 * first)
        store_rows(R, 9 * first, x, y, z)
        for axis in range(3):
            store_lane(t, 3 * first + axis, spread(t_root, 3 * sample + axis), 0)
        for joint in range(1, joints):
            own, parent = first + joint, first + parents[joint]
            rows = with_last(load_rows(R_local, 9 * own), offsets, stride * sample + 3 * joint)
            x, y, z = (
                mix(R, 9 * parent, 1, rows),
                mix(R, 9 * parent + 3, 1, rows),
                mix(R, 9 * parent + 6, 1, rows),
            )
            store_rows(R, 9 * own, x, y, z)
            store_last_added(t, 3 * own, (x, y, z), t, 3 * parent)


@compiled
def backward(start, stop, parents, R_local, offsets, R, grad_R, grad_t, grad_local, grad_root, grad_offsets):
    """Gradients of the samples start..stop. To grad_offsets they are added; it is empty where they are not wanted."""
    joints = len(parents)
    stride = 3 * joints if len(offsets) > 3 * joints else 0
    unit = np.zeros(4, R.dtype)
    unit[3] = 1
    last = load(unit, 0)
    # One sample's gradients [g_R | g_t], to which the children add on the way to the root; they stay in the cache.
    g = np.empty(12 * joints, R.dtype)
    for sample in range(stop - 1, start - 1, -1):
        first = sample * joints
        for joint in range(joints):
            x, y, z = with_last(load_rows(grad_R, 9 * (first + joint)), grad_t, 3 * (first + joint))
            store(g, 12 * joint, x)
            store(g, 12 * joint + 4, y)
            store(g, 12 * joint + 8, z)
        for joint in range(joints - 1, 0, -1):
            own, parent, offset = first + joint, first + parents[joint], stride * sample + 3 * joint
            rows = load(g, 12 * joint), load(g, 12 * joint + 4), load(g, 12 * joint + 8)
            x, y, z = (
                mix(R, 9 * parent, 3, rows),
                mix(R, 9 * parent + 1, 3, rows),
                mix(R, 9 * parent + 2, 3, rows),
            )
            store_rows(grad_local, 9 * own, x, y, z)
            if len(grad_offsets) > 0:
                store_last_added(grad_offsets, offset, (x, y, z), grad_offsets, offset)
            # Columns of the local rotation over 0, and its offset over 1.
            x, y, z = load_rows(R_local, 9 * own)
            low, z = shuffle(x, y, 0, 4, 1, 5), shuffle(z, last, 0, 1, 2, 4)
            columns = (
                shuffle(low, z, 0, 1, 4, 7),
                shuffle(low, z, 2, 3, 5, 7),
                shuffle(shuffle(x, y, 2, 6, 2, 6), z, 0, 1, 6, 7),
            )
            before = load(offsets, offset - 1)
            moved = shuffle(before, last, 1, 2, 3, 7)
            for row in range(3):
                mine, above = 12 * joint + 4 * row, 12 * parents[joint] + 4 * row
                total = plus_times(load(g, above), spread(g, mine), columns[0])
                total = plus_times(total, spread(g, mine + 1), columns[1])
                total = plus_times(total, spread(g, mine + 2), columns[2])
                store(g, above, plus_times(total, spread(g, mine + 3), moved))
        rows = load(g, 0), load(g, 4), load(g, 8)
        store_rows(grad_local, 9 * first, rows[0], rows[1], rows[2])
        store_last(grad_root, 3 * sample, rows)
