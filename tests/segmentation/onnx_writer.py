"""Writes tiny ONNX files for tests: outputs that are constants, without the onnx package."""

import numpy as np

FLOAT, INT64 = 1, 7


def varint(value: int) -> bytes:
    out = b""
    while True:
        value, low = value >> 7, value & 127
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


def info(name: str, shape, kind: int = FLOAT) -> bytes:
    dims = b"".join(text(1, number(1, size) if isinstance(size, int) else text(2, size)) for size in shape)
    return text(1, name) + text(2, text(1, number(1, kind) + text(2, dims)))


def node(operator: str, inputs, outputs, name: str) -> bytes:
    data = b"".join(text(1, i) for i in inputs) + b"".join(text(2, o) for o in outputs)
    return data + text(3, name) + text(4, operator)


def model(input_shape, outputs: dict[str, np.ndarray]) -> bytes:
    """A network that ignores its image (but for adding its zero-scaled mean) and gives constants.

    Each output is ``constant + 0 * mean(image)``.
    """
    graph = text(1, node("ReduceMean", ["image"], ["mean"], "mean_node"))
    inits = text(5, tensor("zero", np.zeros(1, np.float32)))
    graph += text(1, node("Mul", ["mean", "zero"], ["nothing"], "mul_node"))
    outs = b""
    for name, value in outputs.items():
        inits += text(5, tensor(f"const_{name}", value.astype(np.float32)))
        graph += text(1, node("Reshape", ["nothing", "one_dim"], [f"flat_{name}"], f"flatten_{name}"))
        graph += text(1, node("Add", [f"const_{name}", f"flat_{name}"], [name], f"add_{name}"))
        outs += text(12, info(name, value.shape))
    inits += text(5, tensor("one_dim", np.array([1], np.int64)))
    graph += text(2, "tiny") + inits + text(11, info("image", input_shape)) + outs
    return number(1, 8) + text(7, graph) + text(8, text(1, "") + number(2, 13))
