"""A run as a recording for rerun's viewer: images, masks, kept and culled features, map, trajectory against truth.

Images are JPEG at half size, for which everything in their plane is scaled. Rows are collected and handed over
`BLOCK` frames at a time, which costs a third of logging one by one. On the timelines ``frame`` (index) and ``time``
(seconds since the first frame):

- ``world/camera``: the causal pose; ``world/camera/image`` with ``mask``, ``kept`` and ``culled`` below it
- ``error/trans_m``, ``features/kept``, ``features/culled``: numbers a frame; ``state``: where it changes

and without time, from the end of the run: ``world/map``, ``world/estimate``, ``world/truth`` (aligned to the estimate).
"""

from __future__ import annotations

import contextlib
import importlib.util
import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Sequence
from dynslam_bench.core.errors import RunError
from dynslam_bench.core.version import install_hint
from dynslam_bench.envs.rendering import CULLED, ESTIMATE, KEPT, MASK, TRUTH
from dynslam_bench.geometry import se3
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.runs.artifacts import Snapshot, aligned_truth, read_snapshots
from dynslam_bench.runs.exchange.rerun_file import CLEARED, IMAGE, LAYERS, Block, RerunFile, packed
from dynslam_bench.runs.frames import CSV_FILE, read_csv
from dynslam_bench.runs.process.fork_server import child_environment
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.runs.store import RunStore
from dynslam_bench.slam.map_files import read_ply

RECORDING_FILE = "recording.rrd"
BLOCK = 25
_QUALITY = 80


@dataclass
class _Rows:
    """Values of one entity with the frames they belong to."""

    frames: list[int] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)

    def arrays(self, entity: str) -> Block:
        """The rows in a block: side by side where all have one shape, else one behind the other with their lengths."""
        block: Block = {
            f"{entity}|frames": np.array(self.frames, np.int64),
            f"{entity}|times": np.array(self.times, np.float64),
        }
        if entity in (IMAGE, LAYERS["kept"], LAYERS["culled"]):
            lengths = np.array([len(value) for value in self.values], np.int64)
            return block | {f"{entity}|values": np.concatenate(self.values), f"{entity}|lengths": lengths}
        return block | {f"{entity}|values": np.array(self.values)}


class _File(Protocol):
    """What takes the blocks."""

    def write(self, block: Block) -> None: ...
    def close(self) -> None: ...


class _Apart:
    """The file in a process of its own, `rerun_file`: rerun takes a while to load, and its work is not the run's."""

    def __init__(self, start: Block) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", RerunFile.__module__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=child_environment(),
        )
        self.write(start)

    def write(self, block: Block) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # `close` says why
            self._process.stdin.write(packed(block))
            self._process.stdin.flush()

    def close(self) -> None:
        said, _ = self._process.communicate()
        if self._process.returncode:
            reason = said.decode(errors="replace") or f"its process ended with exit code {self._process.returncode}"
            raise RunError(f"the recording cannot be written: {reason}", "check the free space; the log may say more")


class RecordingWriter:
    """Writes one run as an ``.rrd`` file; what a run that ends early has handed over stays readable.

    Args:
        path: The file.
        camera: Of the images that will be added.
        name: Recording's name in the viewer.
        apart: Whether a process of its own writes the file, so that a run need not wait for it.

    Raises:
        RunError: `rerun-sdk` is not installed, or the file cannot be written.
    """

    def __init__(self, path: Path, camera: Camera, name: str, *, apart: bool = False) -> None:
        check_rerun()
        self._size = (max(camera.width // 2, 1), max(camera.height // 2, 1))
        self._scale = np.array([self._size[0] / camera.width, self._size[1] / camera.height])
        self._rows: dict[str, _Rows] = {}
        self._shown: set[str] = set()
        self._first: float | None = None
        self._state = ""
        start = {"path": str(path), "name": name, "matrix": self._matrix(camera), "size": self._size}
        start |= {"kept": KEPT, "culled": CULLED, "mask": MASK}
        try:
            path.touch()
            block = {name: np.array(value) for name, value in start.items()}
            self._file: _File = _Apart(block) if apart else RerunFile(block)
        except OSError as error:
            raise RunError(f"cannot write {path}: {error}", "check the permissions and the free space") from error

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
            self._put(IMAGE, at, self._jpeg(rgb))
        if error_m is not None:
            self._put("error/trans_m", at, error_m)
        self._clear(shot, at)
        if shot is not None:
            self._put_seen(shot, at)
        if state != self._state:
            self._put("state", at, state)
            self._state = state
        if len(self._rows.get(IMAGE, _Rows()).frames) >= BLOCK:
            self._hand_over()

    def finish(
        self,
        estimate: Trajectory,
        truth: Trajectory | None,
        positions: NDArray[np.floating] | None,
        colours: NDArray[np.uint8] | None,
    ) -> None:
        """Add what is known at the end: the trajectory, the truth in its frame, and the map ``[M, 3]`` in metres."""
        block: Block = {}
        for name, track, colour in (("estimate", estimate, ESTIMATE), ("truth", truth, TRUTH)):
            if track is not None and len(track):
                block |= {f"world/{name}|line": track.positions, f"world/{name}|colour": np.array(colour)}
        if positions is not None and len(positions):
            block["world/map|points"] = positions
            if colours is not None:
                block["world/map|colours"] = colours
        if block:
            self._file.write(block)

    def close(self) -> None:
        """Hand over what is left and end the file.

        Raises:
            RunError: It could not be written.
        """
        self._hand_over()
        self._file.close()

    def _matrix(self, camera: Camera) -> NDArray[np.float64]:
        matrix: NDArray[np.float64] = camera.matrix * np.array([*self._scale, 1.0])[:, None]
        matrix[:2, 2] += 0.5 * self._scale  # rerun puts the corner of the top-left pixel at 0, we its centre
        return matrix

    def _put(self, entity: str, at: tuple[int, float], value: Any) -> None:
        rows = self._rows.setdefault(entity, _Rows())
        rows.frames.append(at[0])
        rows.times.append(at[1])
        rows.values.append(value)

    def _put_seen(self, shot: Snapshot, at: tuple[int, float]) -> None:
        points = ((shot.points + 0.5) * self._scale).astype(np.float32)
        for name, chosen in (("kept", points[shot.kept]), ("culled", points[~shot.kept])):
            self._put(LAYERS[name], at, chosen)
            self._put(f"features/{name}", at, float(len(chosen)))
        if shot.mask is not None:
            small = cv2.resize(shot.mask.astype(np.uint8), self._size, interpolation=cv2.INTER_NEAREST)
            self._put(LAYERS["mask"], at, small)

    def _clear(self, shot: Snapshot | None, at: tuple[int, float]) -> None:
        """What an earlier frame showed and this one does not know must not stand on in the viewer."""
        shown = set() if shot is None else {"kept", "culled"} | ({"mask"} if shot.mask is not None else set())
        for name in self._shown - shown:
            self._put(f"{CLEARED}{LAYERS[name]}", at, False)
        self._shown = shown

    def _jpeg(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        small = cv2.cvtColor(cv2.resize(rgb, self._size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2BGR)
        encoded: NDArray[np.uint8] = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
        return encoded

    def _hand_over(self) -> None:
        block: Block = {}
        for entity, rows in self._rows.items():
            block |= rows.arrays(entity)
        self._rows.clear()
        if block:
            self._file.write(block)


def check_rerun() -> None:
    """See that the library is there, without loading it.

    Raises:
        RunError: It is not installed.
    """
    if importlib.util.find_spec("rerun") is None:
        raise RunError("recordings are written with rerun-sdk, which is not installed", install_hint("rerun"))


# A stored run as a recording: what is kept of it, with the images of its sequence.

_TOLERANCE_S = 1e-5


def write_stored(
    path: Path, store: RunStore, record: RunRecord, sequence: Sequence, trajectory: Trajectory
) -> list[str]:
    """Write the recording of a stored run.

    Args:
        path: The file.
        store: The run's.
        record: The run.
        sequence: The frames that it saw.
        trajectory: What is drawn as its estimate, and where the camera goes if the run has no online poses.

    Returns:
        What a user should know, one line each.

    Raises:
        RunError: `rerun-sdk` is not installed, or a file of the run is damaged.
        SequenceError: An image cannot be read.
    """
    folder = store.folder(record.run_id)
    (height, width), shots = read_snapshots(folder)
    scale = np.array([sequence.camera.width / max(width, 1), sequence.camera.height / max(height, 1)])
    seen = {shot.index: _scaled(shot, scale) for shot in shots}
    online = store.trajectory(record.run_id, "online") or trajectory
    rows = {row.index: row for row in read_csv(folder / CSV_FILE)} if (folder / CSV_FILE).is_file() else {}
    writer = RecordingWriter(path, sequence.camera, f"{record.tracker.label} on {record.sequence.id}")
    with contextlib.closing(writer):
        for index in range(len(sequence)):
            frame, row = sequence[index], rows.get(index)
            pose = _pose_at(online, frame.timestamp)
            state, error = ("", None) if row is None else (str(row.state), row.pose_error_trans_m)
            writer.add(index, frame.timestamp, frame.rgb, pose, seen.get(index), state=state, error_m=error)
        cloud = read_ply(folder / "map.ply") if (folder / "map.ply").is_file() else None
        truth = aligned_truth(sequence.ground_truth, trajectory)[0]
        positions, colours = (None, None) if cloud is None else (cloud.positions, cloud.colours)
        writer.finish(trajectory, truth, positions, colours)
    notes = [f"features and masks are known of {len(seen)} of {len(sequence)} frames; `run --rrd` records all"]
    return notes if len(seen) < len(sequence) else []


def _scaled(shot: Snapshot, scale: NDArray[np.float64]) -> Snapshot:
    """A snapshot of an image that the tracker's preprocessing had resized, in pixels of the sequence's."""
    if (scale == 1).all():
        return shot
    points = ((shot.points + 0.5) * scale - 0.5).round().astype(np.int16)
    return replace(shot, points=points)


def _pose_at(trajectory: Trajectory, stamp: float) -> NDArray[np.float64] | None:
    near = int(np.searchsorted(trajectory.timestamps, stamp - _TOLERANCE_S))
    if near < len(trajectory) and abs(trajectory.timestamps[near] - stamp) <= _TOLERANCE_S:
        pose: NDArray[np.float64] = trajectory.T_world_cam[near]
        return pose
    return None
