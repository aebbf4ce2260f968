"""Sums of rows of eight numbers each, in vector registers.

Numba leaves a loop over eight columns to scalar instructions, which takes three to four times as
long. So this one sum, where nearly all the time of a large chain goes, is put together from LLVM's
vectors of eight; LLVM breaks them down to what the processor has. Each column is added up in the
same order whatever the processor: entries in turn to two sums, and these together.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

LANES = 8
"""Columns that are summed at once."""


@intrinsic
def gather_lanes(
    typing_context: Any, entries: Any, begin: Any, end: Any, shift: Any, p: Any, x: Any, out: Any
) -> Any:
    """out[:] = sum over k from `begin` to before `end` of x[entries[k] >> shift] * p[its low bits].

    For use in kernels. `x` and `p` are float64 of 8 columns, contiguous; `out` has 8 numbers;
    `entries` are unsigned, and the bounds and the shift int64. Nothing is checked.
    """

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        word, double = ir.IntType(64), ir.DoubleType()
        vector = ir.VectorType(double, LANES)
        zero = ir.Constant(vector, [0.0] * LANES)
        one = ir.Constant(word, 1)

        def data(position: int) -> Any:
            array = context.make_array(signature.args[position])
            return array(context, builder, args[position]).data

        listed, shares, weights, sums = data(0), data(4), data(5), data(6)
        first, last, bits = args[1], args[2], args[3]
        low = builder.sub(builder.shl(one, bits), one)

        def row(base: Any, index: Any) -> Any:
            at = builder.gep(base, [builder.mul(index, ir.Constant(word, LANES))])
            return builder.load(builder.bitcast(at, vector.as_pointer()), align=8)

        def add(position: Any, total: Any) -> None:
            entry = builder.load(builder.gep(listed, [position]))
            if entry.type.width < word.width:
                entry = builder.zext(entry, word)
            product = builder.fmul(
                row(weights, builder.lshr(entry, bits)), row(shares, builder.and_(entry, low))
            )
            builder.store(builder.fadd(builder.load(total), product), total)

        even, odd = (cgutils.alloca_once(builder, vector) for _ in range(2))
        builder.store(zero, even)
        builder.store(zero, odd)
        count = builder.sub(last, first)
        with cgutils.for_range(builder, builder.lshr(count, one)) as loop:
            at = builder.add(first, builder.shl(loop.index, one))
            add(at, even)
            add(builder.add(at, one), odd)
        with builder.if_then(builder.icmp_unsigned("==", builder.and_(count, one), one)):
            add(builder.sub(last, one), even)
        total = builder.fadd(builder.load(even), builder.load(odd))
        builder.store(total, builder.bitcast(sums, vector.as_pointer()), align=8)
        return context.get_dummy_value()

    return types.void(entries, begin, end, shift, p, x, out), code
