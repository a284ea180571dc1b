"""A run as a recording for rerun's viewer: images, masks, static and dynamic features, map, trajectory against truth.

Images are JPEG at half size, and everything in their plane is scaled with them. On the timelines
``frame`` (index) and ``time`` (seconds since the first frame):

- ``world/camera``: the causal pose; ``world/camera/image`` with ``mask``, ``kept`` and ``culled`` below it
- ``error/trans_m``, ``features/kept``, ``features/culled``: numbers a frame; ``state``: where it changes

and without time, from the end of the run: ``world/map``, ``world/estimate``, ``world/truth``
(aligned to the estimate).
"""

import importlib.util
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Sequence
from dynslam_bench.core import RunError, translate_errors
from dynslam_bench.core.version import install_hint
from dynslam_bench.envs.rendering import CULLED, ESTIMATE, KEPT, MASK, TRUTH
from dynslam_bench.geometry import Camera, Trajectory, associate, se3
from dynslam_bench.runs.artifacts import Snapshot, aligned_truth, read_snapshots
from dynslam_bench.runs.frames import CSV_FILE, read_csv
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.store import RunStore
from dynslam_bench.slam.map_files import read_ply

RECORDING_FILE = "recording.rrd"
IMAGE = "world/camera/image"
"""Path of the images in the recording."""
LAYERS = {"mask": f"{IMAGE}/mask", "kept": f"{IMAGE}/kept", "culled": f"{IMAGE}/culled"}
"""Layers drawn over the images, with their paths in the recording."""
_JPEG_QUALITY = 80
_STAMP_TOLERANCE_S = 1e-5
"""Poses and frames whose stamps differ by less belong to each other."""


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """A frame of a recording.

    Attributes:
        index: Index of the frame in the run's part of the sequence.
        stamp: Seconds.
        jpeg: The image at half size, see `encode`.
        pose: Camera to world ``[4, 4]``; None where the tracker has none: the camera stays where it
            was.
        shot: Features in pixels of the image, and the mask; None if they are not known, which shows
            none.
        state: ``ok``, ``lost``, ...
        error_m: Causal translational error in metres.
    """

    index: int
    stamp: float
    jpeg: bytes
    pose: NDArray[np.float64] | None
    shot: Snapshot | None = None
    state: str = ""
    error_m: float | None = None


def encode(rgb: NDArray[np.uint8]) -> bytes:
    """An image, uint8 ``[H, W, 3]``, red first, as a JPEG file of half its size."""
    size = (max(rgb.shape[1] // 2, 1), max(rgb.shape[0] // 2, 1))
    small = cv2.cvtColor(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1])


def check_rerun() -> None:
    """Check that the library is there, without loading it.

    Raises:
        RunError: It is not installed.
    """
    if importlib.util.find_spec("rerun") is None:
        raise RunError(
            "recordings are written with rerun-sdk, which is not installed", install_hint("rerun")
        )


def write_recording(
    path: Path,
    camera: Camera,
    name: str,
    frames: Iterable[RecordedFrame],
    tracks: tuple[Trajectory, Trajectory | None],
    cloud: Any = None,
) -> None:
    """Write an ``.rrd`` file.

    Args:
        path: The file.
        camera: Intrinsics of the images at full size.
        name: Recording's name in the viewer.
        frames: In order.
        tracks: The estimate, and the truth in its frame.
        cloud: Map points with ``positions`` ``[M, 3]`` in metres and ``colours``; None without.

    Raises:
        RunError: `rerun-sdk` is not installed, or the file cannot be written.
    """
    check_rerun()
    import rerun as rr

    # `touch` fails at once where the file cannot be written
    stream = rr.RecordingStream("dynslam-bench")
    with translate_errors(
        RunError,
        f"cannot write {path}",
        "check the permissions and the free space",
        of=(OSError, RuntimeError),
    ):
        path.touch()
        stream.save(str(path), default_blueprint=_blueprint())

    # the frames in order of time, then what has no time
    stream.send_recording_name(name)
    _log_frames(rr, stream, camera, frames)
    _log_scene(rr, stream, tracks, cloud)
    stream.disconnect()


def _log_scene(
    rr: Any, stream: Any, tracks: tuple[Trajectory, Trajectory | None], cloud: Any
) -> None:
    """Log what is there without time: the trajectories and the map."""
    estimate, truth = tracks
    for name, track, colour in (("estimate", estimate, ESTIMATE), ("truth", truth, TRUTH)):
        if track is not None and len(track):
            line = rr.LineStrips3D([track.positions], colors=[colour])
            stream.log(f"world/{name}", line, static=True)
    if cloud is not None and len(cloud.positions):
        points = rr.Points3D(cloud.positions, colors=cloud.colours, radii=0.005)
        stream.log("world/map", points, static=True)


def _log_frames(rr: Any, stream: Any, camera: Camera, frames: Iterable[RecordedFrame]) -> None:
    """Log the frames in order.

    Args:
        rr: The module ``rerun``.
        stream: rerun's ``RecordingStream``.
        camera: Intrinsics of the images at full size.
        frames: The frames.
    """
    # width and height of the images in the recording, and their shares of those at full size
    size = (max(camera.width // 2, 1), max(camera.height // 2, 1))
    scale = np.array([size[0] / camera.width, size[1] / camera.height])
    _log_camera(rr, stream, camera, size, scale)
    first_stamp: float | None = None
    shown_layers: set[str] = set()
    state = ""
    for frame in frames:
        # the frame's place on both time lines of the viewer: its index, and seconds from the start
        first_stamp = frame.stamp if first_stamp is None else first_stamp
        stream.set_time("frame", sequence=frame.index)
        stream.set_time("time", duration=frame.stamp - first_stamp)

        # the image, the camera's pose, and the numbers of the frame
        stream.log(IMAGE, rr.EncodedImage(contents=frame.jpeg, media_type="image/jpeg"))
        if frame.pose is not None:
            position, quaternion = se3.to_quaternion(frame.pose)
            pose = rr.Transform3D.from_fields(translation=position, quaternion=quaternion)
            stream.log("world/camera", pose)
        if frame.error_m is not None:
            stream.log("error/trans_m", rr.Scalars(frame.error_m))
        if frame.state != state:
            stream.log("state", rr.TextLog(frame.state))

        # features and mask; a layer that this frame lacks is cleared, or the viewer shows the last one
        layers = {} if frame.shot is None else _layers(rr, stream, frame.shot, size, scale)
        for layer in shown_layers - layers.keys():
            stream.log(LAYERS[layer], rr.Clear(recursive=False))
        for layer, picture in layers.items():
            stream.log(LAYERS[layer], picture)
        shown_layers = set(layers)
        state = frame.state


def _log_camera(
    rr: Any, stream: Any, camera: Camera, size: tuple[int, int], scale: NDArray[np.float64]
) -> None:
    """Log the camera, and how features and masks are drawn.

    Args:
        rr: The module ``rerun``.
        stream: rerun's ``RecordingStream``.
        camera: Intrinsics of the images at full size.
        size: Width and height of the images in the recording.
        scale: Recorded size over full size ``[2]`` (x, y).
    """
    # intrinsics of the smaller images; rerun puts the corner of the first pixel at 0, we its centre
    matrix = camera.matrix * np.array([*scale, 1.0])[:, None]
    matrix[:2, 2] += 0.5 * scale
    pinhole = rr.Pinhole(
        image_from_camera=matrix, width=size[0], height=size[1], camera_xyz=rr.ViewCoordinates.RDF
    )

    # static pixels of a mask are transparent; x is right, y down, z forward
    classes = rr.AnnotationContext([(0, "static", (0, 0, 0, 0)), (1, "dynamic", (*MASK, 110))])
    stream.log("world", rr.ViewCoordinates.RDF, static=True)
    stream.log(IMAGE, pinhole, classes, static=True)

    # colours of kept and culled features
    for layer, colour in (("kept", KEPT), ("culled", CULLED)):
        points = rr.Points2D.from_fields(colors=[colour], radii=[1.0])
        stream.log(LAYERS[layer], points, static=True)


def _layers(
    rr: Any, stream: Any, shot: Snapshot, size: tuple[int, int], scale: NDArray[np.float64]
) -> dict[str, Any]:
    """The features and the mask of a frame by their layers; logs how many features there are.

    Args:
        rr: The module ``rerun``.
        stream: rerun's ``RecordingStream``.
        shot: Features ``[N, 2]`` in pixels of the image at full size, and the mask ``[H, W]``.
        size: Width and height of the images in the recording.
        scale: Recorded size over full size ``[2]`` (x, y).
    """
    layers: dict[str, Any] = {}
    # rerun's origin is the corner of the first pixel, ours its centre
    points = ((shot.points + 0.5) * scale).astype(np.float32)
    for layer, chosen in (("kept", points[shot.kept]), ("culled", points[~shot.kept])):
        layers[layer] = rr.Points2D.from_fields(positions=chosen)
        stream.log(f"features/{layer}", rr.Scalars(float(len(chosen))))
    mask = shot.mask
    if mask is not None:
        small = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        layers["mask"] = rr.SegmentationImage(small)
    return layers


def _blueprint() -> Any:
    """Layout that the viewer shows at first: the scene on the left, the image and the numbers on the right."""
    import rerun.blueprint as rrb

    numbers = rrb.Horizontal(
        rrb.TimeSeriesView(origin="error"), rrb.TimeSeriesView(origin="features")
    )
    right = rrb.Vertical(rrb.Spatial2DView(origin=IMAGE), numbers, row_shares=[2, 1])
    return rrb.Blueprint(rrb.Horizontal(rrb.Spatial3DView(origin="world"), right))


def write_stored(
    path: Path, store: RunStore, record: RunRecord, sequence: Sequence, trajectory: Trajectory
) -> list[str]:
    """Write the recording of a stored run.

    Args:
        path: The file.
        store: The run's.
        record: The run.
        sequence: The frames that it was made on.
        trajectory: What is drawn as its estimate, and where the camera goes if the run has no
            online poses.

    Returns:
        What a user should know, one line each.

    Raises:
        RunError: `rerun-sdk` is not installed, or a file of the run is damaged.
        SequenceError: An image cannot be read.
    """
    # features, causal poses and numbers of the frames, each by the frame's index
    folder = store.folder(record.run_id)
    shots = _snapshots(folder, sequence.camera)
    online = store.trajectory(record.run_id, "online") or trajectory
    tracked, rows_of_poses = associate(
        sequence.timestamps, online.timestamps, _STAMP_TOLERANCE_S, strict=False
    )
    poses = dict(zip(tracked.tolist(), online.T_world_cam[rows_of_poses], strict=True))
    table = folder / CSV_FILE
    rows = {row.index: row for row in read_csv(table)} if table.is_file() else {}

    def frames() -> Iterator[RecordedFrame]:
        """The frames of the run, one after the other, with what was stored of each."""
        for index in range(len(sequence)):
            row = rows.get(index)
            frame = sequence[index]
            yield RecordedFrame(
                index=index,
                stamp=frame.timestamp,
                jpeg=encode(frame.rgb),
                pose=poses.get(index),
                shot=shots.get(index),
                state="" if row is None else str(row.state),
                error_m=None if row is None else row.pose_error_trans_m,
            )

    # the map, and the truth in the estimate's frame
    cloud = read_ply(folder / "map.ply") if (folder / "map.ply").is_file() else None
    truth = aligned_truth(sequence.ground_truth, trajectory)[0]
    name = f"{record.tracker.label} on {record.sequence.id}"
    write_recording(path, sequence.camera, name, frames(), (trajectory, truth), cloud)
    if len(shots) == len(sequence):
        return []
    return [
        f"features and masks are known of {len(shots)} of {len(sequence)} frames; `run --rrd` records all"
    ]


def _snapshots(folder: Path, camera: Camera) -> dict[int, Snapshot]:
    """The snapshots of a stored run by the index of their frame.

    Args:
        folder: The run's.
        camera: Intrinsics of the sequence's images. The features are given in their pixels, though
            the tracker's preprocessing may have resized the images.
    """
    (height, width), snapshots = read_snapshots(folder)
    scale = np.array([camera.width / max(width, 1), camera.height / max(height, 1)])
    shots = {}
    for shot in snapshots:
        # the centre of the top-left pixel is at 0 in both
        points = ((shot.points + 0.5) * scale - 0.5).round().astype(np.int16)
        shots[shot.index] = replace(shot, points=points)
    return shots
