"""One episode: the outcome of every frame so far."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.contracts import Trajectory
from dynslam_bench.evaluation import OnlineSample

FrameState = Literal["initialising", "ok", "lost", "dropped"]


@dataclass(frozen=True, eq=False)
class FrameOutcome:
    """One frame of the episode.

    Attributes:
        index: Index of the frame in the sequence (after `frames` and `stride`).
        timestamp: Seconds.
        state: The tracker's state, or ``dropped`` if the frame never reached it.
        T_world_cam: Tracked pose ``[4, 4]``; None unless the state is ``ok``.
        stats: The tracker's diagnostics.
        timings: Seconds: ``read`` (decoding or rendering), ``total`` (the tracker's step, segmentation included,
            reading excluded), ``processor`` (processor time of this process in that step, all threads together; what a
            foreign program or a GPU does is no part of it) and the tracker's stages.
        error: Causal errors against the ground truth; None where there is none.
        reward: What the frame earned.
    """

    index: int
    timestamp: float
    state: FrameState
    T_world_cam: NDArray[np.float64] | None
    stats: Mapping[str, float]
    timings: Mapping[str, float]
    error: OnlineSample | None
    reward: float


@dataclass(eq=False)
class Episode:
    """The frames so far.

    Attributes:
        outcomes: One entry a frame, in order.
        lost_streak: Frames without a tracked pose in a row, up to the last one; an initialising tracker is not lost.
        over: Whether the last step ended the episode.
    """

    outcomes: list[FrameOutcome] = field(default_factory=list)
    lost_streak: int = 0
    over: bool = False

    def add(self, outcome: FrameOutcome) -> None:
        """Append a frame's outcome."""
        self.outcomes.append(outcome)
        self.lost_streak = self.lost_streak + 1 if outcome.state == "lost" else 0

    @property
    def next_index(self) -> int:
        """Index of the frame that comes next."""
        return len(self.outcomes)

    def trajectory(self) -> Trajectory:
        """The online trajectory: the poses of the frames with state ``ok``, each as it was when the frame came."""
        tracked = [(o.timestamp, o.T_world_cam) for o in self.outcomes if o.T_world_cam is not None]
        stamps = np.array([stamp for stamp, _ in tracked], dtype=np.float64)
        poses = np.array([pose for _, pose in tracked], dtype=np.float64).reshape(-1, 4, 4)
        return Trajectory(stamps, poses)
