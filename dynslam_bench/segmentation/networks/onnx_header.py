"""The header of an ONNX file: inputs, outputs, metadata. No dependency, no execution.

An ONNX file is one protocol-buffer message. Only the few fields below are decoded (field numbers from the public
``onnx.proto``): ``ModelProto.graph`` = 7, ``.metadata_props`` = 14; ``GraphProto.initializer`` = 5 (names only),
``.input`` = 11, ``.output`` = 12; ``ValueInfoProto.name`` = 1, ``.type`` = 2; ``TypeProto.tensor_type`` = 1;
``Tensor.shape`` = 2; ``TensorShapeProto.dim`` = 1; ``Dimension.dim_value`` = 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from dynslam_bench.core.errors import SegmentationError


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
        graph = _first(memoryview(data), 7)
        initialised = {_text(tensor, 8) for tensor in _messages(graph, 5)}
        inputs = tuple(_tensor(value) for value in _messages(graph, 11) if _text(value, 1) not in initialised)
        outputs = tuple(_tensor(value) for value in _messages(graph, 12))
        metadata = {_text(entry, 1): _text(entry, 2) for entry in _messages(memoryview(data), 14)}
        if not inputs or not outputs:
            raise ValueError(f"it declares {len(inputs)} inputs and {len(outputs)} outputs")
    except (ValueError, IndexError) as error:
        raise SegmentationError(
            f"{path} is not an ONNX model ({len(data)} bytes): {error}", "the file is truncated or of another format"
        ) from error
    return OnnxHeader(inputs, outputs, metadata)


def _tensor(data: memoryview) -> TensorInfo:
    shape = _first(_first(_first(data, 2), 1), 2)
    return TensorInfo(_text(data, 1), tuple(_dimension(value) for value in _messages(shape, 1)))


def _dimension(data: memoryview) -> int | None:
    sizes = [value for number, value in _fields(data) if number == 1 and isinstance(value, int)]
    return sizes[-1] if sizes and 0 < sizes[-1] < 1 << 62 else None


def _messages(data: memoryview, wanted: int) -> list[memoryview]:
    """The length-delimited values of a field number: messages and texts."""
    return [value for number, value in _fields(data) if number == wanted and isinstance(value, memoryview)]


def _first(data: memoryview, wanted: int) -> memoryview:
    return next(iter(_messages(data, wanted)), memoryview(b""))


def _text(data: memoryview, wanted: int) -> str:
    return bytes(_first(data, wanted)).decode()


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """The (field number, value) pairs of a message; fixed-size values come as their raw bytes."""
    position = 0
    while position < len(data):
        key, position = _varint(data, position)
        kind = key & 7
        if kind == 0:
            value, position = _varint(data, position)
            yield key >> 3, value
            continue
        if kind not in (1, 2, 5):
            raise ValueError(f"unknown wire type {kind}")
        size = 8 if kind == 1 else 4
        if kind == 2:
            size, position = _varint(data, position)
        if position + size > len(data):
            raise ValueError(f"a field of {size} bytes ends beyond the file")
        yield key >> 3, data[position : position + size]
        position += size


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    result = shift = 0
    while True:
        byte = data[position]
        position += 1
        result |= (byte & 127) << shift
        if byte < 128:
            return result, position
        shift += 7
        if shift > 63:
            raise ValueError("a number is longer than ten bytes")
