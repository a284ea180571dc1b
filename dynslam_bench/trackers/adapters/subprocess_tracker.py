"""A tracker in a program of its own, in any language, over JSON lines (`docs/how-to/program.md` states the protocol).

A fault or the death of the program becomes one clear error.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import logging
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple, cast

import cv2
import numpy as np

from dynslam_bench.contracts import Frame, TrackerContext, TrackingState, TrackResult
from dynslam_bench.contracts.checks import as_covariance, faults
from dynslam_bench.core import (
    SHARED_MEMORY,
    DynslamError,
    InfrastructureError,
    TemporaryFolder,
    TrackerError,
    parse_json,
    translate_errors,
)
from dynslam_bench.core.code_files import files_of_command
from dynslam_bench.core.programs import program_environment
from dynslam_bench.core.seeding import derive_seed
from dynslam_bench.core.settings import Scalar
from dynslam_bench.geometry import Camera, Trajectory, se3
from dynslam_bench.trackers.adapters.program_file import (
    ProgramSettings,
    ServedSettings,
    camera_values,
)
from dynslam_bench.trackers.adapters.specs import SubprocessSettings

_SET_PARENT_DEATH_SIGNAL = 1
"""Linux's number of the option of ``prctl`` (``PR_SET_PDEATHSIG``)."""
LOGGER = logging.getLogger(__name__)
"""Gets, at level INFO, every line that a program writes beside its answers; a run keeps them in its log."""
LONGEST_LINE = 1 << 26
"""Bytes of the longest line that is read from a program: a final trajectory of half a million poses."""
FRAME_FILE = "frame.raw"
"""Name of the file through which frames are exchanged."""
PROTOCOL = 2
"""Version of the JSON lines."""
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables by which libraries are told how many threads they may start."""
CAMERA_FIELDS = ("width", "height", "fx", "fy", "cx", "cy", "baseline_m", "readout_s")
"""Fields of `Camera` that a program is told, beside the distortion."""


class Program:
    """One run of an external program.

    Requests go to its standard input, one JSON object a line; it answers each with one JSON object
    a line on its standard output. Lines that do not begin with ``{`` are log output and skipped, as
    is its standard error; the last ones are kept for error messages, all of them go to `LOGGER`. It
    has a session of its own, so that its child processes end with it. It should end by itself at
    the end of its standard input; on Linux it is killed when the process that started it dies.

    Args:
        name: For messages.
        command: Program and arguments.
        folder: Its working folder; None for the current one.
        environment: All environment variables that it gets; None for those of
            `program_environment`.

    Raises:
        TrackerError: The program cannot be started.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        *,
        folder: Path | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.name = name
        with translate_errors(
            TrackerError,
            f"{name}: cannot start '{command[0]}'",
            "check its path",
            of=(OSError, ValueError),
        ):
            self._process = subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                cwd=folder,
                env=dict(program_environment() if environment is None else environment),
                start_new_session=True,
                preexec_fn=end_with_parent(),
            )
        self._kill = weakref.finalize(self, _kill_group, self._process)
        # None: standard output has ended
        self._answers: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        # last lines by channel, before the last request and since then
        self._old_lines: dict[str, str] = {}
        self._new_lines: dict[str, str] = {}
        self._readers: list[threading.Thread] = []
        for channel, stream in (("out", self._process.stdout), ("err", self._process.stderr)):
            arguments = (name, channel, stream, self._answers, self._new_lines)
            reader = threading.Thread(target=_read, args=arguments, daemon=True)
            self._readers.append(reader)
            reader.start()

    def ask(self, request: Mapping[str, Any], timeout_s: float, doing: str) -> dict[str, Any]:
        """Send a request and wait for its answer.

        Args:
            request: JSON-able; ``op`` names what is asked.
            timeout_s: Seconds until the program is given up and killed.
            doing: For messages, e.g. ``at frame 12``.

        Raises:
            TrackerError: It died, did not answer in time, answered no JSON object, or answered
                ``{"error": ...}``.
        """
        # send the request and wait
        self._old_lines.update(self._new_lines)
        self._new_lines.clear()
        try:
            self._write(request)
            text = self._answers.get(timeout=timeout_s)
        except (OSError, ValueError):
            # it has closed its input, or was killed before
            text = None
        except queue.Empty:
            line_shown = f"; its last line: '{self._last_line()}'" if self._last_line() else ""
            self.kill()
            raise TrackerError(
                f"{self.name} {doing}: no answer within {timeout_s:g} s, killed{line_shown}"
            ) from None
        if text is None:
            raise self._death(doing)

        # one JSON object, which may state an error
        try:
            answer = parse_answer(text)
        except TrackerError as error:
            self.kill()
            raise TrackerError(
                f"{self.name} {doing}: {error.args[0]}", "one JSON object a line"
            ) from None
        if answer.get("error"):
            stated = " ".join(str(answer["error"]).split())
            raise TrackerError(f"{self.name} {doing}: {stated[:400]}")
        return answer

    def close(self, timeout_s: float) -> int | None:
        """Ask it to end, wait, and kill it if it does not; may be called more than once.

        Returns:
            The exit code with which it ended by itself; None if it has to be killed.
        """
        with contextlib.suppress(OSError, ValueError):
            self._write({"op": "close"})
            self._process.stdin.close()  # type: ignore[union-attr]
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout_s)
        code = self._process.returncode
        self.kill()
        return code

    def ending(self, code: int) -> str:
        """Words on the program's end, with its last line."""
        shown = "it wrote no message"
        if self._last_line():
            shown = f"its last line: '{self._last_line()}'"
        ended = f"ended with exit code {code}"
        if code < 0:
            ended = f"was killed by signal {-code} ({signal.strsignal(-code)})"
        return f"the program {ended}; {shown}"

    def kill(self) -> None:
        """End it and everything it started, at once."""
        self._kill()
        # a process in another session may hold the pipe open for ever
        for reader in self._readers:
            reader.join(timeout=0.5)

    def _write(self, message: Mapping[str, Any]) -> None:
        """Send a line of JSON."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(message, allow_nan=False).encode() + b"\n")
        self._process.stdin.flush()

    def _last_line(self) -> str:
        """The last line of its log.

        Lines since the last request count before earlier ones, and standard error before standard
        output, which often arrives late, when it is flushed at the end.
        """
        for lines in (self._new_lines, self._old_lines):
            for channel in ("err", "out"):
                if lines.get(channel):
                    return lines[channel]
        return ""

    def _death(self, doing: str) -> TrackerError:
        """The error that says how it ended without an answer."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=1.0)
        code = self._process.returncode
        self.kill()
        if code is None:
            return TrackerError(f"{self.name} {doing}: closed its output without an answer")
        return TrackerError(f"{self.name} {doing}: {self.ending(code)}")


def _read(
    name: str,
    channel: str,
    stream: IO[bytes],
    answers: queue.SimpleQueue[str | None],
    lines: dict[str, str],
) -> None:
    """Sort the lines of a program's output into answers and log until it ends; runs in a thread of its own."""
    with stream:
        for raw in iter(lambda: stream.readline(LONGEST_LINE), b""):
            text = raw.decode(errors="replace").strip()
            if channel == "out" and text.startswith("{"):
                answers.put(text)
            elif text:
                lines[channel] = text[:300]
                LOGGER.info("[%s] %s", name, text)
    if channel == "out":
        answers.put(None)


def parse_answer(text: str) -> dict[str, Any]:
    """A program's answer.

    Raises:
        TrackerError: It is no JSON object; the name of the program is still to be added.
    """
    answer = parse_json(text, f"its answer '{text[:80]}'", kind=TrackerError)
    if not isinstance(answer, dict):
        raise TrackerError(f"its answer '{text[:80]}' is no JSON object")
    return answer


def end_with_parent() -> Callable[[], object] | None:
    """A function that runs in the new process before the program, so that Linux kills it when this process dies.

    None elsewhere, and in threads: Linux watches the thread that starts the process.
    """
    if sys.platform != "linux" or threading.current_thread() is not threading.main_thread():
        return None
    # loaded here: between fork and exec as little as possible is done
    prctl = ctypes.CDLL(None).prctl
    return lambda: prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)


def _kill_group(process: subprocess.Popen[bytes]) -> None:
    """Kill the program with all that it started."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(timeout=5.0)
    with contextlib.suppress(OSError):
        assert process.stdin is not None
        process.stdin.close()


def read_track_answer(
    answer: Mapping[str, Any], frame: Frame, who: str, elapsed_s: Callable[[], float]
) -> TrackResult:
    """The result of one frame.

    Args:
        answer: The program's answer.
        frame: The frame that it is of.
        who: Program and frame, for messages.
        elapsed_s: Seconds since the request; ``transfer`` is what its own timings leave of them.

    Raises:
        TrackerError: It is no valid result, see `faults`.
    """
    # the pose: 16 numbers, or none
    value = answer.get("T_world_cam")
    fitting = (AttributeError, TypeError, ValueError, OverflowError)
    with translate_errors(
        TrackerError,
        f"{who}: T_world_cam is not 16 numbers",
        "row by row, camera to world",
        of=fitting,
    ):
        pose = None if value is None else np.asarray(value, dtype=np.float64).reshape(4, 4)

    # stats and timings; what its timings leave of the time is the transfer
    with translate_errors(
        TrackerError, f"{who}: stats and timings are not objects of numbers", of=fitting
    ):
        stats = _numbers(answer, "stats")
        timings = _numbers(answer, "timings")
    timings["transfer"] = max(0.0, elapsed_s() - sum(timings.values()))
    covariance = answer.get("motion_covariance")
    result = TrackResult(
        pose,
        cast(TrackingState, str(answer.get("state"))[:80]),
        stats,
        timings,
        motion_covariance=None if covariance is None else as_covariance(covariance),
    )
    for fault in faults(result, frame):
        raise TrackerError(f"{who}: answered {fault.found}", fault.cause)
    return result


def _numbers(answer: Mapping[str, Any], field: str) -> dict[str, float]:
    """An answer's object of numbers; an empty one where the field is missing."""
    return {str(key): float(number) for key, number in (answer.get(field) or {}).items()}


def read_final_answer(answer: Mapping[str, Any], who: str) -> Trajectory:
    """The final trajectory; rows ``[timestamp, tx, ty, tz, qx, qy, qz, qw]``, camera to world.

    Raises:
        TrackerError: It is no trajectory.
    """
    with translate_errors(
        TrackerError,
        f"{who}: 'trajectory' is not a list of rows of 8 numbers",
        "timestamp tx ty tz qx qy qz qw",
        of=(TypeError, ValueError, OverflowError),
    ):
        rows = np.asarray(answer.get("trajectory"), dtype=np.float64).reshape(-1, 8)
    norms = np.linalg.norm(rows[:, 4:], axis=1)
    # written so that NaN is caught as well
    if not (np.abs(norms - 1) < 1e-3).all():
        raise TrackerError(f"{who}: a quaternion has norm {norms[np.abs(norms - 1).argmax()]:g}")
    try:
        return Trajectory(rows[:, 0], se3.from_quaternion(rows[:, 1:4], rows[:, 4:]))
    except DynslamError as error:
        raise TrackerError(f"{who}: {error}") from error


class ImageExchange:
    """A private folder through which the frames reach a program; removed by `close`, at the latest with the object.

    ``raw``: one file ``frame.raw`` of fixed size, in shared memory where the system has it. It
    holds the colour image (uint8 ``[H, W, 3]``, red first, row by row) at `rgb_offset` and the
    depth (little-endian float32 ``[H, W]``, metres, 0 = missing) at `depth_offset`, and is
    overwritten before each ``track``. ``png``: for each frame an 8-bit colour PNG and a 16-bit
    depth PNG in units of ``1 / depth_factor`` metres, as in TUM's files; those of the frame before
    are removed.

    Args:
        camera: The camera of the frames.
        mode: ``raw`` or ``png``.
    """

    def __init__(self, camera: Camera, mode: Literal["raw", "png"]) -> None:
        self.camera = camera
        self.mode = mode
        colour = camera.height * camera.width * 3
        self.depth_offset = -(-colour // 16) * 16
        size = self.depth_offset + camera.height * camera.width * 4
        self._temporary = _with_space(size) if mode == "raw" else TemporaryFolder()
        self.folder = self._temporary.path
        if mode == "raw":
            # views of the file: colour, and depth from an offset that is a multiple of 16 bytes
            self._memory = np.memmap(self.folder / FRAME_FILE, np.uint8, "r+", shape=(size,))
            self._rgb = self._memory[:colour].reshape(camera.height, camera.width, 3)
            depth = self._memory[self.depth_offset :].view("<f4")
            self._depth = depth.reshape(camera.height, camera.width)

    def announce(self) -> dict[str, Any]:
        """The part ``images`` of the ``reset`` request."""
        if self.mode == "png":
            return {"mode": "png", "depth_factor": self.camera.written_depth_factor}
        return {
            "mode": "raw",
            "file": str(self.folder / FRAME_FILE),
            "rgb_offset": 0,
            "depth_offset": self.depth_offset,
            "bytes": int(self._memory.size),
        }

    def put(self, frame: Frame) -> dict[str, Any]:
        """Hand over a frame; returns the paths for the ``track`` request, in mode ``png``.

        Raises:
            TrackerError: A PNG file cannot be written.
        """
        if self.mode == "raw":
            np.copyto(self._rgb, frame.rgb)
            np.copyto(self._depth, frame.depth)
            return {}
        for old in self.folder.glob("*.png"):
            old.unlink()
        rgb = self.folder / f"rgb-{frame.index:06d}.png"
        depth = self.folder / f"depth-{frame.index:06d}.png"
        write_images(frame, rgb, depth, self.camera.written_depth_factor)
        return {"rgb": str(rgb), "depth": str(depth)}

    def close(self) -> None:
        """Remove the folder; may be called more than once."""
        self._temporary.close()


def write_images(frame: Frame, rgb: Path, depth: Path | None, depth_factor: float) -> None:
    """Write an 8-bit colour PNG and, unless `depth` is None, a 16-bit depth PNG in ``1 / depth_factor`` metres.

    Raises:
        TrackerError: A file cannot be written.
    """
    images = {rgb: cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR)}
    if depth is not None:
        units = np.rint(np.nan_to_num(frame.depth) * depth_factor)
        images[depth] = units.clip(0, 65535).astype(np.uint16)
    for path, image in images.items():
        if not cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
            raise TrackerError(f"cannot write {path}", "is the temporary folder full?")


def _with_space(size: int) -> TemporaryFolder:
    """A folder with the file for the frames, its space allocated: on a full disk SIGBUS would end the run later.

    Raises:
        InfrastructureError: There is no room, neither in shared memory nor among the temporary
            files.
    """
    reasons = []
    for base in (SHARED_MEMORY, Path(tempfile.gettempdir())):
        try:
            # where the file does not fit, it is removed with the object
            folder = TemporaryFolder(base)
            (folder.path / FRAME_FILE).write_bytes(bytes(size))
            return folder
        except OSError as error:
            reasons.append(f"{base}: {error.strerror}")
    raise InfrastructureError(
        f"no room for a frame of {size / 1e6:.1f} MB: {'; '.join(reasons)}", "free some space"
    )


class Launch(NamedTuple):
    """Start of a program.

    Attributes:
        command: Program and arguments.
        folder: Its working folder; None for the current one.
        environment: All its environment variables.
    """

    command: list[str]
    folder: Path | None
    environment: dict[str, str]


class ProgramTracker:
    """Drives a `Program` through one sequence after the other; each `reset` starts it afresh.

    Args:
        name: For messages.
        settings: Time limits.
        context: Where it runs.
        command: Program and arguments.
        images: How it gets the images, see `ImageExchange`.
        folder: Its working folder; None for the current one.
        exit_codes: Exit codes with which it may end after `close`; None for any.
        variables: Names of environment variables that it gets beside those of
            `program_environment`.
    """

    def __init__(
        self,
        name: str,
        settings: ProgramSettings,
        context: TrackerContext,
        command: Sequence[str],
        *,
        images: Literal["raw", "png"] = "raw",
        folder: Path | None = None,
        exit_codes: Sequence[int] | None = None,
        variables: Sequence[str] = (),
    ) -> None:
        self._exit_codes = exit_codes
        self._variables = variables
        # whether a fault of the program was raised
        self._failed = False
        self._images: Literal["raw", "png"] = images
        self.name = name
        self.limits = settings
        self.context = context
        self._command = list(command)
        self._folder = folder
        self._program: Program | None = None
        self._exchange: ImageExchange | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> ProgramTracker:
        """Refused: the memory of another process cannot be copied.

        Raises:
            TrackerError: Always.
        """
        raise TrackerError(f"{self.name} is a program of its own, whose state cannot be copied")

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Start the program and send it the camera.

        Raises:
            TrackerError: It cannot be started, dies, refuses, or does not answer in time.
        """
        # what the program gets: images, command and environment, request
        self._end()
        self._exchange = ImageExchange(camera, self._images)
        launch = self.launch(camera, self._exchange.folder)
        request = {
            "op": "reset",
            "protocol": PROTOCOL,
            "camera": {
                **{name: getattr(camera, name) for name in CAMERA_FIELDS},
                "distortion": list(camera.distortion),
                "fps": self.context.fps,
            },
            "images": self._exchange.announce(),
            "seed": derive_seed(rng),
            "threads": self.context.threads,
            "device": self.context.device,
            "sequence": self.context.sequence_id,
            "options": self.options(camera, self._exchange.folder),
            "settings": self.settings_sent(),
        }

        # start it; one that refuses is ended
        self._failed = False
        self._program = Program(
            self.name, launch.command, folder=launch.folder, environment=launch.environment
        )
        try:
            if self._ask(request, self.limits.start_timeout_s, "at reset").get("ok") is False:
                raise TrackerError(f"{self.name} answered reset with ok: false")
        except DynslamError:
            self._end()
            raise

    def launch(self, camera: Camera, exchanged: Path) -> Launch:
        """Start of the program.

        Args:
            camera: The camera of the frames.
            exchanged: The folder through which frames are exchanged.
        """
        environment = program_environment(self._variables)
        environment |= dict.fromkeys(THREAD_VARIABLES, str(self.context.threads))
        return Launch(self._command, self._folder, environment)

    def settings_sent(self) -> dict[str, Scalar]:
        """The part ``settings`` of the ``reset`` request: those that a program's file declares."""
        return {}

    def options(self, camera: Camera, folder: Path) -> dict[str, Any]:
        """The part ``options`` of the ``reset`` request; `folder` is private and lives as long as the sequence."""
        return {}

    def track(self, frame: Frame) -> TrackResult:
        """Hand over one frame and wait for its pose.

        ``timings`` are those that the program states, with the rest of the time as ``transfer``.

        Raises:
            TrackerError: It dies, hangs, or does not answer with a pose.
        """
        start = time.perf_counter()
        doing = f"at frame {frame.index}"
        images = {} if self._exchange is None else self._exchange.put(frame)
        request = {"op": "track", "index": frame.index, "timestamp": frame.timestamp, **images}
        with self._noting_failures():
            answer = self._ask(request, self.limits.frame_timeout_s, doing)
            if answer.get("index") != frame.index:
                raise TrackerError(
                    f"{self.name} {doing}: answered index {str(answer.get('index'))[:20]}",
                    "each answer repeats the index of its track request",
                )
            return read_track_answer(
                answer, frame, f"{self.name} {doing}", lambda: time.perf_counter() - start
            )

    def close(self) -> None:
        """End the program (killed if it does not end by itself) and remove the exchanged files.

        Raises:
            TrackerError: It ended by itself, with an exit code that counts as a failure, though it
                answered all.
        """
        program = self._program
        code = self._end()
        allowed = self._exit_codes
        if program is None or code is None or allowed is None or code in allowed:
            return
        raise TrackerError(
            f"{self.name} after its last answer: {program.ending(code)}",
            f"if that is no failure: --set exit_codes={json.dumps([*allowed, code], separators=(',', ':'))}",
        )

    def _end(self) -> int | None:
        """End the program and remove the exchanged files.

        Returns:
            Its exit code; None if it was killed, or after a fault that was raised.
        """
        code = None
        if self._program is not None:
            code = self._program.close(self.limits.close_timeout_s)
            self._program = None
        if self._exchange is not None:
            self._exchange.close()
            self._exchange = None
        return None if self._failed else code

    @contextlib.contextmanager
    def _noting_failures(self) -> Iterator[None]:
        """Remember that a fault was raised: how the program ends then is no second one."""
        try:
            yield
        except TrackerError:
            self._failed = True
            raise

    def _ask(self, request: Mapping[str, Any], timeout_s: float, doing: str) -> dict[str, Any]:
        """The program's answer to a request, see `Program.ask`."""
        if self._program is None:
            raise TrackerError(f"{self.name} was used before reset() or after close()")
        return self._program.ask(request, timeout_s, doing)


class FinalizingProgramTracker(ProgramTracker):
    """A program that also answers ``finalize``."""

    def finalize(self) -> Trajectory:
        """The program's final trajectory; rows ``[timestamp, tx, ty, tz, qx, qy, qz, qw]``, camera to world.

        Raises:
            TrackerError: It dies, hangs, or does not answer with a trajectory.
        """
        with self._noting_failures():
            answer = self._ask({"op": "finalize"}, self.limits.final_timeout_s, "at finalize")
            return read_final_answer(answer, f"{self.name} at finalize")


class DescribedProgramTracker(ProgramTracker):
    """A program that a TOML file describes: its working folder is new for each sequence, and holds its files.

    Args:
        settings: Time limits, and the settings that the file declares.
        context: Where it runs.
    """

    def __init__(self, settings: ServedSettings, context: TrackerContext) -> None:
        self._document = settings.document()
        self._settings = settings
        self._work: TemporaryFolder | None = None
        program = self._document.program
        super().__init__(
            program.name,
            settings,
            context,
            program.command,
            images=program.images,
            exit_codes=program.exit_codes,
        )

    def launch(self, camera: Camera, exchanged: Path) -> Launch:
        """Command of the program with the settings' values; the files that it reads are written."""
        threads = str(self.context.threads)
        places = {"threads": threads, **camera_values(camera, self.context.fps)}
        filled = self._document.filled(self._settings, places)
        self._work = TemporaryFolder()
        work = self._work.path / "work"
        work.mkdir()
        filled.write(work)
        command, environment = self._document.launched(
            filled,
            dict.fromkeys(THREAD_VARIABLES, threads),
            work=work,
            writable=[self._work.path, exchanged],
        )
        return Launch(command, work, environment)

    def settings_sent(self) -> dict[str, Scalar]:
        """The settings by dotted name."""
        return self._document.values(self._settings)

    def _end(self) -> int | None:
        """End the program and remove its working folder; see `ProgramTracker`."""
        code = super()._end()
        if self._work is not None:
            self._work.close()
            self._work = None
        return code


class FinalizingDescribedTracker(DescribedProgramTracker, FinalizingProgramTracker):
    """One that also answers ``finalize``."""


def build_described(settings: ServedSettings, context: TrackerContext) -> ProgramTracker:
    """The tracker of ``subprocess:FILE.toml``.

    Raises:
        SettingsError: The file is missing or damaged.
    """
    is_finalizing = settings.document().program.final
    kind = FinalizingDescribedTracker if is_finalizing else DescribedProgramTracker
    return kind(settings, context)


def files(settings: SubprocessSettings) -> list[Path]:
    """The files whose content decides what ``subprocess:COMMAND`` does: see `files_of_command`."""
    return files_of_command(settings.words(), settings.working_folder)


def build(settings: SubprocessSettings, context: TrackerContext) -> ProgramTracker:
    """The tracker of ``subprocess:COMMAND``.

    Raises:
        SettingsError: No command was given, or its quotes do not match.
    """
    command = settings.words()
    kind = FinalizingProgramTracker if settings.final else ProgramTracker
    name = Path(command[0]).name
    folder = settings.working_folder
    return kind(
        name,
        settings,
        context,
        command,
        images=settings.images,
        folder=folder,
        exit_codes=settings.exit_codes,
        variables=settings.environment,
    )
