"""A tracker in a program of its own, in any language, over JSON lines (`docs/plugins.md` states the protocol)."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dynslam_bench.contracts.result import TrackResult
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.contracts.tracker import TrackerContext
from dynslam_bench.core.code_files import files_of_command
from dynslam_bench.core.errors import DynslamError, TrackerError
from dynslam_bench.core.seeding import derive_seed
from dynslam_bench.geometry.camera import Camera
from dynslam_bench.geometry.trajectory import Trajectory

from .answers import read_final_answer, read_track_answer
from .exchange import ImageExchange
from .program import Program
from .settings import ProgramSettings, SubprocessSettings

PROTOCOL = 2
"""Of the JSON lines; since 2 the answer to ``track`` repeats its index."""


class ProgramTracker:
    """Drives a `Program` through one sequence after the other; each `reset` starts it afresh.

    Args:
        name: For messages.
        settings: Time limits.
        context: Where it runs.
        command: Program and arguments.
        images: How it gets the images, see `ImageExchange`.
        folder: Its working folder; None for the current one.
        environment: Variables to set beside the inherited ones.
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
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._images: Literal["raw", "png"] = images
        self.name, self.limits, self.context = name, settings, context
        self._command, self._folder, self._environment = list(command), folder, dict(environment or {})
        self._program: Program | None = None
        self._exchange: ImageExchange | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> ProgramTracker:
        """Refused: what a program holds in memory cannot be copied.

        Raises:
            TrackerError: Always.
        """
        raise TrackerError(f"{self.name} is a program of its own, whose state cannot be copied")

    def reset(self, camera: Camera, *, rng: np.random.Generator) -> None:
        """Start the program and tell it the camera.

        Raises:
            TrackerError: It cannot be started, dies, refuses, or does not answer in time.
        """
        self.close()
        seed = derive_seed(rng)
        threads = str(self.context.threads)
        limits = {name: threads for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
        self._exchange = ImageExchange(camera, self._images)
        self._program = Program(
            self.name, self._command, folder=self._folder, environment={**limits, **self._environment}
        )
        request = {
            "op": "reset",
            "protocol": PROTOCOL,
            "camera": {
                "width": camera.width,
                "height": camera.height,
                "fx": camera.fx,
                "fy": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "distortion": list(camera.distortion),
                "baseline_m": camera.baseline_m,
                "readout_s": camera.readout_s,
                "fps": self.context.fps,
            },
            "images": self._exchange.announce(),
            "seed": seed,
            "threads": self.context.threads,
            "device": self.context.device,
            "sequence": self.context.sequence_id,
            "options": self.options(camera, self._exchange.folder),
        }
        try:
            self._program.ask(request, self.limits.start_timeout_s, "at reset")
        except DynslamError:
            self.close()
            raise

    def options(self, camera: Camera, folder: Path) -> dict[str, Any]:
        """What else the program is told at ``reset``; `folder` is a private one that lives as long as the sequence."""
        return {}

    def track(self, frame: Frame) -> TrackResult:
        """Hand over one frame and wait for its pose.

        ``timings`` are those that the program states, with the rest of the time as ``transfer``.

        Raises:
            TrackerError: It dies, hangs, or answers what is no pose.
        """
        program, exchange = self._running()
        start = time.perf_counter()
        doing = f"at frame {frame.index}"
        images = exchange.put(frame)
        request = {"op": "track", "index": frame.index, "timestamp": frame.timestamp, **images}
        answer = program.ask(request, self.limits.frame_timeout_s, doing)
        if answer.get("index") != frame.index:
            raise TrackerError(
                f"{self.name} {doing}: answered index {str(answer.get('index'))[:20]}",
                "each answer repeats the index of its track request",
            )
        return read_track_answer(answer, f"{self.name} {doing}", lambda: time.perf_counter() - start)

    def close(self) -> None:
        """End the program (killed if it does not end by itself) and remove the exchanged files."""
        if self._program is not None:
            self._program.close(self.limits.close_timeout_s)
            self._program = None
        if self._exchange is not None:
            self._exchange.close()
            self._exchange = None

    def _running(self) -> tuple[Program, ImageExchange]:
        if self._program is None or self._exchange is None:
            raise TrackerError(f"{self.name} was used before reset() or after close()")
        return self._program, self._exchange


class FinalizingProgramTracker(ProgramTracker):
    """A program that also answers ``finalize``."""

    def finalize(self) -> Trajectory:
        """The program's final trajectory; rows ``[timestamp, tx, ty, tz, qx, qy, qz, qw]``, camera to world.

        Raises:
            TrackerError: It dies, hangs, or answers what is no trajectory.
        """
        program, _ = self._running()
        answer = program.ask({"op": "finalize"}, self.limits.final_timeout_s, "at finalize")
        return read_final_answer(answer, f"{self.name} at finalize")


def files(settings: SubprocessSettings) -> list[Path]:
    """The files whose content decides what ``subprocess:COMMAND`` does: see `files_of_command`."""
    folder = Path(settings.folder).expanduser() if settings.folder else None
    return files_of_command(settings.words(), folder)


def build(settings: SubprocessSettings, context: TrackerContext) -> ProgramTracker:
    """The tracker of ``subprocess:COMMAND``.

    Raises:
        SettingsError: No command was given, or its quotes do not match.
    """
    command = settings.words()
    folder = Path(settings.folder).expanduser() if settings.folder else None
    kind = FinalizingProgramTracker if settings.final else ProgramTracker
    return kind(Path(command[0]).name, settings, context, command, images=settings.images, folder=folder)
