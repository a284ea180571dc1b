"""Frames that are decoded once, into one file of the stage cache that processes map into their memory."""

import contextlib
import logging
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
    call_periodically,
    exclusive_lock,
    replacing,
    translate_errors,
)
from dynslam_bench.core.fingerprint import opencv_version
from dynslam_bench.core.module_graph import PACKAGE, PLUMBING, module_graph
from dynslam_bench.core.records import digest
from dynslam_bench.core.stage_cache import StageCache
from dynslam_bench.sequences.view import Wrapped, reader_of, sequence_part_of

LOG_S = 3.0
"""Decoding that takes longer is logged, every so many seconds."""


class Decoded(Wrapped):
    """A sequence whose frames are read from memory; their arrays cannot be written.

    All frames are decoded, or rendered, when the first one is read. The file is found by the digest
    of their content. Of several processes one decodes, the others wait. Reading the first frame
    raises SequenceError where a frame cannot be decoded, and DynslamError where the stage cache
    cannot be written, e.g. because the disk is full; nothing is left behind.

    Args:
        base: The sequence, preprocessed and cut to the frames that are needed.

    Raises:
        SequenceError: The frames take more than half of the stage cache.
    """

    def __init__(self, base: Sequence) -> None:
        self.base = base
        self._frames: NDArray[np.void] | None = None
        _check_size(base, StageCache().max_bytes)

    def __len__(self) -> int:
        return len(self.base)

    def __getitem__(self, index: int) -> Frame:
        index = range(len(self))[index]
        if self._frames is None:
            self._frames = _mapped(self.base)
        rgb = np.asarray(self._frames["rgb"][index])
        depth = np.asarray(self._frames["depth"][index])
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
                _write(sequence, path)
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


def _record(sequence: Sequence) -> np.dtype[np.void]:
    """Data type of a stored frame: its colour and depth image."""
    size = (sequence.camera.height, sequence.camera.width)
    return np.dtype([("rgb", np.uint8, (*size, 3)), ("depth", np.float32, size)], align=True)


def _check_size(sequence: Sequence, max_bytes: int) -> None:
    """Refuse frames that would fill more than half of the cache's `max_bytes`.

    Raises:
        SequenceError: They would.
    """
    count = len(sequence) * _record(sequence).itemsize
    if count > max_bytes / 2:
        raise SequenceError(
            f"the {len(sequence)} decoded frames of '{sequence.id}' take {count / 1e6:.0f} MB, more than half of the "
            f"{max_bytes / 1e6:.0f} MB of the stage cache",
            "choose part of the sequence by frames, or leave memory_map out",
        )


def _write(sequence: Sequence, path: Path) -> None:
    """Decode all frames into a file that `_read` maps.

    Raises:
        DynslamError: The file cannot be written.
    """
    kind = _record(sequence)
    count = len(sequence) * kind.itemsize
    done = 0

    def log() -> None:
        logging.getLogger(__name__).warning(
            "decoding '%s', once: %d of %d frames", sequence.id, done, len(sequence)
        )

    fault = f"cannot write the {count / 1e6:.0f} MB of decoded frames of '{sequence.id}' to {path.parent}"
    hint = f"free some space, or name another folder by {STAGES_VARIABLE}"
    with (
        translate_errors(DynslamError, fault, hint),
        replacing(path) as temporary,
        temporary.open("wb") as file,
        call_periodically(LOG_S, log),
    ):
        # NumPy's header, then record by record: the frames are never in memory together
        header = {
            "descr": npy.dtype_to_descr(kind),
            "fortran_order": False,
            "shape": (len(sequence),),
        }
        npy.write_array_header_2_0(file, header)
        record = np.zeros((), kind)
        for done in range(len(sequence)):
            frame = sequence[done]
            record["rgb"] = frame.rgb
            record["depth"] = frame.depth
            file.write(record.tobytes())
