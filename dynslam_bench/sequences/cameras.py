"""The cameras of the public data sets, and ``camera.toml`` files."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from dynslam_bench.core import SequenceError, SettingsError, read_toml, write_atomic
from dynslam_bench.core.settings import Settings, build
from dynslam_bench.geometry import Camera
from dynslam_bench.geometry.rigs import BONN_R_BODY_CAM

CAMERA_FILE = "camera.toml"

_WILD_SLAM_DISTORTION = (
    -0.0550149604678154,
    0.06560786068439484,
    -0.0005061274860054255,
    0.0004771310486830771,
    -0.021717390045523643,
)
"""Of both of Wild-SLAM's cameras, as its authors' configurations state it."""

PRIMESENSE_READOUT_S = 0.026
"""Of the Kinect and the Xtion, whose colour cameras have rolling shutters; measured, not published with the sequences.

Of 0, 13, 20, 26 and 33 ms it has the least error, or within 2 % of it, on excerpts of fr1_xyz, fr1_rpy and Bonn crowd
(``docs/results/recordings.md``)."""

CAMERAS: dict[str, Camera] = {
    # Calibration of the colour cameras as published with the TUM RGB-D benchmark.
    "tum-fr1": Camera(
        640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633), readout_s=PRIMESENSE_READOUT_S
    ),
    "tum-fr2": Camera(
        640,
        480,
        520.9,
        521.0,
        325.1,
        249.7,
        (0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
        readout_s=PRIMESENSE_READOUT_S,
    ),
    "tum-fr3": Camera(
        640, 480, 535.4, 539.2, 320.1, 247.6, readout_s=PRIMESENSE_READOUT_S
    ),  # images are undistorted already
    # Calibration published with the Bonn RGB-D Dynamic Dataset.
    "bonn": Camera(
        640,
        480,
        542.822841,
        542.576870,
        315.593520,
        237.756098,
        (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
        readout_s=PRIMESENSE_READOUT_S,
    ),
    # Wild-SLAM MoCap, as its authors' configurations state them.
    "wild-slam": Camera(
        1280,
        720,
        647.2167358398438,
        646.4154663085938,
        643.1209716796875,
        365.55963134765625,
        _WILD_SLAM_DISTORTION,
    ),
    "wild-slam-anymal": Camera(
        1280,
        720,
        647.7445068359375,
        646.9425659179688,
        643.1209716796875,
        365.55963134765625,
        _WILD_SLAM_DISTORTION,
    ),
}

MARKER_TO_CAMERA = {"bonn": BONN_R_BODY_CAM}
"""Rotation from the camera's axes to those of the body whose poses the ground truth holds, where they differ.

Bonn's ground truth is that of the markers on the camera. The lever arm of 2 cm is left out: positions stay those of the
file, to which published errors refer; the protocol ``bonn-camera/v1`` takes it into account."""

PUBLISHED_PREFIXES = {
    "rgbd_dataset_freiburg1_": "tum-fr1",
    "rgbd_dataset_freiburg2_": "tum-fr2",
    "rgbd_dataset_freiburg3_": "tum-fr3",
    "rgbd_bonn_": "bonn",
}

Positive = Annotated[float, Field(gt=0)]


class CameraFile(Settings):
    """The contents of a ``camera.toml``: a known camera by `name`, or the intrinsics themselves."""

    name: str | None = Field(default=None, description="a known camera, in place of intrinsics")
    width: Annotated[int, Field(ge=1)] | None = Field(default=None, description="image width in pixels")
    height: Annotated[int, Field(ge=1)] | None = Field(default=None, description="image height in pixels")
    fx: Positive | None = Field(default=None, description="focal length along x in pixels")
    fy: Positive | None = Field(default=None, description="focal length along y in pixels")
    cx: float | None = Field(default=None, description="principal point x in pixels")
    cy: float | None = Field(default=None, description="principal point y in pixels")
    distortion: tuple[float, float, float, float, float] = Field(
        default=(0.0, 0.0, 0.0, 0.0, 0.0), description="radial-tangential k1, k2, p1, p2, k3"
    )
    depth_factor: Positive = Field(default=5000.0, description="raw depth units a metre")
    baseline_m: Positive = Field(default=0.075, description="baseline of the (virtual) stereo pair in metres")
    readout_s: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0, description="seconds between the first row's exposure and the last one's; 0 = global shutter"
    )
    depth_delay_s: Annotated[float, Field(ge=-1, le=1)] = Field(
        default=0.0, description="seconds by which depth images are exposed later than their stamps say"
    )
    fps: Positive | None = Field(default=None, description="nominal frame rate in Hz")

    def camera(self) -> Camera:
        """The camera that the file describes.

        Raises:
            SequenceError: It names a camera that is not known.
        """
        return known_camera(self.name) if self.name is not None else Camera(**self.model_dump(exclude={"name", "fps"}))


def known_camera(name: str) -> Camera:
    """A camera by name.

    Raises:
        SequenceError: Unknown name; lists the known ones.
    """
    if name not in CAMERAS:
        raise SequenceError(f"unknown camera '{name}'", f"one of {', '.join(CAMERAS)}, or a camera.toml file")
    return CAMERAS[name]


def read_camera(path: Path) -> CameraFile:
    """Read a ``camera.toml``.

    Raises:
        SequenceError: The file cannot be read, or holds something else than a camera.
    """
    try:
        file = build(CameraFile, read_toml(path))
    except SettingsError as error:
        raise SequenceError(f"{path}: {error.args[0]}", error.hint) from None
    missing = [key for key in ("width", "height", "fx", "fy", "cx", "cy") if getattr(file, key) is None]
    if file.name is None and missing:
        raise SequenceError(f"{path} lacks {', '.join(missing)}", f"or name = one of {', '.join(CAMERAS)}")
    return file


def write_camera(path: Path, camera: Camera, *, fps: float | None = None) -> None:
    """Write a ``camera.toml`` that `read_camera` reads back exactly.

    Raises:
        DynslamError: The folder cannot be written.
    """
    lines = [f"width = {int(camera.width)}", f"height = {int(camera.height)}"]
    keys = ("fx", "fy", "cx", "cy", "depth_factor", "baseline_m", "readout_s", "depth_delay_s")
    lines += [f"{key} = {float(getattr(camera, key))!r}" for key in keys]
    lines += [f"distortion = {[float(value) for value in camera.distortion]}"]
    lines += [] if fps is None else [f"fps = {float(fps)!r}"]
    write_atomic(path, "\n".join(lines) + "\n")


def chosen_camera(folder: Path, choice: str | Path | Camera | None = None) -> tuple[Camera, float | None] | None:
    """The camera that the user chose, and the frame rate that a ``camera.toml`` states; None where nothing is chosen.

    Args:
        folder: A sequence's folder.
        choice: A camera, a known camera's name or a ``camera.toml``; it wins over a ``camera.toml`` inside the folder.

    Raises:
        SequenceError: The choice is not understood.
    """
    if isinstance(choice, Camera):
        return choice, None
    if choice is None and not (folder / CAMERA_FILE).is_file():
        return None
    path = folder / CAMERA_FILE if choice is None else Path(choice).expanduser()
    if str(choice) in CAMERAS or (path.suffix.lower() != ".toml" and not path.is_file()):
        return known_camera(str(choice)), None
    file = read_camera(path)
    return file.camera(), file.fps


def find_camera(
    folder: Path, *, stated: Camera | None = None, otherwise: str | None = None
) -> tuple[Camera, float | None]:
    """The camera of a folder for which none was chosen (`chosen_camera`), and its nominal frame rate where it is known.

    Args:
        folder: A sequence's folder.
        stated: What the folder's own calibration says; it wins over what its published name implies.
        otherwise: Name of the camera if nothing else states it, from the catalogue.

    Raises:
        SequenceError: Nothing states the camera.
    """
    if stated is not None:
        return stated, None
    name = folder.resolve().name
    for prefix, camera in PUBLISHED_PREFIXES.items():
        if name.startswith(prefix):
            return CAMERAS[camera], 30.0
    if otherwise:
        return CAMERAS[otherwise], None
    raise SequenceError(
        f"the camera of {folder} is not known: there is no {CAMERA_FILE} inside, and '{name}' is no published name",
        options=(
            f"a published camera: --camera {'|'.join(CAMERAS)}",
            f"another one: --camera FILE.toml, or that file as {CAMERA_FILE} in the folder",
        ),
    )
