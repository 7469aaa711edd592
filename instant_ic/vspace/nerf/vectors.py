"""Operations on table entries as machine vectors, written as LLVM intrinsics because numba does not vectorise them.

``gather`` (rows, entries, weights) → tuple of 4 float32:
    ``Σ weights[c] · rows[entries[c]]`` over the eight corners of a cell.
``scatter`` (rows, entries, weights, upstream):
    ``rows[entries[c]] += weights[c] · upstream``, corner by corner.
``adam`` (rows, grad, m, v, entry, step, beta1, beta2, epsilon):
    one step of Adam on ``rows[entry]`` and its moments, all in the shape of ``rows``; clears ``grad[entry]``.

``rows`` is (size, 4) float32, C-contiguous. ``entries`` and ``weights`` are tuples of eight uint32 and eight float32,
``upstream`` is a tuple of 4 float32. Arguments are not checked.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.cgutils import get_or_insert_function
from numba.extending import intrinsic

_CORNERS = 8
_FAST = ("fast",)
_LONG, _INT, _FLOAT = ir.IntType(64), ir.IntType(32), ir.FloatType()
_FEATURES = 4
_VECTOR = ir.VectorType(_FLOAT, _FEATURES)


def _row(context: Any, builder: Any, kind: Any, rows: Any, entry: Any) -> Any:
    """Emit the pointer to a table's row."""
    first = builder.mul(builder.zext(entry, _LONG), _LONG(_FEATURES))
    data = context.make_array(kind)(context, builder, rows).data
    return builder.bitcast(builder.gep(data, [first]), _VECTOR.as_pointer())


def _filled(builder: Any, scalars: list[Any]) -> Any:
    """Emit a vector of scalars."""
    value = ir.Constant(_VECTOR, ir.Undefined)
    for place, scalar in enumerate(scalars):
        value = builder.insert_element(value, scalar, _INT(place))
    return value


def _weighted(builder: Any, weights: Any, corner: int, value: Any) -> Any:
    """Emit ``weights[corner] · value``."""
    weight = _filled(builder, [builder.extract_value(weights, corner)] * _FEATURES)
    return builder.fmul(value, weight, flags=_FAST)


def _mixed(builder: Any, kept: Any, new: Any, share: Any) -> Any:
    """Emit ``new + share · (kept − new)``."""
    change = builder.fmul(share, builder.fsub(kept, new, flags=_FAST), flags=_FAST)
    return builder.fadd(new, change, flags=_FAST)


@intrinsic
def gather(_typing: Any, rows: Any, entries: Any, weights: Any) -> Any:
    """Emit the weighted sum of a cell's corners."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total = ir.Constant(_VECTOR, [0.0] * _FEATURES)
        for corner in range(_CORNERS):
            entry = builder.extract_value(args[1], corner)
            place = _row(context, builder, signature.args[0], args[0], entry)
            value = _weighted(builder, args[2], corner, builder.load(place, align=4))
            total = builder.fadd(total, value, flags=_FAST)
        parts = [builder.extract_element(total, _INT(place)) for place in range(_FEATURES)]
        return context.make_tuple(builder, signature.return_type, parts)

    return types.UniTuple(types.float32, _FEATURES)(rows, entries, weights), code


@intrinsic
def scatter(_typing: Any, rows: Any, entries: Any, weights: Any, upstream: Any) -> Any:
    """Emit the addition of a gradient to a cell's corners."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = _filled(builder, [builder.extract_value(args[3], place) for place in range(_FEATURES)])
        for corner in range(_CORNERS):
            entry = builder.extract_value(args[1], corner)
            place = _row(context, builder, signature.args[0], args[0], entry)
            added = _weighted(builder, args[2], corner, value)
            builder.store(builder.fadd(builder.load(place, align=4), added, flags=_FAST), place, align=4)
        return context.get_dummy_value()

    return types.void(rows, entries, weights, upstream), code


@intrinsic
def adam(
    _typing: Any, rows: Any, grad: Any, m: Any, v: Any, entry: Any, step: Any, beta1: Any, beta2: Any, epsilon: Any
) -> Any:
    """Emit one step of Adam on an entry."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        places = [_row(context, builder, signature.args[n], args[n], args[4]) for n in range(4)]
        value, slope, mean, square = (builder.load(place, align=4) for place in places)
        step, beta1, beta2, epsilon = (_filled(builder, [scalar] * _FEATURES) for scalar in args[5:])
        mean = _mixed(builder, mean, slope, beta1)
        square = _mixed(builder, square, builder.fmul(slope, slope, flags=_FAST), beta2)
        name, kind = f"llvm.sqrt.v{_FEATURES}f32", ir.FunctionType(_VECTOR, [_VECTOR])
        root = builder.call(get_or_insert_function(builder.module, kind, name), [square])
        ratio = builder.fdiv(mean, builder.fadd(root, epsilon, flags=_FAST), flags=_FAST)
        value = builder.fsub(value, builder.fmul(step, ratio, flags=_FAST), flags=_FAST)
        zero = ir.Constant(_VECTOR, [0.0] * _FEATURES)
        for place, stored in zip(places, (value, zero, mean, square), strict=True):
            builder.store(stored, place, align=4)
        return context.get_dummy_value()

    return types.void(rows, grad, m, v, types.uint32, step, beta1, beta2, epsilon), code
