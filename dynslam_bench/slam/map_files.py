"""Files of a map: ``map.npz``, from which a later run starts, ``keyframes.csv`` and ``map.ply``.

``map.npz`` holds arrays and nothing else, which are checked before they are used. Keyframes and
points are stored without gaps, oldest first, and refer to each other by row. Which frames of which
recording the keyframes were is left out: in another one it means nothing. `docs/reference/files.md`
says how maps are used.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from dynslam_bench.contracts.tracker import MapOutputs
from dynslam_bench.core import DynslamError, RunError, SettingsError, TrackerError, write_atomic
from dynslam_bench.core.reading import MOST_BYTES, TABLE_BYTES, read_bytes, read_npz
from dynslam_bench.core.records import Record, schema
from dynslam_bench.geometry import Camera, feature_scale, format_ns, ns_of, se3

MAP_FILE = "map.npz"
"""Name of a run's saved map."""
MAP_SCHEMA = 1
"""Version of its layout."""
HEADER = "header"
"""Name of the array that holds the header's JSON text."""
ARRAY_HEADER_BYTES = 256
"""Most bytes that numpy writes before an array."""
MAKE_ONE = "a map is made by: run --save-map"
"""Cure where a file is no map."""

Sensors = Literal["rgbd", "rgb"]
Arrays = Mapping[str, NDArray[Any]]

KEYFRAME_ARRAYS = {
    "kf_id": ("i8", "S"),
    "kf_map": ("i8", "S"),
    "kf_pose": ("f8", "S44"),
    "kf_count": ("i8", "S"),
}
"""Type and shape of what is stored for each keyframe; S keyframes."""
FEATURE_ARRAYS = {
    "kf_raw": ("f4", "F2"),
    "kf_response": ("f4", "F"),
    "kf_xy": ("f8", "F2"),
    "kf_right": ("f8", "F"),
    "kf_z": ("f4", "F"),
    "kf_octave": ("i1", "F"),
    "kf_angle": ("f4", "F"),
    "kf_info": ("f8", "F"),
    "kf_info_right": ("f8", "F"),
    "kf_words": ("u8", "FW"),
}
"""Type and shape of what is stored for each feature, one keyframe after the other.

F features of all keyframes, W words of 64 bits a descriptor.
"""
POINT_ARRAYS = {
    "id": ("i8", "P"),
    "position": ("f8", "P3"),
    "normal": ("f8", "P3"),
    "far": ("f8", "P"),
    "words": ("u8", "PW"),
    "rgb": ("u1", "P3"),
    "visible": ("i4", "P"),
    "found": ("i4", "P"),
    "born": ("i8", "P"),
    "n_obs": ("i4", "P"),
}
"""Type and shape of what is stored for each point; P points."""
OBSERVATION_ARRAYS = {"obs_kf": ("i4", "O"), "obs_ft": ("i4", "O")}
"""Type and shape of what is stored for each observation, one point after the other; O observations.

Row of the keyframe, and which of its features.
"""
SUBMAP_ARRAYS = {
    "submap_start": ("f8", "I3"),
    "submap_anchor": ("f8", "I3"),
    "submap_bound": ("f8", "I"),
}
"""Type and shape of what is stored for each submap that was not merged (`Atlas`); I submaps."""
_LAYOUT = KEYFRAME_ARRAYS | FEATURE_ARRAYS | POINT_ARRAYS | OBSERVATION_ARRAYS | SUBMAP_ARRAYS
"""All arrays of a file."""


MAX_TABLE_BYTES = 1 << 30
"""Bytes of all features of a map as tables, at most; two thousand keyframes of a thousand features fill a fifth."""
MAX_WORDS = 64
"""Words of 64 bits of a descriptor, at most; ORB's has four."""
FEATURE_BYTES = 64
"""Bytes of a feature without its descriptor in the tables of a map, about."""
OBSERVATION_BYTES = 8
"""Bytes of an observation in the tables of a map."""


class MapFeatures(Record):
    """The features that a map is made of; only the same are found in it.

    Attributes:
        extractor: Id of the extractor.
        levels: Levels of its image pyramid.
        scale_factor: Ratio of consecutive levels.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    extractor: str
    levels: int = Field(ge=1, le=64)
    scale_factor: float = Field(ge=1, le=100)

    def scales(self, width: int) -> NDArray[np.float64]:
        """Pixels of an image of a width in a pixel of each level, ``[levels]``."""
        octaves = self.scale_factor ** np.arange(self.levels, dtype=np.float64)
        return np.asarray(feature_scale(width) * octaves)


class MapHeader(Record):
    """Header of a map file.

    Attributes:
        kind: Says that the file is a map.
        schema_version: Version of the file's layout; newer ones are refused.
        sensors: ``rgbd``, or ``rgb`` for a map whose unit of length is its own.
        camera: Intrinsics of the undistorted camera, see `Camera`.
        features: What it is made of.
        next_keyframe: Number of the next keyframe.
        next_point: Number of the next point.
        made_by: Which run made it, in words.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["dynslam-bench map"] = "dynslam-bench map"
    schema_version: int = schema(MAP_SCHEMA)
    sensors: Sensors
    camera: dict[str, float]
    features: MapFeatures
    next_keyframe: int = Field(ge=1, lt=2**62)
    next_point: int = Field(ge=0, lt=2**62)
    made_by: str = Field("", max_length=1000)


@dataclass(frozen=True, eq=False)
class SavedMap:
    """The content of a map file.

    Attributes:
        header: Where it comes from.
        arrays: Arrays by name, see `KEYFRAME_ARRAYS` and those after it.
    """

    header: MapHeader
    arrays: Arrays

    def check(self, camera: Camera, features: MapFeatures, sensors: Sensors, file: str) -> None:
        """Refuse a map that a system cannot localise in.

        Args:
            camera: The system's.
            features: The kind of features that the system extracts.
            sensors: ``rgbd`` or ``rgb``.
            file: For the message.

        Raises:
            SettingsError: Names what differs.
        """
        # what the map was made with, and what the system has
        header = self.header
        saved: dict[str, Any] = {
            "sensors": header.sensors,
            **header.features.model_dump(),
            **header.camera,
        }
        own = {"sensors": sensors, **features.model_dump(), **described(camera)}
        differing: list[str] = []
        for name, value in own.items():
            if saved.get(name) != value:
                differing.append(f"{name} {saved.get(name)} instead of {value}")
        if differing:
            cure = "localise with the camera, sensors and features that the map was made with"
            raise SettingsError(f"{file} is a map of {', '.join(differing)}", cure)


def described(camera: Camera) -> dict[str, float]:
    """The part of a camera that a map depends on: undistorted intrinsics and baseline."""
    names = ("width", "height", "fx", "fy", "cx", "cy", "baseline_m")
    return {name: float(value) for name, value in asdict(camera).items() if name in names}


def write_map(path: Path, saved: SavedMap) -> None:
    """Write a map; the same map always gives the same bytes.

    Raises:
        TrackerError: The map is too large to be read again.
        DynslamError: The folder cannot be written.
    """
    # what is too large to be read again is not written
    header = np.frombuffer(saved.header.to_json().encode(), np.uint8)
    size = sum(array.nbytes + ARRAY_HEADER_BYTES for array in (header, *saved.arrays.values()))
    if size > MOST_BYTES:
        raise TrackerError(
            f"the map holds {size / 1e6:.0f} MB, at most {MOST_BYTES / 1e6:.0f} are read of such a file",
            "keep fewer keyframes (backend.keyframes.maximum) or features (features.n_features)",
        )

    # one array a table, and the header as text
    data = io.BytesIO()
    np.savez_compressed(data, **{HEADER: header}, **saved.arrays)  # type: ignore[arg-type]
    write_atomic(path, data.getvalue())


def read_map(path: Path) -> SavedMap:
    """Read a map that `write_map` wrote; every index is checked.

    Raises:
        SettingsError: The file cannot be read, is no map, of a newer version, or damaged; names the
            first fault.
    """
    # the header, which says that it is a map
    arrays = read_npz(path, kind=SettingsError)
    if HEADER not in arrays:
        raise SettingsError(f"{path} is no map: it holds no header", MAKE_ONE)
    try:
        text = arrays.pop(HEADER).tobytes().decode()
        header = MapHeader.parse(text, f"{path} (header)")
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path} is no map: its header is no text", MAKE_ONE) from error
    except DynslamError as error:
        raise SettingsError(str(error)) from error

    # refuse arrays that do not fit each other
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    fault = next(_faults(arrays, header), None)
    if fault is not None:
        raise SettingsError(f"{path} is a damaged map: {fault}", MAKE_ONE)
    return SavedMap(header, arrays)


def _faults(arrays: Arrays, header: MapHeader) -> Iterator[str]:
    """Faults of the arrays of a file that anyone may have written: compiled loops check no index.

    Arrays that are missing, unknown, or of another type or shape; indices out of bounds; references
    that contradict each other. Later checks rely on earlier ones. Damage is found by the check sums
    of the zip file.
    """
    # missing and unknown arrays
    for name in sorted(_LAYOUT.keys() ^ arrays.keys()):
        if name in _LAYOUT:
            yield f"it holds no array '{name}'"
        else:
            yield f"it holds an unknown array '{name[:40]}'"
    yield from _layout_faults(arrays)

    # indices out of bounds: the largest value of each table
    largest = {
        "kf_id": header.next_keyframe - 1,
        "born": header.next_keyframe - 1,
        "id": header.next_point - 1,
        "kf_map": len(arrays["submap_bound"]),
        "kf_octave": header.features.levels - 1,
        "kf_count": np.inf,
        "n_obs": np.inf,
        "obs_kf": len(arrays["kf_id"]) - 1,
        "obs_ft": np.inf,
    }
    for name, most in largest.items():
        if not ((arrays[name] >= 0) & (arrays[name] <= most)).all():
            yield f"'{name}' holds values below 0 or above {most}"

    # sizes and references
    yield from _size_faults(arrays)
    yield from _reference_faults(arrays)


def _layout_faults(arrays: Arrays) -> Iterator[str]:
    """Arrays of another type or shape than `_LAYOUT` has; the first array with an axis decides how long it is."""
    sizes: dict[str, int] = {}
    for name, (kind, axes) in _LAYOUT.items():
        array = arrays[name]
        expected: list[int] = []
        for axis, size in zip(axes, array.shape, strict=False):
            expected.append(int(axis) if axis.isdigit() else sizes.setdefault(axis, size))
        if (
            array.dtype != np.dtype(kind)
            or array.ndim != len(axes)
            or list(array.shape) != expected
        ):
            shape = ", ".join(map(str, expected)) + ", ?" * max(len(axes) - array.ndim, 0)
            yield f"'{name}' is {array.dtype} of shape {str(array.shape)[:60]}, expected {np.dtype(kind)} of ({shape})"


def _size_faults(arrays: Arrays) -> Iterator[str]:
    """Values that are not finite, tables that would be too large, and counts that do not add up."""
    # numbers that are computed with
    for name in ("kf_pose", "kf_xy", "kf_z", "position", "normal", "far"):
        if not np.isfinite(arrays[name]).all():
            yield f"'{name}' holds values that are not finite"

    # descriptors no longer than the matcher reads
    words = max(arrays["kf_words"].shape[1], arrays["words"].shape[1])
    if words > MAX_WORDS:
        yield f"a descriptor has {words} words of 64 bits, at most {MAX_WORDS} are read"

    # a keyframe at least, and an observation of each point
    count = arrays["kf_count"]
    n_obs = arrays["n_obs"].astype(np.int64)
    if not (len(count) and n_obs.all()):
        yield "it holds no keyframe, or a point that none observes"

    # features a keyframe and observations a point: the counts, bytes of one, how many the file holds
    for name, counts, size, held in (
        ("kf_count", count, FEATURE_BYTES + 8 * words, len(arrays["kf_xy"])),
        ("n_obs", n_obs, OBSERVATION_BYTES, len(arrays["obs_kf"])),
    ):
        # as tables, as wide as the longest row
        claimed = len(counts) * int(counts.max(initial=0)) * size
        if claimed > MAX_TABLE_BYTES:
            yield f"'{name}' claims tables of {claimed} bytes, more than {MAX_TABLE_BYTES}"
        if int(counts.sum()) != held:
            yield f"'{name}' does not add up to {held}"


def _reference_faults(arrays: Arrays) -> Iterator[str]:
    """Observations by features that do not exist, or that contradict each other."""
    count = arrays["kf_count"]
    n_obs = arrays["n_obs"].astype(np.int64)
    keyframe = arrays["obs_kf"]
    feature = arrays["obs_ft"]
    if not (feature < count[keyframe]).all():
        yield "'obs_ft' names features that the keyframe does not have"

    # row of each observation among all features, and its point
    row = (np.cumsum(count) - count)[keyframe] + feature
    point = np.repeat(np.arange(len(n_obs)), n_obs)
    if len(np.unique(row)) != len(row):
        yield "a feature observes two points"
    if len(np.unique(point * len(count) + keyframe)) != len(row):
        yield "a keyframe observes a point with two features"


# ---------------------------------------------------------------------- keyframes.csv and map.ply

# one row a point
_PLY_LAYOUT = np.dtype([("position", "<f4", 3), ("colour", "u1", 3), ("observations", "<i4")])


def write_keyframes_csv(
    path: Path, outputs: MapOutputs, exact: Mapping[float, int] | None = None
) -> None:
    """Write ``keyframes.csv``: the fields of `KeyframeRecord`, the pose as tx ty tz and qx qy qz qw.

    The timestamp has nine decimals; `exact` gives the nanoseconds of stamps by their seconds, where
    a float does not hold them. It and the frame are empty for keyframes of an earlier run, in whose
    map this one began.

    Raises:
        DynslamError: The folder cannot be written.
    """
    lines = ["id,frame,timestamp,tx,ty,tz,qx,qy,qz,qw,features,observations,map"]
    for record in outputs.keyframes:
        position_and_quaternion = np.concatenate(se3.to_quaternion(record.T_world_cam))
        pose = (f"{value:.9f}" for value in position_and_quaternion)
        frame: object = ""
        stamp = ""
        if record.frame >= 0:
            frame = record.frame
            stamp = format_ns((exact or {}).get(record.timestamp) or ns_of(record.timestamp))
        cells = (record.id, frame, stamp, *pose, record.features, record.observations, record.map)
        lines.append(",".join(map(str, cells)))
    write_atomic(path, "\n".join([*lines, ""]))


class Cloud(NamedTuple):
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
    """Read a map that `write_ply` wrote.

    Raises:
        RunError: It cannot be read, or is no such file.
    """
    data = read_bytes(path, limit=TABLE_BYTES, kind=RunError)
    # the header tells the number of rows: it has to be the one that this package writes for as many
    head, _, body = data.partition(b"end_header\n")
    rows = len(body) // _PLY_LAYOUT.itemsize
    if head + b"end_header\n" != _ply_header(rows) or len(body) != rows * _PLY_LAYOUT.itemsize:
        raise RunError(
            f"{path} is no map of this package: expected {_PLY_LAYOUT.itemsize} bytes a point, little-endian"
        )
    points = np.frombuffer(body, _PLY_LAYOUT)
    if not np.isfinite(points["position"]).all():
        raise RunError(f"{path} holds points that are not finite")
    return Cloud(*(points[name].copy() for name in ("position", "colour", "observations")))


def _ply_header(rows: int) -> bytes:
    """The header of a PLY file of so many points, which `_PLY_LAYOUT` describes."""
    kinds = {"float": ("x", "y", "z"), "uchar": ("red", "green", "blue"), "int": ("observations",)}
    properties = [f"property {kind} {name}" for kind, names in kinds.items() for name in names]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {rows}",
        *properties,
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode()


def write_ply(path: Path, outputs: MapOutputs) -> None:
    """Write the map points as a binary PLY cloud: float x y z in metres, uchar red green blue, int observations.

    Args:
        path: The file to write.
        outputs: The map.

    Raises:
        DynslamError: The folder cannot be written.
    """
    rows = np.zeros(len(outputs.positions), _PLY_LAYOUT)
    rows["position"] = outputs.positions
    rows["colour"] = outputs.colours
    rows["observations"] = outputs.observations
    write_atomic(path, _ply_header(len(rows)) + rows.tobytes())
