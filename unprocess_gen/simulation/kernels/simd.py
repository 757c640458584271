"""Eight neighbours at a time, as kernels write them where a loop over single numbers would not become vector code.

A value of eight lanes is what a kernel loads, computes with and stores: ``+ - * / & | ^ >> <<`` lane by lane, with
numbers of one lane beside it, and the functions below. Compiled it is a vector of LLVM, which lays it out on whatever
registers a processor has: two of four lanes, one of eight, half of one of sixteen. Where nothing is compiled it is a
NumPy array of eight, so that a kernel reads, and computes, the same either way.

Every operation rounds as it does on single numbers: nothing is reordered, and no multiply-add is fused. Bytes and bits
are counted from the low end, as on every machine that Numba serves.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model, type_callable
from numpy.typing import NDArray

WIDE = 8
"""Lanes to a vector."""

Vector = NDArray[Any]
"""Eight lanes, as Python sees them."""
Numbers = NDArray[Any]
"""What `bare` returns, as Python sees it."""
Index = int | np.integer[Any]


def bare(array: NDArray[Any], at: Index) -> Numbers:
    """Return the numbers of an array in one piece, from the flat index ``at`` on.

    Compiled it is their place in memory and no more: nobody checks an index, and nobody counts that the array is in
    use, which costs a locked instruction each time that one is handed on. So the array must live until the last use: an
    argument of the kernel that Python calls does, and what the same function uses again below.
    """
    return array.reshape(-1)[at:]


def load(numbers: Numbers, at: Index) -> Vector:
    """Return numbers ``at`` to ``at + 7``."""
    return numbers[at : at + WIDE].copy()


def store(numbers: Numbers, at: Index, lanes: Vector) -> None:
    """Put eight lanes where `load` would take them from; uint32 lanes go among uint16 by their low halves."""
    numbers[at : at + WIDE] = lanes.astype(numbers.dtype)


def four_bytes(numbers: Numbers, at: Index) -> np.uint32:
    """Return bytes ``at`` to ``at + 3`` as one number, the first in its lowest bits: one load where it is compiled."""
    return np.uint32(int.from_bytes(numbers[at : at + 4].tobytes(), "little"))


def greatest(x: Vector, y: Any) -> Vector:
    """Return ``x`` where it is above ``y``, else ``y``."""
    return np.asarray(np.where(x > y, x, y), dtype=x.dtype)


def least(x: Vector, y: Any) -> Vector:
    """Return ``x`` where it is below ``y``, else ``y``."""
    return np.asarray(np.where(x < y, x, y), dtype=x.dtype)


def below(x: Any, y: Any) -> Vector:
    """Return all bits set where ``x`` is below ``y``, none elsewhere: unsigned lanes as wide as theirs."""
    lanes = np.asarray(x if np.ndim(x) else y)
    every_bit = 2 ** (8 * lanes.itemsize) - 1
    return np.asarray(np.where(x < y, every_bit, 0), dtype=_unsigned(lanes))


def root(x: Vector) -> Vector:
    """Return the square roots."""
    return np.asarray(np.sqrt(x))


def bits_of(x: Vector) -> Vector:
    """Return the bits of floats, as unsigned lanes as wide."""
    return x.view(_unsigned(x))


def float_of(bits: Vector) -> Vector:
    """Return the float32 that have these bits."""
    return bits.view(np.float32)


def to_float32(x: Vector) -> Vector:
    """Return float64, or uint32 below 2**31, as the nearest float32."""
    return x.astype(np.float32)


def to_uint32(x: Vector) -> Vector:
    """Return whole float32, at least 0 and below 2**31."""
    return x.astype(np.uint32)


def nothing() -> Vector:
    """Return uint32 lanes of 0."""
    return np.zeros(WIDE, dtype=np.uint32)


def mask_of(x: Vector) -> np.uint32:
    """Return the top bits of unsigned lanes as the bits of one number, the first lane's lowest."""
    top = np.uint64(8 * x.itemsize - 1)
    return np.uint32(sum(int(lane >> x.dtype.type(top)) << n for n, lane in enumerate(x)))


def _unsigned(lanes: Vector) -> np.dtype[Any]:
    return np.dtype(f"uint{8 * lanes.itemsize}")


# ------------------------------------------------------------------------------------------------------ as compiled


class Lanes(types.Type):
    """The type of eight lanes of a number."""

    def __init__(self, of: types.Number) -> None:
        self.of = of
        super().__init__(name=f"lanes({of})")


_ELEMENTS: dict[types.Number, ir.Type] = {
    types.float32: ir.FloatType(),
    types.float64: ir.DoubleType(),
    types.uint32: ir.IntType(32),
    types.uint64: ir.IntType(64),
}
_OF_BITS: dict[types.Number, types.Number] = {types.float32: types.uint32, types.float64: types.uint64}
_HALF = ir.IntType(16)


def _vector(kind: Lanes) -> ir.VectorType:
    return ir.VectorType(_ELEMENTS[kind.of], WIDE)


@register_model(Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Lanes) -> None:
        super().__init__(manager, kind, _vector(kind))


def _define(
    function: Callable[..., Any],
    typer: Callable[..., Any],
    build: Callable[..., Any],
    signature: tuple[Any, ...] = (types.VarArg(types.Any),),
) -> None:
    """Say what a function on lanes returns, by the types it is given, and which instructions it becomes."""
    type_callable(function)(lambda context: typer)
    lower_builtin(function, *signature)(build)


def _kind(*operands: Any) -> Lanes | None:
    """Return the one kind of lanes among some operands; None, so that Numba looks further, where there is none."""
    kinds = {operand for operand in operands if isinstance(operand, Lanes)}
    others = [operand for operand in operands if not isinstance(operand, (Lanes, types.Number))]
    return kinds.pop() if len(kinds) == 1 and not others else None


def _spread(context: Any, builder: Any, signature: Any, arguments: Any) -> tuple[Lanes, list[Any]]:
    """Return the kind of lanes, and all operands as such; a single number is put into every lane."""
    kind = _kind(*signature.args)
    assert kind is not None
    return kind, [
        one if of == kind else _in_every_lane(builder, context.cast(builder, one, of, kind.of), kind)
        for of, one in zip(signature.args, arguments, strict=True)
    ]


def _in_every_lane(builder: Any, number: Any, kind: Lanes) -> Any:
    empty, first = ir.Constant(_vector(kind), ir.Undefined), ir.Constant(ir.IntType(32), 0)
    of_first = ir.Constant(ir.VectorType(ir.IntType(32), WIDE), [0] * WIDE)
    return builder.shuffle_vector(builder.insert_element(empty, number, first), empty, of_first)


def _instruction(of_floats: str, of_integers: str) -> Callable[..., Any]:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind, operands = _spread(context, builder, signature, arguments)
        return getattr(builder, of_floats if kind.of in _OF_BITS else of_integers)(*operands)

    return build


def _choice(sign: str) -> Callable[..., Any]:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        _, (x, y) = _spread(context, builder, signature, arguments)
        return builder.select(builder.fcmp_ordered(sign, x, y), x, y)

    return build


def _kind_of_two(x: Any, y: Any) -> Lanes | None:
    return _kind(x, y)


def _mask_kind(x: Any, y: Any) -> Lanes | None:
    kind = _kind(x, y)
    return None if kind is None else Lanes(_OF_BITS[kind.of])


def _below(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    _, (x, y) = _spread(context, builder, signature, arguments)
    return builder.sext(builder.fcmp_ordered("<", x, y), _vector(signature.return_type))


def _root(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    vector = _vector(signature.args[0])
    name = f"llvm.sqrt.v{WIDE}f{signature.args[0].of.bitwidth}"
    return builder.call(
        cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector]), name), arguments
    )


def _reinterpreted(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.bitcast(arguments[0], _vector(signature.return_type))


def _to_float32(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    convert = builder.fptrunc if signature.args[0].of in _OF_BITS else builder.sitofp
    return convert(arguments[0], _vector(signature.return_type))


def _to_uint32(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.fptosi(arguments[0], _vector(signature.return_type))


def _nothing(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return ir.Constant(_vector(signature.return_type), None)


def _mask_of(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    set_ = builder.icmp_signed("<", arguments[0], ir.Constant(_vector(signature.args[0]), None))
    return builder.zext(builder.bitcast(set_, ir.IntType(WIDE)), ir.IntType(32))


class Bare(types.Type):
    """The type of what `bare` returns."""

    def __init__(self, of: types.Number) -> None:
        self.of = of
        super().__init__(name=f"bare({of})")


@register_model(Bare)
class _Place(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Bare) -> None:
        super().__init__(manager, kind, manager.lookup(kind.of).get_data_type().as_pointer())


def _bare(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array, at = arguments
    of_array = isinstance(signature.args[0], types.Array)
    place = context.make_array(signature.args[0])(context, builder, array).data if of_array else array
    return builder.gep(place, [at])


def _at(builder: Any, place: Any, at: Any, pointee: ir.Type) -> Any:
    return builder.bitcast(builder.gep(place, [at]), pointee.as_pointer())


def _load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    place, at = arguments
    lanes = _at(builder, place, at, _vector(signature.return_type))
    return builder.load(lanes, align=signature.args[0].of.bitwidth // 8)


def _store(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    numbers, _, kind = signature.args
    place, at, lanes = arguments
    vector = _vector(kind)
    if numbers.of == types.uint16:
        vector = ir.VectorType(_HALF, WIDE)
        lanes = builder.trunc(lanes, vector)
    builder.store(lanes, _at(builder, place, at, vector), align=numbers.of.bitwidth // 8)
    return context.get_dummy_value()


def _four_bytes(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    place, at = arguments
    return builder.load(_at(builder, place, at, ir.IntType(32)), align=1)


def _one(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.gep(arguments[0], [context.cast(builder, arguments[1], signature.args[1], types.intp)])


def _get(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.load(_one(context, builder, signature, arguments))


def _set(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    number = context.cast(builder, arguments[2], signature.args[2], signature.args[0].of)
    builder.store(number, _one(context, builder, signature, arguments))
    return context.get_dummy_value()


for _sign, _of_floats, _of_integers in (
    (operator.add, "fadd", "add"),
    (operator.sub, "fsub", "sub"),
    (operator.mul, "fmul", "mul"),
    (operator.truediv, "fdiv", ""),
    (operator.and_, "", "and_"),
    (operator.or_, "", "or_"),
    (operator.xor, "", "xor"),
    (operator.lshift, "", "shl"),
    (operator.rshift, "", "lshr"),
):
    type_callable(_sign)(lambda context: _kind_of_two)
    for _operands in ((Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
        lower_builtin(_sign, *_operands)(_instruction(_of_floats, _of_integers))

_define(greatest, _kind_of_two, _choice(">"))
_define(least, _kind_of_two, _choice("<"))
_define(below, _mask_kind, _below)
_define(root, lambda x: x, _root)
_define(bits_of, lambda x: Lanes(_OF_BITS[x.of]), _reinterpreted)
_define(float_of, lambda bits: Lanes(types.float32), _reinterpreted)
_define(to_float32, lambda x: Lanes(types.float32), _to_float32)
_define(to_uint32, lambda x: Lanes(types.uint32), _to_uint32)
_define(nothing, lambda: Lanes(types.uint32), _nothing)
_define(mask_of, lambda x: types.uint32, _mask_of)
_define(bare, lambda array, at: Bare(array.dtype) if isinstance(array, types.Array) else array, _bare)
_define(load, lambda numbers, at: Lanes(numbers.of), _load)
_define(store, lambda numbers, at, lanes: types.none, _store)
_define(four_bytes, lambda numbers, at: types.uint32, _four_bytes)


@type_callable(operator.getitem)
def _type_of_get(context: Any) -> Callable[..., Any]:
    return lambda numbers, at: numbers.of if isinstance(numbers, Bare) else None


@infer_global(operator.setitem)
class _TypeOfSet(AbstractTemplate):
    def generic(self, arguments: Any, keywords: Any) -> Any:
        numbers, at, number = arguments
        return signature(types.none, numbers, at, number) if isinstance(numbers, Bare) else None


lower_builtin(operator.getitem, Bare, types.Integer)(_get)
lower_builtin(operator.setitem, Bare, types.Integer, types.Number)(_set)
