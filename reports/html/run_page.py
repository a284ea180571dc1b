"""What the page of one run shows: its facts, its frames over time, its track beside the true one, its log."""

from __future__ import annotations

import base64
import io
import os
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from dynslam_bench.contracts.sequence import Sequence as FrameSequence
from dynslam_bench.core.errors import DynslamError, RunError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.reading import TABLE_BYTES, read_bytes
from dynslam_bench.evaluation.evaluate import pose_errors
from dynslam_bench.evaluation.protocol import Protocol, RPESpec
from dynslam_bench.geometry.trajectory import Trajectory
from dynslam_bench.reports.figures import broken, significant
from dynslam_bench.reports.html.page import packed_rows, write_side
from dynslam_bench.reports.model.missing import run_command
from dynslam_bench.reports.model.row import RunRow, command_line
from dynslam_bench.reports.tables.leaderboard import DOUBT
from dynslam_bench.runs.artifacts import Snapshot, read_snapshots, spread
from dynslam_bench.runs.exchange.export import open_stored
from dynslam_bench.runs.frames import CSV_FILE
from dynslam_bench.runs.record import RunRecord

Array = NDArray[np.float64]

MOST_FRAMES = 400
"""Frames of a run that its page shows unless something else is asked for."""
_LOG_BYTES = 20_000
_WHOLE = ("total_s", "processor_s", "read_s")
"""Times of a frame that are no stage of it: the figure stacks stages."""


def run_content(
    row: RunRow, record: RunRecord, frames: RunFrames, protocol: Protocol, most: int = MOST_FRAMES
) -> dict[str, Any]:
    """Everything that the page of a run shows, as the page's script reads it.

    Args:
        row: The run.
        record: Its whole record.
        frames: Its frames.
        protocol: How its errors are computed.
        most: Frames that are shown; of longer runs every second, third, ...
    """
    return {
        "id": row.run_id,
        "status": row.status,
        "ending": row.ending,
        "reason": row.reason,
        "facts": _facts(row, record, protocol.rpe),
        "settings": {
            name: value if isinstance(value, str | int | bool | None) else str(value)
            for name, value in record.settings.items()
        },
        "overrides": sorted(record.overrides),
        "stages": [
            [name, *(significant(1000 * value) for value in (time.median_s, time.p95_s, time.mean_s))]
            for name, time in record.timings.items()
        ],
        "protocol": protocol.describe(),
        "started": row.started,
        "machine": row.machine_words,
        "notes": [*row.notes, *filter(None, [frames.fault])],
        "command": run_command(row),
        "asked": command_line(row.command),
        "log": _log(row),
        "frames": _series(frames, most),
        "track": _track(row, protocol, most),
    }


def _facts(row: RunRow, record: RunRecord, rpe: Sequence[RPESpec]) -> list[list[str | float | None]]:
    """Name, number and unit of what is known of a run."""
    rpe_facts = [
        (f"RPE over {spec.describe()}", row.metrics.get(spec.metric("trans")), 1000, "mm/s" if spec.rate else "mm")
        for spec in rpe
    ]
    facts: list[tuple[str, float | None, int, str]] = [
        ("ATE, lost frames held", row.score_m, 1000, "mm"),
        ("ATE of the tracked frames", row.metrics.get("ate_rmse_m"), 1000, "mm"),
        ("ATE of the final trajectory", row.final_ate_m, 1000, "mm"),
        *rpe_facts,
        ("coverage", row.coverage, 100, "%"),
        ("frame time", row.frame_ms, 1, "ms"),
        ("real time", row.real_time_factor, 1, "×"),
        ("memory", row.peak_memory_mb, 1, "MB"),
        ("keyframes", record.keyframes, 1, ""),
        ("map points", record.map_points, 1, ""),
        ("mask overlap (IoU)", row.mask_iou, 1, ""),
    ]
    return [[name, significant(value * factor), unit] for name, value, factor, unit in facts if value is not None]


def _log(row: RunRow) -> str:
    path = row.folder / "log.txt"
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        before = max(file.seek(0, os.SEEK_END) - _LOG_BYTES, 0)
        file.seek(before)
        text = file.read(_LOG_BYTES)
    return (f"... {before} bytes before\n" if before else "") + text.decode(errors="replace")


def _series(frames: RunFrames, most: int) -> dict[str, Any]:
    """The frames over time, thinned and packed."""
    columns = frames.columns
    if not columns:
        return {}
    step = -(-len(frames) // most)
    stamps, start = columns["timestamp"], float(columns["timestamp"][0])
    stages = [name for name in columns if name.endswith("_s") and name not in _WHOLE]
    counts = [name for name in COUNTS if f"stat_{name}" in columns]
    rows = [stamps - start, 1000 * frames.errors_m, 100 * frames.share]
    rows += [columns[f"stat_{name}"] for name in counts] + [1000 * columns[name] for name in stages]
    t, error, share, *others = packed_rows([np.asarray(row, dtype=np.float64)[::step] for row in rows])
    series: dict[str, Any] = {
        "count": len(frames),
        "step": step,
        "start": start,
        "t": t,
        "states": "".join(state[:1] for state in columns["state"][::step].tolist()),
        "frame_error_mm": error,
        "share_source": frames.share_source,
        "counts": dict(zip(counts, others, strict=False)),
        "stages": {name[:-2]: row for name, row in zip(stages, others[len(counts) :], strict=True)},
    }
    return series | {"share": share} if np.isfinite(frames.share).any() else series


def _track(row: RunRow, protocol: Protocol, most: int) -> dict[str, Any]:
    """The aligned track beside the true one; without ground truth the track alone; empty if nothing was tracked.

    Where the time between two poses exceeds twice the median interval, all series have a gap.
    """
    try:
        estimate, truth = row.estimate(row.trajectory), row.ground_truth()
        if estimate is None or len(estimate) < 2:
            return {}
        if truth is None or not row.metrics:
            return _packed_track(estimate, {"xyz": estimate.positions, "angles": _angles(estimate, estimate)}, most)
        aligned, true, series = pose_errors(estimate, truth, protocol)
    except DynslamError as error:
        return {"reason": str(error)}
    columns = {
        "error_mm": 1000 * series["trans_m"],
        "rotation_deg": series["rot_deg"],
        "xyz": aligned.positions,
        "true_xyz": true.positions,
        "angles": _angles(aligned, true),
        "true_angles": _angles(true, true),
    }
    return _packed_track(aligned, columns, most) | {"alignment": protocol.alignment, "doubt": _rotation_doubt(row)}


def _rotation_doubt(row: RunRow) -> str:
    """Why the angles of an aligned track say nothing of the tracker; empty where they do."""
    if row.rotation_reliable:
        return ""
    return (
        f"{DOUBT} Rotation is unreliable: the path hardly determines the alignment's rotation (standard error "
        f"{row.rotation_uncertainty_deg:.0f}°), which turns all angles shown here. Positions are not affected."
    )


def _packed_track(track: Trajectory, columns: Mapping[str, Array], most: int) -> dict[str, Any]:
    """Series along a track ``[N]`` or ``[N, 3]``, thinned, broken at gaps and packed."""
    start = float(track.timestamps[0])
    widths = [1 if values.ndim == 1 else values.shape[1] for values in columns.values()]
    together = np.column_stack(list(columns.values()))
    stamps, values = broken(track.timestamps - start, together, most)
    t, *rows = packed_rows(np.vstack([stamps, values.T]))
    packed: dict[str, Any] = {"start": start, "t": t}
    for name, width in zip(columns, widths, strict=True):
        packed[name] = rows[0] if width == 1 else rows[:width]
        rows = rows[width:]
    return packed


def _angles(track: Trajectory, true: Trajectory) -> Array:
    """Yaw, pitch and roll (about the camera's y, x and z) from the first true pose, in degrees ``[N, 3]``."""
    turned = true.T_world_cam[0, :3, :3].T @ track.T_world_cam[:, :3, :3]
    yaw = np.arctan2(turned[:, 0, 2], turned[:, 2, 2])
    pitch = np.arcsin(np.clip(-turned[:, 1, 2], -1, 1))
    roll = np.arctan2(turned[:, 1, 0], turned[:, 1, 1])
    return np.asarray(np.degrees(np.unwrap(np.stack([yaw, pitch, roll], axis=1), axis=0)))


# -- the frames of a run, from its ``frames.csv``

Columns = dict[str, NDArray[Any]]

COUNTS = ("keypoints", "culled", "matches", "inliers")
_STATS = {f"stat_{name}" for name in (*COUNTS, "mask_fraction")}
_NEEDED = {"index", "timestamp", "state", "frame_error_trans_m"}
_ASKED = 5
"""Runs of a column that are asked for the exact shares of its frames."""


@dataclass(frozen=True, eq=False)
class RunFrames:
    """The frames of a run.

    Attributes:
        columns: What the page shows of ``frames.csv``, a name to values ``[N]``; empty for an imported trajectory.
        share: Share of the pixels that show people ``[N]``, nan where it is not known.
        share_source: Where that comes from, in words; empty where nothing is known.
        fault: Why there are no frames though there is a table; empty otherwise.
    """

    columns: Columns
    share: Array
    share_source: str
    fault: str = ""

    def __len__(self) -> int:
        return len(self.share)

    @property
    def errors_m(self) -> Array:
        """Frame-to-frame translational errors ``[N]`` in metres, nan where there is none."""
        return np.asarray(self.columns["frame_error_trans_m"], dtype=np.float64)


def read_frames(row: RunRow, exact: Mapping[int, float]) -> RunFrames:
    """The frames of a run with the share of dynamic pixels: the exact one if it is known, else by its own masks.

    Args:
        row: The run.
        exact: Frame in the numbering of the run's part without offset to the exact share.
    """
    try:
        columns = read_table(row.folder / CSV_FILE, _is_shown)
    except RunError as error:
        return RunFrames({}, np.zeros(0), "", str(error))
    if columns is None:
        return RunFrames({}, np.zeros(0), "")
    if exact:
        share = [exact.get(index + row.offset, np.nan) for index in columns["index"].tolist()]
        return RunFrames(columns, np.array(share), "exact masks")
    own = columns.get("stat_mask_fraction")
    if own is not None and own.any():  # else it may have no masks
        return RunFrames(columns, own.astype(np.float64), "the tracker's own masks")
    return RunFrames(columns, np.full(len(columns["index"]), np.nan), "")


def exact_shares(rows: Sequence[RunRow]) -> dict[int, float]:
    """Frame (before the offset) to its exact share of dynamic pixels, from those of the first runs that know it."""
    shares: dict[int, float] = {}
    for row in rows[:_ASKED]:
        try:
            columns = read_table(row.folder / CSV_FILE, {"index", "dynamic_share"}.__contains__)
        except RunError:  # is named on the page of that run
            continue
        if columns is not None and "dynamic_share" in columns:
            finite = np.isfinite(columns["dynamic_share"])
            indices = (columns["index"][finite] + row.offset).tolist()
            shares |= dict(zip(indices, columns["dynamic_share"][finite].tolist(), strict=True))
    return shares


def read_table(path: Path, wanted: Callable[[str], bool]) -> Columns | None:
    """Columns of a ``frames.csv``, a name to values ``[N]``: numbers, and the state in words; None for no table.

    Raises:
        RunError: It holds no frames, or something else than numbers.
    """
    kinds: dict[str, Any] = defaultdict(lambda: np.float64, index=np.int64, state=str)
    try:
        if not path.is_file() or not path.stat().st_size:
            return None
        content = io.BytesIO(read_bytes(path, limit=TABLE_BYTES))
        table = pd.read_csv(content, usecols=wanted, dtype=kinds, low_memory=False)
    except (DynslamError, ValueError, OverflowError, OSError) as error:
        raise RunError(f"{CSV_FILE} is damaged: {error}") from error
    if not isinstance(table.index, pd.RangeIndex):
        raise RunError(f"{CSV_FILE} is damaged: its lines have more cells than its heading")
    if not set(filter(wanted, _NEEDED)) <= set(table) or table.empty:
        raise RunError(f"{CSV_FILE} holds no frames")
    if "timestamp" in table and not np.isfinite(table["timestamp"]).all():
        raise RunError(f"{CSV_FILE} is damaged: not every frame has a stamp")
    return {str(name): table[name].to_numpy() for name in table}


def _is_shown(name: str) -> bool:
    """Whether the page shows a column of ``frames.csv``."""
    return name in _NEEDED or name in _STATS or (name.endswith("_s") and not name.startswith("stat_"))


# -- pictures of frames: drawn from the sequence when the report is made, once a frame

FOLDER = "frames"
EVEN, WORST = 16, 4
"""Frames of a run that are shown evenly spread, and those with the largest frame-to-frame error."""
_WIDTH, _QUALITY = 480, 62
_MASK_WIDTH = 240


@dataclass
class PictureBook:
    """Draws the frames that runs show, as long as there is time for it; what is there already is not drawn again.

    Args:
        output: Folder of the report.
        seconds: Time that opening and drawing may take altogether.
    """

    output: Path
    seconds: float
    _spent: float = 0.0
    _opened: dict[tuple[Any, ...], FrameSequence | DynslamError] = field(default_factory=dict)

    def add(self, row: RunRow, record: RunRecord, frames: RunFrames, missing: Counter[str]) -> bool:
        """Draw the frames that a run shows and write what the tracker saw on them as ``data/looks-<run id>.js``.

        Args:
            row: The run.
            record: Its whole record.
            frames: Its frames.
            missing: Why some frames have no picture, which is counted there.

        Returns:
            Whether there is anything to see.
        """
        if not len(frames):
            return False
        try:
            size, snapshots = read_snapshots(row.folder)
        except DynslamError as error:
            missing[str(error)] += 1
            return False
        by_index = {snapshot.index: snapshot for snapshot in snapshots}
        errors_mm = dict(zip(frames.columns["index"].tolist(), (1000 * frames.errors_m).tolist(), strict=True))
        looks = []
        for index in _chosen(frames, sorted(by_index)):
            look: dict[str, Any] = {"index": index}
            try:
                look["image"] = self._image(record, index)
            except DynslamError as error:
                missing[str(error)] += 1
            if index in by_index:
                look |= _annotations(by_index[index], size)
            if look.get("image") or look.get("points"):
                looks.append(look | {"error_mm": significant(errors_mm.get(index))})
        if looks:
            write_side(self.output, f"looks-{row.run_id}", {"looks": looks, "stored": bool(snapshots)})
        return bool(looks)

    def _image(self, record: RunRecord, index: int) -> str:
        """Relative path of the picture of a frame; drawn if it is not there yet.

        Raises:
            DynslamError: The sequence cannot be opened, is another one by now, or the time is over.
        """
        number = (record.frames or (0, None))[0] + (index * record.stride) + record.offset
        path = self.output / FOLDER / (record.sequence.block or record.sequence.part) / f"{number}.webp"
        if not path.is_file():
            if self._spent >= self.seconds:
                raise DynslamError(f"not drawn within {self.seconds:.0f} s", "make the report again: it goes on there")
            began = time.perf_counter()
            image = self._sequence(record)[index].rgb
            size = _shrunk_size(image, _WIDTH)
            shrunk = cv2.resize(np.ascontiguousarray(image[:, :, ::-1]), size, interpolation=cv2.INTER_AREA)
            write_atomic(path, _encoded(".webp", np.asarray(shrunk), cv2.IMWRITE_WEBP_QUALITY, _QUALITY))
            self._spent += time.perf_counter() - began
        return path.relative_to(self.output).as_posix()

    def _sequence(self, record: RunRecord) -> FrameSequence:
        key = (record.place or record.sequence.id, record.frames, record.offset, record.stride, record.sequence.content)
        if key not in self._opened:
            try:
                self._opened[key] = open_stored(record)
            except DynslamError as error:
                self._opened[key] = error
        opened = self._opened[key]
        if isinstance(opened, DynslamError):
            raise opened
        return opened


def _chosen(frames: RunFrames, stored: Sequence[int]) -> list[int]:
    """Frames to show: some spread over the run, and the worst; of those that the run has stored, if it has any."""
    indices = frames.columns["index"]
    order = np.argsort(-np.nan_to_num(frames.errors_m, nan=-1.0), kind="stable")
    bad = [int(indices[at]) for at in order if np.isfinite(frames.errors_m[at])]
    if not stored:
        return sorted({int(indices[at]) for at in spread(len(frames), EVEN)} | set(bad[:WORST]))
    even = {stored[at] for at in spread(len(stored), EVEN)}
    return sorted(even | set([index for index in bad if index in set(stored)][:WORST]))


def _annotations(snapshot: Snapshot, size: tuple[int, int]) -> dict[str, Any]:
    """Features (two bytes each: x and y in 255ths of the image), which were kept, and the mask as a small image."""
    height, width = size
    places = (
        np.clip(snapshot.points * np.array((255 / width, 255 / height), np.float32), 0, 255).round().astype(np.uint8)
    )
    order = np.argsort(snapshot.kept, kind="stable")  # culled ones first
    annotations = {"points": base64.b64encode(places[order].tobytes()).decode(), "culled": int((~snapshot.kept).sum())}
    annotations |= {"width": width, "height": height, "share": None}
    mask = snapshot.mask
    if mask is not None:
        annotations["share"] = significant(100 * np.count_nonzero(mask) / mask.size, 3)
    if mask is not None and annotations["share"]:
        small = cv2.resize(mask.view(np.uint8), _shrunk_size(mask, _MASK_WIDTH), interpolation=cv2.INTER_NEAREST)
        png = base64.b64encode(_encoded(".png", np.asarray(small), cv2.IMWRITE_PNG_BILEVEL, 1)).decode()
        annotations["mask"] = f"data:image/png;base64,{png}"
    return annotations


def _shrunk_size(image: NDArray[Any], width: int) -> tuple[int, int]:
    return width, max(round(image.shape[0] * width / image.shape[1]), 1)


def _encoded(kind: str, image: NDArray[Any], *options: int) -> bytes:
    done, data = cv2.imencode(kind, image, options)
    if not done:
        raise DynslamError(f"this OpenCV cannot write {kind} images")
    return bytes(data)
