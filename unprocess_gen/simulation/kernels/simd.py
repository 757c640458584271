"""Write SIMD code in kernels: vectors of eight numbers, and raw pointers.

LLVM does not vectorise loops that look up tables, convert between widths or list sites. Kernels write them with the
functions of this module, eight sites at a time. One round of such a loop::

    memory of a strip   | x0 x1 x2 x3 x4 x5 x6 x7 | x8 ...          pointer: `pointer_to(array, index)`
                          load(pointer, 0)
    a vector            [ x0 x1 x2 x3 x4 x5 x6 x7 ]                 + - * / & | ^ >> <<, maximum, select ...
    a mask              [ ~0  0  0 ~0  0  0  0  0 ]                 less_than(x, y): all bits of a lane, or none
                          store(pointer, 0, vector)

A scalar operand is copied into every lane. Every operation rounds as it does on single numbers: nothing is reordered,
and no multiply-add is fused. Bytes and bits are numbered from the low end, as on every platform that Numba supports.

Each function has two implementations, which tests compare. Its body is the definition: NumPy, on arrays of eight
elements; uncompiled kernels use it. Its decorator is the compiled form: LLVM instructions on ``<8 x type>``, which LLVM
maps to the registers of the processor.

=============================  =====================================================================================
part of this module            what it teaches Numba
=============================  =====================================================================================
types and compiler             the type of a vector, its operators, and decorators that compile a function as LLVM code
pointers                       `pointers_of` a record, `pointer_to` an array, `buffers_at` constant places, load, store
functions                      comparisons, bits, conversions, square root
=============================  =====================================================================================

A decorator takes a *typer* (types of the operands → type of the result) and a *builder*, which writes the instructions:
``build(context, builder, call, arguments)``, where ``call`` is the signature and ``arguments`` are LLVM values.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, AttributeTemplate, infer_getattr, infer_global, signature
from numba.extending import lower_builtin, lower_getattr_generic, models, register_model
from numpy.typing import NDArray

VECTOR_WIDTH = 8
"""Lanes of a vector."""

Vector = NDArray[Any]
"""Eight lanes; in uncompiled code an array."""
Pointer = NDArray[Any]
"""A raw pointer to array data; in uncompiled code an array."""
Index = int | np.integer[Any]

_Function = TypeVar("_Function", bound=Callable[..., Any])


# ------------------------------------------------------------------------------------------------- types and compiler


class VectorType(types.Type):
    """Describe a vector of eight numbers to Numba."""

    def __init__(self, element: types.Number, llvm_element: ir.Type) -> None:
        self.element, self.llvm = element, ir.VectorType(llvm_element, VECTOR_WIDTH)
        super().__init__(name=f"vector({element})")


_VECTORS = {
    types.float32: VectorType(types.float32, ir.FloatType()),
    types.float64: VectorType(types.float64, ir.DoubleType()),
    types.uint32: VectorType(types.uint32, ir.IntType(32)),
    types.uint64: VectorType(types.uint64, ir.IntType(64)),
}
_FLOAT32, _FLOAT64, _UINT32, _UINT64 = _VECTORS.values()
_UNSIGNED: dict[types.Type, types.Type] = {
    _FLOAT32: _UINT32, _FLOAT64: _UINT64, types.float32: types.uint32, types.float64: types.uint64,
}  # fmt: skip
_FLOATS = {unsigned: floats for floats, unsigned in _UNSIGNED.items()}


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, vector_type: VectorType) -> None:
        super().__init__(manager, vector_type, vector_type.llvm)


def _register(function: Any, typer: Callable[..., Any], build: Callable[..., Any], *operands: Any) -> None:
    """Compile calls of a function as ``build``; ``typer`` returns the result type, or None for other operands."""

    class _Template(AbstractTemplate):
        key = function

        def generic(self, arguments: Any, keywords: Any) -> Any:
            result = typer(*arguments)
            return None if result is None else signature(result, *arguments)

    infer_global(function, types.Function(_Template))
    lower_builtin(function, *operands)(build)


def _compiled(typer: Callable[..., Any], build: Callable[..., Any]) -> Callable[[_Function], _Function]:
    """Return a decorator that compiles a function as ``build(context, builder, signature, arguments)``."""

    def register(function: _Function) -> _Function:
        _register(function, typer, build, types.VarArg(types.Any))
        return function

    return register


def _lanewise(
    code: Callable[..., Any], result: Callable[[Any], Any] = lambda operand_type: operand_type
) -> Callable[[_Function], _Function]:
    """Return a decorator that compiles a function of vectors as ``code(builder, LLVM type of the result, *operands)``.

    ``result`` maps the type of the operands to the type of the result. Operands without a vector are single numbers,
    converted to the type of the first; Numba's own functions of numbers are compiled for each type, in 0.03 s.
    """
    return _compiled(lambda *operands: result(_vector_type(operands) or operands[0]), _per_lane(code))


def _vector_type(operands: tuple[Any, ...]) -> Any:
    """Return the type of the last vector among operands, or None: then Numba tries other overloads."""
    return next((operand for operand in operands[::-1] if isinstance(operand, VectorType)), None)


def _per_lane(code: Callable[..., Any]) -> Callable[..., Any]:
    """Return the code generator of operations on vectors; numbers among operands are copied into every lane."""

    def build(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
        vector_type = _vector_type(call.args)

        def convert(given: Any, operand: Any) -> Any:
            if isinstance(given, VectorType):
                return operand
            if vector_type is None:
                return context.cast(builder, operand, given, call.args[0])
            return _splat(builder, context.cast(builder, operand, given, vector_type.element), vector_type)

        operands = map(convert, call.args, arguments)
        return code(builder, context.get_value_type(call.return_type), *operands)

    return build


def _splat(builder: Any, number: Any, vector_type: VectorType) -> Any:
    empty, first = ir.Constant(vector_type.llvm, ir.Undefined), ir.Constant(ir.IntType(32), 0)
    return _shuffle(builder, [0] * VECTOR_WIDTH, builder.insert_element(empty, number, first), empty)


def _shuffle(builder: Any, lanes: list[int], x: Any, y: Any) -> Any:
    return builder.shuffle_vector(x, y, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes))


def _is_set(builder: Any, mask: Any) -> Any:
    """True if the top bit of each lane is set."""
    return builder.icmp_signed("<", mask, ir.Constant(mask.type, None))


for _operator, _float_code, _integer_code in (
    (operator.add, ir.IRBuilder.fadd, ir.IRBuilder.add),
    (operator.sub, ir.IRBuilder.fsub, ir.IRBuilder.sub),
    (operator.mul, ir.IRBuilder.fmul, ir.IRBuilder.mul),
    (operator.truediv, ir.IRBuilder.fdiv, None),
    (operator.and_, None, ir.IRBuilder.and_),
    (operator.or_, None, ir.IRBuilder.or_),
    (operator.xor, None, ir.IRBuilder.xor),
    (operator.lshift, None, ir.IRBuilder.shl),
    (operator.rshift, None, ir.IRBuilder.lshr),
):

    def _operate(builder: Any, llvm_type: Any, x: Any, y: Any, codes: Any = (_float_code, _integer_code)) -> Any:
        return codes[isinstance(llvm_type.element, ir.IntType)](builder, x, y)

    for _operands in ((VectorType, VectorType), (VectorType, types.Number), (types.Number, VectorType)):
        _register(_operator, lambda *operands: _vector_type(operands), _per_lane(_operate), *_operands)


# ------------------------------------------------------------------------------------------------------------ pointers


def _pointer_type(member: Any) -> Any:
    if isinstance(member, types.Array):
        return types.CPointer(member.dtype)
    if isinstance(member, types.NamedTuple | types.NamedUniTuple):
        return types.NamedTuple([_pointer_type(inner) for inner in member.types], member.instance_class)
    return member


def _build_pointers(context: Any, builder: Any, member_type: Any, member: Any) -> Any:
    if isinstance(member_type, types.Array):
        return context.make_array(member_type)(context, builder, member).data
    if isinstance(member_type, types.NamedTuple | types.NamedUniTuple):
        members = zip(member_type.types, cgutils.unpack_tuple(builder, member), strict=True)
        converted = [_build_pointers(context, builder, kind, value) for kind, value in members]
        return context.make_tuple(builder, _pointer_type(member_type), converted)
    return member


@_compiled(
    _pointer_type, lambda context, builder, call, arguments: _build_pointers(context, builder, *call.args, *arguments)
)
def pointers_of(record: Any) -> Any:
    """Return a named tuple with a pointer to the data of each array, also in nested named tuples."""
    return type(record)(*map(_flatten, record))


def _flatten(member: Any) -> Any:
    if isinstance(member, np.ndarray):
        return member.reshape(-1)
    return pointers_of(member) if hasattr(member, "_fields") else member


@_compiled(
    lambda array, index: _pointer_type(array),
    lambda context, builder, call, arguments: builder.gep(
        _build_pointers(context, builder, call.args[0], arguments[0]), [arguments[1]]
    ),
)
def pointer_to(array: NDArray[Any], index: Index) -> Pointer:
    """Return a pointer to the data of a C-contiguous array, from the flat index ``index`` on.

    Compiled code checks no index and counts no reference: the count costs a locked instruction per call. So the array
    must outlive the pointer, as arguments of the outer kernel do.
    """
    return array.reshape(-1)[index:]


class BuffersType(types.Type):
    """Describe buffers at constant places of one array to Numba.

    Compiled code passes one pointer instead of one for each buffer.
    """

    def __init__(self, name: str, places: Mapping[str, tuple[np.dtype[Any], int]]) -> None:
        self.places = {member: (types.CPointer(from_dtype(dtype)), start) for member, (dtype, start) in places.items()}
        super().__init__(name=name)


@register_model(BuffersType)
class _BuffersModel(models.PrimitiveModel):
    def __init__(self, manager: Any, buffers_type: BuffersType) -> None:
        super().__init__(manager, buffers_type, ir.IntType(8).as_pointer())


def _type_of_buffer(template: AttributeTemplate, buffers_type: BuffersType, member: str) -> Any:
    return buffers_type.places[member][0]


@infer_getattr
class _BufferTemplate(AttributeTemplate):
    key = BuffersType
    generic_resolve: Any = _type_of_buffer


def _build_buffer(context: Any, builder: Any, buffers_type: BuffersType, memory: Any, member: str) -> Any:
    pointer_type, start = buffers_type.places[member]
    place = builder.gep(memory, [ir.Constant(ir.IntType(64), start)])
    return builder.bitcast(place, context.get_value_type(pointer_type))


lower_getattr_generic(BuffersType)(_build_buffer)


def buffers_at(
    name: str, places: Callable[[np.dtype[Any]], Mapping[str, tuple[np.dtype[Any], int]]]
) -> Callable[[_Function], _Function]:
    """Return a decorator that compiles a function of an array as a record of pointers into its data.

    ``places`` returns the dtype of each member and its byte in the data, from the dtype of the array.
    """

    def build(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
        data = _build_pointers(context, builder, call.args[0], arguments[0])
        return builder.bitcast(data, ir.IntType(8).as_pointer())

    return _compiled(
        lambda array: BuffersType(f"{name}({array.dtype})", places(np.dtype(str(array.dtype)))),
        build,
    )


def _address(builder: Any, llvm_type: ir.Type, pointer: Any, index: Any) -> Any:
    return builder.bitcast(builder.gep(pointer, [index]), llvm_type.as_pointer())


def _build_load(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
    address = _address(builder, call.return_type.llvm, *arguments)
    return builder.load(address, align=call.args[0].dtype.bitwidth // 8)


@_compiled(lambda pointer, index: _VECTORS[pointer.dtype], _build_load)
def load(pointer: Pointer, index: Index) -> Vector:
    """Load the vector of elements ``index`` to ``index + 7``."""
    return pointer[index : index + VECTOR_WIDTH].copy()


def _build_store(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
    pointer, index, lanes = arguments
    element = call.args[0].dtype
    if element == types.uint16:
        lanes = builder.trunc(lanes, ir.VectorType(ir.IntType(16), VECTOR_WIDTH))
    builder.store(lanes, _address(builder, lanes.type, pointer, index), align=element.bitwidth // 8)
    return context.get_dummy_value()


@_compiled(lambda pointer, index, lanes: types.none, _build_store)
def store(pointer: Pointer, index: Index, lanes: Vector) -> None:
    """Store a vector as elements ``index`` to ``index + 7``; uint32 lanes are truncated to uint16 elements."""
    pointer[index : index + VECTOR_WIDTH] = lanes.astype(pointer.dtype)


def _build_columns(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
    """Load each row at once and transpose, because single loads would take three times as long."""
    table, starts, index = arguments
    row_type, rows = ir.VectorType(_FLOAT64.llvm.element, 4), []
    for lane in range(VECTOR_WIDTH):
        start = builder.load(builder.gep(starts, [builder.add(index, ir.Constant(index.type, lane))]))
        start = builder.zext(start, ir.IntType(64))
        rows.append(builder.load(_address(builder, row_type, table, start), align=8))
    columns = []
    for column in range(3):
        parts = [_shuffle(builder, [column, 4 + column], *rows[n : n + 2]) for n in range(0, VECTOR_WIDTH, 2)]
        while len(parts) > 1:
            both = [*range(2 * parts[0].type.count)]
            parts = [_shuffle(builder, both, *parts[n : n + 2]) for n in range(0, len(parts), 2)]
        columns += parts
    return context.make_tuple(builder, call.return_type, columns)


@_compiled(lambda table, starts, index: types.UniTuple(_FLOAT64, 3), _build_columns)
def load_columns(table: Pointer, starts: Pointer, index: Index) -> tuple[Vector, Vector, Vector]:
    """Load the first three of four columns of eight rows of a float64 table; the first begins at ``starts[index]``."""
    rows = table[starts[index : index + VECTOR_WIDTH].astype(np.int64)[:, None] + np.arange(3)]
    return rows[:, 0], rows[:, 1], rows[:, 2]


# ------------------------------------------------------------------------------------------------------------ functions


@_lanewise(lambda builder, llvm_type, x, y: builder.select(builder.fcmp_ordered(">", x, y), x, y))
def maximum(x: Any, y: Any) -> Any:
    """Return ``x`` where x > y, else ``y``, per lane or of two floats; ``y`` if either is NaN."""
    return np.where(x > y, x, y).astype(np.result_type(x))[()]


@_lanewise(lambda builder, llvm_type, x, y: builder.select(builder.fcmp_ordered("<", x, y), x, y))
def minimum(x: Any, y: Any) -> Any:
    """Return ``x`` where x < y, else ``y``, per lane or of two floats; ``y`` if either is NaN."""
    return np.where(x < y, x, y).astype(np.result_type(x))[()]


def _build_less_than(builder: Any, llvm_type: Any, x: Any, y: Any) -> Any:
    compare = builder.icmp_unsigned if isinstance(x.type.element, ir.IntType) else builder.fcmp_ordered
    return builder.sext(compare("<", x, y), llvm_type)


@_lanewise(_build_less_than, lambda x: _UNSIGNED.get(x, x))
def less_than(x: Any, y: Any) -> Vector:
    """Return a mask per lane: all bits set where x < y, else 0; unsigned lanes of the same width."""
    unsigned = _unsigned_dtype(x if np.ndim(x) else y)
    return np.asarray(np.where(x < y, ~unsigned.type(0), unsigned.type(0)))


@_compiled(lambda: _UINT32, lambda context, builder, call, arguments: ir.Constant(call.return_type.llvm, None))
def uint32_zeros() -> Vector:
    """Return a uint32 vector of zeros."""
    return np.zeros(VECTOR_WIDTH, dtype=np.uint32)


@_lanewise(lambda builder, llvm_type, mask, x, y: builder.select(_is_set(builder, mask), x, y))
def select(mask: Vector, x: Vector, y: Vector) -> Vector:
    """Return ``x`` in lanes whose mask (`less_than`) is set, else ``y``."""
    return np.asarray(np.where(mask != 0, x, y))


@_compiled(
    lambda x: types.uint32,
    lambda context, builder, call, arguments: builder.zext(
        builder.bitcast(_is_set(builder, *arguments), ir.IntType(VECTOR_WIDTH)), ir.IntType(32)
    ),
)
def movemask(x: Vector) -> np.uint32:
    """Return the top bits of unsigned lanes as the low bits of one number, the first lane lowest."""
    top = np.uint64(8 * x.itemsize - 1)
    return np.uint32(sum(int(lane >> x.dtype.type(top)) << n for n, lane in enumerate(x)))


def _build_any(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
    is_set = builder.icmp_unsigned("!=", arguments[0], ir.Constant(arguments[0].type, None))
    bits = builder.bitcast(is_set, ir.IntType(VECTOR_WIDTH))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


@_compiled(lambda x: types.boolean, _build_any)
def has_any_bit(x: Vector) -> bool:
    """True if any bit of any unsigned lane is set."""
    return bool(np.any(x != 0))


def _call_intrinsic(name: str) -> Callable[..., Any]:
    def code(builder: Any, llvm_type: Any, x: Any) -> Any:
        full_name = f"llvm.{name}.v{VECTOR_WIDTH}{llvm_type.element.intrinsic_name}"
        function_type = ir.FunctionType(llvm_type, [llvm_type])
        return builder.call(cgutils.get_or_insert_function(builder.module, function_type, full_name), [x])

    return code


@_lanewise(_call_intrinsic("sqrt"))
def square_root(x: Vector) -> Vector:
    """Return the square root of each lane."""
    return np.asarray(np.sqrt(x))


@_lanewise(_call_intrinsic("fabs"))
def absolute(x: Vector) -> Vector:
    """Return the absolute value of each lane."""
    return np.asarray(np.abs(x))


@_lanewise(lambda builder, llvm_type, x: builder.bitcast(x, llvm_type), lambda x: _UNSIGNED[x])
def to_bits(x: Any) -> Any:
    """Return the bits of float lanes, or of a float, as unsigned integers of the same width."""
    return x.view(_unsigned_dtype(x))


@_lanewise(lambda builder, llvm_type, bits: builder.bitcast(bits, llvm_type), lambda bits: _FLOATS[bits])
def from_bits(bits: Any) -> Any:
    """Return the float lanes, or the float, of the same width that have these bits."""
    return bits.view(f"float{8 * bits.itemsize}")


_CONVERSIONS = {
    (types.float64, types.float32): ir.IRBuilder.fptrunc,
    (types.float32, types.float64): ir.IRBuilder.fpext,
    (types.uint32, types.float32): ir.IRBuilder.sitofp,
    (types.uint32, types.float64): ir.IRBuilder.sitofp,
    (types.float32, types.uint32): ir.IRBuilder.fptosi,
    (types.uint64, types.uint32): ir.IRBuilder.trunc,
    (types.uint32, types.uint64): ir.IRBuilder.zext,
}


def _convert_to(vector_type: VectorType) -> Callable[[_Function], _Function]:
    def build(context: Any, builder: Any, call: Any, arguments: Any) -> Any:
        convert = _CONVERSIONS[call.args[0].element, vector_type.element]
        return convert(builder, arguments[0], vector_type.llvm)

    return _compiled(lambda x: vector_type, build)


@_convert_to(_FLOAT32)
def to_float32(x: Vector) -> Vector:
    """Convert float64, or uint32 below 2**31, to the nearest float32."""
    return x.astype(np.float32)


@_convert_to(_FLOAT64)
def to_float64(x: Vector) -> Vector:
    """Convert float32, or uint32 below 2**31, to float64."""
    return x.astype(np.float64)


@_convert_to(_UINT32)
def to_uint32(x: Vector) -> Vector:
    """Convert float32 with integer values from 0 to below 2**31, or the low bits of uint64, to uint32."""
    return x.astype(np.uint32)


@_convert_to(_UINT64)
def to_uint64(x: Vector) -> Vector:
    """Convert uint32 lanes to uint64."""
    return x.astype(np.uint64)


def _unsigned_dtype(lanes: Vector) -> np.dtype[Any]:
    return np.dtype(f"uint{8 * lanes.itemsize}")
