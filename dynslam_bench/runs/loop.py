"""The one loop: everything that is ever measured was measured by stepping an environment here."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import gymnasium as gym
import numpy as np

from dynslam_bench.envs.slam_env import SlamEnv
from dynslam_bench.envs.wrappers import DegradeFrames, DropFrames
from dynslam_bench.evaluation.masks import compare_masks
from dynslam_bench.evaluation.protocol import Protocol
from dynslam_bench.geometry.trajectory_files import write_tum
from dynslam_bench.runs.artifacts import (
    SHEET_FILE,
    SheetWriter,
    SnapshotWriter,
    VideoWriter,
    aligned_truth,
    keep_map,
    taken,
)
from dynslam_bench.runs.exchange.recording import RECORDING_FILE, RecordingWriter
from dynslam_bench.runs.frames import FRAMES_FILE, FrameRow
from dynslam_bench.runs.process.child import at
from dynslam_bench.runs.spec import RunSpec

Send = Callable[[dict[str, Any]], None]


def run_loop(job: dict[str, Any], send: Send, stopping: Callable[[], bool]) -> dict[str, Any]:
    """Run a tracker over a sequence.

    Args:
        job: ``spec``, ``folder``, ``protocol`` and ``progress_every``.
        send: Tells the parent.
        stopping: Whether the parent wants an early end.

    Returns:
        The last message: ``done`` or ``stopped``.

    Raises:
        DynslamError: The environment cannot be made, or the tracker broke its contract.
    """
    spec = RunSpec.model_validate(job["spec"])
    folder = Path(job["folder"])
    protocol = Protocol.model_validate(job["protocol"])
    base = _environment(spec, protocol)
    env = _spoiled(base, spec)
    send({"type": "started", "frames": len(base.sequence)})
    recorder = _Recorder(base, spec, folder)
    position = _Position(base)
    with contextlib.closing(recorder):
        with at(position):
            env.reset(seed=spec.seed)
        over = False
        reported = 0
        while True:
            done = base.episode.next_index
            with at(f"frame {done - 1} of {len(base.sequence)}"):
                recorder.add()
            send({"type": "frame", "index": done - 1})
            if done - reported >= job["progress_every"] or over:
                reported = done
                send({"type": "progress", **_partial(base)})
            if over:
                break
            if stopping():
                env.close()
                return {"type": "stopped", "frames": done}
            with at(position):
                _, _, terminated, truncated, _ = env.step(0)
            over = terminated or truncated
        with at("after the last frame"):
            outcome = _finish(base, folder, recorder)
            env.close()
    return {"type": "done", **outcome}


def _environment(spec: RunSpec, protocol: Protocol) -> SlamEnv:
    return SlamEnv(
        spec.sequence,
        spec.tracker,
        settings=spec.settings,
        frames=spec.frames_seen,
        stride=spec.stride,
        device=spec.device,
        threads=spec.threads,
        cache=spec.cache,
        data_root=spec.data_root,
        camera=spec.camera,
        protocol=protocol,
        render_mode="rgb_array" if spec.video else None,
    )


def _spoiled(env: gym.Env[Any, Any], spec: RunSpec) -> gym.Env[Any, Any]:
    """The environment with the degradation and the frame drops that were asked for."""
    if any(spec.degrade.values()):
        env = DegradeFrames(env, seed=0, **spec.degrade)
    if spec.realtime or spec.drop_share:
        env = DropFrames(env, share=None if spec.realtime else spec.drop_share, seed=spec.seed)
    return env


class _Recorder:
    """Everything that is kept of a run frame by frame: the log, and the pictures that were asked for."""

    def __init__(self, env: SlamEnv, spec: RunSpec, folder: Path) -> None:
        self.spec = spec
        self._frames = _FrameWriter(env, (folder / FRAMES_FILE).open("w"))
        self._snapshots = SnapshotWriter(folder, len(env.sequence))
        self._env = env
        self._video = VideoWriter(folder, env) if spec.video else None
        self.sheet = SheetWriter(folder / SHEET_FILE, env) if spec.sheet else None
        title = f"{env.tracker_spec.label} on {env.sequence.id}"
        recording = folder / RECORDING_FILE
        self.recording = RecordingWriter(recording, env.sequence.camera, title, apart=True) if spec.rrd else None

    def add(self) -> None:
        self._frames.write()
        self._snapshots.add(self._env.episode.outcomes[-1], self._env.frame.rgb.shape, self._env.result)
        if self._video is not None:
            self._video.add()
        if self.sheet is not None:
            self.sheet.add()
        if self.recording is not None:
            _record(self.recording, self._env)

    def close(self) -> None:
        self._frames.close()
        self._snapshots.write()
        if self._video is not None:
            self._video.close()
        if self.recording is not None:
            self.recording.close()


def _record(recording: RecordingWriter, env: SlamEnv) -> None:
    """Add the current frame to a recording."""
    outcome, result, frame = env.episode.outcomes[-1], env.result, env.frame
    seen = result.keypoints_xy is not None or result.dynamic_mask is not None
    recording.add(
        outcome.index,
        outcome.timestamp,
        frame.rgb,
        outcome.T_world_cam,
        taken(outcome.index, result) if seen else None,
        state=outcome.state,
        error_m=None if outcome.error is None else outcome.error.trans_m,
    )


class _Position:
    """Says which frame is being tracked."""

    def __init__(self, env: SlamEnv) -> None:
        self._env = env

    def __str__(self) -> str:
        return f"frame {self._env.episode.next_index} of {len(self._env.sequence)}"


def _partial(env: SlamEnv) -> dict[str, Any]:
    """What is known so far: frames, coverage, the protocol's metrics of the frames so far, median frame time."""
    totals = [timing["total"] for timing in env.timings if timing]
    last = env.episode.outcomes[-1].error
    partial: dict[str, Any] = {
        "frames_done": env.episode.next_index,
        "frames": len(env.sequence),
        "metrics": env.episode_metrics() if env.protocol.trajectory == "online" else {},
        "frame_time_s": float(np.median(totals)),
    }
    return partial if last is None else partial | {"pose_error_trans_m": last.trans_m}


def _finish(env: SlamEnv, folder: Path, recorder: _Recorder) -> dict[str, Any]:
    sheet = recorder.sheet
    began = time.perf_counter()
    final = env.final_trajectory()
    outcome: dict[str, Any] = {"finalize_s": None, "gpu_memory_mb": None}
    if final is not None:
        outcome["finalize_s"] = time.perf_counter() - began
        write_tum(folder / "trajectory_final.txt", final)
    kept = keep_map(env, folder, recorder.spec)
    outputs, notes = kept.outputs, [*kept.notes]
    if sheet is not None:
        if outputs is not None:
            sheet.write(outputs, env.online_trajectory() if final is None else final)
        else:
            notes.append(f"no {SHEET_FILE}: the tracker offers neither keyframes nor a map")
    if recorder.recording is not None:
        track = env.online_trajectory() if final is None else final
        truth = aligned_truth(env.sequence.ground_truth, track)[0] if len(track) else None
        cloud = (None, None) if outputs is None else (outputs.positions, outputs.colours)
        recorder.recording.finish(track, truth, *cloud)
    if env.device.startswith("cuda"):
        import torch

        outcome["gpu_memory_mb"] = torch.cuda.max_memory_allocated(env.device) / 1e6
        outcome["gpu"] = torch.cuda.get_device_name(env.device)
    return outcome | kept.counts | {"notes": notes}


class _FrameWriter:
    """Appends the frames that are new to the log; each line is complete before the next frame begins."""

    def __init__(self, env: SlamEnv, log: IO[str]) -> None:
        self._env, self._log = env, log
        self._written = 0

    def write(self) -> None:
        outcomes = self._env.episode.outcomes
        for outcome in outcomes[self._written :]:
            masked = self._masks(outcome.index) if outcome is outcomes[-1] else (None, None)
            self._log.write(FrameRow.of(outcome, *masked).to_json())
        self._log.flush()
        self._written = len(outcomes)

    def close(self) -> None:
        self._log.close()

    def _masks(self, index: int) -> tuple[float | None, float | None]:
        """Overlap of the tracker's mask with the exact one of people, and the share of the image that shows people.

        None where a mask is missing; the overlap also where both are empty.
        """
        if self._env.sequence.masks is None:
            return None, None
        truth = self._env.sequence.masks[index]
        people = [number for number, name in truth.class_names.items() if name == "person"]
        exact, predicted = np.isin(truth.instances, people), self._env.result.dynamic_mask
        overlap = None if predicted is None else compare_masks(np.asarray(predicted, dtype=bool), exact).iou
        return overlap, float(exact.mean())
