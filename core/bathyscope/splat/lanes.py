"""Eight float32 numbers as one numba value, so that kernels can be written for vector units.

Numba's loops over arrays do not vectorise when they branch or touch many arrays. Here a value of type ``F8``
is an LLVM ``<8 x float>``, which LLVM turns into whatever the processor has: one AVX register, two SSE or NEON
ones. Arithmetic and comparisons take an ``F8`` and an ``F8`` or number; a comparison gives a mask ``M8``.

Numba's cache of a kernel looks at the kernel's own file only: clear ``__pycache__`` after changing this one.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable

from bathyscope.splat.jit import instruction

WIDTH = 8
_declare: Callable[..., Any] = cgutils.get_or_insert_function
_type_callable: Callable[..., Any] = type_callable
_lower_builtin: Callable[..., Any] = lower_builtin
_I32 = ir.IntType(32)
_I64 = ir.IntType(64)
_FLOAT = ir.FloatType()
_FLOATS = ir.VectorType(_FLOAT, WIDTH)
_INTS = ir.VectorType(_I32, WIDTH)
_BITS = ir.VectorType(ir.IntType(1), WIDTH)


class Lanes(types.Type):
    """A vector of eight; ``name`` tells what of."""


F8 = Lanes("f32x8")
M8 = Lanes("mask8")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Lanes) -> None:
        initialise: Callable[..., None] = super().__init__
        initialise(manager, kind, _FLOATS if kind == F8 else _BITS)


def _constant(value: float) -> Any:
    return ir.Constant(_FLOATS, [value] * WIDTH)


def _integers(value: int) -> Any:
    return ir.Constant(_INTS, [value] * WIDTH)


def _spread(builder: Any, value: Any) -> Any:
    empty = ir.Constant(_FLOATS, ir.Undefined)
    one = builder.insert_element(empty, value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, empty, _integers(0))


def _widen(builder: Any, kind: Any, value: Any) -> Any:
    if kind == F8:
        return value
    return _spread(builder, builder.fptrunc(value, _FLOAT) if kind == types.float64 else value)


def _call(builder: Any, name: str, *arguments: Any) -> Any:
    """Call the LLVM intrinsic ``name`` on vectors of one type."""
    kind = arguments[0].type
    signature = ir.FunctionType(kind, [kind] * len(arguments))
    return builder.call(_declare(builder.module, signature, f"{name}.v8f32"), arguments)


def _binary(operation: Any, result: Lanes, emit: Callable[[Any, Any, Any], Any]) -> None:
    """Let ``operation`` work on two ``F8``, or one and a number."""
    numbers = (types.float32, types.float64)

    def typer(context: Any) -> Callable[[Any, Any], Any]:
        def resolve(left: Any, right: Any) -> Any:
            fits = all(kind == F8 or kind in numbers for kind in (left, right))
            return result if fits and F8 in (left, right) else None

        return resolve

    def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        wide = [_widen(builder, kind, value) for kind, value in zip(signature.args, arguments, strict=True)]
        return emit(builder, *wide)

    _type_callable(operation)(typer)
    for left, right in ((F8, F8), *((F8, n) for n in numbers), *((n, F8) for n in numbers)):
        _lower_builtin(operation, left, right)(lower)


_binary(operator.add, F8, lambda builder, a, b: builder.fadd(a, b))
_binary(operator.sub, F8, lambda builder, a, b: builder.fsub(a, b))
_binary(operator.mul, F8, lambda builder, a, b: builder.fmul(a, b))
_binary(operator.truediv, F8, lambda builder, a, b: builder.fdiv(a, b))
_binary(operator.lt, M8, lambda builder, a, b: builder.fcmp_ordered("<", a, b))
_binary(operator.le, M8, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
_binary(operator.gt, M8, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_binary(operator.ge, M8, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))


def _type_and(context: Any) -> Callable[[Any, Any], Any]:
    return lambda left, right: M8 if left == M8 and right == M8 else None


def _lower_and(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.and_(*arguments)


_type_callable(operator.and_)(_type_and)
_lower_builtin(operator.and_, M8, M8)(_lower_and)


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any, pointee: Any) -> Any:
    """Where eight numbers of a contiguous array start; no bounds are checked."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), pointee.as_pointer())


@instruction
def load(typing: Any, array: Any, index: Any) -> Any:
    """Eight consecutive float32 of a contiguous array, from the flat ``index`` on."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _address(context, builder, signature.args[0], arguments[0], arguments[1], _FLOATS)
        return builder.load(pointer, align=4)

    return F8(array, types.intp), emit


@instruction
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write eight consecutive float32 of a contiguous array, from the flat ``index`` on."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array_value, place, vector = arguments
        pointer = _address(context, builder, signature.args[0], array_value, place, _FLOATS)
        builder.store(vector, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, F8), emit


@instruction
def peek(typing: Any, array: Any, index: Any) -> Any:
    """One number of a contiguous array at the flat ``index``, which may not be negative."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        return builder.load(builder.gep(data, [arguments[1]]))

    return array.dtype(array, types.intp), emit


@instruction
def poke(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write one number of a contiguous array at the flat ``index``, which may not be negative."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        builder.store(arguments[2], builder.gep(data, [arguments[1]]))
        return context.get_dummy_value()

    return types.void(array, types.intp, array.dtype), emit


@instruction
def store_truncated(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write eight numbers, which have to fit, as int32 without their fraction."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array_value, place, vector = arguments
        pointer = _address(context, builder, signature.args[0], array_value, place, _INTS)
        builder.store(builder.fptosi(vector, _INTS), pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, F8), emit


@instruction
def prefetch(typing: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line at the flat ``index`` of a contiguous array; a wrong index does no harm."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _address(context, builder, signature.args[0], arguments[0], arguments[1], ir.IntType(8))
        kinds = [pointer.type, _I32, _I32, _I32]
        signature = ir.FunctionType(ir.VoidType(), kinds)
        function = _declare(builder.module, signature, "llvm.prefetch.p0i8")
        builder.call(function, [pointer, _I32(0), _I32(3), _I32(1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), emit


@instruction
def wide(typing: Any, value: Any) -> Any:
    """The same float32 eight times."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _spread(builder, arguments[0])

    return F8(types.float32), emit


@instruction
def madd(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """A * b + c, rounded once where the processor can."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _call(builder, "llvm.fmuladd", *arguments)

    return F8(F8, F8, F8), emit


@instruction
def msub(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """C - a * b, rounded once where the processor can."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _call(builder, "llvm.fmuladd", builder.fneg(arguments[0]), *arguments[1:])

    return F8(F8, F8, F8), emit


@instruction
def root(typing: Any, a: Any) -> Any:
    """Square roots."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _call(builder, "llvm.sqrt", *arguments)

    return F8(F8), emit


@instruction
def floor(typing: Any, a: Any) -> Any:
    """Largest whole numbers that are not larger."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _call(builder, "llvm.floor", *arguments)

    return F8(F8), emit


@instruction
def ceil(typing: Any, a: Any) -> Any:
    """Smallest whole numbers that are not smaller."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _call(builder, "llvm.ceil", *arguments)

    return F8(F8), emit


@instruction
def at_least(typing: Any, a: Any, bound: Any) -> Any:
    """The larger; ``bound`` where ``a`` is NaN."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", *arguments), *arguments)

    return F8(F8, F8), emit


@instruction
def at_most(typing: Any, a: Any, bound: Any) -> Any:
    """The smaller; ``bound`` where ``a`` is NaN."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", *arguments), *arguments)

    return F8(F8, F8), emit


@instruction
def pick(typing: Any, mask: Any, yes: Any, no: Any) -> Any:
    """``yes`` where the mask is set, else ``no``."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(*arguments)

    return F8(M8, F8, F8), emit


@instruction
def bits(typing: Any, mask: Any) -> Any:
    """A mask as a number below 256; lane 0 is its lowest bit."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.zext(builder.bitcast(arguments[0], ir.IntType(WIDTH)), _I64)

    return types.uint64(M8), emit


# How lanes of two vectors (the second's from 8 on) are brought side by side to be added, in three rounds.
_FOLDS = (
    ((0, 8, 1, 9, 4, 12, 5, 13), (2, 10, 3, 11, 6, 14, 7, 15)),
    ((0, 1, 8, 9, 4, 5, 12, 13), (2, 3, 10, 11, 6, 7, 14, 15)),
    ((0, 1, 2, 3, 8, 9, 10, 11), (4, 5, 6, 7, 12, 13, 14, 15)),
)


@instruction
def sums(typing: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any) -> Any:
    """The sums of eight vectors, in the order of the arguments."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        left = list(arguments)
        for fold in _FOLDS:
            left = [
                builder.fadd(*(builder.shuffle_vector(*pair, ir.Constant(_INTS, list(order))) for order in fold))
                for pair in zip(left[::2], left[1::2], strict=True)
            ]
        return left[0]

    return F8(*[F8] * WIDTH), emit


@instruction
def below_zero(typing: Any, a: Any) -> Any:
    """-|a|."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        signed = builder.or_(builder.bitcast(arguments[0], _INTS), _integers(-(2**31)))
        return builder.bitcast(signed, _FLOATS)

    return F8(F8), emit


@instruction
def write_numbers(typing: Any, array: Any, index: Any, table: Any, row: Any, base: Any) -> Any:
    """Write the eight int32 of a row of ``table`` (rows, 8), each plus ``base``, from the flat ``index`` on."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array_value, place, table_value, row_value, base_value = arguments
        first = builder.mul(row_value, ir.Constant(row_value.type, WIDTH))
        source = _address(context, builder, signature.args[2], table_value, first, _INTS)
        empty = ir.Constant(_INTS, ir.Undefined)
        one = builder.insert_element(empty, base_value, ir.Constant(_I32, 0))
        numbers = builder.add(builder.load(source, align=4), builder.shuffle_vector(one, empty, _integers(0)))
        target = _address(context, builder, signature.args[0], array_value, place, _INTS)
        builder.store(numbers, target, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, table, types.intp, types.int32), emit


# Minimax polynomial of 2^f on [-1/2, 1/2]: relative error 8e-8.
_EXP2 = (1.0000001192092896, 0.693146944046, 0.240221202374, 0.055507130921, 0.009675540961, 0.001327647245)
_ROUNDER = 12582912.0  # 1.5 * 2^23: adding it leaves the nearest whole number in the low bits


@instruction
def exp2(typing: Any, a: Any) -> Any:
    """2^a to 3e-7 for a from -126 to 126; meaningless, but harmless, outside."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        shifted = builder.fadd(arguments[0], _constant(_ROUNDER))
        fraction = builder.fsub(arguments[0], builder.fsub(shifted, _constant(_ROUNDER)))
        square = builder.fmul(fraction, fraction)
        c = [_constant(coefficient) for coefficient in _EXP2]
        # Pairs first: a short chain of dependent steps counts for more than few of them.
        low, middle, high = (_call(builder, "llvm.fmuladd", c[k + 1], fraction, c[k]) for k in (0, 2, 4))
        value = _call(builder, "llvm.fmuladd", _call(builder, "llvm.fmuladd", high, square, middle), square, low)
        exponent = builder.shl(builder.bitcast(shifted, _INTS), _integers(23))
        return builder.bitcast(builder.add(builder.bitcast(value, _INTS), exponent), _FLOATS)

    return F8(F8), emit


_ROOT_HALF = 0x3F3504F3  # the bits of sqrt(1/2)


@instruction
def log2(typing: Any, a: Any) -> Any:
    """Logarithms to base 2 of positive numbers, to about 1e-7; -127 for 0."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pattern = builder.bitcast(arguments[0], _INTS)
        exponent = builder.ashr(builder.sub(pattern, _integers(_ROOT_HALF)), _integers(23))
        mantissa = builder.bitcast(builder.sub(pattern, builder.shl(exponent, _integers(23))), _FLOATS)
        # log(m) = 2 artanh((m - 1) / (m + 1)), with m from sqrt(1/2) to sqrt(2)
        t = builder.fdiv(builder.fsub(mantissa, _constant(1.0)), builder.fadd(mantissa, _constant(1.0)))
        square = builder.fmul(t, t)
        series = _constant(2.8853900817779268 / 9)
        for odd in (7, 5, 3, 1):
            series = _call(builder, "llvm.fmuladd", series, square, _constant(2.8853900817779268 / odd))
        return _call(builder, "llvm.fmuladd", t, series, builder.sitofp(exponent, _FLOATS))

    return F8(F8), emit
