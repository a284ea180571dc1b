"""What a map looks like from outside: ``keyframes.csv`` and ``map.ply``."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.records import write_atomic
from dynslam_bench.geometry import se3


@dataclass(frozen=True, eq=False)
class KeyframeRecord:
    """One keyframe.

    Attributes:
        id: Number in order of creation.
        frame: Index of its frame.
        timestamp: Seconds.
        T_world_cam: Camera-to-world pose ``[4, 4]``.
        features: Features it holds.
        observations: Map points it observes.
    """

    id: int
    frame: int
    timestamp: float
    T_world_cam: NDArray[np.float64]
    features: int
    observations: int


@dataclass(frozen=True, eq=False)
class MapOutputs:
    """Keyframes, oldest first, and map points.

    Attributes:
        keyframes: All keyframes.
        ids: int64 ``[M]`` ids of the points.
        positions: float64 ``[M, 3]`` world coordinates, metres.
        colours: uint8 ``[M, 3]`` red, green, blue.
        observations: int64 ``[M]``, keyframes that observe each point.
    """

    keyframes: tuple[KeyframeRecord, ...]
    ids: NDArray[np.int64]
    positions: NDArray[np.float64]
    colours: NDArray[np.uint8]
    observations: NDArray[np.int64]


def write_keyframes_csv(path: Path, outputs: MapOutputs) -> None:
    """Write ``keyframes.csv``: id, frame, timestamp (six decimals), tx ty tz, qx qy qz qw, features, observations.

    Raises:
        DynslamError: The folder cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["id", "frame", "timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw", "features", "observations"])
    for record in outputs.keyframes:
        translation, quaternion = se3.to_quaternion(record.T_world_cam)
        numbers = [f"{value:.9f}" for value in (*translation, *quaternion)]
        writer.writerow(
            [record.id, record.frame, f"{record.timestamp:.6f}", *numbers, record.features, record.observations]
        )
    write_atomic(path, text.getvalue())


def write_ply(path: Path, outputs: MapOutputs, *, binary: bool = True) -> None:
    """Write the map points as a PLY cloud: float x y z in metres, uchar red green blue, int observations.

    Args:
        path: The file to write.
        outputs: The map.
        binary: Little-endian binary, or ASCII.

    Raises:
        DynslamError: The folder cannot be written.
    """
    layout = np.dtype(
        [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("n", "<i4")]
    )
    rows = np.zeros(len(outputs.positions), layout)
    for i, name in enumerate("xyz"):
        rows[name] = outputs.positions[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        rows[name] = outputs.colours[:, i]
    rows["n"] = outputs.observations
    header = [
        "ply", f"format {'binary_little_endian' if binary else 'ascii'} 1.0", f"element vertex {len(rows)}",
        "property float x", "property float y", "property float z", "property uchar red", "property uchar green",
        "property uchar blue", "property int observations", "end_header",
    ]  # fmt: skip
    head = ("\n".join(header) + "\n").encode()
    if binary:
        write_atomic(path, head + rows.tobytes())
        return
    body = "".join(f"{r[0]:.6f} {r[1]:.6f} {r[2]:.6f} {r[3]} {r[4]} {r[5]} {r[6]}\n" for r in rows.tolist())
    write_atomic(path, head + body.encode())
