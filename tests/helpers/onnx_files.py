"""Tiny ONNX files whose outputs are constants, written without the onnx package."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

FLOAT = 1
UINT8 = 2
INT64 = 7
FLOAT16 = 10
"""Types of numbers."""
CELLS = 16
SIZE = 64
MASKS = 4
DETECTIONS = 20
"""Sizes of the YOLO networks below: side of the prototypes and of the image, prototypes, rows of detections."""
BOX = (26, 9, 38, 39)
"""Corners of the only object of these networks; its mask fills the box: 360 px."""


def varint(value: int) -> bytes:
    out = b""
    while True:
        low = value & 127
        value = value >> 7
        out += bytes([low | (128 if value else 0)])
        if not value:
            return out


def number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def text(field: int, value: str | bytes) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return varint(field << 3 | 2) + varint(len(data)) + data


def tensor(name: str, value: np.ndarray) -> bytes:
    kind = INT64 if value.dtype == np.int64 else FLOAT
    dims = b"".join(number(1, size) for size in value.shape)
    return dims + number(2, kind) + text(8, name) + text(9, value.tobytes())


def value_info(name: str, shape, kind: int = FLOAT) -> bytes:
    dims = b"".join(
        text(1, number(1, size) if isinstance(size, int) else text(2, size)) for size in shape
    )
    return text(1, name) + text(2, text(1, number(1, kind) + text(2, dims)))


def node(operator: str, inputs, outputs, name: str) -> bytes:
    data = b"".join(text(1, i) for i in inputs) + b"".join(text(2, o) for o in outputs)
    return data + text(3, name) + text(4, operator)


def constant_network(
    input_shape,
    outputs: Mapping[str, np.ndarray],
    metadata: Mapping[str, str] | None = None,
    *,
    open_shapes: bool = False,
    input_kind: int = FLOAT,
) -> bytes:
    """A network that ignores its image (but for adding its zero-scaled mean) and gives constants.

    Each output is ``constant + 0 * mean(image)``.
    """
    graph = text(1, node("ReduceMean", ["image"], ["mean"], "mean_node"))
    graph += text(1, node("Mul", ["mean", "zero"], ["nothing"], "mul_node"))
    inits = text(5, tensor("zero", np.zeros(1, np.float32))) + text(
        5, tensor("one_dim", np.array([1], np.int64))
    )
    outs = b""
    for name, value in outputs.items():
        inits += text(5, tensor(f"const_{name}", value.astype(np.float32)))
        graph += text(
            1, node("Reshape", ["nothing", "one_dim"], [f"flat_{name}"], f"flatten_{name}")
        )
        graph += text(1, node("Add", [f"const_{name}", f"flat_{name}"], [name], f"add_{name}"))
        shape = [f"{name}{axis}" for axis in range(value.ndim)] if open_shapes else value.shape
        outs += text(12, value_info(name, shape))
    graph += text(2, "tiny") + inits + text(11, value_info("image", input_shape, input_kind)) + outs
    return (
        number(1, 8)
        + text(7, graph)
        + text(8, text(1, "") + number(2, 13))
        + entries(metadata or {})
    )


def entries(metadata: Mapping[str, str]) -> bytes:
    """Metadata, which may also be appended to a file."""
    return b"".join(text(14, text(1, key) + text(2, value)) for key, value in metadata.items())


def prototypes() -> np.ndarray:
    """The first one is 1 everywhere, the others 0."""
    planes = np.zeros((1, MASKS, CELLS, CELLS), np.float32)
    planes[0, 0] = 1
    return planes


def raw_detections(classes: int, label: int = 0, *, objectness: int = 0) -> np.ndarray:
    """``[1, 4 + objectness + classes + MASKS, DETECTIONS]``, one of them an object in `BOX` with score 0.9."""
    x0, y0, x1, y1 = BOX
    rows = np.zeros((1, 4 + objectness + classes + MASKS, DETECTIONS), np.float32)
    rows[0, :4, 0] = (x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0
    rows[0, 4 : 4 + objectness, 0] = 1
    rows[0, 4 + objectness + label, 0] = 0.9
    rows[0, 4 + objectness + classes, 0] = 5
    return rows


def suppressed_detections(label: int = 0) -> np.ndarray:
    """``[1, DETECTIONS, 6 + MASKS]``: corners, score, class and coefficients of the object in `BOX`, padded with 0."""
    rows = np.zeros((1, DETECTIONS, 6 + MASKS), np.float32)
    rows[0, 0, :7] = (*BOX, 0.9, label, 5)
    return rows


def names_of(*names: str) -> str:
    """The metadata entry ``names``."""
    return repr(dict(enumerate(names)))
