"""The real ORB-SLAM3 (PyPI package pyorbslam3) in a process of its own; its vocabulary and settings file."""

import hashlib
import lzma
import math
import os
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

from dynslam_bench.contracts import TrackerContext
from dynslam_bench.core import (
    MEGABYTE,
    TrackerError,
    read_bytes,
    translate_errors,
    vocabularies_folder,
    write_atomic,
)
from dynslam_bench.core.plugins import module_command
from dynslam_bench.geometry import Camera
from dynslam_bench.trackers.adapters.program_file import real_text
from dynslam_bench.trackers.adapters.specs import OrbSlam3Settings
from dynslam_bench.trackers.adapters.subprocess_tracker import (
    FinalizingProgramTracker,
    ProgramTracker,
)

ENVIRONMENT_VARIABLE = "DYNSLAM_BENCH_ORB_VOCABULARY"
"""Names the vocabulary where no setting does."""
HINT = (
    f"name ORBvoc.txt of the ORB-SLAM3 repository or another ORB vocabulary in DBoW2's text format, .txt or .txt.xz, "
    f"with --set vocabulary=FILE or ${ENVIRONMENT_VARIABLE}"
)
"""Advice on naming a vocabulary."""
MAX_BYTES = 512 * MEGABYTE
"""Largest vocabulary that is read; that of ORB-SLAM3 has 145 MB."""
MAX_MEMORY = 256 * MEGABYTE
"""Memory that its decompression may take."""
TOKENS = 35
"""Numbers on the line of a node: parent, whether it is a leaf, 32 bytes of the descriptor, weight."""


def files(settings: OrbSlam3Settings) -> list[Path]:
    """The vocabulary file, part of a run's identity.

    Raises:
        TrackerError: See `find_vocabulary`.
    """
    return [find_vocabulary(settings.vocabulary)]


def find_vocabulary(setting: str) -> Path:
    """The vocabulary as a checked ``.txt`` file.

    Args:
        setting: Path of a ``.txt`` or ``.txt.xz`` file; empty for the environment variable's.

    Raises:
        TrackerError: None is named, it is missing, cannot be read, or is no complete vocabulary.
    """
    named = setting.strip() or os.environ.get(ENVIRONMENT_VARIABLE, "").strip()
    if not named:
        raise TrackerError("orbslam3 needs an ORB vocabulary and none is named", HINT)
    path = Path(named).expanduser().absolute()
    if not path.is_file():
        raise TrackerError(f"orbslam3: no vocabulary file {path}", HINT)
    with translate_errors(TrackerError, f"orbslam3: cannot read the vocabulary {path}", HINT):
        stamp = path.stat()
        return _prepared(path, stamp.st_size, stamp.st_mtime_ns)


@lru_cache(maxsize=8)
def _prepared(path: Path, size: int, modified_ns: int) -> Path:
    """Decompress if need be, check; once in a process as long as the file's size and time stay."""
    # a text is used where it lies
    packed = read_bytes(path, limit=MAX_BYTES, kind=TrackerError)
    if path.suffix != ".xz":
        _check(packed, path)
        return path

    # an archive is unpacked once, into a file that is named by its content
    target = vocabularies_folder() / f"{hashlib.sha256(packed).hexdigest()[:16]}.txt"
    if target.is_file():
        return _prepared(target, target.stat().st_size, target.stat().st_mtime_ns)
    with translate_errors(
        TrackerError,
        f"orbslam3: the vocabulary {path} ({size} bytes) is no intact .xz file",
        HINT,
        of=(lzma.LZMAError, EOFError, ValueError),
    ):
        reader = lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=MAX_MEMORY)
        text = reader.decompress(packed, max_length=MAX_BYTES)
        if not reader.eof:
            raise ValueError(f"it is truncated, or unpacks to more than {MAX_BYTES >> 20} MB")
    _check(text, path)
    write_atomic(target, text)
    return target


def _check(text: bytes, path: Path) -> None:
    """Check that the text is a complete vocabulary; ORB-SLAM3's loader does not.

    Raises:
        TrackerError: Names the first line that is wrong.
    """
    lines = text.splitlines()
    header = lines[0].split() if lines else []
    try:
        branching, depth, _, _ = map(int, header)
        fits = 2 <= branching <= 20 and 1 <= depth <= 10
    except ValueError:
        fits = False
    if not fits:
        shown = b" ".join(header)[:40].decode(errors="replace")
        raise TrackerError(
            f"orbslam3: {path} is no ORB vocabulary: line 1 is '{shown}', not '<branching> <depth> <score> <weight>'",
            HINT,
        )
    if fault := _first_fault(text.rstrip().splitlines()[1:]):
        raise TrackerError(
            f"orbslam3: the vocabulary {path} ({len(lines)} lines) is damaged: {fault}", HINT
        )


def _first_fault(nodes: Iterable[bytes]) -> str:
    """The first fault of the tree, or an empty string; node 0 is the root, node i is on line i + 1."""
    childless = {0}
    for node, line in enumerate(nodes, start=1):
        tokens = line.split()
        if len(tokens) != TOKENS or not b"".join(tokens[:-1]).isdigit():
            return f"line {node + 1} is not a node of {TOKENS} numbers"
        parent = int(tokens[0])
        if parent >= node:
            return f"line {node + 1} names parent {parent}, which has not come yet"
        childless.discard(parent)
        if tokens[1] == b"0":
            childless.add(node)
    if childless:
        return f"{len(childless)} inner nodes have no children, as if its end were missing"
    return ""


WORKER = "dynslam_bench.trackers.adapters.orbslam3_worker"
"""The module that runs as a process of its own."""
BORDER_PX = 16
"""ORB-SLAM3 extracts no corners so near to the edge of a pyramid level."""
_VIEWER = (
    ("KeyFrameSize", 0.05),
    ("KeyFrameLineWidth", 1.0),
    ("GraphLineWidth", 0.9),
    ("PointSize", 2.0),
    ("CameraSize", 0.08),
    ("CameraLineWidth", 3.0),
    ("ViewpointX", 0.0),
    ("ViewpointY", -0.7),
    ("ViewpointZ", -1.8),
    ("ViewpointF", 500.0),
)


class OrbSlam3Program(ProgramTracker):
    """ORB-SLAM3, untouched: its own threads, loop closing and relocalisation included.

    It runs in a child process: ORB-SLAM3 ends its process on bad input, writes to standard output
    and cannot be stopped otherwise.

    Args:
        settings: What goes into its settings file, the vocabulary, and time limits.
        context: Where it runs. ORB-SLAM3 starts three threads of its own whatever `threads` says.

    Raises:
        TrackerError: The vocabulary is missing or damaged.
    """

    sensor: str
    """ORB-SLAM3's name of the sensor."""

    def __init__(self, settings: OrbSlam3Settings, context: TrackerContext) -> None:
        self._vocabulary = find_vocabulary(settings.vocabulary)
        self.settings = settings
        super().__init__("orbslam3", settings, context, module_command(WORKER))

    def options(self, camera: Camera, folder: Path) -> dict[str, Any]:
        """Paths of the vocabulary and of the settings file, which is written here.

        Raises:
            TrackerError: ORB-SLAM3 cannot take the camera.
        """
        check_camera(camera, self.settings)
        path = folder / "settings.yaml"
        path.write_text(settings_yaml(camera, self.settings, self.context.fps))
        return {
            "vocabulary": str(self._vocabulary),
            "settings_file": str(path),
            "sensor": self.sensor,
        }


class OrbSlam3(OrbSlam3Program, FinalizingProgramTracker):
    """RGB-D mode: online poses are its answers at each frame, final ones what it saves at the end."""

    sensor = "RGBD"


class OrbSlam3Monocular(OrbSlam3Program):
    """Monocular mode, which saves no poses of frames at the end; it gets no depth."""

    sensor = "MONOCULAR"


def check_camera(camera: Camera, settings: OrbSlam3Settings) -> None:
    """Refuse cameras with which ORB-SLAM3 crashes or returns meaningless poses.

    Raises:
        TrackerError: Another camera model, intrinsics that are none, or an image too small for the
            pyramid.
    """
    # the camera model: a pinhole with five coefficients
    if type(camera) is not Camera or len(camera.distortion) != 5:
        raise TrackerError(
            f"orbslam3 cannot take a {type(camera).__name__} with {len(camera.distortion)} distortion coefficients",
            "its RGB-D mode knows the pinhole camera with k1 k2 p1 p2 k3 only; undistort the images",
        )

    # intrinsics that are finite and positive
    values = (camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline_m, *camera.distortion)
    if (
        not all(math.isfinite(value) for value in values)
        or min(camera.fx, camera.fy, camera.baseline_m) <= 0
    ):
        raise TrackerError(
            f"orbslam3 cannot take the camera fx={camera.fx:g} fy={camera.fy:g} cx={camera.cx:g} cy={camera.cy:g} "
            f"baseline={camera.baseline_m:g} m distortion={camera.distortion}",
            "focal lengths and baseline must be positive, all values finite",
        )

    # the pyramid: its smallest level must have pixels inside the border, and no extreme shape
    shrunk = settings.scale_factor ** (settings.levels - 1)
    columns = round(camera.width / shrunk) - 2 * BORDER_PX
    rows = round(camera.height / shrunk) - 2 * BORDER_PX
    pyramid = f"{settings.levels} pyramid levels of {settings.scale_factor:g}"
    size = f"images of {camera.width}x{camera.height} with {pyramid}"
    if min(columns, rows) < 1:
        raise TrackerError(
            f"orbslam3 cannot take {size}: the smallest level has no pixel inside its border of {BORDER_PX}",
            f"each side needs {math.ceil((2 * BORDER_PX + 0.5) * shrunk)} pixels; resize the sequence or lower levels",
        )
    if columns / rows < 0.5:
        raise TrackerError(
            f"orbslam3 cannot take {size}: the smallest level is {rows / columns:.2f} times as high as wide",
            "it crashes above 2; turn the images, or lower levels",
        )


def settings_yaml(
    camera: Camera, settings: OrbSlam3Settings, fps: float, depth_factor: float = 1.0
) -> str:
    """ORB-SLAM3's settings file (format 1.0) for images of this camera; depth comes in metres unless a factor says."""
    k1, k2, p1, p2, k3 = camera.distortion
    numbers = {
        "Camera1.fx": camera.fx,
        "Camera1.fy": camera.fy,
        "Camera1.cx": camera.cx,
        "Camera1.cy": camera.cy,
        "Camera1.k1": k1,
        "Camera1.k2": k2,
        "Camera1.p1": p1,
        "Camera1.p2": p2,
        "Camera1.k3": k3,
        "Stereo.b": camera.baseline_m,
        "Stereo.ThDepth": settings.close_depth_baselines,
        "RGBD.DepthMapFactor": depth_factor,
        "ORBextractor.scaleFactor": settings.scale_factor,
        **{f"Viewer.{key}": value for key, value in _VIEWER},
    }
    integers = {
        "Camera.width": camera.width,
        "Camera.height": camera.height,
        "Camera.fps": max(1, round(fps)),
        "Camera.RGB": 1,
        "ORBextractor.nFeatures": settings.features,
        "ORBextractor.nLevels": settings.levels,
        "ORBextractor.iniThFAST": settings.fast_threshold,
        "ORBextractor.minThFAST": settings.min_fast_threshold,
    }
    lines = ["%YAML:1.0", "---", 'File.version: "1.0"', 'Camera.type: "PinHole"']
    lines += [f"{key}: {real_text(float(value))}" for key, value in numbers.items()]
    lines += [f"{key}: {int(value)}" for key, value in integers.items()]
    return "\n".join(lines) + "\n"
