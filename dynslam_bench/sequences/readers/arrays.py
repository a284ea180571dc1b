"""Depth as arrays of metres in NumPy's own format; a file that claims to be huge is refused before it costs memory."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from dynslam_bench.core.errors import SequenceError
from dynslam_bench.core.images import MOST_BYTES
from dynslam_bench.core.reading import read_bytes


def read_metres(path: Path, *, size: tuple[int, int] | None = None, mismatch: str = "") -> NDArray[np.float32]:
    """The array as float32 ``[H, W]`` in metres; what is not finite or below 0 is missing, that is 0.

    Args:
        path: An ``.npy`` file of floating-point numbers.
        size: Width and height that it has to have; None for any.
        mismatch: Ends the message where it has another one.

    Raises:
        SequenceError: The file is missing, damaged, of another size, or holds something else.
    """
    data = read_bytes(path, limit=MOST_BYTES, kind=SequenceError)
    stream = BytesIO(data)
    try:
        version = npy.read_magic(stream)
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, in_columns, kind = header(stream)
    except Exception as error:  # a damaged header makes numpy's reader raise whatever it likes
        raise SequenceError(f"depth array {path} cannot be read ({len(data)} bytes)", "it is no .npy file") from error
    rest = len(data) - stream.tell()
    if len(shape) != 2 or kind.kind != "f" or rest != int(kind.itemsize) * int(shape[0]) * int(shape[1]) or not rest:
        raise SequenceError(
            f"depth array {path} claims {kind} of shape {str(shape)[:60]} over {rest} bytes, expected rows of metres"
        )
    if size is not None and shape != size[::-1]:
        raise SequenceError(f"depth array {path} is {shape[1]}x{shape[0]}, {mismatch}")
    values = np.frombuffer(data, kind, offset=stream.tell()).reshape(shape, order="F" if in_columns else "C")
    with np.errstate(invalid="ignore", over="ignore"):
        depth = np.ascontiguousarray(values, dtype=np.float32)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
