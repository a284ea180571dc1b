"""The header of a TensorFlow Lite file: input, outputs, the operators that make them, labels. No dependency.

A TensorFlow Lite file is one FlatBuffer. Only these fields are decoded (numbers from the public
schema.fbs): Model.operator_codes = 1, .subgraphs = 2, .buffers = 4; Buffer.data = 0;
OperatorCode.deprecated_builtin_code = 0, .builtin_code = 3; SubGraph.tensors = 0, .inputs = 1,
.outputs = 2, .operators = 3, .name = 4; Operator.opcode_index = 0, .inputs = 1, .outputs = 2;
Tensor.shape = 0, .type = 1, .buffer = 2, .name = 3. TensorFlow's metadata tools append labels to
the file as a zip archive.
"""

from __future__ import annotations

import lzma
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from dynslam_bench.core import SegmentationError, translate_errors
from dynslam_bench.segmentation.networks.onnx_header import TensorInfo

IDENTIFIER = b"TFL3"
"""Bytes 4 to 8 of every file of this format."""
ELEMENTS = {
    0: "float32",
    1: "float16",
    2: "int32",
    3: "uint8",
    4: "int64",
    5: "string",
    6: "bool",
    7: "int16",
    9: "int8",
    10: "float64",
}
"""Types of a tensor's numbers, by the value of TensorType."""
PROBABILITY_OPERATORS = {14: "LOGISTIC", 25: "SOFTMAX"}
"""Operators whose output lies between 0 and 1, by the value of BuiltinOperator."""
MOST_ENTRIES = 100_000
"""No network has as many tensors or operators; a longer list is damage."""
_ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    NotImplementedError,
    RuntimeError,
    OSError,
)
"""Errors of `zipfile` at damaged, encrypted or unknown archives."""
LONGEST_LABELS = 100_000
"""Bytes of a file of labels; a longer one is none."""


@dataclass(frozen=True)
class TfliteHeader:
    """Inputs, outputs and labels that a TensorFlow Lite file declares.

    Attributes:
        inputs: Its inputs, images as ``[1, H, W, C]``.
        outputs: Its outputs, maps as ``[1, h, w, C]``.
        made_by: BuiltinOperator of the operator that gives each output; -1 where none does.
        labels: Names of the outputs' channels; empty where the file has none.
    """

    inputs: tuple[TensorInfo, ...]
    outputs: tuple[TensorInfo, ...]
    made_by: tuple[int, ...]
    labels: tuple[str, ...]


def read_tflite_header(path: Path) -> TfliteHeader:
    """Read the inputs, outputs and labels that a TensorFlow Lite file declares.

    Raises:
        SegmentationError: The file is missing, truncated or no TensorFlow Lite model.
    """
    with translate_errors(
        SegmentationError, f"cannot read the network {path}", "give the path of a .tflite file"
    ):
        data = path.expanduser().read_bytes()
    with translate_errors(
        SegmentationError,
        f"{path} is not a TensorFlow Lite model ({len(data)} bytes)",
        "the file is truncated or of another format",
        of=(ValueError, IndexError, struct.error, *_ZIP_ERRORS),
    ):
        if data[4:8] != IDENTIFIER:
            raise ValueError(f"it begins with {data[:8]!r}")
        model = _Table(data, _number(data, "I", 0))
        graphs = model.tables(2)
        if len(graphs) != 1:
            raise ValueError(f"it has {len(graphs)} graphs")
        graph = graphs[0]
        _check_references(model, graph)
        tensors = [_tensor(table) for table in graph.tables(0)]
        inputs = graph.numbers(1)
        outputs = graph.numbers(2)

        # the operator that gives each output
        codes = [max(table.number("b", 0), table.number("i", 3)) for table in model.tables(1)]
        made_by = {}
        for operator in graph.tables(3):
            for tensor in operator.numbers(2):
                made_by[tensor] = codes[operator.number("I", 0)]
        return TfliteHeader(
            tuple(tensors[index] for index in inputs),
            tuple(tensors[index] for index in outputs),
            tuple(made_by.get(index, -1) for index in outputs),
            _labels(path.expanduser()),
        )


def _check_references(model: _Table, graph: _Table) -> None:
    """Refuse a file that refers to what it does not have: OpenCV would read beyond it, and end the process.

    Raises:
        ValueError: A name or the numbers of a tensor are missing.
    """
    n_bytes = len(model.data)
    buffers = model.tables(4)
    for buffer in buffers:
        first, length = buffer.vector(0)
        if first + length > n_bytes:
            raise ValueError(f"numbers end at byte {first + length} of {n_bytes}")
    tensors = graph.tables(0)
    for tensor in tensors:
        if not tensor.text(3) or tensor.number("I", 2) >= len(buffers):
            raise ValueError("a tensor without a name or numbers")
    if not graph.text(4):
        raise ValueError("a graph without a name")
    used = graph.numbers(1) + graph.numbers(2)
    for operator in graph.tables(3):
        # an input that is left out is -1
        used += [index for index in operator.numbers(1) if index != -1]
        used += operator.numbers(2)
        if operator.number("I", 0) >= len(model.tables(1)):
            raise ValueError("an operator of an unknown kind")
    if any(not 0 <= index < len(tensors) for index in used):
        raise ValueError("an operator of an unknown tensor")


def _labels(path: Path) -> tuple[str, ...]:
    """The lines of the text file among the appended files; empty where there is none."""
    if not zipfile.is_zipfile(path):
        return ()
    with zipfile.ZipFile(path) as archive:
        texts = [entry for entry in archive.infolist() if entry.filename.endswith(".txt")]
        if len(texts) != 1 or texts[0].file_size > LONGEST_LABELS:
            return ()
        # the size that an archive states need not be true
        with archive.open(texts[0]) as file:
            lines = file.read(LONGEST_LABELS).decode(errors="replace").splitlines()
    return tuple(line.strip() for line in lines if line.strip())


def _tensor(table: _Table) -> TensorInfo:
    """An input or output; a size of -1 or 0 is open."""
    shape = tuple(size if size > 0 else None for size in table.numbers(0))
    return TensorInfo(table.text(3), shape, ELEMENTS.get(table.number("b", 1), "unknown"))


@dataclass(frozen=True)
class _Table:
    """A table of a FlatBuffer, at a position in its bytes."""

    data: bytes
    position: int

    def number(self, kind: str, field: int) -> int:
        """A scalar of a `struct` type; 0 where the field is missing."""
        at = self._place(field)
        return 0 if at is None else _number(self.data, kind, at)

    def numbers(self, field: int) -> list[int]:
        """A vector of 32-bit integers; empty where the field is missing."""
        first, length = self.vector(field)
        return list(struct.unpack_from(f"<{length}i", self.data, first))

    def tables(self, field: int) -> list[_Table]:
        """A vector of tables; empty where the field is missing."""
        first, length = self.vector(field)
        if length > MOST_ENTRIES:
            raise ValueError(f"a list of {length} entries")
        places = [first + 4 * index for index in range(length)]
        return [_Table(self.data, at + _number(self.data, "I", at)) for at in places]

    def text(self, field: int) -> str:
        """A text; empty where the field is missing."""
        first, length = self.vector(field)
        return self.data[first : first + length].decode(errors="replace")

    def vector(self, field: int) -> tuple[int, int]:
        """Offset of the elements of a vector, and their number; 0, 0 where the field is missing."""
        at = self._place(field)
        if at is None:
            return 0, 0
        start = at + _number(self.data, "I", at)
        length = _number(self.data, "I", start)
        return start + 4, length

    def _place(self, field: int) -> int | None:
        """Offset of a field; None where it is missing. The table begins with the offset of its list of fields."""
        fields = self.position - _number(self.data, "i", self.position)
        slot = 4 + 2 * field
        if fields < 0:
            raise ValueError("a table lies before the file")
        if slot >= _number(self.data, "H", fields):
            return None
        offset = _number(self.data, "H", fields + slot)
        return self.position + offset if offset else None


def _number(data: bytes, kind: str, position: int) -> int:
    """The number of a `struct` type at a position, in little-endian order."""
    return int(struct.unpack_from("<" + kind, data, position)[0])
