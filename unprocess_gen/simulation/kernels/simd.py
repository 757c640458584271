"""Write SIMD code in kernels: vectors of eight numbers, and raw pointers.

This module serves loops that LLVM does not vectorise by itself. Kernels load vectors, compute with them and store them.
Vectors support ``+ - * / & | ^ >> <<`` per lane, also with a scalar operand, and the functions of this module. Every
operation rounds as it does on single numbers: nothing is reordered, and no multiply-add is fused.

Each function has two implementations, which tests compare. Uncompiled kernels use the one on NumPy arrays of eight
elements. Compiled kernels use LLVM instructions on ``<8 x type>``, which LLVM maps to the registers of the processor.
Bytes and bits are numbered from the low end, as on every platform that Numba supports.
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

VECTOR_WIDTH = 8
"""Lanes of a vector."""

Vector = NDArray[Any]
"""Eight lanes; in uncompiled code an array."""
Pointer = NDArray[Any]
"""A raw pointer to array data; in uncompiled code an array."""
Index = int | np.integer[Any]


def pointer_to(array: NDArray[Any], at: Index) -> Pointer:
    """Return a pointer to the data of a C-contiguous array, from the flat index ``at`` on.

    Compiled code checks no index and counts no reference: the count costs a locked instruction per call. So the array
    must outlive the pointer, as arguments of the outer kernel do.
    """
    return array.reshape(-1)[at:]


def pointers_of(record: Any) -> Any:
    """Return a named tuple with a pointer to the data of each array, also in nested named tuples."""
    return type(record)(*map(_flatten, record))


def _flatten(member: Any) -> Any:
    if isinstance(member, np.ndarray):
        return member.reshape(-1)
    return pointers_of(member) if hasattr(member, "_fields") else member


def load(pointer: Pointer, at: Index) -> Vector:
    """Load the vector of elements ``at`` to ``at + 7``."""
    return pointer[at : at + VECTOR_WIDTH].copy()


def store(pointer: Pointer, at: Index, lanes: Vector) -> None:
    """Store a vector as elements ``at`` to ``at + 7``; uint32 lanes are truncated to uint16 elements."""
    pointer[at : at + VECTOR_WIDTH] = lanes.astype(pointer.dtype)


def load_four_bytes(pointer: Pointer, at: Index) -> np.uint32:
    """Load bytes ``at`` to ``at + 3`` as one little-endian number, in a single instruction."""
    return np.uint32(int.from_bytes(pointer[at : at + 4].tobytes(), "little"))


def maximum(x: Vector, y: Any) -> Vector:
    """Return ``x`` where x > y, else ``y``, per lane; ``y`` if either is NaN."""
    return np.asarray(np.where(x > y, x, y), dtype=x.dtype)


def minimum(x: Vector, y: Any) -> Vector:
    """Return ``x`` where x < y, else ``y``, per lane; ``y`` if either is NaN."""
    return np.asarray(np.where(x < y, x, y), dtype=x.dtype)


def less_than(x: Any, y: Any) -> Vector:
    """Return a mask per lane: all bits set where x < y, else 0; unsigned lanes of the same width."""
    lanes = np.asarray(x if np.ndim(x) else y)
    every_bit = 2 ** (8 * lanes.itemsize) - 1
    return np.asarray(np.where(x < y, every_bit, 0), dtype=_unsigned_dtype(lanes))


def square_root(x: Vector) -> Vector:
    """Return the square root of each lane."""
    return np.asarray(np.sqrt(x))


def to_bits(x: Vector) -> Vector:
    """Return the bits of float lanes as unsigned integers of the same width."""
    return x.view(_unsigned_dtype(x))


def from_bits(bits: Vector) -> Vector:
    """Return the float32 lanes that have these bits."""
    return bits.view(np.float32)


def absolute(x: Vector) -> Vector:
    """Return the absolute value of each float32 lane."""
    return np.asarray(np.abs(x))


def low_half(x: Vector) -> Vector:
    """Return the low 32 bits of each uint64 lane."""
    return x.astype(np.uint32)


def to_float32(x: Vector) -> Vector:
    """Convert float64, or uint32 below 2**31, to the nearest float32."""
    return x.astype(np.float32)


def to_float64(x: Vector) -> Vector:
    """Convert float32 lanes to float64."""
    return x.astype(np.float64)


def to_uint32(x: Vector) -> Vector:
    """Convert float32 lanes with integer values from 0 to below 2**31 to uint32."""
    return x.astype(np.uint32)


def uint32_zeros() -> Vector:
    """Return a uint32 vector of zeros."""
    return np.zeros(VECTOR_WIDTH, dtype=np.uint32)


def select(mask: Vector, x: Vector, y: Vector) -> Vector:
    """Return ``x`` in lanes whose mask (`less_than`) is set, else ``y``."""
    return np.asarray(np.where(mask != 0, x, y))


def movemask(x: Vector) -> np.uint32:
    """Return the top bits of unsigned lanes as the low bits of one number, the first lane lowest."""
    top = np.uint64(8 * x.itemsize - 1)
    return np.uint32(sum(int(lane >> x.dtype.type(top)) << n for n, lane in enumerate(x)))


def _unsigned_dtype(lanes: Vector) -> np.dtype[Any]:
    return np.dtype(f"uint{8 * lanes.itemsize}")


# ------------------------------------------------------------------------------------------------- Numba types and code


class VectorType(types.Type):
    """Describe a vector of eight numbers to Numba."""

    def __init__(self, element: types.Number) -> None:
        self.element = element
        super().__init__(name=f"vector({element})")


_LLVM_TYPES: dict[types.Number, ir.Type] = {
    types.float32: ir.FloatType(),
    types.float64: ir.DoubleType(),
    types.uint32: ir.IntType(32),
    types.uint64: ir.IntType(64),
}
_UNSIGNED: dict[types.Number, types.Number] = {types.float32: types.uint32, types.float64: types.uint64}
_INT16 = ir.IntType(16)


def _llvm_vector(vector_type: VectorType) -> ir.VectorType:
    return ir.VectorType(_LLVM_TYPES[vector_type.element], VECTOR_WIDTH)


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, vector_type: VectorType) -> None:
        super().__init__(manager, vector_type, _llvm_vector(vector_type))


def _register(
    function: Callable[..., Any],
    typer: Callable[..., Any],
    build: Callable[..., Any],
    signature: tuple[Any, ...] = (types.VarArg(types.Any),),
) -> None:
    """Register the result type and the LLVM code of a function on vectors."""
    type_callable(function)(lambda context: typer)
    lower_builtin(function, *signature)(build)


def _common_type(*operands: Any) -> VectorType | None:
    """Return the only vector type among operands; None, so that Numba tries other overloads, if there is none."""
    vector_types = {operand for operand in operands if isinstance(operand, VectorType)}
    others = [operand for operand in operands if not isinstance(operand, (VectorType, types.Number))]
    return vector_types.pop() if len(vector_types) == 1 and not others else None


def _broadcast(context: Any, builder: Any, signature: Any, arguments: Any) -> tuple[VectorType, list[Any]]:
    """Return the vector type and the operands converted to it; scalars are copied into every lane."""
    vector_type = _common_type(*signature.args)
    assert vector_type is not None
    return vector_type, [
        operand
        if given == vector_type
        else _splat(builder, context.cast(builder, operand, given, vector_type.element), vector_type)
        for given, operand in zip(signature.args, arguments, strict=True)
    ]


def _splat(builder: Any, number: Any, vector_type: VectorType) -> Any:
    empty, first = ir.Constant(_llvm_vector(vector_type), ir.Undefined), ir.Constant(ir.IntType(32), 0)
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), VECTOR_WIDTH), [0] * VECTOR_WIDTH)
    return builder.shuffle_vector(builder.insert_element(empty, number, first), empty, zeros)


def _build_operation(float_name: str, integer_name: str) -> Callable[..., Any]:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector_type, operands = _broadcast(context, builder, signature, arguments)
        return getattr(builder, float_name if vector_type.element in _UNSIGNED else integer_name)(*operands)

    return build


def _build_select(comparison: str) -> Callable[..., Any]:
    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        _, (x, y) = _broadcast(context, builder, signature, arguments)
        return builder.select(builder.fcmp_ordered(comparison, x, y), x, y)

    return build


def _operation_type(x: Any, y: Any) -> VectorType | None:
    return _common_type(x, y)


def _comparison_type(x: Any, y: Any) -> VectorType | None:
    vector_type = _common_type(x, y)
    return None if vector_type is None else VectorType(_UNSIGNED.get(vector_type.element, vector_type.element))


def _build_less_than(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    vector_type, (x, y) = _broadcast(context, builder, signature, arguments)
    compare = builder.fcmp_ordered if vector_type.element in _UNSIGNED else builder.icmp_unsigned
    return builder.sext(compare("<", x, y), _llvm_vector(signature.return_type))


def _build_square_root(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    vector = _llvm_vector(signature.args[0])
    name = f"llvm.sqrt.v{VECTOR_WIDTH}f{signature.args[0].element.bitwidth}"
    return builder.call(
        cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector]), name), arguments
    )


def _build_bitcast(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.bitcast(arguments[0], _llvm_vector(signature.return_type))


def _build_to_float32(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    convert = builder.fptrunc if signature.args[0].element in _UNSIGNED else builder.sitofp
    return convert(arguments[0], _llvm_vector(signature.return_type))


def _build_to_uint32(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.fptosi(arguments[0], _llvm_vector(signature.return_type))


def _build_to_float64(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.fpext(arguments[0], _llvm_vector(signature.return_type))


def _build_absolute(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    bits = ir.VectorType(ir.IntType(32), VECTOR_WIDTH)
    positive = builder.and_(builder.bitcast(arguments[0], bits), ir.Constant(bits, [0x7FFFFFFF] * VECTOR_WIDTH))
    return builder.bitcast(positive, _llvm_vector(signature.return_type))


def _build_low_half(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.trunc(arguments[0], _llvm_vector(signature.return_type))


def _build_lane_select(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    mask, x, y = arguments
    return builder.select(builder.icmp_signed("<", mask, ir.Constant(_llvm_vector(signature.args[0]), None)), x, y)


def _build_zeros(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return ir.Constant(_llvm_vector(signature.return_type), None)


def _build_movemask(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    is_set = builder.icmp_signed("<", arguments[0], ir.Constant(_llvm_vector(signature.args[0]), None))
    return builder.zext(builder.bitcast(is_set, ir.IntType(VECTOR_WIDTH)), ir.IntType(32))


class PointerType(types.Type):
    """Describe a raw pointer to numbers to Numba."""

    def __init__(self, element: types.Number) -> None:
        self.element = element
        super().__init__(name=f"pointer({element})")


@register_model(PointerType)
class _PointerModel(models.PrimitiveModel):
    def __init__(self, manager: Any, pointer_type: PointerType) -> None:
        super().__init__(manager, pointer_type, manager.lookup(pointer_type.element).get_data_type().as_pointer())


def _build_pointer(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array, at = arguments
    is_array = isinstance(signature.args[0], types.Array)
    pointer = context.make_array(signature.args[0])(context, builder, array).data if is_array else array
    return builder.gep(pointer, [at])


def _type_of_pointers(member: Any) -> Any:
    if isinstance(member, types.Array):
        return PointerType(member.dtype)
    if isinstance(member, types.NamedTuple | types.NamedUniTuple):
        return types.NamedTuple([_type_of_pointers(each) for each in member.types], member.instance_class)
    return member


def _build_pointers(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return _pointers(context, builder, signature.args[0], arguments[0])


def _pointers(context: Any, builder: Any, of_type: Any, member: Any) -> Any:
    if isinstance(of_type, types.Array):
        return context.make_array(of_type)(context, builder, member).data
    if isinstance(of_type, types.NamedTuple | types.NamedUniTuple):
        members = zip(of_type.types, cgutils.unpack_tuple(builder, member), strict=True)
        converted = [_pointers(context, builder, each, value) for each, value in members]
        return context.make_tuple(builder, _type_of_pointers(of_type), converted)
    return member


def _address(builder: Any, pointer: Any, at: Any, pointee: ir.Type) -> Any:
    return builder.bitcast(builder.gep(pointer, [at]), pointee.as_pointer())


def _build_load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    pointer, at = arguments
    lanes = _address(builder, pointer, at, _llvm_vector(signature.return_type))
    return builder.load(lanes, align=signature.args[0].element.bitwidth // 8)


def _build_store(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    pointer_type, _, vector_type = signature.args
    pointer, at, lanes = arguments
    vector = _llvm_vector(vector_type)
    if pointer_type.element == types.uint16:
        vector = ir.VectorType(_INT16, VECTOR_WIDTH)
        lanes = builder.trunc(lanes, vector)
    builder.store(lanes, _address(builder, pointer, at, vector), align=pointer_type.element.bitwidth // 8)
    return context.get_dummy_value()


def _build_load_four_bytes(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    pointer, at = arguments
    return builder.load(_address(builder, pointer, at, ir.IntType(32)), align=1)


def _element_address(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.gep(arguments[0], [context.cast(builder, arguments[1], signature.args[1], types.intp)])


def _build_getitem(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.load(_element_address(context, builder, signature, arguments))


def _build_setitem(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    number = context.cast(builder, arguments[2], signature.args[2], signature.args[0].element)
    builder.store(number, _element_address(context, builder, signature, arguments))
    return context.get_dummy_value()


for _operator, _float_name, _integer_name in (
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
    type_callable(_operator)(lambda context: _operation_type)
    for _operands in ((VectorType, VectorType), (VectorType, types.Number), (types.Number, VectorType)):
        lower_builtin(_operator, *_operands)(_build_operation(_float_name, _integer_name))

_register(maximum, _operation_type, _build_select(">"))
_register(minimum, _operation_type, _build_select("<"))
_register(less_than, _comparison_type, _build_less_than)
_register(square_root, lambda x: x, _build_square_root)
_register(to_bits, lambda x: VectorType(_UNSIGNED[x.element]), _build_bitcast)
_register(from_bits, lambda bits: VectorType(types.float32), _build_bitcast)
_register(to_float32, lambda x: VectorType(types.float32), _build_to_float32)
_register(to_float64, lambda x: VectorType(types.float64), _build_to_float64)
_register(absolute, lambda x: x, _build_absolute)
_register(low_half, lambda x: VectorType(types.uint32), _build_low_half)
_register(select, lambda mask, x, y: x, _build_lane_select)
_register(to_uint32, lambda x: VectorType(types.uint32), _build_to_uint32)
_register(uint32_zeros, lambda: VectorType(types.uint32), _build_zeros)
_register(movemask, lambda x: types.uint32, _build_movemask)
_register(
    pointer_to, lambda array, at: PointerType(array.dtype) if isinstance(array, types.Array) else array, _build_pointer
)
_register(pointers_of, _type_of_pointers, _build_pointers)
_register(load, lambda pointer, at: VectorType(pointer.element), _build_load)
_register(store, lambda pointer, at, lanes: types.none, _build_store)
_register(load_four_bytes, lambda pointer, at: types.uint32, _build_load_four_bytes)


@type_callable(operator.getitem)
def _type_getitem(context: Any) -> Callable[..., Any]:
    return lambda pointer, at: pointer.element if isinstance(pointer, PointerType) else None


@infer_global(operator.setitem)
class _SetitemTemplate(AbstractTemplate):
    def generic(self, arguments: Any, keywords: Any) -> Any:
        pointer, at, number = arguments
        return signature(types.none, pointer, at, number) if isinstance(pointer, PointerType) else None


lower_builtin(operator.getitem, PointerType, types.Integer)(_build_getitem)
lower_builtin(operator.setitem, PointerType, types.Integer, types.Number)(_build_setitem)
