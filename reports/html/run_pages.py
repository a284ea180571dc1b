"""Pages of runs: what a page shows of a run is written beside it, one script and one folder of pictures a run."""

from __future__ import annotations

import io
import os
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dynslam_bench.core import TABLE_BYTES, DynslamError, RunError, read_bytes
from dynslam_bench.core.module_graph import PLUMBING, module_graph
from dynslam_bench.core.number_text import mm, significant_text
from dynslam_bench.core.records import digest
from dynslam_bench.evaluation import Protocol, RPESpec, pose_errors
from dynslam_bench.evaluation.verdicts import CATASTROPHE, FLOOR_M
from dynslam_bench.geometry import Trajectory
from dynslam_bench.reports.figures import COLOURS, NEUTRAL, packed, significant
from dynslam_bench.reports.html.page import read_remark, write_changed, write_side
from dynslam_bench.reports.model.row import RunRow, command_line, grouped, run_command
from dynslam_bench.reports.model.summary import reservations
from dynslam_bench.reports.model.workers import WorkerPool, run_jobs
from dynslam_bench.runs.artifacts import VIDEO_FILE, read_snapshots
from dynslam_bench.runs.exchange.recording import RECORDING_FILE
from dynslam_bench.runs.frames import CSV_FILE
from dynslam_bench.runs.layout import file_stamp
from dynslam_bench.runs.record import RunRecord, coverage_text
from dynslam_bench.runs.rows import part_words

Array = NDArray[np.float64]

RUN_PAGE = "run.html"
"""The page that shows one run."""
SHARE_EDGES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 1.0)
"""Bins of the share of dynamic pixels."""
FEWEST_FRAMES = 5
"""Frames below which a bin shows nothing."""
MOST_FRAMES = 400
"""About how many frames of a run its page shows."""
RESIDUALS = 60
"""About how many residuals, lines from the estimate to the true position, a track shows."""
WORST = 6
"""Frames that a page offers to jump to, those with the largest frame-to-frame error."""
_APART = 15
"""Frames between two of these at least."""
_LOG_BYTES = 20_000
"""Bytes of the end of a log that a page shows."""
_NO_STAGES = ("total_s", "processor_s", "read_s")
"""Times of a frame that are no stage of it: the figure stacks stages."""


@dataclass(frozen=True)
class RunPage:
    """Entry in the report for a run whose page was written.

    Attributes:
        variant_key: Its tracker and settings.
        squares: Sum of the squared frame-to-frame errors (translation, m²) of its frames in every
            bin of `SHARE_EDGES`, of a successful run where exact masks tell the share.
        frames: Number of these frames.
    """

    variant_key: str
    squares: list[float]
    frames: list[int]


@dataclass(frozen=True)
class LeastError:
    """The least error that a ranked tracker has on a sequence.

    Attributes:
        error_m: Median over the tracker's runs, in metres.
        label: The tracker.
    """

    error_m: float
    label: str


def write_run_pages(
    rows: Sequence[RunRow],
    pictured: Collection[str],
    protocol: Protocol,
    output: Path,
    least: Mapping[str, LeastError] | None = None,
    pool: WorkerPool | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[RunPage]:
    """Write what the pages of some runs show: ``data/run-<id>.js``, and their pictures.

    Args:
        rows: The runs.
        pictured: Ids of the runs whose pictures are copied.
        protocol: How errors are computed.
        output: Folder of the report.
        least: The least error on each sequence that has one, by `RunRow.sequence_key`.
        pool: Workers that write the pages; None to write them here.
        progress: Called with the runs that are done, and all.

    Raises:
        DynslamError: The folder cannot be written, or a run's files are damaged.
    """
    # exact shares of dynamic pixels by column: from runs without offset, of these from the newest
    newest = sorted(rows, key=lambda row: row.started, reverse=True)
    newest.sort(key=lambda row: row.offset)
    shares = {}
    for column, runs in grouped(newest, lambda row: row.sequence_key).items():
        shares[column] = exact_shares(runs)

    # write the pages, those of one column after each other
    jobs = []
    for column, runs in grouped(rows, lambda row: row.sequence_key).items():
        for row in runs:
            best = (least or {}).get(column)
            jobs.append((row, row.run_id in pictured, shares[column], protocol, output, best))
    pages: list[RunPage] = []
    for page in run_jobs(pool, _write_page, jobs):
        pages.append(page)
        progress(len(pages), len(rows))
    return pages


def _write_page(
    row: RunRow,
    pictured: bool,
    share: Mapping[int, float],
    protocol: Protocol,
    output: Path,
    least: LeastError | None,
) -> RunPage:
    """Write the page of a run whose frames have these exact shares of dynamic pixels.

    A page whose inputs are as they were stays as it is.
    """
    # a page that was made of the same code, protocol, files and state stays
    name = f"run-{row.run_id}"
    files = _files(row, output)
    stamps = [file_stamp(row.folder / file) for file in (CSV_FILE, "log.txt")]
    state = row.store.index.state(row.run_id, row.sequence.part)
    code = [_own_code(), protocol.digest(), *share.items()]
    beside = None if least is None else [least.error_m, least.label]
    made_of = digest([code, state, stamps, files, pictured, row.notes, row.failed, beside])
    earlier = read_remark(output, name)
    if earlier and earlier[0] == made_of:
        return RunPage(row.variant_key, *earlier[1:])

    # what the page shows
    record = row.store.read_whole(row.run_id)
    frames = read_frames(row, share)
    pictures = _copy_pictures(row, output) if pictured else []
    data = run_data(row, record, frames, protocol, pictures, least)

    # squared errors by the share of people, of the frames of a successful run with exact masks
    has_exact = (frames.share_source == EXACT) & (not row.failed)
    exact = np.isfinite(frames.errors_m) & np.isfinite(frames.share) & has_exact
    sums = share_sums(frames.share[exact], frames.errors_m[exact])
    write_side(output, name, data | {"files": files}, remark=[made_of, *sums])
    return RunPage(row.variant_key, *sums)


@cache
def _own_code() -> str:
    """Digest of the code that pages are made by."""
    return module_graph().digest([__name__], PLUMBING)


def _copy_pictures(row: RunRow, output: Path) -> list[int]:
    """Copy the pictures of a run beside its page; returns their frames."""
    sources = sorted(row.folder.glob("frame_*.webp"))
    target = output / "frames" / row.run_id
    for source in sources:
        write_changed(target / source.name, read_bytes(source, kind=RunError))
    return [int(source.stem.removeprefix("frame_")) for source in sources]


def _files(row: RunRow, output: Path) -> list[tuple[str, str]]:
    """Name and relative path of the run's files, where the report lies in the results folder of the run."""
    if not output.resolve().is_relative_to(row.store.root.resolve()):
        return []
    files = {
        "trajectory": f"trajectory_{row.trajectory}.txt",
        "video": VIDEO_FILE,
        "rerun recording": RECORDING_FILE,
        "frames.csv": CSV_FILE,
    }
    folder = Path(os.path.relpath(row.folder.resolve(), output.resolve())).as_posix()
    return [
        (name, f"{folder}/{file}") for name, file in files.items() if (row.folder / file).is_file()
    ]


def share_sums(share: Array, errors_m: Array) -> tuple[list[float], list[int]]:
    """Sums of the squared errors ``[N]``, and numbers of frames, in every bin of `SHARE_EDGES`."""
    squares, _ = np.histogram(share, SHARE_EDGES, weights=errors_m**2)
    counts, _ = np.histogram(share, SHARE_EDGES)
    return squares.tolist(), counts.tolist()


def error_by_share(pages: Sequence[RunPage]) -> list[list[float | None]]:
    """RMSE in mm and number of frames of each bin between `SHARE_EDGES`, over some runs; empty for no frame.

    Not the median: a tracker that follows people errs grossly on few frames, and best of all on
    most.
    """
    # sums over the runs, in every bin
    squares = np.sum([page.squares for page in pages], axis=0)
    counts = np.sum([page.frames for page in pages], axis=0)
    if not counts.any():
        return []
    rmse_mm = 1000 * np.sqrt(squares / np.maximum(counts, 1))
    return [
        [significant(error, 4) if count >= FEWEST_FRAMES else None, count]
        for error, count in zip(rmse_mm.tolist(), counts.tolist(), strict=True)
    ]


# -- what the page of a run shows


def run_data(
    row: RunRow,
    record: RunRecord,
    frames: RunFrames,
    protocol: Protocol,
    pictures: Sequence[int] = (),
    least: LeastError | None = None,
) -> dict[str, Any]:
    """Everything that the page of a run shows, as the page's script reads it.

    Series of numbers stand once, under ``series``; the figures name them (``"@x"``).

    Args:
        row: The run.
        record: Its whole record.
        frames: Its frames.
        protocol: How its errors are computed.
        pictures: Frames that have a picture.
        least: The least error on the run's sequence.
    """
    # series of numbers over the frames and along the track, and the figures that name them
    series, lost = _series(frames, pictures)
    start = float(frames.columns["timestamp"][0]) if frames.columns else None
    track, fault = _track(row, protocol, start)
    figures = {
        "time": _time_figure(row, frames, series, track, lost),
        "track": _track_figure(track),
        "poses": _poses_figure(row, track),
        "stages": _stages_figure(series),
    }
    packed_series = {}
    for name, values in (series | track).items():
        packed_series[name] = packed(values, "i4" if name == "index" else "f4")

    level, verdict = run_summary(row, frames, least)
    return {
        "id": row.run_id,
        "level": level,
        "verdict": verdict,
        "numbers": _numbers(row, protocol.rpe),
        "quote": _quote(row, protocol),
        "more": _more_numbers(row, record),
        "settings": _settings_data(record),
        "stages": _stages_data(record),
        "protocol": protocol.describe(),
        "started": row.started,
        "machine": row.machine_words,
        "notes": [*row.notes, *filter(None, [frames.fault, fault, _rotation_doubt(row)])],
        "command": run_command(row),
        "asked": command_line(row.command),
        "log": _log_tail(row),
        "pictures": list(pictures),
        "worst": _worst(frames),
        "moment": _moment(row, frames),
        "caption": _caption(row, pictures, lost) if series or track else [],
        "series": packed_series,
        "figures": {name: figure for name, figure in figures.items() if figure},
    }


def _settings_data(record: RunRecord) -> list[list[Any]]:
    """Name and value of every setting, and whether it was asked for; those that were come first."""
    lines: list[list[Any]] = []
    for name, value in record.settings.items():
        text = value if isinstance(value, str | int | bool) else str(value)
        lines.append([name, text, name in record.overrides])
    return sorted(lines, key=lambda line: not line[2])


def _stages_data(record: RunRecord) -> list[list[Any]]:
    """Name of every stage, and the median, the 95th percentile and the mean of its time in milliseconds."""
    lines: list[list[Any]] = []
    for name, time in record.timings.items():
        times_s = (time.median_s, time.p95_s, time.mean_s)
        lines.append([name, *(significant(1000 * time_s) for time_s in times_s)])
    return lines


Level = Literal["red", "amber", "green"]


def run_summary(
    row: RunRow, frames: RunFrames, least: LeastError | None = None
) -> tuple[Level, str]:
    """Level of how a run ended, and a sentence on it and why.

    Red: it failed, or a camera that does not move has no larger error. Amber: frames were lost, the
    trajectory is probably faulty, or the error is more than `CATASTROPHE` times the least on the
    sequence.

    Args:
        row: The run.
        frames: Its frames.
        least: The least error on the run's sequence.
    """
    if row.failed:
        return "red", _failure_words(row, frames)

    # the error, in metres and of a static camera's
    score_m = row.score_m
    static_m = row.static_camera_ate_rmse_m
    error = "No ground truth" if score_m is None else f"ATE {mm(score_m)} mm"
    if score_m is not None and static_m:
        error += f", {significant_text(100 * score_m / static_m, 2)} % of a static camera's"
        if score_m >= static_m and not row.fixed_camera:
            return "red", f"No better than not moving: {error}"
    far_off = _far_off_words(score_m, least)

    if row.incomplete:
        words = f"Tracked {row.n_tracked} of {row.n_frames} frames: {error}{far_off}"
        loss = _loss_words(row, frames)
        return "amber", f"{words}. {loss}" if loss else words
    if row.hints:
        return "amber", f"{error}, but the trajectory is probably faulty: {row.hints[0]}"
    if row.coverage is None:
        return "amber" if far_off else "green", f"{row.poses_words}: {error}{far_off}"
    tracked = "Tracked" if row.n_tracked < row.n_frames else f"All {row.n_frames} frames tracked"
    return "amber" if far_off else "green", f"{tracked}: {error}{far_off}"


def _far_off_words(score_m: float | None, least: LeastError | None) -> str:
    """Words on how many times the least error a run has, where that is more than `CATASTROPHE`; else empty."""
    if score_m is None or least is None:
        return ""
    ratio = max(score_m, FLOOR_M) / max(least.error_m, FLOOR_M)
    if ratio <= CATASTROPHE:
        return ""
    return (
        f", {significant_text(ratio, 2)} times the least here ({mm(least.error_m)} mm, {least.label}; "
        f"above {CATASTROPHE:g} times counts as a catastrophe)"
    )


def _failure_words(row: RunRow, frames: RunFrames) -> str:
    """Sentence on how a failed run ended, and why."""
    reason = f": {row.reason}" if row.reason else ""
    if row.status == "ok":
        return f"Not evaluated{reason}"
    if row.status != "lost":
        return f"{row.ending.capitalize()} frames{reason}"
    if not row.n_tracked:
        return f"Never tracked: not one of {row.n_frames} frames"
    why = row.reason or row.ending
    return f"{_loss_words(row, frames) or 'Lost'}. {why[0].upper()}{why[1:]}"


def _loss_words(row: RunRow, frames: RunFrames) -> str:
    """Sentence on when tracking was lost first, and what the frame showed; empty where it was not."""
    lost = np.flatnonzero(frames.columns.get("state", np.array([], str)) == "lost")
    if not len(lost):
        return ""
    at = int(lost[0])
    seconds = frames.columns["timestamp"][at] - frames.columns["timestamp"][0]
    facts = []
    inliers = frames.columns.get("stat_inliers", np.full(at + 1, np.nan))[at]
    if np.isfinite(inliers):
        facts.append(f"{inliers:.0f} inliers")
    share = frames.share[at]
    if np.isfinite(share):
        who = "people fill" if frames.share_source == EXACT else "its masks cover"
        facts.append(f"{who} {100 * share:.0f} %")
    words = f"Lost after {seconds:.1f} s of {row.sequence.duration_s:.1f} s"
    return f"{words}: {' while '.join(facts)}" if facts else words


def _numbers(row: RunRow, rpe: Sequence[RPESpec]) -> list[list[str]]:
    """The six numbers of a run: name and text, a dash for what is not known."""
    # absolute error, in millimetres and in percent of a static camera's
    score_m = row.score_m
    static_m = row.static_camera_ate_rmse_m
    ate_name = "ATE, as it counts" if row.failed else "ATE, lost frames held"
    ate = ""
    of_static = ""
    if score_m is not None:
        ate = f"{mm(score_m)} mm"
        if static_m:
            of_static = f"{significant_text(100 * score_m / static_m)} %"

    # the first relative error of the protocol that the run has
    rpe_name = "RPE"
    rpe_text = ""
    measured = [spec for spec in rpe if spec.metric("trans") in row.metrics]
    if measured:
        spec = measured[0]
        per_second = "/s" if spec.rate else ""
        rpe_name = f"RPE over {spec.describe()}"
        rpe_text = f"{mm(row.metrics[spec.metric('trans')])} mm{per_second}"

    time = "" if row.frame_ms is None else f"{significant_text(row.frame_ms)} ms"
    memory = "" if row.peak_memory_mb is None else f"{row.peak_memory_mb:.0f} MB"
    numbers = [
        (ate_name, ate),
        ("of a static camera's", of_static),
        (rpe_name, rpe_text),
        ("coverage", coverage_text(row.coverage, row.truth_share)),
        ("time of a frame", time),
        ("memory", memory),
    ]
    return [[name, text or "–"] for name, text in numbers]


def _quote(row: RunRow, protocol: Protocol) -> list[str]:
    """The error with everything that it depends on, then what speaks against quoting it."""
    if row.score_m is None:
        return []
    part = f" [{part_words(row)}]" if part_words(row) else ""
    words = [
        f"{row.label} on {row.sequence.id}{part}, {row.repeat}: ATE (RMSE) {mm(row.score_m)} mm",
        "lost frames held at the last pose",
        f"coverage {coverage_text(row.coverage, row.truth_share)}",
        protocol.describe(),
    ]
    if row.git:
        words.append(f"revision {row.git.revision[:10]}")
    return [f"{', '.join(words)}.", *reservations([row])]


def _more_numbers(row: RunRow, record: RunRecord) -> list[list[str]]:
    """Rows (name, text) of the table of further numbers on a run's page; missing ones are left out."""
    # name, value, factor to the unit that is shown, unit
    numbers = [
        ("ATE of the tracked frames", row.metrics.get("ate_rmse_m"), 1000, " mm"),
        ("ATE of the final trajectory", row.final_ate_m, 1000, " mm"),
        ("false motion, farthest", row.metrics.get("false_motion_max_m"), 1000, " mm"),
        ("false motion, path", row.metrics.get("false_motion_path_m"), 1000, " mm"),
        ("NEES / 6 of the covariances, one frame", row.metrics.get("nees_1f_mean"), 1, ""),
        ("within the 95 % ellipsoid, one frame", row.metrics.get("within95_1f"), 100, " %"),
        ("NEES / 6 of the covariances, one second", row.metrics.get("nees_1s_mean"), 1, ""),
        ("within the 95 % ellipsoid, one second", row.metrics.get("within95_1s"), 100, " %"),
        ("real time", row.real_time_factor, 1, " ×"),
        ("keyframes", record.keyframes, 1, ""),
        ("map points", record.map_points, 1, ""),
        ("overlap (IoU) of the masks, dilated", row.mask_iou, 1, ""),
    ]
    return [
        [name, f"{value * by:.4g}{unit}"] for name, value, by, unit in numbers if value is not None
    ]


def _log_tail(row: RunRow) -> str:
    """The end of a run's log; empty for none."""
    path = row.folder / "log.txt"
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        skipped = max(file.seek(0, os.SEEK_END) - _LOG_BYTES, 0)
        file.seek(skipped)
        text = file.read(_LOG_BYTES)
    return (f"... {skipped} bytes before\n" if skipped else "") + text.decode(errors="replace")


def _worst(frames: RunFrames) -> list[list[float | None]]:
    """Index and error in mm of the frames with the largest frame-to-frame error."""
    worst: list[list[float | None]] = []
    errors_m = frames.errors_m.copy()
    while len(worst) < WORST and np.isfinite(errors_m).any():
        at = int(np.nanargmax(errors_m))
        worst.append([int(frames.columns["index"][at]), significant(1000 * errors_m[at], 3)])
        # its neighbours would show the same moment
        errors_m[max(at - _APART, 0) : at + _APART + 1] = np.nan
    return worst


def _moment(row: RunRow, frames: RunFrames) -> int | None:
    """The frame at which the page opens: the first that was lost, the last of a failed run, else the worst; or None."""
    if not frames.columns:
        return None
    index = frames.columns["index"]
    lost = np.flatnonzero(frames.columns["state"] == "lost")
    if len(lost):
        return int(index[lost[0]])
    if row.failed:
        return int(index[-1])
    if np.isfinite(frames.errors_m).any():
        return int(index[np.nanargmax(frames.errors_m)])
    return int(index[0])


def _caption(
    row: RunRow,
    pictures: Sequence[int],
    lost: Sequence[tuple[float, float]],
) -> list[str]:
    """Describe what is drawn in the pictures and over time, in sentences."""
    sentences = []
    if pictures:
        drawn = []
        with suppress(DynslamError):
            _, shots = read_snapshots(row.folder)
            if any(shot.kept.any() for shot in shots):
                drawn.append("blue circles are static features")
            if any(len(shot.kept) and not shot.kept.all() for shot in shots):
                drawn.append("red crosses are dynamic ones")
            if any(shot.packed is not None and shot.packed.any() for shot in shots):
                drawn.append("yellow is the dynamic mask")
        if drawn:
            words = ", ".join(drawn)
            sentences.append(f"{words[0].upper()}{words[1:]}.")
    if lost:
        sentences.append("Shaded: not tracked.")
    return [*sentences, "Click or drag in the figure, move the slider, or press ← and →."]


def _rotation_doubt(row: RunRow) -> str:
    """Why no angles are drawn; empty where they are."""
    if row.rotation_reliable:
        return ""
    return (
        "No angles are drawn: the path hardly determines the alignment's rotation (standard error "
        f"{row.rotation_uncertainty_deg:.0f}°). Positions are not affected."
    )


# -- series and figures of a run

Series = dict[str, Any]
"""Name to numbers ``[N]``."""


def _series(frames: RunFrames, pictures: Sequence[int]) -> tuple[Series, list[tuple[float, float]]]:
    """The frames over time, thinned but for those with a picture; and the spans in which tracking was lost."""
    columns = frames.columns
    if not columns:
        return {}, []
    index = columns["index"]
    seconds = columns["timestamp"] - columns["timestamp"][0]
    tracked = columns["state"] == "ok"

    # every so many frames, and those with a picture
    step = -(-len(index) // MOST_FRAMES)
    keep = (np.arange(len(index)) % step == 0) | np.isin(index, pictures)

    # errors, share of people, counts of features, and times of stages that took any
    series = {
        "index": index,
        "t": seconds,
        "frame_error": np.where(tracked, 1000 * frames.errors_m, np.nan),
        "share": 100 * frames.share,
    }
    series |= {name: columns[f"stat_{name}"] for name in COUNTS if f"stat_{name}" in columns}
    stages = [name for name in columns if name.endswith("_s") and name not in _NO_STAGES]
    series |= {
        name: 1000 * columns[name] for name in stages if np.nanmax(columns[name], initial=0.0) > 0
    }

    # spans without tracking: from the first frame of each to the first behind it, or to the end
    edges = np.flatnonzero(np.diff(np.concatenate([[0], columns["state"] != "ok", [0]])))
    ends = np.append(seconds, seconds[-1])
    spans = [
        (float(seconds[first]), float(ends[behind]))
        for first, behind in edges.reshape(-1, 2).tolist()
    ]
    return {name: values[keep] for name, values in series.items()}, spans


def _track(row: RunRow, protocol: Protocol, start: float | None) -> tuple[Series, str]:
    """The aligned track and the true path of the run's frames over the time since `start`, and why there is none.

    Without ground truth the track is as the tracker gave it. Where the time between two poses
    exceeds twice the median interval, all series have a gap.
    """
    truth = row.ground_truth()
    estimate = row.estimate(row.trajectory)

    # without frames, time begins with the first known pose
    if start is None:
        whole = truth or estimate
        start = 0.0 if whole is None else float(whole.timestamps[0])

    # curves of the true path, in seconds since the start
    series: Series = {}
    if truth is not None and len(truth) > 1:
        drawn = _truth_of_run(row, truth)
        series = _along("true", drawn.timestamps - start, [drawn.positions, _angles(drawn, truth)])

    # the estimate: aligned and with its errors, where there is ground truth
    if estimate is None or len(estimate) < 2:
        return series, ""
    error_mm = np.full(len(estimate), np.nan)
    if truth is not None and row.metrics:
        try:
            estimate, true_poses, errors = pose_errors(estimate, truth, protocol)
        except DynslamError as error:
            return series, str(error)
        error_mm = 1000 * errors["trans_m"]
        series |= _residuals(estimate.positions, true_poses.positions)
    columns = [estimate.positions, _angles(estimate, truth or estimate), error_mm]
    return series | _along("track", estimate.timestamps - start, columns), ""


def _residuals(positions: Array, true_positions: Array) -> Series:
    """Lines from estimated to true positions ``[N, 3]`` each, thinned to about `RESIDUALS`, a gap behind each."""
    step = max(1, -(-len(positions) // RESIDUALS))
    starts = positions[::step]
    ends = true_positions[::step]
    gaps = np.full_like(starts, np.nan)
    points = np.stack([starts, ends, gaps], axis=1).reshape(-1, 3)
    return {f"residual_{axis}": points[:, column] for column, axis in enumerate("xyz")}


def _truth_of_run(row: RunRow, truth: Trajectory) -> Trajectory:
    """The ground truth between the first and the last frame of the run's part; all of it where that is not known."""
    with suppress(DynslamError):
        stamps = row.store.timestamps(row.sequence.part)
        if len(stamps) > 1:
            margin = float(np.median(np.diff(stamps)))
            is_begun = truth.timestamps >= stamps[0] - margin
            inside = is_begun & (truth.timestamps <= stamps[-1] + margin)
            return truth.select(inside) if np.count_nonzero(inside) > 1 else truth
    return truth


def _along(name: str, stamps: Array, columns: Sequence[Array]) -> Series:
    """Time, position, angles and error along a track, thinned and broken at gaps."""
    stamps, values = broken(stamps, np.column_stack(columns), MOST_FRAMES)
    names = ("x", "y", "z", "yaw", "pitch", "roll", "error")[: values.shape[1]]
    series = {f"{name}_t": stamps}
    for column, part in enumerate(names):
        series[f"{name}_{part}"] = values[:, column]
    return series


def _line(name: str, x: str, y: str, colour: str, panel: int, **more: Any) -> dict[str, Any]:
    """A plotly trace whose data are named series: ``"@x"``, filled in by the page, see `_series`.

    Args:
        name: What the legend calls it.
        x: Name of the series along the axis.
        y: Name of the series that is drawn.
        colour: Its colour.
        panel: Number of the panel, from 1 on.
        **more: Further properties of plotly's trace; ``line`` adds to colour and width.
    """
    style = {"color": colour, "width": 1.8} | more.pop("line", {})
    trace = {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": f"@{x}",
        "y": f"@{y}",
        "line": style,
        "xaxis": "x",
        "yaxis": f"y{panel if panel > 1 else ''}",
    }
    return trace | more


def _time_figure(
    row: RunRow,
    frames: RunFrames,
    series: Series,
    track: Series,
    lost: Sequence[tuple[float, float]],
) -> dict[str, Any]:
    """Error, inliers and people's share on one time axis, lost spans shaded."""
    # panel, line, its time, its series, colour, and further properties
    share_name = f"share of people: {frames.share_source}"
    dotted = {"line": {"dash": "dot"}}
    dashed = {"line": {"dash": "dash"}}
    filled = {"fill": "tozeroy"}
    lines: list[tuple[str, str, str, str, str, dict[str, Any]]] = [
        ("error (mm)", "absolute error", "track_t", "track_error", COLOURS[1], {}),
        ("error (mm)", "frame-to-frame error", "t", "frame_error", COLOURS[0], dotted),
        ("features", "inliers", "t", "inliers", COLOURS[2], {}),
        ("features", "dynamic (culled)", "t", "culled", COLOURS[1], dashed),
        ("people (%)", share_name, "t", "share", COLOURS[4], filled),
    ]

    # draw what has a number; panels without a line are left out
    columns = series | track
    hover = "%{y:.3g} at %{x:.2f} s<extra>%{fullData.name}</extra>"
    panels: list[str] = []
    traces = []
    for panel, name, x, y, colour, more in lines:
        if y not in columns or not np.isfinite(columns[y]).any():
            continue
        if panel not in panels:
            panels.append(panel)
        traces.append(_line(name, x, y, colour, len(panels), **more, hovertemplate=hover))
    if not traces:
        return {}

    # shade where tracking was lost, and what a failed run never saw
    spans = list(lost)
    times = columns.get("t", columns.get("track_t"))
    if row.failed and times is not None and row.n_processed < row.n_frames:
        spans.append((float(times[-1]), row.sequence.duration_s))
    layout = {
        "height": 60 + 150 * len(panels),
        "hovermode": "x",
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom"},
        "shapes": [_shade(*span) for span in spans],
    }
    return {"data": traces, "layout": layout | _axes(panels, 0.02, rangemode="tozero")}


def _axes(titles: Sequence[str], gap: float, **more: Any) -> dict[str, Any]:
    """Axes of panels below each other, with these titles, over one time axis."""
    last = len(titles) if len(titles) > 1 else ""
    count = len(titles)
    axes: dict[str, Any] = {"xaxis": {"title": {"text": "time (s)"}, "anchor": f"y{last}"}}
    for at, title in enumerate(titles):
        # from the top down, as shares of the figure's height
        domain = [1 - (at + 1) / count + gap, 1 - at / count - gap]
        axes[f"yaxis{at + 1 if at else ''}"] = {"title": {"text": title}, "domain": domain} | more
    return axes


def _shade(start: float, end: float) -> dict[str, Any]:
    """A span of time that is shaded over all panels."""
    span = {"x0": round(start, 4), "x1": round(end, 4), "y0": 0, "y1": 1, "yref": "paper"}
    return {
        "type": "rect",
        "fillcolor": COLOURS[1],
        "opacity": 0.18,
        "line": {"width": 0},
        "layer": "below",
    } | span


HEAT = {
    "colorscale": [[0, COLOURS[0]], [0.5, "#b9b3aa"], [1, COLOURS[1]]],
    "cmin": 0,
    "cmax": 3,
    "colorbar": {
        "title": {"text": "error (mm)"},
        "tickvals": [0, 1, 2, 3],
        "ticktext": ["1", "10", "100", "1000"],
        "thickness": 12,
        "len": 0.6,
    },
}
"""Colours of an error along a track, by its logarithm: the same scale for all runs."""


def _track_figure(track: Series) -> dict[str, Any]:
    """The track in space, coloured by its error, beside the true path."""
    data = []
    if "true_t" in track:
        data.append(_path("true path", "true", {"color": NEUTRAL, "width": 3}))
    if "track_t" in track:
        # colour by the logarithm of the error, where there is one
        track["track_heat"] = np.log10(np.maximum(track["track_error"], 1e-3))
        measured = bool(np.isfinite(track["track_error"]).any())
        line: dict[str, Any] = (
            HEAT | {"color": "@track_heat"} if measured else {"color": COLOURS[0]}
        )
        path = _path(
            "estimate", "track", line | {"width": 6}, "%{customdata:.3g} mm<extra></extra>"
        )
        data.append(path | {"customdata": "@track_error", "showlegend": not measured})

    if "residual_x" in track:
        data.append(_path("residuals", "residual", {"color": COLOURS[1], "width": 1}))

    # seen from above and behind: the camera's y points down, its z ahead
    axes = {f"{name}axis": {"title": {"text": f"{name} (m)"}} for name in "xyz"}
    view = {"up": {"x": 0, "y": -1, "z": 0}, "eye": {"x": 0.7, "y": -1.4, "z": -1.8}}
    scene = axes | {"aspectmode": "data", "camera": view}
    legend = {"orientation": "h", "y": 0, "x": 0}
    layout = {
        "height": 430,
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "scene": scene,
        "legend": legend,
    }
    return {"data": data, "layout": layout} if data else {}


def _path(name: str, part: str, line: dict[str, Any], hover: str = "") -> dict[str, Any]:
    """A path in space.

    Args:
        name: What the legend calls it.
        part: First part of the names of its series: ``true``, ``track`` or ``residual``.
        line: Its style.
        hover: What is shown where the pointer rests; empty for nothing.
    """
    positions = {axis: f"@{part}_{axis}" for axis in "xyz"}
    on_hover = {"hovertemplate": hover} if hover else {"hoverinfo": "skip"}
    trace = {"type": "scatter3d", "mode": "lines", "name": name, "line": line}
    return trace | positions | on_hover


def _poses_figure(row: RunRow, track: Series) -> dict[str, Any]:
    """Position and angles over time, beside the true ones; angles only where the alignment determines them."""
    if "track_t" not in track:
        return {}
    # a panel for each
    parts = {"x": "x (m)", "y": "y (m)", "z": "z (m)"}
    if row.rotation_reliable:
        parts |= {"yaw": "yaw (°)", "pitch": "pitch (°)", "roll": "roll (°)"}

    # name, first part of the series' names, colour, and further properties
    lines: list[tuple[str, str, str, dict[str, Any]]] = [
        ("truth", "true", NEUTRAL, {"line": {"dash": "dash"}}),
        ("estimate", "track", COLOURS[0], {}),
    ]
    data = []
    for panel, part in enumerate(parts, 1):
        for name, source, colour, more in lines:
            if f"{source}_t" in track:
                data.append(_line(name, f"{source}_t", f"{source}_{part}", colour, panel, **more))
    layout = {"height": 130 * len(parts), "showlegend": False} | _axes([*parts.values()], 0.01)
    return {"data": data, "layout": layout}


def _stages_figure(series: Series) -> dict[str, Any]:
    """Time of every frame, stage upon stage."""
    stages = [name for name in series if name.endswith("_s")]
    if not stages:
        return {}
    data = []
    for at, name in enumerate(stages):
        colour = COLOURS[at % len(COLOURS)]
        style = {"width": 0.5}
        data.append(
            _line(name.removesuffix("_s"), "t", name, colour, 1, stackgroup="stages", line=style)
        )

    # a few slow frames do not set the scale: the axis ends at 2.5 times the 80th percentile
    total = np.nansum([series[name] for name in stages], axis=0)
    top = min(float(total.max()), 2.5 * float(np.quantile(total, 0.8))) or 1.0
    axes = {
        "xaxis": {"title": {"text": "time (s)"}},
        "yaxis": {"title": {"text": "ms"}, "range": [0, 1.05 * top]},
    }
    return {"data": data, "layout": {"height": 360} | axes}


def broken(stamps: Array, values: Array, most: int) -> tuple[Array, Array]:
    """Thin a series and put NaN where the time between two poses exceeds twice the median interval.

    Args:
        stamps: Seconds ``[N]``.
        values: ``[N, K]``.
        most: About how many points to keep.

    Returns:
        Stamps ``[M]`` and values ``[M, K]`` with NaN rows in the gaps.
    """
    if len(stamps) < 3:
        return stamps, values
    # number the pieces between gaps [N]
    intervals = np.diff(stamps)
    piece = np.concatenate([[0], np.cumsum(intervals > 2 * np.median(intervals))])

    # keep every so many poses, and the ends of every piece
    step = max(1, -(-len(stamps) // most))
    keep = np.arange(len(stamps)) % step == 0
    edge = np.diff(piece) > 0
    keep |= np.append(edge, True) | np.append(True, edge)
    kept = np.flatnonzero(keep)

    # a row of NaN in the middle of every gap
    breaks = np.flatnonzero(np.diff(piece[kept]) > 0) + 1
    middle = (stamps[kept][breaks - 1] + stamps[kept][breaks]) / 2
    return (
        np.insert(stamps[kept], breaks, middle),
        np.insert(values[kept], breaks, np.nan, axis=0),
    )


def _angles(track: Trajectory, true: Trajectory) -> Array:
    """Yaw, pitch and roll (about the camera's y, x and z) from the first true pose, in degrees ``[N, 3]``."""
    R_first_cam = true.T_world_cam[0, :3, :3].T @ track.T_world_cam[:, :3, :3]
    angles = Rotation.from_matrix(R_first_cam).as_euler("YXZ")
    return np.asarray(np.degrees(np.unwrap(angles, axis=0)))


# -- the frames of a run, from its ``frames.csv``

Columns = dict[str, NDArray[Any]]
"""Name of a column to its values ``[N]``."""

COUNTS = ("culled", "inliers")
"""Counts of features that the page shows over time."""
_STATS = {f"stat_{name}" for name in (*COUNTS, "mask_fraction")}
"""Columns of statistics that the page shows."""
_NEEDED = {"index", "timestamp", "state", "frame_error_trans_m"}
"""Columns without which a table holds no frames."""
EXACT = "exact masks"
"""Source of the share of people where it comes from exact masks."""
_ASKED = 5
"""Runs of a column that are asked for the exact shares of its frames."""


@dataclass(frozen=True, eq=False)
class RunFrames:
    """The frames of a run.

    Attributes:
        columns: What the page shows of ``frames.csv``, a name to values ``[N]``; empty for an
            imported trajectory.
        errors_m: Frame-to-frame translational errors ``[N]`` in metres, nan where there is none.
        share: Share of the pixels that show people ``[N]``, nan where it is not known.
        share_source: Where that comes from, in words; empty where nothing is known.
        fault: Why there are no frames though there is a table; empty otherwise.
    """

    columns: Columns
    errors_m: Array
    share: Array
    share_source: str = ""
    fault: str = ""


def read_frames(row: RunRow, exact: Mapping[int, float]) -> RunFrames:
    """The frames of a run with the share of dynamic pixels: the exact one if it is known, else by its own masks.

    Args:
        row: The run.
        exact: Frame in the numbering of the run's part without offset to the exact share.
    """
    try:
        columns = read_table(row.folder / CSV_FILE, _is_shown)
    except RunError as error:
        return RunFrames({}, np.zeros(0), np.zeros(0), fault=str(error))
    if columns is None:
        return RunFrames({}, np.zeros(0), np.zeros(0))

    # exact shares, else those of the tracker's masks; a tracker without masks has zeros
    share = columns.get("stat_mask_fraction", np.zeros(0))
    source = "the tracker's own masks"
    if exact:
        share = np.array([exact.get(at + row.offset, np.nan) for at in columns["index"].tolist()])
        source = EXACT
    elif not share.any():
        share = np.full(len(columns["index"]), np.nan)
        source = ""
    return RunFrames(columns, columns["frame_error_trans_m"], share, source)


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
    types: dict[str, Any] = defaultdict(lambda: np.float64, index=np.int64, state=str)
    try:
        if not path.is_file() or not path.stat().st_size:
            return None
        content = io.BytesIO(read_bytes(path, limit=TABLE_BYTES))
        table = pd.read_csv(content, usecols=wanted, dtype=types, low_memory=False)
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
    is_time = name.endswith("_s") and not name.startswith("stat_")
    return is_time or name in _NEEDED or name in _STATS
