"""A map as files: ``keyframes.csv`` and ``map.ply``."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.map_outputs import MapOutputs
from dynslam_bench.core.errors import RunError
from dynslam_bench.core.reading import TABLE_BYTES, read_bytes
from dynslam_bench.core.records import write_atomic
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.stamps import format_ns, ns_of

_COLOURS = ("red", "green", "blue")
_LAYOUT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("n", "<i4")]
)


def write_keyframes_csv(path: Path, outputs: MapOutputs, exact: Mapping[float, int] | None = None) -> None:
    """Write ``keyframes.csv``: the fields of `KeyframeRecord`, the pose as tx ty tz and qx qy qz qw.

    The timestamp has nine decimals; `exact` gives the nanoseconds of stamps by their seconds, where a float does not
    hold them. It and the frame are empty for keyframes of an earlier run, in whose map this one began.

    Raises:
        DynslamError: The folder cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["id", "frame", "timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw", "features", "observations", "map"]
    )
    for record in outputs.keyframes:
        translation, quaternion = se3.to_quaternion(record.T_world_cam)
        numbers = [f"{value:.9f}" for value in (*translation, *quaternion)]
        when: list[object] = ["", ""]
        if record.frame >= 0:
            when = [record.frame, format_ns((exact or {}).get(record.timestamp) or ns_of(record.timestamp))]
        writer.writerow([record.id, *when, *numbers, record.features, record.observations, record.map])
    write_atomic(path, text.getvalue())


@dataclass(frozen=True, eq=False)
class Cloud:
    """Map points of a stored run.

    Attributes:
        positions: float32 ``[M, 3]``, world coordinates, metres.
        colours: uint8 ``[M, 3]``, red, green, blue.
        observations: int32 ``[M]``, keyframes that observe each point.
    """

    positions: NDArray[np.float32]
    colours: NDArray[np.uint8]
    observations: NDArray[np.int32]


def read_ply(path: Path) -> Cloud:
    """Read a map that `write_ply` wrote in binary.

    Raises:
        RunError: It cannot be read, or is no such file.
    """
    data = read_bytes(path, limit=TABLE_BYTES, kind=RunError)
    head, _, body = data.partition(b"end_header\n")
    rows = len(body) // _LAYOUT.itemsize
    if head + b"end_header\n" != _header(rows, "binary_little_endian") or len(body) != rows * _LAYOUT.itemsize:
        raise RunError(f"{path} is no map of this package: expected {_LAYOUT.itemsize} bytes a point, little-endian")
    found = np.frombuffer(body, _LAYOUT)
    positions = np.stack([found[name] for name in "xyz"], axis=1)
    if not np.isfinite(positions).all():
        raise RunError(f"{path} holds points that are not finite")
    colours = np.stack([found[name] for name in _COLOURS], axis=1)
    return Cloud(positions, colours, found["n"])


def _header(rows: int, coding: str) -> bytes:
    kinds = {"float": ("x", "y", "z"), "uchar": _COLOURS, "int": ("observations",)}
    properties = [f"property {kind} {name}" for kind, names in kinds.items() for name in names]
    header = ["ply", f"format {coding} 1.0", f"element vertex {rows}", *properties, "end_header"]
    return ("\n".join(header) + "\n").encode()


def write_ply(path: Path, outputs: MapOutputs, *, binary: bool = True) -> None:
    """Write the map points as a PLY cloud: float x y z in metres, uchar red green blue, int observations.

    Args:
        path: The file to write.
        outputs: The map.
        binary: Little-endian binary, or ASCII.

    Raises:
        DynslamError: The folder cannot be written.
    """
    rows = np.zeros(len(outputs.positions), _LAYOUT)
    for i, name in enumerate("xyz"):
        rows[name] = outputs.positions[:, i]
    for i, name in enumerate(_COLOURS):
        rows[name] = outputs.colours[:, i]
    rows["n"] = outputs.observations
    head = _header(len(rows), "binary_little_endian" if binary else "ascii")
    if binary:
        write_atomic(path, head + rows.tobytes())
        return
    body = "".join(f"{r[0]:.6f} {r[1]:.6f} {r[2]:.6f} {r[3]} {r[4]} {r[5]} {r[6]}\n" for r in rows.tolist())
    write_atomic(path, head + body.encode())
