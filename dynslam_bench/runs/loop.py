"""The loop in which every run is made: it steps an environment and keeps what is recorded of each frame."""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from dynslam_bench.contracts import MapOutputs
from dynslam_bench.core import call_periodically
from dynslam_bench.envs.slam_env import SlamEnv
from dynslam_bench.envs.wrappers import DegradeFrames, DropFrames
from dynslam_bench.evaluation import Protocol, compare_masks
from dynslam_bench.evaluation.comparison import tracked_frames
from dynslam_bench.geometry import Trajectory, write_tum
from dynslam_bench.runs.artifacts import (
    SHEET_FILE,
    SheetWriter,
    SnapshotWriter,
    VideoWriter,
    aligned_truth,
    keep_map,
    snapshot_of,
)
from dynslam_bench.runs.exchange.recording import (
    RECORDING_FILE,
    RecordedFrame,
    check_rerun,
    encode,
    write_recording,
)
from dynslam_bench.runs.frames import FRAMES_FILE, FrameRow
from dynslam_bench.runs.layout import FINAL
from dynslam_bench.runs.process.failures import at
from dynslam_bench.runs.spec import RunSpec

_SIGN_OF_LIFE_S = 5.0
"""Seconds between two signs of life of a batch program, which reports no frames."""
Send = Callable[[dict[str, Any]], None]


def run_loop(job: dict[str, Any], send: Send, stopping: Callable[[], bool]) -> dict[str, Any]:
    """Run a tracker over a sequence.

    Args:
        job: ``spec``, ``folder``, ``protocol`` and ``progress_every``.
        send: Sends a message to the parent.
        stopping: Whether the parent wants an early end.

    Returns:
        The last message: ``done`` or ``stopped``.

    Raises:
        DynslamError: The environment cannot be made, or the tracker broke its contract.
    """
    spec = RunSpec.model_validate(job["spec"])
    slam = _slam_env(spec, Protocol.model_validate(job["protocol"]))
    env = _with_changed_frames(slam, spec)
    total = len(slam.sequence)

    def position() -> str:
        return f"frame {slam.episode.next_index} of {total}"

    def last_position() -> str:
        return f"frame {slam.episode.next_index - 1} of {total}"

    send({"type": "started", "frames": total})
    recorder = _Recorder(slam, spec, Path(job["folder"]))
    with contextlib.closing(recorder):
        with at(position):
            env.reset(seed=spec.seed)  # it tracks the first frame
        is_over = False
        n_reported = 0
        while True:
            # keep the frame that was just tracked, and report it
            n_done = slam.episode.next_index
            with at(last_position):
                recorder.add()
            send({"type": "frame", "index": n_done - 1})
            if n_done - n_reported >= job["progress_every"] or is_over:
                n_reported = n_done
                send({"type": "progress", **_partial(slam)})
            if is_over:
                break
            if stopping():
                env.close()
                return {"type": "stopped", "frames": n_done}
            # track the next frame
            with at(position):
                _, _, terminated, truncated, _ = env.step(0)
            is_over = terminated or truncated

        signs_of_life: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
        # a batch program, which has a time limit of its own, is at work
        if not slam.tracker_spec.online:
            signs_of_life = call_periodically(
                _SIGN_OF_LIFE_S, lambda: send({"type": "frame", "index": total - 1})
            )
        with at(lambda: "after the last frame"), signs_of_life:
            outcome = recorder.finish()
            env.close()
    return {"type": "done", **outcome}


def _slam_env(spec: RunSpec, protocol: Protocol) -> SlamEnv:
    """The environment of a run; the protocol is that of the partial metrics."""
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


def _with_changed_frames(slam: SlamEnv, spec: RunSpec) -> gym.Env[Any, Any]:
    """The environment, with its frames degraded or dropped as a run asks for."""
    env: gym.Env[Any, Any] = slam
    if any(spec.degrade.values()):
        env = DegradeFrames(env, seed=0, **spec.degrade)
    if spec.realtime or spec.drop_share:
        env = DropFrames(env, share=None if spec.realtime else spec.drop_share, seed=spec.seed)
    return env


def _partial(env: SlamEnv) -> dict[str, Any]:
    """Numbers of the run so far: frames, coverage, the protocol's metrics of the frames so far, median frame time."""
    totals = [timing["total"] for timing in env.timings if timing]
    last = env.episode.outcomes[-1].error
    partial: dict[str, Any] = {
        "frames_done": env.episode.next_index,
        "frames": len(env.sequence),
        "metrics": env.episode_metrics() if env.protocol.trajectory == "online" else {},
        "frame_time_s": float(np.median(totals)),
    }
    return partial if last is None else partial | {"pose_error_trans_m": last.trans_m}


class _Recorder:
    """Everything that is kept of a run: the frame log, and the pictures that were asked for.

    Each line of the log is complete before the next frame begins.
    """

    def __init__(self, env: SlamEnv, spec: RunSpec, folder: Path) -> None:
        self._env = env
        self._spec = spec
        self._folder = folder
        self._title = f"{env.tracker_spec.label} on {env.sequence.id}"
        self._log = (folder / FRAMES_FILE).open("w")
        self._logged = 0
        self._snapshots = SnapshotWriter(folder, len(env.sequence)) if spec.snapshots else None
        self._video = VideoWriter(folder, env) if spec.video else None
        self._sheet = SheetWriter(folder / SHEET_FILE, env) if spec.sheet else None
        self._recorded: list[RecordedFrame] = []
        if spec.rrd:
            check_rerun()

    def add(self) -> None:
        """Keep the frames since the last call: the one just tracked, and those that were dropped before it."""
        env = self._env
        result = self._env.result
        outcomes = env.episode.outcomes
        *dropped, outcome = outcomes[self._logged :]
        self._log.writelines(FrameRow.of(frame).to_json() for frame in dropped)
        self._log.write(FrameRow.of(outcome, *self._compare_masks(outcome.index)).to_json())
        self._log.flush()
        self._logged = len(outcomes)
        if self._snapshots is not None:
            self._snapshots.add(outcome, env.frame.rgb, result)
        if self._video is not None:
            self._video.add()
        if self._sheet is not None:
            self._sheet.add()
        if self._spec.rrd:
            self._recorded.append(
                RecordedFrame(
                    index=outcome.index,
                    stamp=outcome.timestamp,
                    jpeg=encode(env.frame.rgb),
                    pose=outcome.T_world_cam,
                    shot=snapshot_of(outcome.index, result),
                    state=outcome.state,
                    error_m=None if outcome.error is None else outcome.error.trans_m,
                )
            )

    def finish(self) -> dict[str, Any]:
        """Write what is known at the end, and return what goes into the record."""
        env = self._env
        outcome: dict[str, Any] = {}

        # the final optimisation, and the map
        began = time.perf_counter()
        final = env.final_trajectory()
        if final is not None:
            outcome["finalize_s"] = time.perf_counter() - began
            write_tum(self._folder / FINAL, final)
        outputs, counts, notes = keep_map(env, self._folder, self._spec)
        measured = env.measured
        notes += measured.pop("notes", [])
        if not env.tracker_spec.online and final is not None:
            outcome |= measured | self._coverage_of_batch(final)

        # the pictures that were asked for
        track = env.online_trajectory() if final is None else final
        if self._sheet is not None and outputs is not None:
            self._sheet.write(outputs, track)
        elif self._sheet is not None:
            notes.append(f"no {SHEET_FILE}: the tracker offers neither keyframes nor a map")
        if self._spec.rrd:
            self._write_recording(track, outputs)

        if env.device.startswith("cuda"):
            import torch

            outcome["gpu_memory_mb"] = torch.cuda.max_memory_allocated(env.device) / 1e6
            outcome["gpu"] = torch.cuda.get_device_name(env.device)
        return outcome | counts | {"notes": notes}

    def _coverage_of_batch(self, final: Trajectory) -> dict[str, int]:
        """Number of frames that a batch program has tracked, and of those that have no pose at the end."""
        tracked = tracked_frames(final, self._env.sequence.timestamps)  # bool, one a frame
        return {"tracked": int(tracked.sum()), "lost_at_end": int(tracked[::-1].argmax())}

    def _write_recording(self, track: Trajectory, outputs: MapOutputs | None) -> None:
        """Write the recording for rerun's viewer.

        Args:
            track: The run's final trajectory, or the online one.
            outputs: Keyframes and map points; None where the tracker offers none.
        """
        sequence = self._env.sequence
        truth = aligned_truth(sequence.ground_truth, track)[0] if len(track) else None
        write_recording(
            self._folder / RECORDING_FILE,
            sequence.camera,
            self._title,
            self._recorded,
            (track, truth),
            outputs,
        )

    def close(self) -> None:
        """Finish the files, also those of a run that ends early."""
        self._log.close()
        if self._snapshots is not None:
            self._snapshots.write()
        if self._video is not None:
            self._video.close()

    def _compare_masks(self, index: int) -> tuple[float | None, float | None]:
        """The tracker's mask against the exact one of people.

        Returns:
            Overlap of the two masks, 0 to 1; None where one is missing, or both are empty. Share of
            the image that shows people, 0 to 1; None without exact masks.
        """
        masks = self._env.sequence.masks
        if masks is None:
            return None, None
        truth = masks[index]
        people = [number for number, name in truth.class_names.items() if name == "person"]
        exact = np.isin(truth.instances, people)
        people_share = float(exact.mean())
        predicted = self._env.result.dynamic_mask
        if predicted is None:
            return None, people_share
        overlap = compare_masks(np.asarray(predicted, dtype=bool), exact).iou
        return overlap, people_share
