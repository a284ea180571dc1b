"""The header of an ONNX file: inputs, outputs, metadata. No dependency, no execution.

An ONNX file is one protocol-buffer message. Only these fields are decoded (field numbers from the
public onnx.proto): ModelProto.graph = 7, .metadata_props = 14; GraphProto.initializer = 5 (names
only), .input = 11, .output = 12; ValueInfoProto.name = 1, .type = 2; TypeProto.tensor_type = 1;
Tensor.elem_type = 1, .shape = 2; TensorShapeProto.dim = 1; Dimension.dim_value = 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from dynslam_bench.core import SegmentationError, translate_errors

Fields: TypeAlias = dict[int, list[Any]]
"""Values of a message, each an integer or a memoryview, by field number."""
_NOTHING = memoryview(b"")
"""In place of a field that is missing."""

# protocol buffers' wire types
VARINT = 0
LENGTH_DELIMITED = 2
FIXED_BYTES = {1: 8, 5: 4}
"""Length of numbers of fixed size, by wire type."""

ELEMENTS = {
    1: "float32",
    2: "uint8",
    3: "int8",
    4: "uint16",
    5: "int16",
    6: "int32",
    7: "int64",
    8: "string",
    9: "bool",
    10: "float16",
    11: "float64",
    12: "uint32",
    13: "uint64",
    16: "bfloat16",
}
"""Types of a tensor's numbers, by the value of TensorProto.DataType."""


@dataclass(frozen=True)
class TensorInfo:
    """An input or output.

    Attributes:
        name: Its name.
        shape: Its size along each axis; an open one is None.
        element: Type of its numbers, see `ELEMENTS`; empty where the file does not say.
    """

    name: str
    shape: tuple[int | None, ...]
    element: str = "float32"

    def __str__(self) -> str:
        sizes = "x".join("?" if size is None else str(size) for size in self.shape) or "scalar"
        return f"{self.name} {sizes}" if self.is_real else f"{self.name} {sizes} {self.element}"

    @property
    def is_real(self) -> bool:
        """Whether its numbers are real ones, as scores and coordinates are, and not whole ones, as labels are."""
        return "float" in self.element or not self.element


def read_header(path: Path) -> tuple[list[TensorInfo], list[TensorInfo], dict[str, str]]:
    """The inputs, outputs and metadata that an ONNX file declares.

    Raises:
        SegmentationError: The file is missing, truncated or no ONNX model.
    """
    with translate_errors(
        SegmentationError, f"cannot read the network {path}", "give the path of an .onnx file"
    ):
        data = path.expanduser().read_bytes()
    with translate_errors(
        SegmentationError,
        f"{path} is not an ONNX model ({len(data)} bytes)",
        "the file is truncated or of another format",
        of=(ValueError, IndexError, TypeError, AttributeError),
    ):
        # a field of another type raises too
        model = _fields(memoryview(data))
        graph = _message(model, 7)

        # older files list the weights among the inputs
        initialised = {_text(_fields(tensor), 8) for tensor in graph.get(5, ())}
        declared = [_tensor(_fields(value)) for value in graph.get(11, ())]
        outputs = [_tensor(_fields(value)) for value in graph.get(12, ())]
        inputs = [tensor for tensor in declared if tensor.name not in initialised]
        entries = [(_text(entry, 1), _text(entry, 2)) for entry in map(_fields, model.get(14, ()))]
        metadata = dict(entries)
        for name, value in entries:
            if metadata[name] != value:
                raise SegmentationError(
                    f"{path}: the metadata hold two different entries '{name[:100]}'", "keep one"
                )
        if not inputs or not outputs:
            raise ValueError(f"it declares {len(inputs)} inputs and {len(outputs)} outputs")
    return inputs, outputs, metadata


def _tensor(value: Fields) -> TensorInfo:
    """An input or output, of a ValueInfoProto."""
    kind = _message(_message(value, 2), 1)
    sizes = [_fields(dimension).get(1, [0])[-1] for dimension in _message(kind, 2).get(1, ())]
    shape = tuple(size if 0 < size < 1 << 62 else None for size in sizes)
    return TensorInfo(_text(value, 1), shape, ELEMENTS.get(kind.get(1, [0])[-1], ""))


def _message(fields: Fields, number: int) -> Fields:
    """A message within a message; without any fields where there is none."""
    return _fields(fields.get(number, [_NOTHING])[0])


def _text(fields: Fields, number: int) -> str:
    """A text within a message; empty where there is none."""
    return str(fields.get(number, [_NOTHING])[0].tobytes().decode())


def _fields(data: memoryview) -> Fields:
    """The values of a message by field number: integers, and the bytes of everything else."""
    fields: Fields = {}
    position = 0
    while position < len(data):
        # a key: field number and wire type
        key, position = _varint(data, position)
        kind = key & 7
        # an integer, or the length of what follows: written before it, or fixed by the type
        begin = position
        if kind in (VARINT, LENGTH_DELIMITED):
            value, begin = _varint(data, position)
        elif kind in FIXED_BYTES:
            value = FIXED_BYTES[kind]
        else:
            raise ValueError(f"unknown wire type {kind}")
        position = begin if kind == VARINT else begin + value
        if position > len(data):
            raise ValueError(f"a field of {value} bytes ends beyond the file")
        fields.setdefault(key >> 3, []).append(value if kind == VARINT else data[begin:position])
    return fields


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    """The number that begins at a position, and the position after it."""
    result = 0
    for shift in range(0, 70, 7):
        byte = data[position]
        position += 1
        result |= (byte & 127) << shift
        if byte < 128:
            return result, position
    raise ValueError("a number is longer than ten bytes")
