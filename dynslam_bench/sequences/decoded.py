"""Frames that are decoded once, into one file of the stage cache that processes map into their memory."""

import contextlib
import os
from pathlib import Path

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, Sequence
from dynslam_bench.core import (
    STAGES_VARIABLE,
    DynslamError,
    SequenceError,
    exclusive_lock,
    replacing,
    translate_errors,
)
from dynslam_bench.core.fingerprint import opencv_version
from dynslam_bench.core.module_graph import PACKAGE, PLUMBING, module_graph
from dynslam_bench.core.records import digest
from dynslam_bench.core.stage_cache import StageCache
from dynslam_bench.sequences.view import Wrapped, reader_of, sequence_part_of


class Decoded(Wrapped):
    """A sequence whose frames are read from memory; their arrays cannot be written.

    The file is found by the digest of the frames' content. Of several processes one decodes, the
    others wait.

    Args:
        base: The sequence, preprocessed and cut to the frames that are needed.

    Raises:
        SequenceError: A frame cannot be decoded, or the frames take more than half of the stage
            cache.
        DynslamError: The stage cache cannot be written, e.g. because the disk is full; nothing is
            left behind.
    """

    def __init__(self, base: Sequence) -> None:
        self.base = base
        self._frames = _mapped(base)

    def __len__(self) -> int:
        return len(self.base)

    def __getitem__(self, index: int) -> Frame:
        index = range(len(self))[index]
        rgb, depth = (np.asarray(self._frames[name][index]) for name in ("rgb", "depth"))
        return Frame(index, float(self.base.timestamps[index]), rgb, depth)


def _mapped(sequence: Sequence) -> NDArray[np.void]:
    """The frames as a mapped array of records ``rgb`` and ``depth``, which is written if it is not there or damaged."""
    # the file of this content, of these frames and of the code that decodes them
    cache = StageCache()
    part = sequence_part_of(sequence)
    code = [
        module_graph().digest(
            [reader_of(sequence), f"{PACKAGE}.sequences.preprocessing"], PLUMBING
        ),
        opencv_version(),
    ]
    path = cache.path(
        "frames", digest([sequence.digest(), part.start, part.stop, part.stride, code]), ".npy"
    )

    # one process decodes, the others wait for its lock and find the file
    if (frames := _read(path)) is None:
        with translate_errors(
            DynslamError, f"cannot write the stage cache {cache.folder}", f"set {STAGES_VARIABLE}"
        ):
            path.parent.mkdir(parents=True, exist_ok=True)
        with exclusive_lock(path.with_suffix(".lock")):
            if (frames := _read(path)) is None:
                _write(sequence, path, cache.max_bytes)
                cache.prune()
                frames = np.load(path, mmap_mode="r", allow_pickle=False)

    # note that it was used; a cache that can only be read has no such note
    with contextlib.suppress(OSError):
        os.utime(path)
    return frames


def _read(path: Path) -> NDArray[np.void] | None:
    """The mapped array of a file; None if it is not there, or damaged."""
    with contextlib.suppress(FileNotFoundError, EOFError, ValueError):
        frames: NDArray[np.void] = np.load(path, mmap_mode="r", allow_pickle=False)
        return frames
    return None


def _write(sequence: Sequence, path: Path, max_bytes: int) -> None:
    """Decode all frames into a file that `_read` maps.

    Raises:
        SequenceError: They would fill more than half of the cache's `max_bytes`.
        DynslamError: The file cannot be written.
    """
    # one record a frame
    size = (sequence.camera.height, sequence.camera.width)
    kind = np.dtype([("rgb", np.uint8, (*size, 3)), ("depth", np.float32, size)], align=True)
    count = len(sequence) * kind.itemsize
    if count > max_bytes / 2:
        raise SequenceError(
            f"the {len(sequence)} decoded frames of '{sequence.id}' take {count / 1e6:.0f} MB, more than half of the "
            f"{max_bytes / 1e6:.0f} MB of the stage cache",
            "choose part of the sequence by frames, or leave memory_map out",
        )
    fault = f"cannot write the {count / 1e6:.0f} MB of decoded frames of '{sequence.id}' to {path.parent}"
    hint = f"free some space, or name another folder by {STAGES_VARIABLE}"
    with (
        translate_errors(DynslamError, fault, hint),
        replacing(path) as temporary,
        temporary.open("wb") as file,
    ):
        # NumPy's header, then record by record: the frames are never in memory together
        header = {
            "descr": npy.dtype_to_descr(kind),
            "fortran_order": False,
            "shape": (len(sequence),),
        }
        npy.write_array_header_2_0(file, header)
        record = np.zeros((), kind)
        for index in range(len(sequence)):
            frame = sequence[index]
            record["rgb"] = frame.rgb
            record["depth"] = frame.depth
            file.write(record.tobytes())
