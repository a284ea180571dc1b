"""The stage cache: what does not depend on the settings under study is computed once and stored with its cost.

Entries are addressed by content: the key digests the stage, its code (a plug-in's too), its
settings, the machine, the threads and the input itself (see `core.fingerprint`), so that nothing
stale is ever returned. Each entry is one file that appears by atomic rename, so many processes may
share a cache. When it grows over its bound, the least recently used entries are deleted.
"""

import contextlib
import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import DynslamError, translate_errors
from dynslam_bench.core.files import replacing
from dynslam_bench.core.folders import STAGES_VARIABLE, stage_cache_folder
from dynslam_bench.core.module_graph import PLUMBING, module_graph
from dynslam_bench.core.reading import read_npz

ReadsSoFar = Callable[[], str]
"""Gives a digest of all that the plug-ins of this process have read so far."""
_RECORDING: list[ReadsSoFar] = []
"""The record given to `record_reads`, in a list of one; empty where nothing records."""


def record_reads(reads_so_far: ReadsSoFar) -> None:
    """Set how this process tells what plug-ins have read; without it their stages are not cached."""
    _RECORDING[:] = [reads_so_far]


def stage_code(entry_point: str) -> ReadsSoFar | None:
    """A function that gives the digest of a stage's code; of a plug-in's with all that it has read so far.

    It is called before and after a stage computes: what a plug-in reads meanwhile, such as its
    weights at its first frame, makes the result one of an unknown state, which is not stored.

    Args:
        entry_point: ``module:Attr`` or ``file.py:Attr`` of the stage.

    Returns:
        None where the code is a plug-in's and nothing records what it reads.
    """
    module = entry_point.rpartition(":")[0]
    if module in module_graph().modules:
        # unlike a lambda it can be pickled
        return partial(str, module_graph().digest([module], PLUMBING))
    return _RECORDING[0] if _RECORDING else None


DEFAULT_MAX_BYTES = 8 * 2**30
"""Bound of a cache, in bytes."""
_PRUNE_EVERY = 512
"""Writes between two looks at the cache's size."""
_SHRINK_TO = 0.8
"""Share of the bound that is left when the cache is pruned."""
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Entry:
    """A stored stage result.

    Attributes:
        arrays: The result.
        cost_s: Seconds that computing it took when it was computed.
    """

    arrays: Arrays
    cost_s: float


class StageCache:
    """A folder of stage results, bounded in size.

    Args:
        folder: Folder of the cache; created when first written to.
        max_bytes: Bound; when it is passed, the least recently used entries are deleted until four
            fifths are left.
    """

    def __init__(self, folder: Path | None = None, max_bytes: int = DEFAULT_MAX_BYTES) -> None:
        self.folder = stage_cache_folder() if folder is None else folder
        self.max_bytes = max_bytes
        self._writes = 0

    def get(self, stage: str, key: str) -> Entry | None:
        """The stored result, or None; a damaged entry is deleted and counts as missing."""
        path = self.path(stage, key)
        try:
            arrays = read_npz(path)
            entry = Entry(arrays, float(arrays.pop("cost_s")))
        except (DynslamError, KeyError):
            entry = None
        # it fails for a cache that can only be read, or where another process has just deleted the entry
        with contextlib.suppress(OSError):
            if entry is None:
                path.unlink()
            else:
                os.utime(path)
        return entry

    def put(self, stage: str, key: str, arrays: Mapping[str, NDArray[Any]], cost_s: float) -> None:
        """Store a result; another process may have stored the same meanwhile, which does not matter.

        Args:
            stage: The stage.
            key: Digest of all that the result depends on.
            arrays: The result.
            cost_s: Seconds that computing it took.

        Raises:
            DynslamError: The folder cannot be written, e.g. a full disk; nothing is left behind.
        """
        path = self.path(stage, key)
        with (
            translate_errors(
                DynslamError,
                f"cannot write the stage cache {self.folder}",
                f"free some space, or name another folder by {STAGES_VARIABLE}",
            ),
            replacing(path) as temporary,
            temporary.open("wb") as file,
        ):
            contents = {**arrays, "cost_s": np.float64(cost_s)}
            np.savez(file, allow_pickle=False, **contents)  # type: ignore[arg-type]
        self._writes += 1
        if self._writes % _PRUNE_EVERY == 1:
            self.prune()

    def prune(self) -> int:
        """Delete the least recently used entries if the cache is over its bound; returns the bytes freed."""
        total = sum(size for _, _, size in self._entries())
        return 0 if total <= self.max_bytes else self._shrink(_SHRINK_TO * self.max_bytes)

    def info(self) -> dict[str, Any]:
        """Filling of the cache: ``folder``, ``max_bytes``, ``bytes_by_stage`` and ``entries_by_stage``."""
        sizes = Counter[str]()
        counts = Counter[str]()
        for _, path, size in sorted(self._entries(), key=itemgetter(1)):
            sizes[path.parent.parent.name] += size
            counts[path.parent.parent.name] += 1
        return {
            "folder": self.folder,
            "max_bytes": self.max_bytes,
            "bytes_by_stage": sizes,
            "entries_by_stage": counts,
        }

    def clear(self) -> int:
        """Delete every entry; returns the bytes freed. Entries that other processes write meanwhile stay."""
        return self._shrink(0)

    def _shrink(self, most_bytes: float) -> int:
        """Delete the least recently used entries until at most so many bytes are left; returns the bytes freed."""
        entries = sorted(self._entries(), key=itemgetter(0))
        total = sum(size for _, _, size in entries)
        freed = 0
        for _, path, size in entries:
            if total - freed <= most_bytes:
                break
            path.unlink(missing_ok=True)
            freed += size
        return freed

    def path(self, stage: str, key: str, suffix: str = ".npz") -> Path:
        """Path of an entry.

        `get` and `put` use ``.npz``. Other modules write ``.npy``, which count and are deleted as all
        entries are.
        """
        return self.folder / stage / key[:2] / f"{key}{suffix}"

    def _entries(self) -> list[tuple[float, Path, int]]:
        """(last use, path, bytes) of every entry; files that vanish meanwhile are left out."""
        entries = []
        for path in self.folder.glob("*/*/*.np[yz]"):
            with contextlib.suppress(OSError):
                status = path.stat()
                entries.append((status.st_mtime, path, status.st_size))
        return entries
