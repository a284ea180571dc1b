"""Every layout of recorded sequences that is read, and which one a folder has.

A new layout is a function ``read(folder, fps) -> Contents`` and a row of `LAYOUTS`
(``docs/how-to/dataset.md``). Each function raises a `SequenceError` for a file that is missing or
malformed, a `TrajectoryError` for such a ground truth.
"""

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dynslam_bench.core import SequenceError, TrajectoryError, read_text, translate_errors
from dynslam_bench.geometry import (
    Array,
    Camera,
    LoadedTrajectory,
    Trajectory,
    from_seconds,
    load_tum,
    nearest_gap,
    read_stamps,
    read_table,
    se3,
    to_seconds,
)
from dynslam_bench.geometry.camera import TUM_DEPTH_FACTOR
from dynslam_bench.geometry.trajectory_files import NoPoseError
from dynslam_bench.sequences.readers.files import (
    LEFT_OUT,
    MILLIMETRES,
    Contents,
    ImageList,
    camera_on_body,
    checked_camera,
    find_names,
    image_folders,
    is_identity,
    list_folder,
    nanoseconds,
    numbers,
    pick,
    rate_of,
    read_associations,
    read_image_list,
    read_pose_table,
    read_rows,
    read_yaml,
    rigid,
    section,
    size_of_first,
    stamped,
    stated_file,
)

PEOPLE_LIST = "people.txt"
"""List of exact masks, 8-bit images of the colour images' size and stamps: 0 is the scene, k > 0 is person k."""
ASSOCIATIONS = ("associations.txt", "associated.txt", "associate.txt", "association.txt")
"""Names of a list of pairs."""
TRUTHS = ("groundtruth.txt", "pose.txt")
"""Names of a ground truth in TUM's format."""


# TUM RGB-D, Bonn Dynamic, Wild-SLAM MoCap, and recordings of one's own.


def read_tum(folder: Path, fps: float | None) -> Contents:
    """Read the lists ``rgb.txt`` and ``depth.txt``, else an ``associations.txt``, else the names of the images.

    `fps` makes stamps of images that are named by frame numbers. What is there and not used is said
    in the notes.
    """
    # ground truth, and exact masks of people where there are any
    truth, dropped = _tum_truth(folder)
    people_list = stated_file(folder, PEOPLE_LIST)
    people = None if people_list is None else read_image_list(people_list)

    # images: by the list of pairs where one of the two lists is missing, else list by list
    lists = {name: stated_file(folder, f"{name}.txt") for name in ("rgb", "depth")}
    present = [path.name for path in lists.values() if path is not None]
    pairs = stated_file(folder, *ASSOCIATIONS)
    notes = [*_unused(folder, ASSOCIATIONS), *_unused(folder, TRUTHS)]
    if pairs is not None and len(present) < len(lists):
        paired = True
        colour, depth = read_associations(pairs)
        notes += [f"{name} is not used: {pairs.name} lists the images" for name in present]
    else:
        paired = False
        colour, depth = (
            list_folder(folder, name, fps) if path is None else read_image_list(path)
            for name, path in lists.items()
        )
        if pairs is not None:
            notes.insert(0, f"{pairs.name} is not used: {' and '.join(present)} list the images")
        elif len(present) == 1:
            unlisted = next(name for name, path in lists.items() if path is None)
            notes.append(
                f"there is no {unlisted}.txt: the images of {unlisted}/ are stamped by their names"
            )

        for name, path in lists.items():
            taken, *others = image_folders(folder, name) if path is None else [""]
            notes += [f"{other}/ is not used: {taken}/ is taken" for other in others]

    # a stated rate is that of the frame numbers, of which the images may be every n-th
    rate = rate_of(colour) if colour.irregular[LEFT_OUT] else None
    return Contents(
        colour,
        depth,
        paired,
        truth,
        dropped,
        fps=rate,
        people=people,
        truth_of_body=True,
        notes=tuple(notes),
    )


def _unused(folder: Path, names: tuple[str, ...]) -> list[str]:
    """A phrase on the files of these names, which mean the same, other than the first that is there."""
    present = [name for name in names if (folder / name).exists()]
    return [f"{name} is not used: {present[0]} is taken" for name in present[1:]]


def _tum_truth(folder: Path) -> tuple[Trajectory | None, str]:
    """The ground truth, None if there is no file, and one phrase on the lines that were not taken as they stand."""
    path = stated_file(folder, *TRUTHS)
    if path is None:
        return None, ""
    file = load_tum(path)
    return file.trajectory, _not_taken(file)


def _not_taken(file: LoadedTrajectory) -> str:
    """One phrase on the lines of a ground truth that were not taken as they stand; empty for none."""
    return ", ".join(f"ground truth: {phrase}" for phrase in file.notes.describe())


def read_eth3d(folder: Path, fps: float | None) -> Contents:
    """ETH3D SLAM: TUM's lists, paired by ``associated.txt``, with the camera in ``calibration.txt``.

    A sequence is published as two archives of one folder: ``*_mono.zip`` (colour, lists,
    calibration, ground truth) and ``*_rgbd.zip`` (depth and ``associated.txt``).
    """
    pairs = stated_file(folder, "associated.txt")
    if pairs is None:
        raise SequenceError(
            f"{folder} has no associated.txt, that is no depth",
            "unpack the sequence's _rgbd archive into it as well",
        )
    colour, depth = read_associations(pairs)
    calibration = folder / "calibration.txt"
    fx, fy, cx, cy = read_table(calibration, 4, "fx fy cx cy")[0].tolist()
    camera = checked_camera(
        calibration, size_of_first(folder, colour), (fx, fy), (cx, cy), TUM_DEPTH_FACTOR
    )
    truth, dropped = _tum_truth(folder)
    return Contents(colour, depth, True, truth, dropped, camera, fps or 27.1)


# the data set's published intrinsics, with fy turned positive (`read_icl_nuim`)
_ICL_CAMERA = Camera(640, 480, 481.20, 480.0, 319.5, 239.5, depth_factor=TUM_DEPTH_FACTOR)
# M, which turns the y axis of images and poses
_ICL_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def read_icl_nuim(folder: Path, fps: float | None) -> Contents:
    """ICL-NUIM in its TUM-compatible form: ``rgb/N.png``, ``depth/N.png`` and a ``*.gt.freiburg`` by frame number.

    Its camera has a negative fy: the y axis points up, in images and in poses alike. Turning it
    down mirrors the camera and the world, ``M T M`` with ``M = diag(1, -1, 1)``, after which fy is
    positive and every pose is a rotation as before. Its ``associations.txt`` names the depth image
    first; images are paired by their numbers instead.
    """
    rate = fps or 30.0
    files = find_names(folder, "*.gt.freiburg")
    if len(files) > 1:
        raise SequenceError(
            f"{folder} holds {len(files)} trajectories ({', '.join(files[:3])[:200]}), expected 1"
        )

    # poses by frame number, mirrored: M T M
    file = load_tum(folder / files[0])
    truth = Trajectory(
        file.trajectory.timestamps / rate, _ICL_MIRROR @ file.trajectory.T_world_cam @ _ICL_MIRROR
    )

    # images by frame number
    colour = list_folder(folder, "rgb", rate)
    depth = list_folder(folder, "depth", rate)
    return Contents(colour, depth, False, truth, _not_taken(file), _ICL_CAMERA, rate)


# the camera that the data set states for all sequences
_SEVEN_SCENES_CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0, depth_factor=MILLIMETRES)
# how platforms write a number that is none
_LOST = ("nan", "inf", "#ind", "#qnan", "#inf")


def read_seven_scenes(folder: Path, fps: float | None) -> Contents:
    """7-Scenes: ``frame-*.color.png``, ``.depth.png`` and ``.pose.txt``, the poses being KinectFusion's 4x4 matrices.

    The poses are camera to world and taken to the last digit. A frame that KinectFusion lost (a
    pose that is no number) stays a frame without ground truth. Raw depth 65535 is missing.
    """
    rate = fps or 30.0

    # frame numbers, and their stamps at the nominal rate
    files = find_names(folder, "frame-*.color.png")
    frames = [name.removeprefix("frame-").removesuffix(".color.png") for name in files]
    for number in frames:
        if not (number.isascii() and number.isdigit() and len(number) < 16):
            raise SequenceError(f"frame-{number[:40]}.color.png of {folder} is named by no number")
    with translate_errors(
        SequenceError, f"the numbers of the frames of {folder} are no frame numbers", of=ValueError
    ):
        stamps = from_seconds(int(number) / rate for number in frames)
    colour = stamped(files, stamps, str(folder))
    depth = stamped([f"frame-{number}.depth.png" for number in frames], stamps, str(folder))

    # poses of the frames that KinectFusion did not lose
    poses = [_kinect_fusion_pose(folder / f"frame-{number}.pose.txt") for number in frames]
    tracked = [i for i, pose in enumerate(poses) if pose is not None]
    matrices = np.array([pose for pose in poses if pose is not None])
    truth = Trajectory(to_seconds(stamps[tracked]), matrices, stamps[tracked]) if tracked else None
    lost = len(poses) - len(tracked)
    dropped = f"ground truth: {lost} of {len(poses)} poses lost" if lost else ""
    return Contents(colour, depth, True, truth, dropped, _SEVEN_SCENES_CAMERA, rate)


def _kinect_fusion_pose(path: Path) -> Array | None:
    """A 4x4 pose, unchanged; None where it is no number, as KinectFusion writes a lost frame."""
    parts = read_text(path, limit=1 << 16, kind=SequenceError).split()
    if len(parts) == 16 and any(mark in part.lower() for part in parts for mark in _LOST):
        return None
    try:
        return rigid([float(part) for part in parts], str(path))
    except ValueError:
        raise SequenceError(
            f"{path} holds {len(parts)} values, expected the 16 numbers of a 4x4 pose"
        ) from None


# the data set's intrinsics
_SHIBUYA_CAMERA = Camera(
    640, 360, *2 * (772.5483399593904,), 320.0, 180.0, depth_factor=1.0, baseline_m=0.25
)
_T_NED_CAM = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From optical axes (x right, y down, z forward) to NED axes (x forward, y right, z down)."""


def read_tartanair_shibuya(folder: Path, fps: float | None) -> Contents:
    """TartanAir-Shibuya: ``image_0``, ``depth_0`` (arrays of metres), ``times.txt``, and ``gt_pose.txt`` in NED axes.

    Poses are those of a camera that looks along x, with y to the right and z down. The sky is
    rendered at thousands of metres and is no measurement.
    """
    # images, stamps and poses, line by line; poses with a stamp or without
    colour = find_names(folder, "image_0/*.[pj][np]g")
    depth = find_names(folder, "depth_0/*.npy")
    stamps = read_stamps(folder / "times.txt")
    try:
        rows = read_table(folder / "gt_pose.txt", 8, "timestamp tx ty tz qx qy qz qw")[:, 1:]
    except TrajectoryError:
        rows = read_table(folder / "gt_pose.txt", 7, "tx ty tz qx qy qz qw")
    if not len(colour) == len(depth) == len(stamps) == len(rows):
        raise SequenceError(
            f"{folder} holds {len(colour)} colour images, {len(depth)} depth arrays, {len(stamps)} stamps and "
            f"{len(rows)} poses, expected as many of each"
        )

    # poses: finite, with a quaternion that is not 0
    if not np.isfinite(rows).all() or (np.linalg.norm(rows[:, 3:], axis=1) < 1e-8).any():
        raise SequenceError(f"{folder / 'gt_pose.txt'} holds a pose that is none")

    # in order of time, from NED axes to optical ones
    images = stamped(colour, stamps, str(folder))
    arrays = stamped(depth, stamps, str(folder))
    order = np.argsort(stamps, kind="stable")
    poses = se3.from_quaternion(rows[order, :3], rows[order, 3:]) @ _T_NED_CAM
    truth = Trajectory(images.stamps, poses, images.stamps_ns)
    return Contents(images, arrays, True, truth, camera=_SHIBUYA_CAMERA, fps=fps, furthest_m=1000.0)


# names of the frames of reference in OpenLORIS' YAML files
_LORIS_BASE = "base_link"
_LORIS_CAMERA = "d400_color_optical_frame"
_LORIS_GAP_S = 1.0
"""Seconds: a ground truth that is never nearer to an image is that of another sequence."""


def read_openloris(folder: Path, fps: float | None) -> Contents:
    """OpenLORIS-Scene: ``color.txt``, ``aligned_depth.txt``, ``groundtruth.txt`` of the robot's base, two YAML files.

    Intrinsics are in the order fx cx fy cy. The ground truth is that of ``base_link``;
    ``trans_matrix.yaml`` says where on it the camera sits. Stamps are said to carry a deliberate
    random bias, another for every sequence, so only those of one sequence may be compared. A ground
    truth that shares no time with the images is refused.
    """
    colour = read_image_list(folder / "color.txt")
    depth = read_image_list(folder / "aligned_depth.txt")
    sensors = folder / "sensors.yaml"
    transforms = folder / "trans_matrix.yaml"

    # intrinsics, in the order fx cx fy cy
    sensor = section(read_yaml(sensors), _LORIS_CAMERA, str(sensors))
    fx, cx, fy, cy = numbers(sensor, "intrinsics", 4, str(sensors))
    camera = checked_camera(sensors, size_of_first(folder, colour), (fx, fy), (cx, cy), MILLIMETRES)

    # poses of the robot's base, if they are of the time of the images
    base, dropped = _tum_truth(folder)
    if base is None:
        return Contents(colour, depth, camera=camera, fps=fps)
    gap = float(nearest_gap(colour.stamps, base.timestamps).min())
    if gap > _LORIS_GAP_S:
        raise SequenceError(
            f"the ground truth of {folder} is never nearer than {gap:.3f} s to an image",
            "stamps of OpenLORIS carry a bias of their own in every sequence: are both files of the same one?",
        )

    # the camera on the base, and its poses: T_world_cam = T_world_base T_base_cam
    entries = _mappings(section(read_yaml(transforms), "trans_matrix", str(transforms)))
    placed = [
        entry
        for entry in entries
        if entry.get("parent_frame") == _LORIS_BASE and entry.get("child_frame") == _LORIS_CAMERA
    ]
    if not placed:
        raise SequenceError(
            f"{transforms} holds no rigid transformation from {_LORIS_BASE} to {_LORIS_CAMERA}"
        )
    T_base_cam = rigid(numbers(placed[0], "matrix", 16, str(transforms)), str(transforms))
    truth = base.with_poses(base.T_world_cam @ T_base_cam)
    return Contents(colour, depth, truth=truth, truth_dropped=dropped, camera=camera, fps=fps)


def _mappings(value: object) -> list[dict[str, object]]:
    """The mappings in a list; none where it is no list."""
    return [entry for entry in value if isinstance(entry, dict)] if isinstance(value, list) else []


def read_vslam_lab(folder: Path, fps: float | None) -> Contents:
    """VSLAM-LAB: ``rgb.csv`` (stamps in nanoseconds, pairs), ``calibration.yaml``, ``groundtruth.csv``.

    The ground truth is that of the body, on which ``T_BS`` places the camera. VSLAM-LAB writes the
    identity where the data set states nothing.
    """
    # colour and depth images, a pair a row, in order of time
    table = folder / "rgb.csv"
    names = ("ts_rgb_0 (ns)", "path_rgb_0", "ts_depth_0 (ns)", "path_depth_0")
    stamps, files, depth_stamps, depth_files = pick(*read_rows(table), names, table)
    order = np.argsort(nanoseconds(stamps, table), kind="stable")
    colour = stamped(files, nanoseconds(stamps, table), str(table))
    depth = stamped(
        [depth_files[i] for i in order],
        nanoseconds([depth_stamps[i] for i in order], table),
        str(table),
    )

    # the camera, among the lists of sensors
    where = str(folder / "calibration.yaml")
    entries = [entry for value in read_yaml(Path(where)).values() for entry in _mappings(value)]
    stated = next((entry for entry in entries if entry.get("cam_name") == "rgb_0"), None)
    if stated is None:
        raise SequenceError(f"{where} describes no camera 'rgb_0'")
    size = numbers(stated, "image_dimension", 2, where)
    focal = numbers(stated, "focal_length", 2, where)
    centre = numbers(stated, "principal_point", 2, where)
    depth_factor = _depth_factor(stated, where)
    kind = stated.get("distortion_type")
    if kind not in (None, "radtan4", "radtan5"):
        raise SequenceError(
            f"{where}: the distortion '{str(kind)[:40]}' is not read, only radtan4 and radtan5"
        )
    distortion: list[float] = []
    if kind is not None:
        count = 4 if kind == "radtan4" else 5
        distortion = numbers(stated, "distortion_coefficients", count, where)
    camera = checked_camera(where, size, focal, centre, depth_factor, distortion)

    # the camera's poses by those of the body
    T_body_cam = camera_on_body(stated, where)
    truth, dropped = _truth_of_table(stated_file(folder, "groundtruth.csv"), T_body_cam)
    return Contents(
        colour,
        depth,
        True,
        truth,
        dropped,
        camera,
        fps or _frame_rate(stated.get("fps")),
        truth_of_body=is_identity(T_body_cam),
    )


def _depth_factor(mapping: object, where: str) -> float | None:
    """The ``depth_factor`` of a mapping; None where it states none."""
    if not isinstance(mapping, Mapping) or mapping.get("depth_factor") is None:
        return None
    (factor,) = numbers(mapping, "depth_factor", 1, where)
    return factor


def _truth_of_table(path: Path | None, T_body_cam: Array) -> tuple[Trajectory | None, str]:
    """The camera's poses of a table of the body's, and one phrase on the rows that were not taken as they stand."""
    if path is None:
        return None, ""
    try:
        file = read_pose_table(path, T_body_cam)
    except NoPoseError:
        return None, f"ground truth: no row of {path.name} holds a rotation"
    return file.trajectory, _not_taken(file)


def read_euroc(folder: Path, fps: float | None) -> Contents:
    """RGB-D in EuRoC's layout: ``mav0/cam0``, ``mav0/depth0`` (registered), ``mav0/state_groundtruth_estimate0``.

    The folder holds ``mav0`` or is ``mav0`` itself. Stamps are nanoseconds. The ground truth is the
    body's, its quaternion has w first, and ``T_BS`` of ``cam0`` places the camera on the body.
    EuRoC itself has no depth: ``depth0`` is what others add, and its ``sensor.yaml`` or a
    ``camera.toml`` states the ``depth_factor``.
    """
    base = "mav0/" if (folder / "mav0").is_dir() else ""
    if stated_file(folder, f"{base}depth0/data.csv") is None:
        raise SequenceError(
            f"{folder} has no {base}depth0/data.csv, that is no depth",
            "EuRoC's own sequences are stereo",
        )
    colour = _euroc_images(folder, f"{base}cam0")
    depth = _euroc_images(folder, f"{base}depth0")

    # the camera: colour and depth images have its intrinsics
    where = str(folder / base / "cam0" / "sensor.yaml")
    sensor = read_yaml(Path(where))
    size = numbers(sensor, "resolution", 2, where)
    intrinsics = numbers(sensor, "intrinsics", 4, where)
    distortion = numbers(sensor, "distortion_coefficients", 4, where)
    depth_factor = None
    depth_sensor = stated_file(folder, f"{base}depth0/sensor.yaml")
    if depth_sensor is not None:
        depth_factor = _depth_factor(read_yaml(depth_sensor), str(depth_sensor))
    camera = checked_camera(where, size, intrinsics[:2], intrinsics[2:], depth_factor, distortion)

    # its poses by those of the body
    T_body_cam = camera_on_body(sensor, where)
    truth, dropped = _truth_of_table(
        stated_file(folder, f"{base}state_groundtruth_estimate0/data.csv"), T_body_cam
    )
    return Contents(
        colour,
        depth,
        False,
        truth,
        dropped,
        camera,
        fps or _frame_rate(sensor.get("rate_hz")),
        truth_of_body=is_identity(T_body_cam),
    )


def _euroc_images(folder: Path, name: str) -> ImageList:
    """The images of a camera's ``data.csv``, which lie in ``data`` beside it."""
    path = folder / name / "data.csv"
    heading, rows = read_rows(path)
    if len(heading) < 2:
        raise SequenceError(f"{path} has one column, expected a stamp and a file name")
    return stamped(
        [f"{name}/data/{row[1]}" for row in rows],
        nanoseconds([row[0] for row in rows], path),
        str(path),
    )


def _frame_rate(value: object) -> float | None:
    """A frame rate in Hz that a file states; None where the value is none."""
    return float(value) if isinstance(value, (int, float)) and 0 < value < 1e6 else None


# Which layout a folder has.


@dataclass(frozen=True)
class Layout:
    """One layout.

    Attributes:
        name: For example ``7-scenes``; the catalogue names it.
        marks: A folder has this layout if all of these files are in it (patterns), or in its folder
            ``mav0``.
        read: Reads a folder of this layout, ``read(folder, fps)``, fps being the nominal frame rate
            in Hz, where the user or the catalogue states one. It raises a `SequenceError` where the
            folder is not in this layout or damaged, a `TrajectoryError` where its ground truth
            cannot be read.
        holds: Name of the layout whose marks its folders have as well; empty for none.
    """

    name: str
    marks: tuple[str, ...]
    read: Callable[[Path, float | None], Contents]
    holds: str = ""

    def fits(self, folder: Path) -> bool:
        """Whether a folder has this layout."""
        return any(
            all(_has(base, mark) for mark in self.marks) for base in (folder, folder / "mav0")
        )


def _has(folder: Path, mark: str) -> bool:
    """Whether a folder has a file of this name or pattern, be it a link to a file that is gone: its reader says so."""
    return any(folder.glob(mark)) if "*" in mark else os.path.lexists(folder / mark)


# in the order in which they are tried; TUM's last, as others hold its files as well
TUM = Layout("tum", ("rgb.txt",), read_tum)
LAYOUTS = (
    Layout("eth3d", ("calibration.txt", "associated.txt"), read_eth3d, holds="tum"),
    Layout("icl-nuim", ("*.gt.freiburg",), read_icl_nuim),
    Layout("7-scenes", ("frame-*.color.png",), read_seven_scenes),
    Layout("tartanair-shibuya", ("gt_pose.txt", "times.txt"), read_tartanair_shibuya),
    Layout("openloris", ("color.txt", "aligned_depth.txt"), read_openloris),
    Layout("vslam-lab", ("rgb.csv", "calibration.yaml"), read_vslam_lab),
    Layout("euroc", ("cam0/data.csv",), read_euroc),
    TUM,
)
"""All layouts, in the order in which they are tried."""


def layouts_of(folder: Path, catalogued: str = "") -> list[Layout]:
    """All layouts that a folder has, the one to take first; none where no mark is there.

    Args:
        folder: The folder.
        catalogued: Name of the layout in which the data set is published. It comes first where the
            folder has it, and what is a part of it is no layout of its own.
    """
    fitting = [layout for layout in LAYOUTS if layout.fits(folder)]
    published = layout_of(catalogued) if catalogued else None

    # a layout that another one holds is no layout of its own
    held = {layout.holds for layout in fitting}
    if published is not None and published not in fitting:
        held.add(published.holds)
    fitting = [layout for layout in fitting if layout is published or layout.name not in held]

    # TUM's lists without their images: the folder is of another layout, or was changed by a tool
    if published is TUM and len(fitting) > 1 and not _has_listed_images(folder):
        return fitting
    return sorted(fitting, key=lambda layout: layout is not published)


def _has_listed_images(folder: Path) -> bool:
    """Whether the first images of both of TUM's lists are there."""
    with suppress(SequenceError):
        firsts = [read_image_list(folder / f"{name}.txt").files[0] for name in ("rgb", "depth")]
        return all((folder / first).is_file() for first in firsts)
    return False


def find_layout(folder: Path, catalogued: str = "") -> Layout:
    """The layout of a folder, by its files; where no mark is there the catalogued one, else TUM's.

    Args:
        folder: The folder.
        catalogued: See `layouts_of`.
    """
    fitting = layouts_of(folder, catalogued)
    if fitting:
        return fitting[0]
    return layout_of(catalogued) if catalogued and not is_plain(folder) else TUM


def is_plain(folder: Path) -> bool:
    """Whether a folder holds what TUM's reader takes without lists: images in two folders, or a list of pairs."""
    if image_folders(folder, "rgb") and image_folders(folder, "depth"):
        return True
    return any(os.path.lexists(folder / name) for name in ASSOCIATIONS)


def layout_notes(folder: Path, taken: Layout, catalogued: str = "") -> tuple[str, ...]:
    """Phrases on what else a folder could be, and on a layout other than the one in which the data set is published."""
    notes = []
    if catalogued and taken.name != catalogued:
        notes.append(
            f"read in the layout {taken.name}, by its files; the data set is published in {catalogued}"
        )
    for other in layouts_of(folder, catalogued):
        if other is not taken:
            notes.append(
                f"read in the layout {taken.name} ({', '.join(taken.marks)}); {', '.join(other.marks)} of the layout "
                f"{other.name} is not used"
            )
    return tuple(notes)


def layout_of(name: str) -> Layout:
    """A layout by name.

    Raises:
        SequenceError: There is none of that name.
    """
    layout = next((layout for layout in LAYOUTS if layout.name == name), None)
    if layout is None:
        raise SequenceError(
            f"unknown layout '{name}'", f"one of {', '.join(layout.name for layout in LAYOUTS)}"
        )
    return layout


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag, rather than a folder of images."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() and any(
            [*path.glob("*.db3"), *path.glob("*.mcap")]
        )
    return path.is_file() and path.suffix in (".bag", ".mcap", ".db3")
