"""A map as files: ``keyframes.csv`` and ``map.ply``."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from dynslam_bench.contracts.map_outputs import MapOutputs
from dynslam_bench.core.records import write_atomic
from dynslam_bench.geometry import se3


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
    kinds = {"float": ("x", "y", "z"), "uchar": ("red", "green", "blue"), "int": ("observations",)}
    properties = [f"property {kind} {name}" for kind, names in kinds.items() for name in names]
    coding = "binary_little_endian" if binary else "ascii"
    header = ["ply", f"format {coding} 1.0", f"element vertex {len(rows)}", *properties, "end_header"]
    head = ("\n".join(header) + "\n").encode()
    if binary:
        write_atomic(path, head + rows.tobytes())
        return
    body = "".join(f"{r[0]:.6f} {r[1]:.6f} {r[2]:.6f} {r[3]} {r[4]} {r[5]} {r[6]}\n" for r in rows.tolist())
    write_atomic(path, head + body.encode())
