"""Conformance of sequences."""

import pickle
from pathlib import Path

import numpy as np

from dynslam_bench.contracts import Camera, Frame, Sequence, Trajectory
from dynslam_bench.sequences import open_sequence
from dynslam_bench.testing.report import (
    ConformanceReport,
    NotApplicable,
    require,
    require_all,
    require_arrays,
    require_equal,
)


def check_sequence(sequence: Sequence | str | Path, *, frames: int = 3) -> None:
    """Check that a sequence keeps its contract.

    Args:
        sequence: A sequence, or the name of one.
        frames: How many frames to read, spread over the sequence.

    Raises:
        ConformanceError: Names every failed check, the fault and the likely cause.
    """
    sequence_report(sequence, frames=frames).raise_for_failures()


def sequence_report(sequence: Sequence | str | Path, *, frames: int = 3) -> ConformanceReport:
    """Run all checks of `check_sequence` and report each."""
    if isinstance(sequence, (str, Path)):
        sequence = open_sequence(sequence)
    report = ConformanceReport(f"sequence {getattr(sequence, 'id', type(sequence).__name__)!r}")
    if not report.run("protocol", lambda: _protocol(sequence)):
        return report
    # frames spread evenly, the first and the last among them
    spread = np.linspace(0, len(sequence) - 1, max(frames, 2)).astype(int)
    chosen = sorted(set(spread.tolist()))
    return report.run_all(
        {},
        {
            "timestamps": lambda: _timestamps(sequence),
            "frames": lambda: _frames(sequence, chosen),
            "end of the sequence": lambda: _end(sequence),
            "reading twice": lambda: _twice(sequence, chosen[-1]),
            "ground truth": lambda: _ground_truth(sequence),
            "masks": lambda: _masks(sequence, chosen),
            "digest": lambda: _digest(sequence),
            "pickling": lambda: _pickling(sequence),
        },
    )


_MEMBERS = (
    "id",
    "camera",
    "timestamps",
    "ground_truth",
    "masks",
    "fps",
    "license",
    "citation",
    "digest",
    "__len__",
)
"""Members that a sequence has beside its frames."""


def _protocol(sequence: Sequence) -> None:
    """All members are there, of the right types, and there is a frame."""
    missing = [name for name in (*_MEMBERS, "__getitem__") if not hasattr(sequence, name)]
    require(
        not missing,
        f"a {type(sequence).__name__} lacks {', '.join(missing)}",
        "see dynslam_bench.sequences.Sequence",
    )
    texts = (sequence.license, sequence.citation)
    require_all(
        (isinstance(sequence.id, str) and sequence.id, f"the id is {sequence.id!r}, not a text"),
        (
            isinstance(sequence.camera, Camera),
            f"the camera is a {type(sequence.camera).__name__}, not a Camera",
        ),
        (len(sequence) >= 1, "the sequence has no frame"),
        (all(isinstance(text, str) for text in texts), "license or citation is no text"),
    )


def _timestamps(sequence: Sequence) -> None:
    """One float64 stamp in seconds for each frame, increasing, at about the rate that `fps` says."""
    stamps = sequence.timestamps
    fps = sequence.fps
    require(
        isinstance(stamps, np.ndarray) and stamps.dtype == np.float64,
        "timestamps are no float64 array",
        "float32 holds stamps of today to 100 s only",
    )
    intervals = np.diff(stamps)
    require_all(
        (stamps.shape == (len(sequence),), f"{stamps.shape} timestamps for {len(sequence)} frames"),
        (np.isfinite(stamps).all(), "a timestamp is not finite"),
        (
            (intervals > 0).all(),
            "timestamps are not strictly increasing",
            "the list is unsorted or has duplicates",
        ),
        (fps > 0, f"fps is {fps}"),
    )
    rate = 1 / float(np.median(intervals)) if len(intervals) else fps
    require(
        1 / 3 < rate / fps < 3,
        f"fps is {fps:g}, but the median rate is {rate:g} Hz",
        "timestamps have to be in seconds",
    )


def _frames(sequence: Sequence, chosen: list[int]) -> None:
    """Frames have the camera's size, their own index and stamp, and depth in metres."""
    size = sequence.camera.height, sequence.camera.width
    for index in chosen:
        frame = sequence[index]
        stamp = float(sequence.timestamps[index])
        where = f"frame {index}: "
        require(isinstance(frame, Frame), f"frame {index} is a {type(frame).__name__}, not a Frame")
        require_arrays(
            frame,
            {"rgb": (np.uint8, (*size, 3)), "depth": (np.float32, size)},
            where,
            "the camera's size is not the image's, or the image is grey",
        )
        depth = frame.depth
        measured = frame.depth[frame.depth > 0]
        median_m = float(np.median(measured)) if len(measured) else 1.0
        require_all(
            (frame.index == index, f"frame {index} says that its index is {frame.index}"),
            (
                frame.timestamp == stamp,
                f"{where}stamped {frame.timestamp!r}, but timestamps[{index}] is {stamp}",
            ),
            (
                (np.isfinite(depth) & (depth >= 0)).all(),
                f"{where}depth has values below 0 or not finite",
                "missing depth is 0",
            ),
            (
                0.05 < median_m < 200,
                f"{where}the median depth is {median_m:g} m",
                "wrong depth_factor",
            ),
        )


def _end(sequence: Sequence) -> None:
    """There is no frame behind the last."""
    try:
        sequence[len(sequence)]
    except IndexError:
        return
    require(
        False,
        f"sequence[{len(sequence)}] gives a frame beyond the end",
        "without an IndexError, loops never end",
    )


def _twice(sequence: Sequence, index: int) -> None:
    """A frame is the same when it is read again."""
    cause = "randomness, or a buffer that is written again"
    require_equal(
        sequence[index],
        sequence[index],
        ("rgb", "depth"),
        f"frame {index} differs when it is read again",
        cause,
    )


def _ground_truth(sequence: Sequence) -> None:
    """The ground truth is a trajectory on the frames' clock."""
    truth = sequence.ground_truth
    if truth is None:
        raise NotApplicable("the sequence has none")
    require(
        isinstance(truth, Trajectory),
        f"the ground truth is a {type(truth).__name__}, not a Trajectory",
    )
    stamps = sequence.timestamps
    # seconds: a pose 0.1 s away from the first or last frame still counts
    overlap = (truth.timestamps >= stamps[0] - 0.1) & (truth.timestamps <= stamps[-1] + 0.1)
    require(
        overlap.any(),
        f"the ground truth spans {truth.timestamps[0]:.3f} to {truth.timestamps[-1]:.3f} s, the frames "
        f"{stamps[0]:.3f} to {stamps[-1]:.3f} s",
        "they use different clocks",
    )


def _masks(sequence: Sequence, chosen: list[int]) -> None:
    """Masks have the frames' size, and every object has a class name."""
    source = sequence.masks
    if source is None:
        raise NotApplicable("the sequence has none")
    shape = (sequence.camera.height, sequence.camera.width)
    for index in chosen:
        masks = source[index]
        kind = masks.instances.dtype
        names = set(masks.class_names)
        unnamed = sorted(set(np.unique(masks.instances).tolist()) - {0} - names)
        require_all(
            (
                masks.instances.shape == shape and np.issubdtype(kind, np.integer),
                f"the mask of frame {index} is {kind} {masks.instances.shape}, expected integers {shape}",
            ),
            (
                not unnamed,
                f"instances {unnamed} of frame {index} have no class name",
                "0 is the background",
            ),
            (set(masks.moving) <= names, f"moving instances of frame {index} have no class name"),
        )


def _digest(sequence: Sequence) -> None:
    """The digest is a text that stays the same."""
    first = sequence.digest()
    require(isinstance(first, str) and first, f"the digest is {first!r}, not a text")
    require(
        sequence.digest() == first,
        "two digests of one sequence differ",
        "it must depend on the content only",
    )


def _pickling(sequence: Sequence) -> None:
    """Check that a pickled copy is the same sequence: workers get it so."""
    copy = pickle.loads(pickle.dumps(sequence))
    require(
        len(copy) == len(sequence) and copy.digest() == sequence.digest(),
        "a pickled copy is another sequence",
    )
    require(np.array_equal(copy[0].rgb, sequence[0].rgb), "frame 0 of a pickled copy differs")
