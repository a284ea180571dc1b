"""A map as a file, ``map.npz``, from which a later run starts: arrays and nothing else, checked before they are used.

Keyframes and points are stored without gaps, oldest first, and refer to each other by row. Which frames of which
recording the keyframes were is left out: in another one it means nothing. `docs/backend.md` lists the arrays.
"""

from __future__ import annotations

import io
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from dynslam_bench.core.array_files import MOST_BYTES, read_npz
from dynslam_bench.core.errors import DynslamError, SettingsError, TrackerError
from dynslam_bench.core.records import Record, schema, write_atomic
from dynslam_bench.geometry.camera import Camera

from .saved_map_faults import Arrays, array_faults, content_faults

MAP_FILE = "map.npz"
MAP_SCHEMA = 1
HEADER = "header"
ARRAY_HEADER_BYTES = 256
"""What numpy writes before an array, at most."""
MAKE_ONE = "a map is made by: run --save-map"

Sensors = Literal["rgbd", "rgb"]

KEYFRAME_ARRAYS = {
    "kf_id": ("i8", "S"), "kf_island": ("i8", "S"), "kf_pose": ("f8", "S44"), "kf_count": ("i8", "S"),
}  # fmt: skip
"""Type and shape of what is stored of each keyframe; S keyframes."""
FEATURE_ARRAYS = {
    "kf_raw": ("f4", "F2"), "kf_response": ("f4", "F"), "kf_xy": ("f8", "F2"), "kf_right": ("f8", "F"),
    "kf_z": ("f4", "F"), "kf_octave": ("i1", "F"), "kf_angle": ("f4", "F"), "kf_info": ("f8", "F"),
    "kf_info_right": ("f8", "F"), "kf_words": ("u8", "FW"), "kf_point": ("i4", "F"),
}  # fmt: skip
"""Of each feature of each keyframe, one keyframe after the other; F features, W words of 64 bits a descriptor."""
POINT_ARRAYS = {
    "id": ("i8", "P"), "position": ("f8", "P3"), "normal": ("f8", "P3"), "far": ("f8", "P"), "words": ("u8", "PW"),
    "rgb": ("u1", "P3"), "visible": ("i4", "P"), "found": ("i4", "P"), "born": ("i8", "P"), "n_obs": ("i4", "P"),
}  # fmt: skip
"""Of each point; P points."""
OBSERVATION_ARRAYS = {"obs_kf": ("i4", "O"), "obs_ft": ("i4", "O")}
"""Of each observation, one point after the other: row of the keyframe, and which of its features; O observations."""
ISLAND_ARRAYS = {"island_start": ("f8", "I3"), "island_anchor": ("f8", "I3"), "island_reach": ("f8", "I")}
"""Of each map that never met the first one (`Islands`); I of them."""
_LAYOUT = KEYFRAME_ARRAYS | FEATURE_ARRAYS | POINT_ARRAYS | OBSERVATION_ARRAYS | ISLAND_ARRAYS


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

    @property
    def scales(self) -> NDArray[np.float64]:
        """Scale of each level."""
        return np.asarray(self.scale_factor ** np.arange(self.levels, dtype=np.float64))

    def __str__(self) -> str:
        return f"{self.extractor}, {self.levels} levels of {self.scale_factor:g}"


class MapHeader(Record):
    """What a map says of itself.

    Attributes:
        kind: Says that the file is a map.
        schema_version: Of the file; newer ones are refused.
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
    """A map as it lies in a file.

    Attributes:
        header: What it says of itself.
        arrays: By name, see `KEYFRAME_ARRAYS` and those after it.
    """

    header: MapHeader
    arrays: Arrays

    def check(self, camera: Camera, features: MapFeatures, sensors: Sensors, where: str) -> None:
        """Refuse a map that a system cannot localise in.

        Args:
            camera: The system's.
            features: Those that it extracts.
            sensors: ``rgbd`` or ``rgb``.
            where: The file, for the message.

        Raises:
            SettingsError: Names what differs.
        """
        kinds = {"rgbd": "an RGB-D", "rgb": "a monocular"}
        if self.header.sensors != sensors:
            made, here = kinds[self.header.sensors], kinds[sensors]
            raise SettingsError(f"{where} is {made} map, and this is {here} system", "their units of length differ")
        if self.header.features != features:
            raise SettingsError(
                f"{where} is made of other features ({self.header.features}) than this system's ({features})",
                "set features.* as they were when the map was made",
            )
        own = described(camera)
        odd = [name for name in own if self.header.camera.get(name) != own[name]]
        if odd:
            differs = ", ".join(f"{name} {self.header.camera.get(name)} instead of {own[name]}" for name in odd)
            raise SettingsError(f"{where} was made with another camera: {differs}")


def described(camera: Camera) -> dict[str, float]:
    """What of a camera a map depends on: undistorted intrinsics, and what depth becomes a right coordinate by."""
    names = ("width", "height", "fx", "fy", "cx", "cy", "baseline_m")
    return {name: float(value) for name, value in asdict(camera).items() if name in names}


def write_map(path: Path, saved: SavedMap) -> None:
    """Write a map; the same map always gives the same bytes.

    Raises:
        TrackerError: The map is too large to be read again.
        DynslamError: The folder cannot be written.
    """
    header = np.frombuffer(saved.header.to_json().encode(), np.uint8)
    size = sum(array.nbytes + ARRAY_HEADER_BYTES for array in (header, *saved.arrays.values()))
    if size > MOST_BYTES:
        raise TrackerError(
            f"the map holds {size / 1e6:.0f} MB, at most {MOST_BYTES / 1e6:.0f} are read of such a file",
            "keep fewer keyframes (backend.keyframes.maximum) or features (features.n_features)",
        )
    data = io.BytesIO()
    np.savez_compressed(data, **{HEADER: header}, **saved.arrays)  # type: ignore[arg-type]
    write_atomic(path, data.getvalue())


def read_map(path: Path) -> SavedMap:
    """Read a map that `write_map` wrote; every number that something is looked up by is checked.

    Raises:
        SettingsError: The file cannot be read, is no map, of a newer version, or damaged; names the first fault.
    """
    found = read_npz(path, kind=SettingsError)
    if HEADER not in found:
        raise SettingsError(f"{path} is no map: it holds no header", MAKE_ONE)
    try:
        text = found.pop(HEADER).tobytes().decode()
        header = MapHeader.parse(text, f"{path} (header)")
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path} is no map: its header is no text", MAKE_ONE) from error
    except DynslamError as error:
        raise SettingsError(str(error)) from error
    arrays = {name: np.ascontiguousarray(array) for name, array in found.items()}
    numbers = header.next_keyframe, header.next_point, header.features.levels
    for fault in chain(array_faults(arrays, _LAYOUT), content_faults(arrays, *numbers)):  # basic ones first
        raise SettingsError(f"{path} is a damaged map: {fault}", MAKE_ONE)
    return SavedMap(header, arrays)
