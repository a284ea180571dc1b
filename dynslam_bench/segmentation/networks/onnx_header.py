"""The header of an ONNX file: inputs, outputs, metadata. No dependency, no execution.

An ONNX file is one protocol-buffer message. Only the few fields below are decoded (field numbers from the public
``onnx.proto``): ``ModelProto.graph`` = 7, ``.metadata_props`` = 14; ``GraphProto.initializer`` = 5 (names only),
``.input`` = 11, ``.output`` = 12; ``ValueInfoProto.name`` = 1, ``.type`` = 2; ``TypeProto.tensor_type`` = 1;
``Tensor.shape`` = 2; ``TensorShapeProto.dim`` = 1; ``Dimension.dim_value`` = 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from dynslam_bench.core.errors import SegmentationError

Fields: TypeAlias = dict[int, list[Any]]
"""Values of a message, each an integer or a memoryview, by field number."""
_NOTHING = memoryview(b"")


@dataclass(frozen=True)
class TensorInfo:
    """Name and shape of an input or output; an open dimension is None."""

    name: str
    shape: tuple[int | None, ...]

    def __str__(self) -> str:
        return f"{self.name} {'x'.join('?' if size is None else str(size) for size in self.shape) or 'scalar'}"


@dataclass(frozen=True)
class OnnxHeader:
    """Inputs, outputs and metadata that a file declares."""

    inputs: tuple[TensorInfo, ...]
    outputs: tuple[TensorInfo, ...]
    metadata: dict[str, str]


def read_header(path: Path) -> OnnxHeader:
    """Decode the header of an ONNX file.

    Raises:
        SegmentationError: The file is missing, truncated or no ONNX model.
    """
    try:
        data = path.expanduser().read_bytes()
    except OSError as error:
        raise SegmentationError(
            f"cannot read the network {path}: {error.strerror}", "give the path of an .onnx file"
        ) from error
    try:
        model = _fields(memoryview(data))
        graph = _message(model, 7)
        initialised = {_text(_fields(tensor), 8) for tensor in graph.get(5, ())}
        inputs, outputs = (tuple(_tensor(_fields(value)) for value in graph.get(number, ())) for number in (11, 12))
        inputs = tuple(tensor for tensor in inputs if tensor.name not in initialised)
        metadata = {_text(entry, 1): _text(entry, 2) for entry in map(_fields, model.get(14, ()))}
        if not inputs or not outputs:
            raise ValueError(f"it declares {len(inputs)} inputs and {len(outputs)} outputs")
    except (ValueError, IndexError, TypeError, AttributeError) as error:  # also a field of another type
        raise SegmentationError(
            f"{path} is not an ONNX model ({len(data)} bytes): {error}", "the file is truncated or of another format"
        ) from error
    return OnnxHeader(inputs, outputs, metadata)


def _tensor(value: Fields) -> TensorInfo:
    shape = _message(_message(_message(value, 2), 1), 2)
    sizes = [_fields(dimension).get(1, [0])[-1] for dimension in shape.get(1, ())]
    return TensorInfo(_text(value, 1), tuple(size if 0 < size < 1 << 62 else None for size in sizes))


def _message(fields: Fields, number: int) -> Fields:
    return _fields(fields.get(number, [_NOTHING])[0])


def _text(fields: Fields, number: int) -> str:
    text: str = fields.get(number, [_NOTHING])[0].tobytes().decode()
    return text


def _fields(data: memoryview) -> Fields:
    """The values of a message by field number: integers, and the bytes of everything else."""
    fields: Fields = {}
    position = 0
    while position < len(data):
        key, position = _varint(data, position)
        kind = key & 7
        if kind not in (0, 1, 2, 5):
            raise ValueError(f"unknown wire type {kind}")
        value, begin = _varint(data, position) if kind in (0, 2) else ({1: 8, 5: 4}[kind], position)
        position = begin if kind == 0 else begin + value
        if position > len(data):
            raise ValueError(f"a field of {value} bytes ends beyond the file")
        fields.setdefault(key >> 3, []).append(value if kind == 0 else data[begin:position])
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
