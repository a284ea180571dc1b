"""Readers of recorded sequences, one folder layout each: one of its files is damaged, the others are sound."""

import re
import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from dynslam_bench.geometry.camera import Camera
from dynslam_bench.sequences.readers.layouts import layout_of
from dynslam_bench.sequences.readers.recorded import RecordedSequence

from .campaign import Target, at

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "sequences"))
from published_folders import WRITERS, random_poses

SIZE = (16, 12)


@cache
def _files(name: str) -> dict[str, bytes]:
    """The files of a small folder of a layout."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "s"
        WRITERS[name](folder, random_poses(0), size=SIZE)
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


GONE = 128
"""Added to an input's first byte, the file is missing."""


def _attacked(name: str, damaged: tuple[str, ...]) -> Target:
    """A target that damages one of some files, or takes it away; the first byte of an input says which."""

    def read(data: bytes | None, folder: Path) -> None:
        first = data[0] if data else 0
        for file, content in _files(name).items():
            at(folder, file, content)
        at(folder, damaged[first % GONE % len(damaged)], None if data is None or first >= GONE else data[1:])
        contents = layout_of(name).read(folder)
        camera = Camera(*SIZE, 10.0, 10.0, 8.0, 6.0, depth_factor=1000.0)
        sequence = RecordedSequence(folder, contents, camera, id="fuzz", any_depth_size=True)
        for index in range(min(len(sequence), 3)):
            depth = sequence[index].depth
            assert np.isfinite(depth).all() and (depth >= 0).all()

    def seeds() -> list[bytes]:
        found = []
        for which, file in enumerate(damaged):
            content = _files(name).get(file, b"")
            found += [bytes([which]) + content, bytes([which + GONE])]
            found += [bytes([which]) + re.sub(old, new, content) for place, old, new in ODD[name] if place == file]
        return found

    return Target(f"layout {name}", read, seeds)


DAMAGED = {
    "eth3d": ("associated.txt", "calibration.txt", "groundtruth.txt"),
    "icl-nuim": ("livingRoom0.gt.freiburg", "second.gt.freiburg", "rgb/1.png"),
    "7-scenes": ("frame-000001.pose.txt", "frame-000001.depth.png", "frame-x.color.png"),
    "tartanair-shibuya": ("times.txt", "gt_pose.txt", "depth_0/000001.npy"),
    "openloris": ("sensors.yaml", "trans_matrix.yaml", "color.txt", "groundtruth.txt"),
    "vslam-lab": ("rgb.csv", "calibration.yaml", "groundtruth.csv"),
    "euroc": (
        "mav0/cam0/sensor.yaml",
        "mav0/cam0/data.csv",
        "mav0/depth0/data.csv",
        "mav0/depth0/sensor.yaml",
        "mav0/state_groundtruth_estimate0/data.csv",
    ),
}
SKEWED = (rb"0\.269463", b"5")
"""A rotation that is none."""
ODD: dict[str, list[tuple[str, bytes, bytes]]] = {
    "eth3d": [],
    "icl-nuim": [],
    "7-scenes": [("frame-000001.pose.txt", rb"5\.43\S*", b"nan"), ("frame-000001.pose.txt", rb"5\.43\S*", b"7.0")],
    "tartanair-shibuya": [
        ("depth_0/000001.npy", rb"'<f4'", b"'<U1'"),
        ("depth_0/000001.npy", rb"12, 16", b"16, 12"),
        ("depth_0/000001.npy", rb"NUMPY\x01", b"NUMPY\x09"),
        ("gt_pose.txt", rb"(?m)^\S+ ", b""),
        ("gt_pose.txt", rb"0\.\d+", b"0"),
        ("gt_pose.txt", rb"(?s)\n.*", b""),
    ],
    "openloris": [
        ("sensors.yaml", rb"(?s).*", b"3"),
        ("trans_matrix.yaml", *SKEWED),
        ("groundtruth.txt", rb"(?m)^5\.", b"99."),
    ],
    "vslam-lab": [
        ("rgb.csv", rb"path_depth_0", b"path"),
        ("rgb.csv", rb"\n", b"\n\n"),
        ("rgb.csv", rb"(?s)\n.*", b""),
        ("groundtruth.csv", rb"qw", b"w"),
        ("groundtruth.csv", rb"0\.\d+", b"0"),
        ("calibration.yaml", rb"rgb_0", b"rgb_1"),
        ("calibration.yaml", rb"radtan5", b"fisheye"),
        ("calibration.yaml", rb"60\.5", b"-1"),
        ("calibration.yaml", *SKEWED),
        ("calibration.yaml", rb"\bT_BS: \S+", b"other: [0,"),
    ],
    "euroc": [
        ("mav0/cam0/sensor.yaml", *SKEWED),
        ("mav0/cam0/sensor.yaml", rb"T_BS", b"other"),
        ("mav0/cam0/sensor.yaml", rb"16, 12", b"0, 12"),
        ("mav0/cam0/data.csv", rb",\S+", b""),
        ("mav0/depth0/sensor.yaml", b"^", b"depth_factor: 5000\n"),
        ("mav0/state_groundtruth_estimate0/data.csv", rb"(?m),.*$", b""),
        ("mav0/state_groundtruth_estimate0/data.csv", rb"0\.\d+", b"0"),
    ],
}
"""Files, what is replaced in them, by what: those branches that damage at random seldom finds."""
TARGETS = [_attacked(name, files) for name, files in DAMAGED.items()]
