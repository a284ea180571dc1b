"""Where the map's tables lie: in memory while they are small, in temporary files mapped into memory afterwards.

A camera that goes on into new territory leaves most of its map behind. What nobody touches need not stay in memory: the
pages of a mapped file leave the process when told to, and come back, from the system's cache or from disk, as soon as
they are touched. The files have no name, so that nothing is left of them, however the process ends.
"""

from __future__ import annotations

import logging
import math
import mmap
import os
import tempfile
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

Table = NDArray[Any]

IN_MEMORY_BYTES = 16_000_000
"""Beyond so many bytes in all, tables move into files, each as it grows."""
SMALL_BYTES = 200_000
"""Smaller tables stay in memory: a file takes descriptors of which a process has few."""

log = logging.getLogger(__name__)


class TableSpace:
    """Gives named tables room to grow.

    A forked process shares the files: only one of the two may go on with the tables.

    Args:
        in_memory_bytes: What all of them together may take in memory.
    """

    def __init__(self, in_memory_bytes: int = IN_MEMORY_BYTES) -> None:
        self._most = in_memory_bytes
        self._bytes: dict[str, int] = {}
        self._row_bytes: dict[str, int] = {}
        self._files: dict[str, tuple[IO[bytes], mmap.mmap]] = {}

    def __reduce__(self) -> tuple[type[TableSpace], tuple[int]]:
        """A copy has no files: those are one process's, and its tables come as they are."""
        return TableSpace, (self._most,)

    @property
    def bytes_in_files(self) -> int:
        """Bytes of the tables that lie in files."""
        return sum(self._bytes[name] for name in self._files)

    def grown(self, name: str, table: Table, length: int, axis: int = 0) -> Table:
        """A longer table with the same content, and zeros behind it; the shorter one is not to be used any more.

        Args:
            name: Whose table it is.
            table: As it is.
            length: Its new length.
            axis: Along which it grows.
        """
        shape = list(table.shape)
        shape[axis] = length
        size = self._bytes[name] = math.prod(shape) * table.itemsize
        self._row_bytes[name] = math.prod(shape[1:]) * table.itemsize
        former = self._files.pop(name, None)
        if former is not None and axis == 0:
            longer = self._in_file(name, size, former[0])
            if longer is not None:
                return longer.view(table.dtype).reshape(shape)
        large = sum(self._bytes.values()) > self._most and size >= SMALL_BYTES
        raw = self._in_file(name, size) if large else None
        bigger = np.zeros(shape, table.dtype) if raw is None else raw.view(table.dtype).reshape(shape)
        bigger[tuple(slice(0, n) for n in table.shape)] = table
        return bigger

    def rest(self, *names: str, rows: int | None = None) -> None:
        """Let go of pages of tables that lie in files; what is needed comes back by itself.

        Args:
            names: Which tables; none for all.
            rows: How many rows of each, from the first one on; None for all.
        """
        for name in names or self._files:
            if name in self._files:
                mapped = self._files[name][1]
                size = len(mapped) if rows is None else min(max(rows, 0) * self._row_bytes[name], len(mapped))
                size -= size % mmap.PAGESIZE if rows is not None else 0
                if size and hasattr(mmap, "MADV_DONTNEED"):
                    mapped.madvise(mmap.MADV_DONTNEED, 0, size)

    def _in_file(self, name: str, size: int, file: IO[bytes] | None = None) -> NDArray[np.uint8] | None:
        """A file's bytes, as many as asked for, behind what it has zeros; None where there is no room for it."""
        try:
            file = file or tempfile.TemporaryFile(prefix="dynslam-map-")
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # a full disk is noticed here, not when a page is touched
            else:
                file.truncate(size)
            self._files[name] = file, mmap.mmap(file.fileno(), size)
        except OSError as error:
            log.warning("a table of the map stays in memory: no room for %.1f MB in a file: %s", size / 1e6, error)
            return None
        return np.frombuffer(self._files[name][1], np.uint8)
