"""Explicit SIMD for numba: a vector of LANES float32 (or int32, or booleans) as a value inside jitted code.

Numba's loops over pixels do not vectorise on their own (measured 3 to 6 times slower), so kernels state their vectors:

    t = simd.load(plane, i)                     # LANES consecutive floats
    drawn = (alpha >= ALPHA_MIN) & (t > ZERO)   # a mask; operands may mix vectors and float32 scalars
    simd.store(plane, i, simd.select(drawn, t - t * alpha, t))

Each maps to one vector instruction of LLVM, and LLVM maps it to what the processor has. Arrays are 1-D, contiguous,
float32 or int32; indices are not checked.
"""

from __future__ import annotations

import operator
from typing import Any

import llvmlite.binding
from llvmlite import ir
from numba.core import cgutils, config, types
from numba.core.datamodel.models import PrimitiveModel
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, register_model


def _compiles_avx512() -> bool:
    """Whether numba compiles for AVX-512: for this processor, unless it was told to compile for another one."""
    target: Any = config  # its attributes are made when numba starts
    if target.CPU_FEATURES is not None:
        return "+avx512f" in target.CPU_FEATURES
    return target.CPU_NAME is None and llvmlite.binding.get_host_cpu_features().get("avx512f", False)


#: Sixteen floats fill an AVX-512 register; elsewhere eight: one AVX register, or two of SSE or NEON.
LANES = 16 if _compiles_avx512() else 8

# Reassociation and contraction only: NaN and infinity keep their meaning, the guards rely on it.
FLAGS = ("contract", "reassoc", "arcp", "nsz")

_intrinsic: Any = intrinsic  # to a type checker the decorated functions have one argument too many

_F32, _I32, _I1 = ir.FloatType(), ir.IntType(32), ir.IntType(1)


class LaneType(types.Type):
    """Numba type of a vector of LANES elements of one LLVM type."""

    def __init__(self, name: str, element: ir.Type) -> None:
        super().__init__(name=f"{name}x{LANES}")
        self.ir = ir.VectorType(element, LANES)


@register_model(LaneType)
class _LaneModel(PrimitiveModel):
    def __init__(self, manager, lane_type):
        super().__init__(manager, lane_type, lane_type.ir)


floats = LaneType("float32", _F32)
ints = LaneType("int32", _I32)
mask = LaneType("bool", _I1)
_SCALARS = {types.float32: floats, types.int32: ints}


def _spread(builder, value, kind):
    """`value` as a vector: scalars are copied to every lane."""
    if isinstance(kind, LaneType):
        return value
    vector = _SCALARS[kind].ir
    undefined = ir.Constant(vector, ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ints.ir, [0] * LANES))


def _constant(x):
    return ir.Constant(floats.ir, [x] * LANES)


def _call(builder, name, result, arguments):
    """Call an LLVM intrinsic; `name` without the type suffix."""
    function_type = ir.FunctionType(result, [a.type for a in arguments])
    function = cgutils.get_or_insert_function(builder.module, function_type, f"llvm.{name}.v{LANES}f32")
    return builder.call(function, arguments)


_DOUBLES = ir.VectorType(ir.DoubleType(), LANES)


def _spread_double(builder, value):
    undefined = ir.Constant(_DOUBLES, ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(ints.ir, [0] * LANES))


def _call_double(builder, name, argument):
    function_type = ir.FunctionType(_DOUBLES, [_DOUBLES])
    function = cgutils.get_or_insert_function(builder.module, function_type, f"llvm.{name}.v{LANES}f64")
    return builder.call(function, [argument])


def _line(builder, start, slope):
    steps = ir.Constant(_DOUBLES, [float(k) for k in range(LANES)])
    return builder.fadd(_spread_double(builder, start), builder.fmul(_spread_double(builder, slope), steps))


def _define_operator(op, left, right_scalar, result, emit):
    """Type and lower `op` for two vectors, and for a vector with a scalar on either side."""
    pairs = [(left, left), (left, right_scalar), (right_scalar, left)] if right_scalar else [(left, left)]

    @infer_global(op)
    class _Typing(AbstractTemplate):
        def generic(self, args, kws):
            return signature(result, *args) if args in pairs else None

    def lower(context, builder, sig, args):
        return emit(builder, *(_spread(builder, a, kind) for a, kind in zip(args, sig.args, strict=True)))

    for pair in pairs:
        lower_builtin(op, *pair)(lower)


for _op, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _define_operator(_op, floats, types.float32, floats, lambda b, x, y, n=_name: getattr(b, n)(x, y, flags=FLAGS))
for _op, _name in ((operator.ge, ">="), (operator.gt, ">"), (operator.le, "<="), (operator.lt, "<")):
    _define_operator(_op, floats, types.float32, mask, lambda b, x, y, n=_name: b.fcmp_ordered(n, x, y))
    _define_operator(_op, ints, types.int32, mask, lambda b, x, y, n=_name: b.icmp_signed(n, x, y))
_define_operator(operator.and_, mask, None, mask, lambda b, x, y: b.and_(x, y))


def _pointer(context, builder, array_type, array, index, vector):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


@_intrinsic
def load(typingctx, array, index):
    """The LANES elements that start at array[index]."""
    kind = _SCALARS[array.dtype]

    def lower(context, builder, sig, args):
        value = builder.load(_pointer(context, builder, sig.args[0], args[0], args[1], kind.ir))
        value.align = 4
        return value

    return kind(array, index), lower


@_intrinsic
def repeat(typingctx, array, index):
    """array[index] in every lane, without numba's look at whether the index is negative."""
    kind = _SCALARS[array.dtype]

    def lower(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return _spread(builder, builder.load(builder.gep(data, [args[1]])), sig.args[0].dtype)

    return kind(array, index), lower


@_intrinsic
def store(typingctx, array, index, vector):
    """array[index : index + LANES] = vector."""

    def lower(context, builder, sig, args):
        kind = _SCALARS[sig.args[0].dtype]
        pointer = _pointer(context, builder, sig.args[0], args[0], args[1], kind.ir)
        builder.store(_spread(builder, args[2], sig.args[2]), pointer).align = 4
        return context.get_dummy_value()

    return types.void(array, index, vector), lower


@_intrinsic
def spread(typingctx, scalar):
    """The scalar (float32 or int32) in every lane."""
    return _SCALARS[scalar](scalar), lambda context, builder, sig, args: _spread(builder, args[0], sig.args[0])


@_intrinsic
def counting_from(typingctx, start):
    """start, start + 1, ..., start + LANES - 1 in float32, from a float32 or an int32 start.

    From an int32 it is exact, and no optimisation may mix it with what is subtracted from it.
    """

    def lower(context, builder, sig, args):
        first = _spread(builder, args[0], sig.args[0])
        if sig.args[0] == types.int32:
            return builder.sitofp(builder.add(first, ir.Constant(ints.ir, list(range(LANES)))), floats.ir)
        return builder.fadd(first, ir.Constant(floats.ir, [float(k) for k in range(LANES)]), flags=FLAGS)

    return floats(start), lower


@_intrinsic
def line_whole(typingctx, start, slope, limit):
    """Per lane k the integer nearest to start + k slope, kept within +-limit; start, slope and limit are float64."""

    def lower(context, builder, sig, args):
        centre = _line(builder, args[0], args[1])
        high, low = (_spread_double(builder, v) for v in (args[2], builder.fneg(args[2])))
        centre = builder.select(builder.fcmp_ordered("<", centre, high), centre, high)
        centre = builder.select(builder.fcmp_ordered(">", centre, low), centre, low)
        return builder.fptosi(_call_double(builder, "rint", centre), ints.ir)

    return ints(start, slope, limit), lower


@_intrinsic
def line_rest(typingctx, start, slope, whole):
    """Per lane k what start + k slope (float64) is more than `whole`, rounded to float32 at the end."""

    def lower(context, builder, sig, args):
        rest = builder.fsub(_line(builder, args[0], args[1]), builder.sitofp(args[2], _DOUBLES))
        return builder.fptrunc(rest, floats.ir)

    return floats(start, slope, whole), lower


@_intrinsic
def select(typingctx, condition, yes, no):
    """Per lane: yes where the condition holds, else no. Either may be a scalar."""
    kind = ints if ints in (yes, no) or (yes, no) == (types.int32, types.int32) else floats

    def lower(context, builder, sig, args):
        return builder.select(args[0], _spread(builder, args[1], sig.args[1]), _spread(builder, args[2], sig.args[2]))

    return kind(condition, yes, no), lower


@_intrinsic
def minimum(typingctx, x, y):
    """Per lane the smaller of two; y where x is NaN."""

    def lower(context, builder, sig, args):
        a, b = (_spread(builder, v, kind) for v, kind in zip(args, sig.args, strict=True))
        return builder.select(builder.fcmp_ordered("<", a, b), a, b)

    return floats(x, y), lower


@_intrinsic
def maximum(typingctx, x, y):
    """Per lane the larger of two; y where x is NaN."""

    def lower(context, builder, sig, args):
        a, b = (_spread(builder, v, kind) for v, kind in zip(args, sig.args, strict=True))
        return builder.select(builder.fcmp_ordered(">", a, b), a, b)

    return floats(x, y), lower


def _unary(name, doc):
    def typer(typingctx, x):
        return floats(x), lambda context, builder, sig, args: _call(builder, name, floats.ir, list(args))

    typer.__doc__ = doc
    return _intrinsic(typer)


square_root = _unary("sqrt", "Per lane square root.")
round_up = _unary("ceil", "Per lane the next integer above, as a float.")
round_down = _unary("floor", "Per lane the next integer below, as a float.")
magnitude = _unary("fabs", "Per lane absolute value.")


@_intrinsic
def to_int(typingctx, x):
    """Per lane conversion of an integral float within the range of int32."""
    return ints(x), lambda context, builder, sig, args: builder.fptosi(args[0], ints.ir)


#: 2^f = 1 + f (c1 + f (c2 + ...)) on [-1/2, 1/2]: minimax in the relative error, 9e-8: one unit in the last place.
EXP2_COEFFICIENTS = (
    0.6931470036506653,
    0.24022242426872253,
    0.05550733581185341,
    0.009671512991189957,
    0.001326472731307149,
)


@_intrinsic
def exp2_nonpositive(typingctx, x):
    """Per lane 2^x for x <= 0; below 2^-126, the smallest normal number, it stays there."""

    def lower(context, builder, sig, args):
        lowest = _constant(-126.0)
        y = builder.select(builder.fcmp_ordered(">", args[0], lowest), args[0], lowest)
        whole = _call(builder, "rint", floats.ir, [y])
        part = builder.fsub(y, whole)
        value = _constant(EXP2_COEFFICIENTS[-1])
        for c in (*reversed(EXP2_COEFFICIENTS[:-1]), 1.0):
            value = _call(builder, "fmuladd", floats.ir, [value, part, _constant(c)])
        exponent = builder.shl(builder.fptosi(whole, ints.ir), ir.Constant(ints.ir, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(value, ints.ir), exponent), floats.ir)

    return floats(x), lower


@_intrinsic
def total(typingctx, x):
    """Sum over the lanes, in an order that depends on the processor only."""

    def lower(context, builder, sig, args):
        function_type = ir.FunctionType(_F32, [_F32, floats.ir])
        name = f"llvm.vector.reduce.fadd.v{LANES}f32"
        function = cgutils.get_or_insert_function(builder.module, function_type, name)
        return builder.call(function, [ir.Constant(_F32, 0.0), args[0]], fastmath=FLAGS)

    return types.float32(x), lower


@_intrinsic
def any_lane(typingctx, condition):
    """True when the condition holds in at least one lane."""

    def lower(context, builder, sig, args):
        bits = ir.IntType(LANES)
        return builder.icmp_unsigned("!=", builder.bitcast(args[0], bits), ir.Constant(bits, 0))

    return types.boolean(condition), lower
