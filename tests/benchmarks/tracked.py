"""Trackers on sequences in this process: less work than a run of its own for many short clips."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.settings import parse_assignments
from dynslam_bench.evaluation import evaluate
from dynslam_bench.geometry import Trajectory
from dynslam_bench.geometry.motion_covariances import MotionCovariances
from dynslam_bench.sequences import open_sequence
from dynslam_bench.trackers import TRACKERS, TrackerContext, build_tracker
from dynslam_bench.trackers.registry import resolve_settings

NO_ERROR_M = 1.0
"""Error of a clip without a trajectory, metres; it bounds all others."""


class Clip:
    """The frames of a sequence, read once."""

    def __init__(self, name: str, first: int = 0, count: int | None = None) -> None:
        whole = open_sequence(name)
        stop = len(whole) if count is None else min(len(whole), first + count)
        sequence = open_sequence(name, frames=(first, stop))
        self.id = sequence.id
        self.masks = sequence.masks
        self.camera = sequence.camera
        self.truth = sequence.ground_truth
        self.frames: list[Frame] = [sequence[index] for index in range(len(sequence))]
        self.stamps = np.array([frame.timestamp for frame in self.frames])


@dataclass(frozen=True, eq=False)
class Tracked:
    """A tracker's poses and covariances on a clip."""

    clip: Clip
    poses: Trajectory
    covariances: MotionCovariances

    @property
    def ate_m(self) -> float:
        """Online ATE of the tracked frames under tum-rgbd/v1, metres."""
        if len(self.poses) < 3:
            return NO_ERROR_M
        scored = evaluate(self.poses, self.clip.truth, input_timestamps=self.clip.stamps)
        return scored.metrics["ate_rmse_m"]

    @property
    def coverage(self) -> float:
        """Share of the frames with a pose."""
        return len(self.poses) / len(self.clip.frames)


def track(tracker: str, clip: Clip, assignments: Iterable[str] = ()) -> Tracked:
    """A tracker on a clip, with settings as ``name=value``."""
    spec = TRACKERS.get(tracker)
    settings = resolve_settings(spec, parse_assignments(list(assignments)))
    system = build_tracker(spec, settings, TrackerContext(clip.id, clip.masks))
    system.reset(clip.camera, rng=np.random.default_rng(0))
    poses = {}
    covariances = {}
    for frame in clip.frames:
        result = system.track(frame)
        if result.state != "ok" or result.T_world_cam is None:
            continue
        poses[frame.timestamp] = result.T_world_cam
        if result.motion_covariance is not None:
            covariances[frame.timestamp] = result.motion_covariance
    return Tracked(
        clip,
        Trajectory(np.array([*poses]), np.array([*poses.values()]).reshape(-1, 4, 4)),
        MotionCovariances(
            np.array([*covariances]), np.array([*covariances.values()]).reshape(-1, 6, 6)
        ),
    )
