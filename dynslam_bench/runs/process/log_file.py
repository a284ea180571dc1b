"""The log of a run within bounds: its beginning and its end are kept, and what was cut is said."""

from __future__ import annotations

import os
from pathlib import Path

WHOLE = 1 << 20
"""A log of up to so many bytes is kept as it is."""
KEPT = 1 << 18
"""Bytes kept of the beginning and of the end of a longer one."""
_MOST = 1 << 23
"""While the run lasts the file is emptied when it is longer."""


class LogFile:
    """Watches a file that other processes append to.

    Args:
        path: The file; it may not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._head = self._tail = b""
        self._seen = 0

    def look(self) -> None:
        """Empty the file if it has become long, after its first and last bytes were taken; call it often."""
        try:
            size = self.path.stat().st_size
        except OSError:
            return
        if size > _MOST:
            self._take(size)
            os.truncate(self.path, 0)  # whoever writes appends, so that writing goes on at the new end

    def finish(self) -> None:
        """Write the log as it is kept; nobody may write any more."""
        if not self.path.is_file():
            return
        size = self.path.stat().st_size
        if not self._seen and size <= WHOLE:
            return
        self._take(size)
        cut = self._seen - len(self._head) - len(self._tail)
        note = f"\n\n[... about {cut / 1e6:.1f} of {self._seen / 1e6:.1f} MB were cut here ...]\n\n"
        self.path.write_bytes(self._head + note.encode() + self._tail)

    def _take(self, size: int) -> None:
        with self.path.open("rb") as file:
            if not self._seen:
                self._head = file.read(KEPT)
            begin = max(size - KEPT, len(self._head) if not self._seen else 0)
            file.seek(begin)
            latest = file.read(size - begin)
        self._tail = (self._tail + latest)[-KEPT:]
        self._seen += size
