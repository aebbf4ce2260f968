"""Several swings at once: numbers of `LANES` lanes, as one vector register holds them.

A kernel written for numbers also takes `Lanes`: they add, subtract, multiply, divide, compare and
`select` lane by lane, so that a lane's result depends neither on the others nor on the instructions
that a machine has. A product that is added or subtracted in the same expression is not rounded
before: one instruction does both. Which products, this module decides from the source, and not the
compiler from the machine; a processor without that instruction gets the same bits, slowly. What
cannot be written so (a branch, a table) is done lane by lane on memory.

Numba has no such type; this module adds it by numba's extension interface.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, overload, register_model

LANES = 4
"""Swings that are simulated at once, as many as doubles in a register of AVX2. Twice as many, in a
register of AVX-512, take less time for a step of all, but what concerns one swing then leaves more
lanes idle; HZD was 5 to 10 % slower, sliding mode as much faster."""

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_FLAGS = ir.VectorType(ir.IntType(1), LANES)


class _LanesType(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Lanes")


class _MaskType(types.Type):
    def __init__(self) -> None:
        super().__init__(name="LanesMask")


_lanes, _mask = _LanesType(), _MaskType()


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: types.Type) -> None:
        super().__init__(manager, numba_type, _VECTOR)


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: types.Type) -> None:
        super().__init__(manager, numba_type, _FLAGS)


def _vector(context: Any, builder: Any, value: Any, numba_type: types.Type) -> Any:
    """A number in every lane; lanes as they are."""
    if isinstance(numba_type, _LanesType):
        return value
    number = context.cast(builder, value, numba_type, types.float64)
    out = ir.Constant(_VECTOR, ir.Undefined)
    for lane in range(LANES):
        out = builder.insert_element(out, number, ir.Constant(ir.IntType(32), lane))
    return out


def _define(operation: Any, result: types.Type, kind: type, emit: Callable) -> None:
    """Teach numba a binary operation on lanes and numbers (or masks)."""
    allowed = (kind, types.Float, types.Integer) if kind is _LanesType else (kind,)

    @infer_global(operation)
    class Template(AbstractTemplate):
        key = operation

        def generic(self, args: tuple, kws: dict) -> Any:
            known = len(args) == 2 and all(isinstance(a, allowed) for a in args)
            if known and any(isinstance(a, kind) for a in args):
                return signature(result, *args)
            return None

    def lower(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        if kind is _LanesType:
            pairs = zip(args, sig.args, strict=True)
            args = tuple(_vector(context, builder, value, own) for value, own in pairs)
        return emit(builder, *args)

    for other in allowed:
        lower_builtin(operation, kind, other)(lower)
        if other is not kind:
            lower_builtin(operation, other, kind)(lower)


def _fused(builder: Any, product: Any, negated: bool, rest: Any) -> Any:
    """``rest`` with a product added or, ``negated``, subtracted, rounded once."""
    x, y = product.operands
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fma.v{LANES}f64")
    return builder.call(function, [builder.fneg(x) if negated else x, y, rest])


def _is_product(value: Any) -> bool:
    return isinstance(value, ir.Instruction) and value.opname == "fmul"


def _add(builder: Any, x: Any, y: Any) -> Any:
    if _is_product(y):
        return _fused(builder, y, False, x)
    if _is_product(x):
        return _fused(builder, x, False, y)
    return builder.fadd(x, y)


def _subtract(builder: Any, x: Any, y: Any) -> Any:
    if _is_product(y):
        return _fused(builder, y, True, x)
    if _is_product(x):
        return _fused(builder, x, False, builder.fneg(y))
    return builder.fsub(x, y)


_define(operator.add, _lanes, _LanesType, _add)
_define(operator.sub, _lanes, _LanesType, _subtract)
for _operation, _method in ((operator.mul, "fmul"), (operator.truediv, "fdiv")):
    _define(_operation, _lanes, _LanesType, lambda b, x, y, m=_method: getattr(b, m)(x, y))
for _operation, _sign in (
    (operator.lt, "<"),
    (operator.gt, ">"),
    (operator.le, "<="),
    (operator.ge, ">="),
    (operator.eq, "=="),
):
    _define(_operation, _mask, _LanesType, lambda b, x, y, c=_sign: b.fcmp_ordered(c, x, y))
_define(operator.ne, _mask, _LanesType, lambda b, x, y: b.fcmp_unordered("!=", x, y))
_define(operator.and_, _mask, _MaskType, lambda b, x, y: b.and_(x, y))
_define(operator.or_, _mask, _MaskType, lambda b, x, y: b.or_(x, y))


@infer_global(operator.neg)
class _Negative(AbstractTemplate):
    key = operator.neg

    def generic(self, args: tuple, kws: dict) -> Any:
        return signature(_lanes, _lanes) if args == (_lanes,) else None


lower_builtin(operator.neg, _LanesType)(lambda context, builder, sig, args: builder.fneg(args[0]))


@intrinsic
def _select(context, mask, x, y):
    def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        x, y = (_vector(context, builder, args[i], sig.args[i]) for i in (1, 2))
        return builder.select(args[0], x, y)

    return _lanes(mask, x, y), generate


def select(condition: Any, x: Any, y: Any) -> Any:
    """``x`` where the condition holds, else ``y``."""
    return x if condition else y


@overload(select)
def _overload_select(condition, x, y):
    if isinstance(condition, _MaskType):
        return lambda condition, x, y: _select(condition, x, y)
    return lambda condition, x, y: x if condition else y


def _unary(name: str) -> Callable:
    """An intrinsic function of LLVM, of lanes."""

    @intrinsic
    def function(context, x):
        def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
            kind = ir.FunctionType(_VECTOR, [_VECTOR])
            full_name = f"llvm.{name}.v{LANES}f64"
            return builder.call(
                cgutils.get_or_insert_function(builder.module, kind, full_name), args
            )

        return _lanes(_lanes), generate

    return function


_magnitude, _square_root = _unary("fabs"), _unary("sqrt")


@overload(abs)
def _overload_abs(x):
    if isinstance(x, _LanesType):
        return lambda x: _magnitude(x)
    return None


@overload(math.sqrt)
def _overload_sqrt(x):
    if isinstance(x, _LanesType):
        return lambda x: _square_root(x)
    return None


def _pointer(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
    """Where the lanes of ``array[row, i]`` stand; the array is contiguous, (rows, k, LANES)."""
    array = context.make_array(sig.args[0])(context, builder, args[0])
    width = builder.extract_value(array.shape, 1)
    row, i = (context.cast(builder, args[k], sig.args[k], types.intp) for k in (1, 2))
    place = builder.mul(builder.add(builder.mul(row, width), i), ir.Constant(width.type, LANES))
    return builder.bitcast(builder.gep(array.data, [place]), _VECTOR.as_pointer())


@intrinsic
def load(context, array, row, i):
    """Lanes ``array[row, i, :]`` of a contiguous array of shape (rows, k, LANES)."""

    def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        value = builder.load(_pointer(context, builder, sig, args))
        value.align = 8
        return value

    return _lanes(array, row, i), generate


@intrinsic
def store(context, array, row, i, value):
    """Put lanes, or one number, into ``array[row, i, :]``."""

    def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        lanes = _vector(context, builder, args[3], sig.args[3])
        builder.store(lanes, _pointer(context, builder, sig, args)).align = 8
        return context.get_dummy_value()

    return types.void(array, row, i, value), generate


def _pointer_from(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
    """Where ``array[row, first]`` stands; the array is contiguous and has two dimensions."""
    array = context.make_array(sig.args[0])(context, builder, args[0])
    width = builder.extract_value(array.shape, 1)
    row, first = (context.cast(builder, args[k], sig.args[k], types.intp) for k in (1, 2))
    place = builder.add(builder.mul(row, width), first)
    return builder.bitcast(builder.gep(array.data, [place]), _VECTOR.as_pointer())


@intrinsic
def load_from(context, array, row, first):
    """Lanes ``array[row, first : first + LANES]`` of a contiguous array of shape (rows, k)."""

    def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        value = builder.load(_pointer_from(context, builder, sig, args))
        value.align = 8
        return value

    return _lanes(array, row, first), generate


@intrinsic
def store_into(context, array, row, first, value):
    """Put lanes, or one number, into ``array[row, first : first + LANES]``."""

    def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        lanes = _vector(context, builder, args[3], sig.args[3])
        builder.store(lanes, _pointer_from(context, builder, sig, args)).align = 8
        return context.get_dummy_value()

    return types.void(array, row, first, value), generate


@intrinsic
def splat(context, number):
    """A number in every lane."""

    def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        return _vector(context, builder, args[0], sig.args[0])

    return _lanes(number), generate


@intrinsic
def lane_of(context, lanes, lane):
    """The number in one lane."""

    def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        return builder.extract_element(args[0], args[1])

    return types.float64(lanes, lane), generate


def _bits(builder: Any, value: Any) -> tuple[Any, Any, Callable[[int], Any]]:
    """The bits of a number or lanes, their LLVM type, and constants of it."""
    kind: Any = ir.IntType(64)
    if value.type == _VECTOR:
        kind = ir.VectorType(kind, LANES)

    def constant(number: int) -> Any:
        return ir.Constant(kind, number if value.type != _VECTOR else [number] * LANES)

    return builder.bitcast(value, kind), kind, constant


@intrinsic
def mantissa(context, x):
    """``x 2^-binary_exponent(x)``, 0.5 to 1, of a positive number or lanes of them."""

    def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        bits, _, constant = _bits(builder, args[0])
        bits = builder.or_(
            builder.and_(bits, constant(0x000FFFFFFFFFFFFF)), constant(0x3FE0000000000000)
        )
        return builder.bitcast(bits, args[0].type)

    return x(x), generate


@intrinsic
def binary_exponent(context, x):
    """Exponent of two of a positive number or lanes of them."""

    def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        bits, _, constant = _bits(builder, args[0])
        biased = builder.lshr(bits, constant(52))
        # Its bits in those of 2^52 are 2^52 more than it.
        number = builder.bitcast(builder.or_(biased, constant(0x4330000000000000)), args[0].type)
        offset = 2.0**52 + 1022.0
        offsets = ir.Constant(args[0].type, [offset] * LANES if args[0].type == _VECTOR else offset)
        return builder.fsub(number, offsets)

    return x(x), generate


@intrinsic
def power_of_two(context, x):
    """``2^x`` for whole numbers or lanes of them, -1022 to 1023."""

    def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        offset = 1.5 * 2.0**52 + 1023.0
        offsets = ir.Constant(args[0].type, [offset] * LANES if args[0].type == _VECTOR else offset)
        bits, _, constant = _bits(builder, builder.fadd(args[0], offsets))
        return builder.bitcast(builder.shl(bits, constant(52)), args[0].type)

    return x(x), generate


@intrinsic
def _negated_if_odd(context, x, number):
    def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        bits, _, constant = _bits(builder, args[0])
        last, _, _ = _bits(builder, args[1])
        sign = builder.shl(last, constant(63))
        return builder.bitcast(builder.xor(bits, sign), args[0].type)

    return x(x, x), generate


def negated_if_odd(x: Any, number: Any) -> Any:
    """``x``, negated where ``number`` is odd, a whole one from 2^52 to 2^53: its last bit says so.

    Both are numbers, or both are lanes.
    """
    return -x if number % 2.0 == 1.0 else x


@overload(negated_if_odd)
def _overload_negated_if_odd(x, number):
    return lambda x, number: _negated_if_odd(x, number)


@intrinsic
def any_lane(context, mask):
    """Whether a condition holds in any lane."""

    def generate(context: Any, builder: Any, sig: Any, args: tuple) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask), generate
