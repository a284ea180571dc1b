"""The arguments of an environment: the sequence and its part, and the device."""

import re
from collections.abc import Sequence as PySequence
from pathlib import Path
from typing import cast

import numpy as np

from dynslam_bench.contracts import Sequence, timestamps_ns
from dynslam_bench.core import SequenceError, SettingsError
from dynslam_bench.core.arguments import names_wrong_arguments
from dynslam_bench.core.settings import Settings
from dynslam_bench.geometry import refuse_close
from dynslam_bench.sequences import PreprocessingSettings, SequenceView, open_sequence
from dynslam_bench.sequences.catalogue import parse_frames

Frames = PySequence[int | None] | str | None
"""Part of a sequence: ``(start, stop)``, ``"start:stop"`` with either end open, or None for all."""


def open_frames(
    sequence: str | Sequence,
    data_root: str | Path | None,
    camera: str | Path | None,
    frames: Frames,
    stride: int,
    preprocessing: PreprocessingSettings | None = None,
    *,
    memory_map: bool = False,
) -> Sequence:
    """The sequence, preprocessed and cut to the chosen frames.

    Args:
        sequence: An id, a folder, or a sequence object.
        data_root: Folder of the sequences.
        camera: Camera of a folder that does not name its own.
        frames: Part of the sequence.
        stride: Take every so many frames.
        preprocessing: Applied to every frame.
        memory_map: Whether the frames are decoded once, see `sequences.decoded.Decoded`.

    Raises:
        SequenceError: Unknown, missing or damaged sequence, or no frames are left.
    """
    start, stop = parse_frames(frames)
    if isinstance(sequence, str | Path):
        sequence = open_sequence(
            sequence,
            data_root=data_root,
            camera=camera,
            frames=(start, stop),
            stride=stride,
            preprocessing=preprocessing,
        )
    else:
        if preprocessing is not None and preprocessing.changes_images:
            from dynslam_bench.sequences.preprocessing import Preprocessed

            sequence = cast("Sequence", Preprocessed(sequence, preprocessing))
        if (start, stop, stride) != (0, None, 1):
            sequence = cast("Sequence", SequenceView(sequence, start, stop, stride))
    if memory_map:
        from dynslam_bench.sequences.decoded import Decoded

        sequence = cast("Sequence", Decoded(sequence))
    return sequence


def parse_window(window: Frames, sequence: Sequence) -> tuple[int, int]:
    """First frame of a window and one past its last.

    Raises:
        SequenceError: It does not lie within the sequence, or has fewer than two frames.
    """
    first, stop = parse_frames(window)
    stop = len(sequence) if stop is None else stop
    if not 0 <= first < stop - 1 < len(sequence):
        raise SequenceError(
            f"the window {first}:{stop} is no part of '{sequence.id}', which has {len(sequence)} frames here",
            f"give two frames or more within 0:{len(sequence)}",
        )
    return first, stop


def check_frames(sequence: Sequence) -> None:
    """Refuse a sequence that is too short for an episode, or whose stamps do not tell its frames or true poses apart.

    Raises:
        SequenceError: It has fewer than two frames, stamps that do not increase, or two frames or true poses less than
            1 us apart.
    """
    if len(sequence) < 2:
        raise SequenceError(f"'{sequence.id}' has {len(sequence)} frames here, an episode needs 2 or more")
    stamps = np.asarray(sequence.timestamps, dtype=np.float64)
    wrong = np.flatnonzero(~(np.diff(stamps) > 0))
    if len(wrong):
        at = int(wrong[0]) + 1
        raise SequenceError(
            f"'{sequence.id}' has {len(wrong)} of {len(stamps)} stamps that are not later than the one before, first "
            f"that of frame {at}: {stamps[at]} after {stamps[at - 1]} s",
            "each frame has a stamp of its own, in seconds, ascending",
        )
    refuse_close(timestamps_ns(sequence), f"frames of '{sequence.id}'", SequenceError)
    if sequence.ground_truth is not None:
        refuse_close(sequence.ground_truth.timestamps_ns, f"ground truth of '{sequence.id}'", SequenceError)


def preprocessing_of(settings: Settings) -> PreprocessingSettings | None:
    """The group ``preprocessing`` of a tracker's settings; None for trackers without one."""
    group = getattr(settings, "preprocessing", None)
    return group if isinstance(group, PreprocessingSettings) else None


@names_wrong_arguments
def resolve_device(device: str = "auto") -> str:
    """``cpu`` or ``cuda:N`` for ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.

    ``auto`` is the first CUDA device, or the CPU where there is none. Torch is imported only if a driver is present.

    Raises:
        SettingsError: The name is not understood, or the machine has no such device.
    """
    if device == "cpu":
        return "cpu"
    if device != "auto" and not re.fullmatch(r"cuda(:\d+)?", device):
        raise SettingsError(f"unknown device '{device}'", "write auto, cpu, cuda or cuda:N")
    count = 0
    if any(Path(node).exists() for node in ("/dev/nvidiactl", "/dev/dxg", "/dev/kfd")):
        import torch

        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if device == "auto":
        return "cuda:0" if count else "cpu"
    index = int(device.partition(":")[2] or 0)
    if index >= count:
        raise SettingsError(
            f"device '{device}' was asked for, this machine has {count} CUDA devices", "use --device cpu"
        )
    return f"cuda:{index}"
