"""The cameras of the public data sets, ``camera.toml`` files, and which camera a folder has."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from dynslam_bench.core import SequenceError, SettingsError, read_toml, write_atomic
from dynslam_bench.core.images import read_image
from dynslam_bench.core.settings import Settings, build
from dynslam_bench.geometry import Camera
from dynslam_bench.geometry.camera import TUM_DEPTH_FACTOR
from dynslam_bench.geometry.rigs import BONN_R_BODY_CAM, nearest_rotation
from dynslam_bench.sequences.readers.files import MILLIMETRES, Contents, size_of_first, stated_file

CAMERA_FILE = "camera.toml"
"""Name of the file in a sequence's folder that describes its camera."""

_WILD_SLAM_DISTORTION = (
    -0.0550149604678154,
    0.06560786068439484,
    -0.0005061274860054255,
    0.0004771310486830771,
    -0.021717390045523643,
)
"""Distortion of both of Wild-SLAM's cameras, as its authors' configurations state it."""

PRIMESENSE_READOUT_S = 0.026
"""Readout time of the Kinect and the Xtion, which have rolling shutters; measured, not published with the sequences.

Of 0, 13, 20, 26 and 33 ms it has the least error, or within 2 % of it, on excerpts of fr1_xyz,
fr1_rpy and Bonn crowd (``docs/results/recordings.md``).
"""

CAMERAS: dict[str, Camera] = {
    # calibration of the colour cameras as published with the TUM RGB-D benchmark
    "tum-fr1": Camera(
        640,
        480,
        517.3,
        516.5,
        318.6,
        255.3,
        (0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
        depth_factor=TUM_DEPTH_FACTOR,
        readout_s=PRIMESENSE_READOUT_S,
    ),
    "tum-fr2": Camera(
        640,
        480,
        520.9,
        521.0,
        325.1,
        249.7,
        (0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
        depth_factor=TUM_DEPTH_FACTOR,
        readout_s=PRIMESENSE_READOUT_S,
    ),
    # the images of freiburg3 are undistorted already
    "tum-fr3": Camera(
        640,
        480,
        535.4,
        539.2,
        320.1,
        247.6,
        depth_factor=TUM_DEPTH_FACTOR,
        readout_s=PRIMESENSE_READOUT_S,
    ),
    # calibration published with the Bonn RGB-D Dynamic Dataset; its ground truth is that of the
    # markers on the camera. The lever arm of 2 cm is left out: positions stay those of the file, to
    # which published errors refer; the protocol bonn-camera/v1 takes it into account.
    "bonn": Camera(
        640,
        480,
        542.822841,
        542.576870,
        315.593520,
        237.756098,
        (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
        depth_factor=TUM_DEPTH_FACTOR,
        readout_s=PRIMESENSE_READOUT_S,
        R_body_cam=BONN_R_BODY_CAM,
    ),
    # Wild-SLAM MoCap, as its authors' configurations state them
    "wild-slam": Camera(
        1280,
        720,
        647.2167358398438,
        646.4154663085938,
        643.1209716796875,
        365.55963134765625,
        _WILD_SLAM_DISTORTION,
        depth_factor=TUM_DEPTH_FACTOR,
    ),
    "wild-slam-anymal": Camera(
        1280,
        720,
        647.7445068359375,
        646.9425659179688,
        643.1209716796875,
        365.55963134765625,
        _WILD_SLAM_DISTORTION,
        depth_factor=TUM_DEPTH_FACTOR,
    ),
}

PUBLISHED_PREFIXES = {
    "rgbd_dataset_freiburg1_": "tum-fr1",
    "rgbd_dataset_freiburg2_": "tum-fr2",
    "rgbd_dataset_freiburg3_": "tum-fr3",
    "rgbd_bonn_": "bonn",
}
"""Beginnings of folder names of the public data sets, and the camera that all sequences of that name have."""


class CameraError(SequenceError):
    """The camera of a recording is not known, or nothing says how many raw units of its depth make a metre."""


# Files.

INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")
"""Keys of a `camera.toml` that a camera cannot be without."""

Positive = Annotated[float, Field(gt=0)]
_Row = tuple[float, float, float]


class CameraFile(Settings):
    """The contents of a ``camera.toml``: the intrinsics, or a known camera by `name`, which other keys change."""

    name: str | None = Field(
        default=None, description="a known camera; what else the file states replaces its values"
    )
    width: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="image width in pixels"
    )
    height: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="image height in pixels"
    )
    fx: Positive | None = Field(default=None, description="focal length along x in pixels")
    fy: Positive | None = Field(default=None, description="focal length along y in pixels")
    cx: float | None = Field(default=None, description="principal point x in pixels")
    cy: float | None = Field(default=None, description="principal point y in pixels")
    distortion: tuple[float, float, float, float, float] = Field(
        default=(0.0, 0.0, 0.0, 0.0, 0.0), description="radial-tangential k1, k2, p1, p2, k3"
    )
    depth_factor: Positive | None = Field(
        default=None, description="raw depth units a metre; needed by depth images"
    )
    baseline_m: Positive = Field(
        default=0.075, description="baseline of the (virtual) stereo pair in metres"
    )
    readout_s: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0,
        description="seconds between the first row's exposure and the last one's; 0 = global shutter",
    )
    depth_delay_s: Annotated[float, Field(ge=-1, le=1)] = Field(
        default=0.0,
        description="seconds by which depth images are exposed later than their stamps say",
    )
    R_body_cam: tuple[_Row, _Row, _Row] | None = Field(
        default=None,
        description="rotation from the camera's axes to those of the body whose poses groundtruth.txt holds",
    )
    fps: Annotated[float, Field(ge=0.01, le=10_000)] | None = Field(
        default=None, description="nominal frame rate in Hz"
    )

    def camera(self, base: Camera | None = None) -> Camera:
        """The camera that the file describes.

        Args:
            base: What the folder says of its camera, for a file that states no intrinsics.

        Raises:
            SequenceError: It names a camera that is not known, or intrinsics are missing.
        """
        # a known camera, of which the file changes some values
        stated = {key: getattr(self, key) for key in self.model_fields_set - {"name", "fps"}}
        if self.name is not None:
            return replace(known_camera(self.name), **stated)

        # all intrinsics by the file, or all by the folder
        missing = [key for key in INTRINSICS if stated.get(key) is None]
        if not missing:
            return Camera(**stated)
        if base is None or len(missing) < len(INTRINSICS):
            raise CameraError(
                f"the camera lacks {', '.join(missing)}", f"or name = one of {', '.join(CAMERAS)}"
            )
        return replace(base, **stated)


def known_camera(name: str) -> Camera:
    """A camera by name.

    Raises:
        SequenceError: Unknown name; lists the known ones.
    """
    if name not in CAMERAS:
        raise SequenceError(
            f"unknown camera '{name}'", f"one of {', '.join(CAMERAS)}, or a camera.toml file"
        )
    return CAMERAS[name]


def read_camera(path: Path) -> CameraFile:
    """Read a ``camera.toml``.

    Raises:
        SequenceError: The file cannot be read, or holds something else than a camera.
    """
    try:
        return build(CameraFile, read_toml(path))
    except SettingsError as error:
        raise SequenceError(f"{path}: {error.args[0]}", error.hint) from None


def write_camera(path: Path, camera: Camera, *, fps: float | None = None) -> None:
    """Write a ``camera.toml`` that `read_camera` reads back exactly, with everything that belongs to the camera.

    With `R_body_cam`, the ``groundtruth.txt`` beside it has to hold the poses of the body.

    Raises:
        DynslamError: The folder cannot be written.
    """
    lines = [f"width = {int(camera.width)}", f"height = {int(camera.height)}"]
    keys = ("fx", "fy", "cx", "cy", "depth_factor", "baseline_m", "readout_s", "depth_delay_s")
    values = {key: getattr(camera, key) for key in keys}
    lines += [f"{key} = {float(value)!r}" for key, value in values.items() if value is not None]
    lines += [f"distortion = {[float(value) for value in camera.distortion]}"]
    if camera.R_body_cam is not None:
        rows = [[float(value) for value in row] for row in camera.R_body_cam]
        lines += ["# from the camera's axes to those of the body whose poses groundtruth.txt holds"]
        lines += [f"R_body_cam = {rows}"]
    lines += [] if fps is None else [f"fps = {float(fps)!r}"]
    write_atomic(path, "\n".join(lines) + "\n")


# Which camera a folder has.


@dataclass(frozen=True)
class ChosenCamera:
    """The camera that the user chose or wrote.

    Attributes:
        stated: The camera, or the file that describes it.
        source: The file's path, or words, for messages.
    """

    stated: Camera | CameraFile
    source: str

    @property
    def fps(self) -> float | None:
        """The frame rate in Hz that a file states."""
        return self.stated.fps if isinstance(self.stated, CameraFile) else None

    def camera(self, base: Camera | None) -> Camera:
        """The camera, see `CameraFile.camera`.

        Raises:
            SequenceError: The file names an unknown camera, or lacks intrinsics.
        """
        if isinstance(self.stated, Camera):
            return self.stated
        try:
            return self.stated.camera(base)
        except SequenceError as error:
            raise type(error)(f"{self.source}: {error.args[0]}", error.hint) from None


def chosen_camera(folder: Path, choice: str | Path | Camera | None = None) -> ChosenCamera | None:
    """The camera that the user chose; None where nothing is chosen.

    Args:
        folder: A sequence's folder.
        choice: A camera, a known camera's name or a ``camera.toml``; it wins over a ``camera.toml``
            inside the folder.

    Raises:
        SequenceError: The choice is not understood.
    """
    if isinstance(choice, Camera):
        return ChosenCamera(choice, "the camera that was given")
    if choice is None:
        # the file in the folder
        inside = stated_file(folder, CAMERA_FILE)
        return None if inside is None else ChosenCamera(read_camera(inside), str(inside))

    # a name, or the path of a file
    path = Path(choice).expanduser()
    if str(choice) in CAMERAS or (path.suffix.lower() != ".toml" and not path.is_file()):
        return ChosenCamera(known_camera(str(choice)), f"camera {choice}")
    return ChosenCamera(read_camera(path), str(path))


def camera_by_name(folder: Path) -> str | None:
    """Name of the camera of the public data set after which a folder is named; None for any other name."""
    name = folder.resolve().name
    return next(
        (camera for prefix, camera in PUBLISHED_PREFIXES.items() if name.startswith(prefix)), None
    )


def camera_of(
    folder: Path,
    contents: Contents,
    chosen: ChosenCamera | None,
    catalogued: str = "",
    *,
    lacks_rate: bool = False,
) -> Camera:
    """The camera of a folder, complete and plausible: what was chosen, else what files say, else what the name implies.

    What belongs to the recording and not to the lens comes from the recording where the chosen
    camera does not state it: the depth factor from the folder's own calibration, `R_body_cam` from
    the data set of the folder's name.

    Args:
        folder: A sequence's folder.
        contents: What its reader found in it.
        chosen: What the user chose.
        catalogued: Name of the camera that the catalogue states; empty where it does not.
        lacks_rate: Whether nothing states a frame rate that the images need: the camera file of the
            error asks for it.

    Returns:
        The camera. Its `R_body_cam` is the rotation that the ground truth needs, None where it
        needs none.

    Raises:
        CameraError: Nothing states the camera, or the depth factor that its depth images need. The
            error brings a ``camera.toml`` to copy.
        SequenceError: It has values that nobody could mean.
    """
    # what was chosen, else what the folder's files state, else what its name implies
    named = catalogued or camera_by_name(folder)
    of_dataset = CAMERAS[named] if named else None
    base = contents.camera or of_dataset
    try:
        camera = base if chosen is None else chosen.camera(base)
    except CameraError as error:
        raise CameraError(
            str(error.args[0]), error.hint, template=_template(folder, contents, chosen)
        ) from None
    if camera is None:
        raise CameraError(
            f"the camera of {folder} is not known: there is no {CAMERA_FILE} inside, and '{folder.resolve().name}' is "
            "no published name",
            options=(
                f"a published camera: --camera {'|'.join(CAMERAS)}",
                f"another one: --camera FILE.toml, or that file as {CAMERA_FILE} in the folder",
            ),
            template=_template(folder, contents, None, lacks_rate=lacks_rate),
        )

    # what belongs to the recording and not to the lens
    if camera.depth_factor is None and contents.camera is not None:
        camera = replace(camera, depth_factor=contents.camera.depth_factor)
    if camera.R_body_cam is None and of_dataset is not None:
        camera = replace(camera, R_body_cam=of_dataset.R_body_cam)
    if not contents.truth_of_body:
        camera = replace(camera, R_body_cam=None)
    check_camera(camera, f"the camera of {folder}" if chosen is None else chosen.source)

    # images of raw numbers need a unit; arrays hold metres
    if camera.depth_factor is None and any(
        not file.endswith(".npy") for file in contents.depth.files
    ):
        where = f"{CAMERA_FILE} in the folder" if chosen is None else chosen.source
        raise CameraError(
            f"the depth images of {folder} hold raw numbers, and nothing says how many make a metre: {where} has no "
            "depth_factor",
            _how_to_tell(folder, contents),
            template=_template(folder, contents, chosen, camera),
        )
    return camera


# A camera.toml to copy, with what the images tell.


def _how_to_tell(folder: Path, contents: Contents) -> str:
    """The two usual depth factors with the distances that they give, for a hint."""
    median = _median_raw_depth(folder, contents)
    millimetres = f"depth_factor = {MILLIMETRES} (millimetres)"
    of_tum = f"depth_factor = {TUM_DEPTH_FACTOR} (TUM's files)"
    if median is None:
        return f"usual are {millimetres} and {of_tum}"
    return (
        f"write {millimetres} if the scene is {median / MILLIMETRES:.3g} m away by the median of the first image, "
        f"{of_tum} if it is {median / TUM_DEPTH_FACTOR:.3g} m"
    )


def _median_raw_depth(folder: Path, contents: Contents) -> float | None:
    """Median raw value of the first depth image's measured pixels; None where it holds none or cannot be read."""
    with suppress(SequenceError):
        raw = read_image(folder / contents.depth.files[0], kind=SequenceError)
        measured = raw[raw > 0]
        if len(measured):
            return float(np.median(measured))
    return None


def _template(
    folder: Path,
    contents: Contents,
    chosen: ChosenCamera | None,
    camera: Camera | None = None,
    *,
    lacks_rate: bool = False,
) -> str:
    """A ``camera.toml`` that is complete but for what nobody knows: left empty, with a remark what belongs there."""
    # what the images, the chosen file and the camera tell
    stated: dict[str, Any] = {}
    with suppress(SequenceError):
        stated["width"], stated["height"] = size_of_first(folder, contents.colour)
    if chosen is not None and isinstance(chosen.stated, CameraFile):
        stated |= chosen.stated.model_dump(include=set(INTRINSICS), exclude_none=True)
    distortion = [0.0] * 5
    if camera is not None:
        stated |= {key: getattr(camera, key) for key in INTRINSICS}
        distortion = [float(value) for value in camera.distortion]

    # intrinsics, empty where nothing tells them
    remarks = {
        "width": "of the colour images, in pixels",
        "height": "",
        "fx": "focal lengths in pixels, from the camera's calibration",
        "fy": "",
        "cx": "principal point in pixels; the centre of the top-left pixel is 0",
        "cy": "",
    }
    lines = [
        _template_line(f"{key} = {stated.get(key, '')}", remark) for key, remark in remarks.items()
    ]
    lines.append(_template_line(f"distortion = {distortion}", "k1, k2, p1, p2, k3"))

    # the two usual depth factors, with the distance that each one gives
    median = _median_raw_depth(folder, contents)
    lines.append(
        "# raw depth units a metre: keep the line whose distance is that of the scene, without its first #"
    )
    remark_of_factor = {
        MILLIMETRES: "millimetres, as most cameras write them",
        TUM_DEPTH_FACTOR: "TUM's files",
    }
    for factor, remark in remark_of_factor.items():
        if median is not None:
            remark += f": the first image's median is {median / factor:.3g} m"
        lines.append(_template_line(f"# depth_factor = {factor}", remark))
    rate = chosen.fps if chosen is not None else contents.fps
    if lacks_rate:
        lines.append(_template_line("fps =", "images a second: their names are numbers"))
    elif rate is not None:
        lines.append(f"fps = {rate}")
    return "\n".join(lines)


def _template_line(text: str, remark: str) -> str:
    """A line of a `camera.toml`, with a remark behind it."""
    return f"{text:28}  # {remark}" if remark else text.rstrip()


# Values that nobody could mean.

_FOCAL_LENGTHS = (0.02, 100.0)
"""In units of the image's size: fields of view of 175 and 0.6 degrees."""
_DEPTH_FACTORS = (1.0, 655_350.0)
"""A raw unit is a metre; 65535 raw units, the most that 16 bits hold, are 0.1 m."""
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
"""Radial (k) and tangential (p) distortion, in OpenCV's order."""
_BASELINES_M = (0.001, 10.0)
"""Baselines of stereo pairs, metres."""
_LONGEST_S = 1.0
"""Longest readout time and delay of depth: slower than any camera."""
_MOST_FOLDED = 0.05
"""Share of the pixels that a distortion may send to a wrong place: calibrations are often poor in the corners."""
_FOLDED_PX = 1.0
"""A pixel that comes back farther than this from its place was sent to a wrong one."""
_LEAST_DRAWN = 0.5
"""Least share of its distance from the centre at which an undistorted corner lies; 0.9 of lenses with a pincushion."""


def check_camera(camera: Camera, where: str) -> None:
    """Refuse a camera with values that nobody could mean.

    Args:
        camera: The camera.
        where: What states it, for the message.

    Raises:
        SequenceError: Names the first such value, with the number and what is expected.
    """
    for fault in _faults(camera):
        raise SequenceError(
            f"{where}: {fault}", "write the camera's calibration, see docs/how-to/recording.md"
        )


def _faults(camera: Camera) -> Iterator[str]:
    """Faults of a camera, one phrase each; later ones take for granted that earlier ones are none."""
    if len(camera.distortion) != len(_COEFFICIENTS):
        yield f"distortion has {len(camera.distortion)} coefficients, expected {', '.join(_COEFFICIENTS)}"

    # all numbers are finite
    names = (*INTRINSICS, "baseline_m", "readout_s", "depth_delay_s")
    numbers: dict[str, float] = {name: getattr(camera, name) for name in names}
    numbers |= zip(_COEFFICIENTS, camera.distortion, strict=True)
    for name, value in numbers.items():
        if not np.isfinite(value):
            yield f"{name} is {value}, expected a finite number"

    # intrinsics lie in the ranges of real lenses
    if min(camera.width, camera.height) < 1:
        yield f"an image of {camera.width} x {camera.height} pixels"
    for name, size in (("fx", camera.width), ("fy", camera.height)):
        low, high = (share * size for share in _FOCAL_LENGTHS)
        if not low <= numbers[name] <= high:
            yield f"the focal length {name} is {numbers[name]:g} px in {size} px of image, expected {low:g} to {high:g}"
    for name, size in (("cx", camera.width), ("cy", camera.height)):
        if not 0 <= numbers[name] <= size:
            yield f"the principal point's {name} is {numbers[name]:g} px, outside of the image's {size} px"

    # depth, baseline and times
    low, high = _DEPTH_FACTORS
    if camera.depth_factor is not None and not low <= camera.depth_factor <= high:
        yield f"depth_factor is {camera.depth_factor:g} raw units a metre, expected {low:g} to {high:g}"
    low, high = _BASELINES_M
    if not low <= camera.baseline_m <= high:
        yield f"baseline_m is {camera.baseline_m:g} m, expected {low:g} to {high:g}"
    if not 0 <= camera.readout_s <= _LONGEST_S:
        yield f"readout_s is {camera.readout_s:g} s, expected 0 to {_LONGEST_S:g}"
    if abs(camera.depth_delay_s) > _LONGEST_S:
        yield f"depth_delay_s is {camera.depth_delay_s:g} s, expected at most {_LONGEST_S:g} either way"

    # the rotation is one, and the distortion can be undone
    if camera.R_body_cam is not None and not _is_rotation(camera.R_body_cam):
        yield f"R_body_cam is no rotation: {[list(row) for row in camera.R_body_cam]}"
    folded = _folded_share(camera)
    if folded > _MOST_FOLDED:
        yield (
            f"the distortion {list(camera.distortion)} folds the image: {100 * folded:.0f} % of its pixels do not come "
            "back when they are undistorted and distorted again"
        )
    drawn = _corner_drawn_to(camera)
    if drawn < _LEAST_DRAWN:
        yield (
            f"the distortion {list(camera.distortion)} draws a corner of the image to {drawn:.2g} of its distance from "
            f"the centre, expected {_LEAST_DRAWN:g} or more"
        )


def _is_rotation(rows: tuple[tuple[float, float, float], ...]) -> bool:
    """Whether rows are a rotation, up to the rounding of published ones."""
    matrix = np.array(rows, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return False
    rotation = nearest_rotation(matrix)
    return bool(np.abs(rotation - matrix).max() < 0.01 and np.linalg.det(rotation) > 0)


def _corner_drawn_to(camera: Camera) -> float:
    """Distance from the centre of the farthest corner when it is undistorted, as a share of that before."""
    right = camera.width - 1
    bottom = camera.height - 1
    corners = np.array([[0, 0], [right, 0], [0, bottom], [right, bottom]], dtype=np.float64)
    centre = np.array([camera.cx, camera.cy])
    focal_lengths = np.array([camera.fx, camera.fy])
    distances = np.linalg.norm((corners - centre) / focal_lengths, axis=1)
    farthest = int(distances.argmax())
    undistorted = camera.undistort_points(corners[farthest : farthest + 1])
    drawn = np.linalg.norm((undistorted[0] - centre) / focal_lengths)
    return float(drawn / distances[farthest])


def _folded_share(camera: Camera) -> float:
    """Share of the image's pixels, on a grid, that do not come back when they are undistorted and distorted again."""
    columns = np.linspace(0, camera.width - 1, 21)
    rows = np.linspace(0, camera.height - 1, 21)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    with np.errstate(over="ignore", invalid="ignore"):
        again = camera.distort_points(camera.undistort_points(pixels))
        error = np.linalg.norm(again - pixels, axis=1)
    return float(np.mean(~(error < _FOLDED_PX)))
