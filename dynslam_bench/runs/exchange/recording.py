"""A run as a recording for rerun's viewer: images, masks, kept and culled features, map, trajectory against truth.

Images are JPEG at half size, for which everything in their plane is scaled. Rows are collected and handed over
`BLOCK` frames at a time, which costs a third of logging one by one. On the timelines ``frame`` (index) and ``time``
(seconds since the first frame):

- ``world/camera``: the causal pose; ``world/camera/image`` with ``mask``, ``kept`` and ``culled`` below it
- ``error/trans_m``, ``features/kept``, ``features/culled``: numbers a frame; ``state``: where it changes

and without time, from the end of the run: ``world/map``, ``world/estimate``, ``world/truth`` (aligned to the estimate).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.errors import RunError
from dynslam_bench.envs.rendering import CULLED, ESTIMATE, KEPT, MASK, TRUTH
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory

from ..snapshots import Snapshot

RECORDING_FILE = "recording.rrd"
BLOCK = 25
_QUALITY = 80
_IMAGE = "world/camera/image"
_LAYERS = {"mask": f"{_IMAGE}/mask", "kept": f"{_IMAGE}/kept", "culled": f"{_IMAGE}/culled"}


@dataclass
class _Rows:
    """Values of one entity with the frames they belong to."""

    frames: list[int] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)


class RecordingWriter:
    """Writes one run as an ``.rrd`` file; what a run that ends early has handed over stays readable.

    Args:
        path: The file.
        camera: Of the images that will be added.
        name: Recording's name in the viewer.

    Raises:
        RunError: `rerun-sdk` is not installed, or the file cannot be written.
    """

    def __init__(self, path: Path, camera: Camera, name: str) -> None:
        self._rr: Any = load_rerun()
        self._size = (max(camera.width // 2, 1), max(camera.height // 2, 1))
        self._scale = np.array([self._size[0] / camera.width, self._size[1] / camera.height])
        self._rows: dict[str, _Rows] = {}
        self._shown: set[str] = set()
        self._first: float | None = None
        self._state = ""
        self._stream = self._rr.RecordingStream("dynslam-bench")
        try:
            self._stream.save(path, default_blueprint=_layout())
        except (OSError, RuntimeError) as error:
            raise RunError(f"cannot write {path}: {error}", "check the permissions and the free space") from error
        self._stream.send_recording_name(name)
        self._set_up(camera)

    def add(
        self,
        index: int,
        stamp: float,
        rgb: NDArray[np.uint8] | None,
        pose: NDArray[np.float64] | None,
        shot: Snapshot | None = None,
        *,
        state: str = "",
        error_m: float | None = None,
    ) -> None:
        """Add a frame.

        Args:
            index: Of the frame in the run's part of the sequence.
            stamp: Seconds.
            rgb: uint8 ``[H, W, 3]``, red first; None to show none.
            pose: Camera to world ``[4, 4]``; None where the tracker has none: the camera stays where it was.
            shot: Features in pixels of the image, and the mask; None if they are not known, which shows none.
            state: ``ok``, ``lost``, ...
            error_m: Causal translational error in metres.
        """
        self._first = stamp if self._first is None else self._first
        at = (index, stamp - self._first)
        if pose is not None:
            self._put("world/camera", at, np.concatenate(se3.to_quaternion(pose)))
        if rgb is not None:
            self._put(_IMAGE, at, self._jpeg(rgb))
        if error_m is not None:
            self._put("error/trans_m", at, error_m)
        self._clear(shot, at)
        if shot is not None:
            self._put_seen(shot, at)
        if state != self._state:
            self._at(at)
            self._stream.log("state", self._rr.TextLog(state))
            self._state = state
        if len(self._rows.get(_IMAGE, _Rows()).frames) >= BLOCK:
            self._hand_over()

    def finish(
        self,
        estimate: Trajectory,
        truth: Trajectory | None,
        positions: NDArray[np.floating] | None,
        colours: NDArray[np.uint8] | None,
    ) -> None:
        """Add what is known at the end: the trajectory, the truth in its frame, and the map ``[M, 3]`` in metres."""
        rr = self._rr
        for name, track, colour in (("estimate", estimate, ESTIMATE), ("truth", truth, TRUTH)):
            if track is not None and len(track):
                self._stream.log(f"world/{name}", rr.LineStrips3D([track.positions], colors=[colour]), static=True)
        if positions is not None and len(positions):
            self._stream.log("world/map", rr.Points3D(positions, colors=colours, radii=0.005), static=True)

    def close(self) -> None:
        """Hand over what is left and end the file."""
        self._hand_over()
        self._stream.disconnect()

    def _set_up(self, camera: Camera) -> None:
        rr, (sx, sy) = self._rr, self._scale
        matrix = camera.matrix * np.array([[sx], [sy], [1.0]])
        matrix[:2, 2] += 0.5 * self._scale  # rerun puts the corner of the top-left pixel at 0, we its centre
        width, height = self._size
        pinhole = rr.Pinhole(image_from_camera=matrix, width=width, height=height, camera_xyz=rr.ViewCoordinates.RDF)
        classes = rr.AnnotationContext([(0, "static", (0, 0, 0, 0)), (1, "dynamic", (*MASK, 110))])
        self._stream.log("world", rr.ViewCoordinates.RDF, static=True)
        self._stream.log(_IMAGE, pinhole, classes, static=True)
        for name, colour in (("kept", KEPT), ("culled", CULLED)):
            looks = rr.Points2D.from_fields(colors=[colour], radii=[1.0])
            self._stream.log(_LAYERS[name], looks, static=True)

    def _put(self, entity: str, at: tuple[int, float], value: Any) -> None:
        rows = self._rows.setdefault(entity, _Rows())
        rows.frames.append(at[0])
        rows.times.append(at[1])
        rows.values.append(value)

    def _put_seen(self, shot: Snapshot, at: tuple[int, float]) -> None:
        points = ((shot.points + 0.5) * self._scale).astype(np.float32)
        for name, chosen in (("kept", points[shot.kept]), ("culled", points[~shot.kept])):
            self._put(_LAYERS[name], at, chosen)
            self._put(f"features/{name}", at, float(len(chosen)))
        if shot.mask is not None:
            small = cv2.resize(shot.mask.astype(np.uint8), self._size, interpolation=cv2.INTER_NEAREST)
            self._put(_LAYERS["mask"], at, small.tobytes())

    def _clear(self, shot: Snapshot | None, at: tuple[int, float]) -> None:
        """What an earlier frame showed and this one does not know must not stand on in the viewer."""
        shown = set() if shot is None else {"kept", "culled"} | ({"mask"} if shot.mask is not None else set())
        for name in self._shown - shown:
            self._at(at)
            self._stream.log(_LAYERS[name], self._rr.Clear(recursive=False))
        self._shown = shown

    def _at(self, at: tuple[int, float]) -> None:
        self._stream.set_time("frame", sequence=at[0])
        self._stream.set_time("time", duration=at[1])

    def _jpeg(self, rgb: NDArray[np.uint8]) -> bytes:
        small = cv2.cvtColor(cv2.resize(rgb, self._size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2BGR)
        return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()

    def _hand_over(self) -> None:
        rr = self._rr
        for entity, rows in self._rows.items():
            index = [rr.TimeColumn("frame", sequence=rows.frames), rr.TimeColumn("time", duration=rows.times)]
            self._stream.send_columns(entity, indexes=index, columns=self._columns(entity, rows.values))
        self._rows.clear()

    def _columns(self, entity: str, values: Sequence[Any]) -> Any:
        rr = self._rr
        if entity == "world/camera":
            poses = np.array(values)
            return rr.Transform3D.columns(translation=poses[:, :3], quaternion=poses[:, 3:])
        if entity == _IMAGE:
            return rr.EncodedImage.columns(blob=values, media_type=["image/jpeg"] * len(values))
        if entity == _LAYERS["mask"]:
            width, height = self._size
            shape = rr.components.ImageFormat(width=width, height=height, channel_datatype=rr.ChannelDatatype.U8)
            return rr.SegmentationImage.columns(buffer=values, format=[shape] * len(values))
        if entity in _LAYERS.values():
            lengths = [len(points) for points in values]
            return rr.Points2D.columns(positions=np.concatenate(values).reshape(-1, 2)).partition(lengths)
        return rr.Scalars.columns(scalars=values)


def load_rerun() -> Any:
    """The library.

    Raises:
        RunError: It is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise RunError(
            "recordings are written with rerun-sdk, which is not installed", "pip install 'dynslam-bench[rerun]'"
        ) from error
    return rerun


def _layout() -> Any:
    """What the viewer shows at first: the room on the left, the image and the numbers on the right."""
    import rerun.blueprint as rrb

    numbers = rrb.Horizontal(rrb.TimeSeriesView(origin="error"), rrb.TimeSeriesView(origin="features"))
    right = rrb.Vertical(rrb.Spatial2DView(origin=_IMAGE), numbers, row_shares=[2, 1])
    return rrb.Blueprint(rrb.Horizontal(rrb.Spatial3DView(origin="world"), right))
