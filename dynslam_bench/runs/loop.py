"""The loop in which every run is made: it steps an environment and keeps what is recorded of each frame."""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from dynslam_bench.core import call_periodically
from dynslam_bench.envs import DegradeFrames, DropFrames, SlamEnv
from dynslam_bench.evaluation import Protocol, compare_masks
from dynslam_bench.evaluation.comparison import tracked_frames
from dynslam_bench.geometry import write_tum
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

_BEAT_S = 5.0
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
    base = SlamEnv(
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
        protocol=Protocol.model_validate(job["protocol"]),
        render_mode="rgb_array" if spec.video else None,
    )
    env: gym.Env[Any, Any] = base
    if any(spec.degrade.values()):
        env = DegradeFrames(env, seed=0, **spec.degrade)
    if spec.realtime or spec.drop_share:
        env = DropFrames(env, share=None if spec.realtime else spec.drop_share, seed=spec.seed)
    total = len(base.sequence)

    def position() -> str:
        return f"frame {base.episode.next_index} of {total}"

    send({"type": "started", "frames": total})
    recorder = _Recorder(base, spec, Path(job["folder"]))
    with contextlib.closing(recorder):
        with at(position):
            env.reset(seed=spec.seed)
        over = False
        reported = 0
        while True:
            done = base.episode.next_index
            with at(lambda: f"frame {base.episode.next_index - 1} of {total}"):
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
        signs: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
        # a batch program, which has a time limit of its own, is at work
        if not base.tracker_spec.online:
            signs = call_periodically(_BEAT_S, lambda: send({"type": "frame", "index": total - 1}))
        with at(lambda: "after the last frame"), signs:
            outcome = recorder.finish()
            env.close()
    return {"type": "done", **outcome}


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
            shot = snapshot_of(outcome.index, result)
            error_m = None if outcome.error is None else outcome.error.trans_m
            image = encode(env.frame.rgb)
            pose = outcome.T_world_cam
            self._recorded.append(
                RecordedFrame(
                    outcome.index, outcome.timestamp, image, pose, shot, outcome.state, error_m
                )
            )

    def finish(self) -> dict[str, Any]:
        """Write what is known at the end, and return what goes into the record."""
        env = self._env
        folder = self._folder
        began = time.perf_counter()
        final = env.final_trajectory()
        outcome: dict[str, Any] = {}
        if final is not None:
            outcome["finalize_s"] = time.perf_counter() - began
            write_tum(folder / FINAL, final)
        outputs, counts, notes = keep_map(env, folder, self._spec)
        if not env.tracker_spec.online and final is not None:
            measured = env.measured
            tracked = tracked_frames(final, env.sequence.timestamps)
            notes += measured.pop("notes")
            outcome |= measured | {
                "tracked": int(tracked.sum()),
                "lost_at_end": int(tracked[::-1].argmax()),
            }
        track = env.online_trajectory() if final is None else final
        if self._sheet is not None and outputs is not None:
            self._sheet.write(outputs, track)
        elif self._sheet is not None:
            notes.append(f"no {SHEET_FILE}: the tracker offers neither keyframes nor a map")
        if self._spec.rrd:
            truth = aligned_truth(env.sequence.ground_truth, track)[0] if len(track) else None
            path = folder / RECORDING_FILE
            camera = env.sequence.camera
            write_recording(path, camera, self._title, self._recorded, (track, truth), outputs)
        if env.device.startswith("cuda"):
            import torch

            outcome["gpu_memory_mb"] = torch.cuda.max_memory_allocated(env.device) / 1e6
            outcome["gpu"] = torch.cuda.get_device_name(env.device)
        return outcome | counts | {"notes": notes}

    def close(self) -> None:
        """Finish the files, also those of a run that ends early."""
        self._log.close()
        if self._snapshots is not None:
            self._snapshots.write()
        if self._video is not None:
            self._video.close()

    def _compare_masks(self, index: int) -> tuple[float | None, float | None]:
        """Overlap of the tracker's mask with the exact one of people, and the share of the image that shows people.

        None where a mask is missing; the overlap also where both are empty.
        """
        masks = self._env.sequence.masks
        if masks is None:
            return None, None
        truth = masks[index]
        people = [number for number, name in truth.class_names.items() if name == "person"]
        exact = np.isin(truth.instances, people)
        predicted = self._env.result.dynamic_mask
        overlap = (
            None
            if predicted is None
            else compare_masks(np.asarray(predicted, dtype=bool), exact).iou
        )
        return overlap, float(exact.mean())
