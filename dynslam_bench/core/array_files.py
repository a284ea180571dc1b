"""Read ``.npz`` files that somebody else may have made: no more memory than they may hold, one clear error."""

from __future__ import annotations

import io
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.reading import read_bytes

MOST_BYTES = 1 << 28
"""Of a file, and of all arrays in it together."""
# What zipfile and numpy raise over damaged files; a header may also claim more than there is memory.
_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError, OSError, EOFError, ValueError, TypeError,
           LookupError, ArithmeticError, SyntaxError, NotImplementedError, RuntimeError, MemoryError)  # fmt: skip


def read_npz(path: Path, *, kind: type[DynslamError] = DynslamError) -> dict[str, NDArray[Any]]:
    """The arrays of a file by name; nothing is unpickled.

    Args:
        path: The file.
        kind: What is raised.

    Raises:
        DynslamError: Of the given kind: it cannot be read, is damaged, or holds or claims more than `MOST_BYTES`.
    """
    data = read_bytes(path, limit=MOST_BYTES, kind=kind)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            claimed = sum(entry.file_size for entry in archive.infolist())
            if claimed > MOST_BYTES:
                raise kind(f"{path} claims {claimed / 1e6:.0f} MB of arrays, at most {MOST_BYTES / 1e6:.0f} are read")
            return {entry.filename.removesuffix(".npy"): _array(archive, entry) for entry in archive.infolist()}
    except _DAMAGE as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise kind(f"{path} holds no arrays: {reason}") from error


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    """One array, whose header claims as much as the file holds before memory is taken for it."""
    content = archive.read(entry)
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, in_columns, kind = header(stream)
    if kind.hasobject:
        raise ValueError(f"{entry.filename} holds objects")
    count = 1
    for size in shape:
        count *= int(size)
    if min(shape, default=0) < 0 or count * kind.itemsize != len(content) - stream.tell():
        raise ValueError(f"{entry.filename} claims {kind} of shape {str(shape)[:60]}, which it does not hold")
    values = np.frombuffer(content, kind, count, stream.tell()) if count else np.zeros(0, kind)
    return values.reshape(shape, order="F" if in_columns else "C")
