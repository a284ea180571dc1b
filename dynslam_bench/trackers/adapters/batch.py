"""A program that reads a whole sequence folder and writes one trajectory at its end: `batch:FILE.toml`."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from dynslam_bench.contracts import Frame, TrackerContext, TrackResult
from dynslam_bench.core import (
    TemporaryFolder,
    TrackerError,
    TrackerTimeoutError,
    TrajectoryError,
    translate_errors,
)
from dynslam_bench.geometry import Camera, Trajectory, load_tum, nearest_gap, read_table, se3
from dynslam_bench.trackers.adapters.orbslam3 import settings_yaml
from dynslam_bench.trackers.adapters.program_file import (
    BatchSettings,
    FilledProgram,
    camera_values,
)
from dynslam_bench.trackers.adapters.specs import OrbSlam3Settings
from dynslam_bench.trackers.adapters.subprocess_tracker import LOGGER, end_with_parent, write_images

WORK = "work"
"""The program's working folder, below the run's."""
_POLL_S = 0.1
"""Interval at which memory is measured, and the end of the program is looked for."""
_COLOUR = re.compile(r"\x1b\[[\d;]*m")
"""Escape sequences that colour a terminal's text."""
WRITE_THERE = "let the command write to {output}, a new file in its working folder"
"""Advice where the trajectory is not of this run."""
LONGEST_TAIL = 1 << 16
"""Bytes of a program's output of which the end is kept."""


class BatchTracker:
    """Collects the frames in a folder in TUM layout and runs the program on it at the end.

    No frame has a pose before: only the final trajectory exists. Time and memory are those of the
    program, measured from outside.

    Args:
        settings: The program, its time limit, and the settings that its file declares.
        context: Where it runs.

    Raises:
        SettingsError: The file that describes the program is damaged.
    """

    def __init__(self, settings: BatchSettings, context: TrackerContext) -> None:
        self._document = settings.document()
        self._program = self._document.program
        self._file = self._document.path
        self._settings = settings
        self._limit_s = settings.timeout_s
        self._context = context
        self._folder: TemporaryFolder | None = None
        self.measured: dict[str, Any] = {}
        """After `finalize`: ``program_s``, ``program_memory_mb`` (resident, all its processes; 0 where
        a container hides it) and ``notes``."""

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Begin a new sequence in a new folder."""
        self.close()
        self._stamps = list[float]()
        self._camera = camera
        self.measured = {}
        self._folder = TemporaryFolder()
        for name in ("rgb", "depth"):
            (self._folder.path / "sequence" / name).mkdir(parents=True)

    def track(self, frame: Frame) -> TrackResult:
        """Write the frame's images; no pose is known yet.

        Raises:
            TrackerError: They cannot be written, or `reset` was not called.
        """
        name = f"{frame.timestamp:.6f}.png"
        rgb, depth = (self._open() / "sequence" / kind / name for kind in ("rgb", "depth"))
        write_images(
            frame,
            rgb,
            None if self._program.sensors == "rgb" else depth,
            self._camera.written_depth_factor,
        )
        self._stamps.append(frame.timestamp)
        return TrackResult(None, "initialising")

    def finalize(self) -> Trajectory:
        """Run the program and read what it wrote.

        Raises:
            TrackerError: It cannot be started, ended with an exit code that is not among the
                program's `exit_codes`, wrote no trajectory, or one that is not of these frames or
                not of this run; with its last words.
            TrackerTimeoutError: It did not end in time.
        """
        # run it on the sequence's folder, in a new working folder
        folder = self._open()
        program = self._program
        output = self._new_working_folder(folder) / program.output
        filled = self._filled(folder, output)
        filled.write(folder / WORK)
        code = self._run(filled, folder)
        log = _tail(folder / "log.txt")
        LOGGER.info("[%s] %s", program.name, log)

        # it was killed, failed, or wrote nothing
        last_words = _last_words(log)
        hint = _display_hint(log)
        if code is None:
            raise TrackerTimeoutError(
                f"{program.name}: not done within {self._limit_s:g} s, killed; {last_words}", hint
            )
        if code < 0:
            ended = f"killed by signal {-code} ({signal.strsignal(-code)})"
        else:
            ended = f"ended with exit code {code}"
        missing = "" if output.is_file() else f", and wrote no {program.output}"
        if code not in program.exit_codes:
            fine = f"if that is no failure: exit_codes = {[*program.exit_codes, code]} in {self._file.name}"
            raise TrackerError(f"{program.name}: {ended}{missing}; {last_words}", hint or fine)
        if missing:
            raise TrackerError(
                f"{program.name}: {ended}{missing}; {last_words}", hint or WRITE_THERE
            )

        # read the trajectory, if it is of this run
        self._check_written_now(output)
        try:
            trajectory, read_notes = self._read(output)
        except TrajectoryError as error:
            text = str(error.args[0]).replace(str(output), program.output)
            raise TrackerError(
                f"{program.name}: {text}; it {ended}; {last_words}", error.hint
            ) from None

        # note what is not as usual
        notes: list[str] = []
        if code or len(trajectory) < len(self._stamps):
            notes.append(f"the program {ended}; {last_words}")
        notes += [f"{program.output}: {note}" for note in read_notes]
        self.measured["notes"] = notes
        return trajectory

    def _new_working_folder(self, folder: Path) -> Path:
        """An empty folder for the program to work in."""
        work = folder / WORK
        # of an earlier call
        if work.exists():
            shutil.rmtree(work)
        work.mkdir()
        return work

    def _filled(self, folder: Path, output: Path) -> FilledProgram:
        """Write the lists of images and ``camera.yaml``; fill the command with their paths and the settings."""
        sequence = folder / "sequence"
        camera = folder / "camera.yaml"
        self._write_lists(sequence)
        camera.write_text(camera_yaml(self._camera, self._context.fps))
        places = {
            "sequence": str(sequence),
            "associations": str(sequence / "associations.txt"),
            "camera": str(camera),
            "output": str(output),
            "folder": str(folder),
            "threads": str(self._context.threads),
            **camera_values(self._camera, self._context.fps),
        }
        return self._document.filled(self._settings, places)

    def close(self) -> None:
        """Remove the folder; may be called more than once."""
        if self._folder is not None:
            self._folder.close()
            self._folder = None

    def _check_written_now(self, output: Path) -> None:
        """Refuse a trajectory that the program did not write in this run.

        Raises:
            TrackerError: It is a link to a file elsewhere, or older than the program's start.
        """
        name = f"{self._program.name}: {self._program.output}"
        real = output.resolve()
        if not real.is_relative_to(self._open().resolve() / WORK):
            raise TrackerError(
                f"{name} is a link to {real}, outside of the working folder of this run",
                WRITE_THERE,
            )
        # Both stamps are of one file system; the log was made right before the program was started.
        early_s = (self._started_ns - real.stat().st_mtime_ns) / 1e9
        if early_s > 0:
            raise TrackerError(
                f"{name} was written {early_s:.3g} s before the program started: it is not of this run",
                WRITE_THERE,
            )

    def _open(self) -> Path:
        """The folder of this run.

        Raises:
            TrackerError: `reset` was not called, or `close` was.
        """
        if self._folder is None:
            raise TrackerError(f"{self._program.name} was used before reset() or after close()")
        return self._folder.path

    def _write_lists(self, folder: Path) -> None:
        """Write ``rgb.txt``, ``depth.txt`` and ``associations.txt``, as TUM's sequences have them."""
        kinds = ("rgb",) if self._program.sensors == "rgb" else ("rgb", "depth")
        rows = [[f"{stamp:.6f} {kind}/{stamp:.6f}.png" for kind in kinds] for stamp in self._stamps]
        for column, kind in enumerate(kinds):
            (folder / f"{kind}.txt").write_text("".join(f"{row[column]}\n" for row in rows))
        (folder / "associations.txt").write_text("".join(f"{' '.join(row)}\n" for row in rows))

    def _run(self, filled: FilledProgram, folder: Path) -> int | None:
        """Run the program to its end, and measure it.

        Args:
            filled: The program's command and variables.
            folder: Folder of the run; the program works in ``work`` below it.

        Returns:
            The exit code; None if it had to be killed. `measured` has ``program_s``, and
            ``program_memory_mb``: the largest resident memory of the process.
        """
        work = folder / WORK
        command, environment = self._document.launched(
            filled,
            {"OMP_NUM_THREADS": str(self._context.threads)},
            work=work,
            writable=[folder],
        )
        began = time.perf_counter()
        log = folder / "log.txt"
        with (
            log.open("wb") as out,
            translate_errors(TrackerError, f"{self._program.name}: cannot start '{command[0]}'"),
        ):
            # by the file system's clock: a trajectory that is older was not written by this run
            self._started_ns = os.fstat(out.fileno()).st_mtime_ns
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                cwd=work,
                env=environment,
                start_new_session=True,
                preexec_fn=end_with_parent(),
            )

        # wait, and measure the memory meanwhile
        code = None
        peak = 0
        try:
            while code is None and time.perf_counter() - began < self._limit_s:
                peak = max(peak, _resident(process.pid))
                with contextlib.suppress(subprocess.TimeoutExpired):
                    code = process.wait(_POLL_S)
        finally:
            # kill the whole process group: the program and what it started
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        self.measured["program_s"] = time.perf_counter() - began
        container = self._document.container
        is_measured = container is None or container.ends_with_its_command
        self.measured["program_memory_mb"] = peak / 1e6 if is_measured else 0.0
        return code

    def _read(self, output: Path) -> tuple[Trajectory, list[str]]:
        """The trajectory that the program wrote, and what of the file was not taken as it stands, a line each.

        Raises:
            TrajectoryError: It is damaged, or of other frames.
        """
        # indices of frames
        stamps = np.array(self._stamps)
        if self._program.format == "indices":
            rows = read_table(output, 8, "index tx ty tz qx qy qz qw")
            index, first = np.unique(rows[:, 0], return_index=True)
            if not len(index) or not (np.isin(index, np.arange(len(stamps)))).all():
                raise TrajectoryError(
                    f"{output} does not hold indices of frames 0 to {len(stamps) - 1}"
                )
            notes: list[str] = []
            repeats = len(rows) - len(index)
            if repeats > 0:
                notes.append(
                    f"{repeats} of {len(rows)} lines repeat an index, the first of each is taken"
                )
            poses = se3.from_quaternion(rows[first, 1:4], rows[first, 4:])
            return Trajectory(stamps[index.astype(int)], poses), notes

        # stamps; at least one must be of a frame
        file = load_tum(output)
        trajectory = file.trajectory
        gap = nearest_gap(trajectory.timestamps, stamps)
        interval = float(np.median(np.diff(stamps)))
        if gap.min() > interval / 2:
            raise TrajectoryError(
                f"none of the {len(trajectory)} poses in {output} is of a frame: they have stamps from "
                f"{trajectory.timestamps[0]:.3f} to {trajectory.timestamps[-1]:.3f} s, the frames from "
                f"{stamps[0]:.3f} to {stamps[-1]:.3f} s",
                "another clock, or format = 'indices'?",
            )
        return trajectory, file.notes.describe()


def camera_yaml(camera: Camera, fps: float) -> str:
    """A settings file for ORB-SLAM3 (format 1.0) with the keys of ORB-SLAM2 beside them, for 16-bit depth images."""
    settings = OrbSlam3Settings()
    orbslam3 = settings_yaml(camera, settings, fps, depth_factor=camera.written_depth_factor)
    k1, k2, p1, p2, k3 = camera.distortion
    orbslam2 = {
        "Camera.fx": camera.fx,
        "Camera.fy": camera.fy,
        "Camera.cx": camera.cx,
        "Camera.cy": camera.cy,
        "Camera.k1": k1,
        "Camera.k2": k2,
        "Camera.p1": p1,
        "Camera.p2": p2,
        "Camera.k3": k3,
        "Camera.bf": camera.fx * camera.baseline_m,
        "ThDepth": settings.close_depth_baselines,
        "DepthMapFactor": camera.written_depth_factor,
    }
    return orbslam3 + "".join(f"{name}: {float(value)!r}\n" for name, value in orbslam2.items())


def _resident(pid: int) -> int:
    """Resident memory in bytes of a process and all that it started, summed; 0 if it has ended."""
    total = 0
    with contextlib.suppress(psutil.Error):
        top = psutil.Process(pid)
        for process in (top, *top.children(recursive=True)):
            total += process.memory_info().rss
    return total


def _tail(log: Path) -> str:
    """The end of a program's log, without colours."""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - LONGEST_TAIL))
        return _COLOUR.sub("", file.read().decode(errors="replace"))


def _last_words(log: str) -> str:
    """The last line of a log, in words for a message."""
    for line in reversed(log.splitlines()):
        if line.strip():
            return f"its last words: '{line.strip()[:300]}'"
    return "it wrote no message"


def _display_hint(log: str) -> str:
    """Advice where a log speaks of a display; else an empty text."""
    if re.search("display|x11|glx|opengl", log, re.IGNORECASE):
        return "does it need a display? switch its viewer off, or put xvfb-run before it"
    return ""
