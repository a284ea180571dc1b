"""The index of a store: one SQLite file with what was computed from its runs, and runs as rows of tables.

The index holds metrics, rows of lists and rows of reports. Each value holds for one version of the code that computed
it and for one state (times and sizes) of the files that it was computed from. The file may be deleted at any time;
values that are missing, damaged or out of date are computed again from the run folders.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dynslam_bench.core.errors import RunError
from dynslam_bench.core.toml import assignments
from dynslam_bench.runs.record import MetricRecord, RunRecord

if TYPE_CHECKING:
    import pandas as pd

INDEX_FILE = "index.sqlite"
RUN_FILE, ONLINE, FINAL = "run.json", "trajectory_online.txt", "trajectory_final.txt"
_TABLE = (
    "CREATE TABLE IF NOT EXISTS computed "
    "(name TEXT, run_id TEXT, version TEXT, state TEXT, value TEXT, PRIMARY KEY (name, run_id))"
)
_LOCKED_S = 10.0
Row = dict[str, Any]
FIELDS = (
    *("run_id", "tracker", "sequence", "frames", "seed", "offset", "noise", "repeat", "settings", "status"),
    *("ate_rmse_m", "static_camera_ate_rmse_m", "coverage", "frame_ms", "segmentation"),
    *("seen_in_training", "study", "identity", "reason", "started"),
)
"""Names of the values of a list's row, in order."""


class RunIndex:
    """What was computed from the runs of a store.

    Args:
        root: Folder of the store.
    """

    def __init__(self, root: Path) -> None:
        self.root, self.path = root, root / INDEX_FILE

    def state(self, run_id: str, part: str, record_stamp: str = "") -> str:
        """The state of the files that a run's values are computed from.

        Args:
            run_id: The run.
            part: Its part of a sequence.
            record_stamp: `file_stamp` of its record before that was read; empty for the present one.
        """
        run, sequence = f"{self.root}/runs/{run_id}", f"{self.root}/sequences/{part}"
        files = (f"{run}/{ONLINE}", f"{run}/{FINAL}", f"{sequence}/groundtruth.txt", f"{sequence}/timestamps.txt")
        return " ".join([part, record_stamp or file_stamp(f"{run}/{RUN_FILE}"), *map(file_stamp, files)])

    def get(self, name: str, version: str, run_id: str) -> str | None:
        """The value of one run, as `read` gives it."""
        rows = self._select("name = ? AND version = ? AND run_id = ?", (name, version, run_id))
        return next((value for _, state, value in rows if self._holds(run_id, state, value)), None)

    def read(self, name: str, version: str, run_ids: Iterable[str], *, check_links: bool = False) -> dict[str, str]:
        """The values that hold, by run.

        Args:
            name: What they are, e.g. ``metrics`` with a protocol's digest.
            version: Digest of the code that computes them.
            run_ids: Runs that are stored.
            check_links: Whether runs whose folders hold links to elsewhere or pipes are left out, too.
        """
        stored = set(run_ids)
        return {
            run_id: value
            for run_id, state, value in self._select("name = ? AND version = ?", (name, version))
            if run_id in stored and self._holds(run_id, state, value)
            if not check_links or self._is_plain(run_id, state)
        }

    def _select(self, condition: str, arguments: tuple[str, ...]) -> list[tuple[Any, Any, Any]]:
        with contextlib.suppress(sqlite3.Error), self._opened(create=False) as connection:
            return connection.execute(
                f"SELECT run_id, state, value FROM computed WHERE {condition}", arguments
            ).fetchall()
        return []

    def _holds(self, run_id: str, state: Any, value: Any) -> bool:
        return isinstance(value, str) and isinstance(state, str) and state == self.state(run_id, _part_of(state))

    def write(self, name: str, version: str, entries: Iterable[tuple[str, str, str]]) -> None:
        """Keep values; a store that cannot be written stays as it is.

        Args:
            name: What they are.
            version: Digest of the code that computed them.
            entries: Run, its state before it was read, and the value.
        """
        rows: list[tuple[str, ...]] = [(name, run_id, version, state, value) for run_id, state, value in entries]
        command = "INSERT OR REPLACE INTO computed (name, run_id, version, state, value) VALUES (?, ?, ?, ?, ?)"
        self._change(command, rows)

    def forget(self, run_id: str) -> None:
        """Remove the values of a run."""
        if self.path.exists():
            self._change("DELETE FROM computed WHERE run_id = ?", [(run_id,)])

    def names(self) -> set[str]:
        """Names of the values that are kept."""
        with contextlib.suppress(sqlite3.Error), self._opened(create=False) as connection:
            return {str(name) for (name,) in connection.execute("SELECT DISTINCT name FROM computed")}
        return set()

    def _change(self, command: str, rows: Sequence[tuple[str, ...]]) -> None:
        for _ in range(2):
            try:
                with self._opened(create=True) as connection, connection:
                    connection.executemany(command, rows)
                return
            except (sqlite3.OperationalError, UnicodeEncodeError):  # it cannot be written, or a value not be encoded
                return
            except sqlite3.DatabaseError:  # it is damaged, or no database
                with contextlib.suppress(OSError):
                    self.path.unlink()

    @contextlib.contextmanager
    def _opened(self, *, create: bool) -> Iterator[sqlite3.Connection]:
        """The database; no link is followed, and no pipe is opened.

        Raises:
            sqlite3.OperationalError: It is not there, or cannot be opened.
        """
        is_there = self.path.exists() or self.path.is_symlink()
        if (is_there and (self.path.is_symlink() or not self.path.is_file())) or not (is_there or create):
            raise sqlite3.OperationalError(f"{self.path} is no database")
        with contextlib.closing(sqlite3.connect(self.path, timeout=_LOCKED_S)) as connection:
            connection.execute("PRAGMA synchronous = OFF")  # a power cut costs an index, which is made again
            if create:
                connection.execute(_TABLE)
            yield connection

    def _is_plain(self, run_id: str, state: str) -> bool:
        try:
            check_plain(self.root / "runs" / run_id, self.root)
            check_plain(self.root / "sequences" / _part_of(state), self.root)
        except RunError:
            return False
        return True


def _part_of(state: str) -> str:
    return state.partition(" ")[0]


def file_stamp(file: str | Path) -> str:
    """Time (nanoseconds) and size (bytes) of a file; ``-`` where there is none."""
    try:
        status = os.stat(file)  # noqa: PTH116 - a hundred thousand of them: pathlib takes twice as long
    except OSError:
        return "-"
    return f"{status.st_mtime_ns},{status.st_size}"


def check_plain(folder: Path, root: Path) -> None:
    """Check that a folder holds plain files of its store: no link to elsewhere, no pipe that nothing writes.

    Raises:
        RunError: It names the offending entry. A folder that is not there has none.
    """
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_symlink() and not Path(entry.path).resolve().is_relative_to(root.resolve()):
                raise RunError(f"{entry.path} is a link that leads out of {root}", "put the file in its place")
            if not entry.is_file() and not entry.is_dir():
                raise RunError(f"{entry.path} is no plain file")


def run_row(record: RunRecord, metrics: MetricRecord | None) -> Row:
    """A run's row in a list: JSON values under the names `FIELDS`.

    Args:
        record: The run.
        metrics: Its errors under some protocol; None without.
    """
    from dynslam_bench.segmentation.networks.checkpoints import seen_in_training  # loads the catalogue of all sequences

    errors = {} if metrics is None else metrics.metrics
    not_scored = "" if metrics is None or errors else metrics.reasons.get(metrics.trajectory, "")
    return {
        "run_id": record.run_id,
        "tracker": record.tracker.id,
        "sequence": record.sequence.id,
        "frames": part_words(record),
        "seed": record.seed,
        "offset": record.offset,
        "noise": record.sequence.noise,
        "repeat": record.repeat,
        "settings": "; ".join(assignments(record.asked)),
        "status": record.status,
        "ate_rmse_m": errors.get("ate_rmse_m"),
        "static_camera_ate_rmse_m": errors.get("static_camera_ate_rmse_m"),
        "coverage": record.coverage,
        "frame_ms": None if record.frame_time_s is None else 1000 * record.frame_time_s,
        "segmentation": record.segmentation,
        "seen_in_training": seen_in_training(record.segmentation, record.sequence.id),
        "study": record.trial_of,
        "identity": "" if record.verified else "unverified",
        "reason": record.reason or (not_scored if record.sequence.ground_truth else ""),
        "started": record.started,
    }


def part_words(record: RunRecord) -> str:
    """Which frames of its sequence a run was asked for, e.g. ``0:60, every 2nd``; empty for all of them."""
    words = []
    if record.frames is not None:
        start, stop = record.frames
        words.append(f"{start}:{'' if stop is None else stop}")
    if record.stride > 1:
        words.append(f"every {record.stride}{ {2: 'nd', 3: 'rd'}.get(record.stride, 'th') }")
    return ", ".join(words)


_TEXT = (
    *("run_id", "kind", "tracker", "label", "settings", "provenance"),
    *("sequence", "frames", "split", "repeat", "status", "reason", "study", "identity"),
    *("device", "segmentation", "protocol_id", "protocol_digest", "trajectory"),
)
_WHOLE = (
    *("seed", "offset", "noise", "stride", "threads", "n_frames", "n_processed", "n_tracked", "n_lost"),
    *("keyframes", "map_points", "maps"),
)
_NUMBERS = (
    *("coverage", "frame_ms", "real_time_factor", "finalize_s", "wall_s", "peak_memory_mb"),
    *("mask_iou", "epipolar_skipped"),
)


def runs_frame(runs: Iterable[tuple[RunRecord, MetricRecord | None]]) -> pd.DataFrame:
    """Runs as a frame.

    Args:
        runs: Records with their metrics; None for a run that was not scored.

    Returns:
        One row a run, in their order. Whatever may be missing is ``pd.NA``, never nan or an empty string.

        - ``string``: run_id, kind (``run``, ``imported``), tracker, label (its name in tables), settings (those that
          were asked for, ``name=value; ...``), provenance, sequence, frames (``A:B, every 2nd``, missing for all),
          split, repeat (``seed 0, offset 2``), status, reason (missing for ``ok``), study (of which the run is a trial,
          missing for any other run), identity (``unverified`` for runs of an older scheme of ids, else missing),
          device, segmentation (source of the masks), protocol_id, protocol_digest and trajectory (``online``,
          ``final``): what the errors hold under and are of.
        - ``Int64``: seed, offset, noise (missing for the sequence's own), stride, threads, n_frames, n_processed,
          n_tracked, n_lost, keyframes, map_points, maps.
        - ``Float64``: coverage (0 to 1), frame_ms (median, milliseconds, segmentation included, decoding excluded),
          real_time_factor, finalize_s and wall_s (seconds), peak_memory_mb (MB), mask_iou and epipolar_skipped (0 to
          1), and every metric under its own name with its unit (``ate_rmse_m``, ``rpe_1s_rot_rmse_deg``, see
          `Evaluation`); ``ate_rmse_m`` is there even if no run has one.
        - ``datetime64[us, UTC]``: started.
    """
    import pandas as pd

    pairs = list(runs)
    metrics = sorted({name for _, scored in pairs if scored is not None for name in scored.metrics} | {"ate_rmse_m"})
    kinds: dict[str, str] = dict.fromkeys(_TEXT, "string") | dict.fromkeys(_WHOLE, "Int64")
    kinds |= dict.fromkeys((*_NUMBERS, *metrics), "Float64")
    frame = pd.DataFrame([_cells(*pair) for pair in pairs], columns=list(kinds), dtype=object).astype(kinds)
    stamps = pd.Series([record.started or None for record, _ in pairs], dtype=object)
    started = pd.to_datetime(stamps, utc=True, format="ISO8601")
    return frame.assign(started=started.astype("datetime64[us, UTC]"))


def _cells(record: RunRecord, metrics: MetricRecord | None) -> Row:
    cells = {name: getattr(record, name) for name in (*_WHOLE, *_NUMBERS, *_TEXT) if hasattr(record, name)}
    cells |= run_row(record, metrics)
    cells |= {
        "label": record.tracker.label or record.tracker.id,
        "provenance": record.tracker.provenance,
        "split": record.sequence.split,
        "reason": record.reason,
    }
    if metrics is not None:
        cells |= {name: getattr(metrics, name) for name in ("protocol_id", "protocol_digest", "trajectory")}
        cells |= metrics.metrics
    return {name: None if value == "" else value for name, value in cells.items()}
