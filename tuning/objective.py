"""What a configuration is worth: runs of the run store, compared with the default settings' on the same instances."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from dynslam_bench.core.errors import EvaluationError, StudyError, TrajectoryError
from dynslam_bench.evaluation.evaluate import evaluate
from dynslam_bench.evaluation.protocol import Protocol, get_protocol
from dynslam_bench.runs import RunRecord, RunSpec, RunStore, run_many, score
from dynslam_bench.sequences.catalogue import open_sequence

from .study_file import StudySpec

FLOOR_M = 1e-4
"""Errors below a tenth of a millimetre count as that: a ratio of two perfect runs is no news."""


@dataclass(frozen=True)
class Instance:
    """What a configuration is tried on: one sequence, in one repeat.

    Attributes:
        sequence: The sequence.
        seed: Seed of the run.
        offset: So many leading frames are left out.
    """

    sequence: str
    seed: int
    offset: int = 0

    def __str__(self) -> str:
        return f"{self.sequence}, seed {self.seed}" + (f", offset {self.offset}" if self.offset else "")


@dataclass(frozen=True)
class Outcome:
    """One configuration on one instance.

    Attributes:
        instance: Where.
        run_id: The run.
        ate_m: ATE RMSE in metres, lost frames held at the last pose.
        coverage: Share of frames that were tracked.
        frame_s: Mean seconds a frame, segmentation included.
        rtf: Real-time factor: duration of the sequence's frames over the time they took.
    """

    instance: Instance
    run_id: str
    ate_m: float
    coverage: float
    frame_s: float
    rtf: float


class InstanceFailedError(Exception):
    """A run did not come to its end; carries the reason."""


@dataclass
class Configuration:
    """The outcomes of one configuration, and what they amount to."""

    outcomes: list[Outcome] = field(default_factory=list)

    def log_ratios(self, reference: Mapping[Instance, Outcome]) -> list[float]:
        """Natural logarithm of the ATE ratio to the reference, by instance."""
        return [log_ratio(outcome.ate_m, reference[outcome.instance].ate_m) for outcome in self.outcomes]

    @property
    def coverage(self) -> float:
        """Mean coverage."""
        return float(np.mean([outcome.coverage for outcome in self.outcomes]))

    @property
    def rtf(self) -> float:
        """Geometric mean of the real-time factors."""
        return float(np.exp(np.mean([math.log(outcome.rtf) for outcome in self.outcomes])))

    @property
    def fps(self) -> float:
        """Frames a second: the inverse of the mean frame time."""
        return 1.0 / float(np.mean([outcome.frame_s for outcome in self.outcomes]))

    def violations(self, spec: StudySpec) -> dict[str, float]:
        """How far each constraint is violated, relatively; <= 0 is fulfilled."""
        found = {}
        if spec.min_coverage is not None:
            found["coverage"] = spec.min_coverage - self.coverage
        if spec.min_fps is not None:
            found["fps"] = (spec.min_fps - self.fps) / spec.min_fps
        return found


class Evaluator:
    """Makes the runs of configurations.

    Args:
        spec: The study.
        results: The results folder; trials' runs are stored like any others.
    """

    def __init__(self, spec: StudySpec, results: Path) -> None:
        self.spec = spec
        self.store = RunStore(results)
        self.protocol = held_protocol(spec.protocol)
        self._lock = threading.Lock()

    def instances(self, sequences: Sequence[str], repeats: Sequence[tuple[int, int]]) -> list[Instance]:
        """Every sequence in every repeat, a pair of seed and start offset."""
        return [Instance(sequence, *repeat) for sequence in sequences for repeat in repeats]

    def run(
        self,
        settings: Mapping[str, Any],
        instance: Instance,
        *,
        cache: bool,
        on_progress: Callable[[dict[str, Any]], bool] | None = None,
        cancelled: Callable[[], bool] | None = None,
    ) -> Outcome | None:
        """Run a configuration on one instance, or take the stored run.

        Args:
            settings: Overrides of the tracker's settings.
            instance: Where.
            cache: Whether to use the stage cache.
            on_progress: Told of partial metrics; returning False stops the run.
            cancelled: Asked many times a second; True ends the run at once.

        Returns:
            The outcome; None if `on_progress` stopped it, or it was cancelled.

        Raises:
            InstanceFailedError: The run crashed, timed out, ran out of memory or was invalid; names run and reason.
        """
        spec = RunSpec(
            tracker=self.spec.tracker, sequence=instance.sequence, settings=dict(settings), seed=instance.seed,
            offset=instance.offset, threads=self.spec.threads, cache=cache, data_root=self.spec.data_root,
        )  # fmt: skip
        listener = None if on_progress is None else (lambda _, partial: on_progress(partial))
        (record,) = run_many(
            [spec], results=self.store, on_progress=listener, protocol=self.protocol, cancelled=cancelled
        )  # fmt: skip
        if record.status == "stopped":
            return None
        if record.failed:
            raise InstanceFailedError(f"{instance}: {record.status}: {record.reason}")
        return self.outcome(record, instance)

    def ate_of_first(self, run_id: str, frames: int) -> float | None:
        """ATE RMSE in metres of a stored run's first frames; None where they have no error."""
        record = self.store.get(run_id)
        trajectory = self.store.trajectory(run_id, "online")
        truth = None if record is None else self.store.ground_truth(record.sequence.part)
        if record is None or trajectory is None or truth is None:
            return None
        stamps = self.store.timestamps(record.sequence.part)
        seen = trajectory.select(trajectory.timestamps <= stamps[min(frames, len(stamps)) - 1])
        try:
            evaluation = evaluate(seen, truth, self.protocol, input_timestamps=stamps[:frames])
        except (EvaluationError, TrajectoryError):
            return None
        return float(evaluation.metrics["ate_rmse_m"])

    def outcome(self, record: RunRecord, instance: Instance) -> Outcome:
        """What a stored run amounts to.

        Raises:
            InstanceFailedError: Nothing was tracked, so that there is no error to compare; says why.
        """
        metrics = score(self.store, record, self.protocol)
        evaluation = metrics.online
        if evaluation is None:
            ate = never_moved_m(instance.sequence, self.spec.data_root)  # nothing tracked: as if it had not moved
        else:
            ate = evaluation.metrics["ate_rmse_m"]
        total = record.timings["total"].mean_s
        period = record.sequence.duration_s / max(record.sequence.frames - 1, 1)
        return Outcome(instance, record.run_id, float(ate), record.coverage, total, period / total)


def log_ratio(ate_m: float, reference_m: float) -> float:
    """Natural logarithm of an error's ratio to the reference's."""
    return math.log(max(ate_m, FLOOR_M) / max(reference_m, FLOOR_M))


def held_protocol(protocol_id: str) -> Protocol:
    """The protocol with lost frames held at the last pose, so that losing track never pays."""
    protocol = get_protocol(protocol_id)
    if protocol.lost_frames == "hold":
        return protocol
    return protocol.model_copy(update={"id": f"{protocol.id}+hold", "lost_frames": "hold"})


@lru_cache(maxsize=64)
def never_moved_m(sequence: str, data_root: str | None) -> float:
    """ATE RMSE in metres of a camera that never moves, from the ground truth alone.

    Raises:
        StudyError: The sequence has no ground truth: it cannot be tuned on.
    """
    opened = open_sequence(sequence, data_root=None if data_root is None else Path(data_root))
    if opened.ground_truth is None:
        raise StudyError(f"sequence '{sequence}' has no ground truth, so nothing can be tuned on it")
    positions = opened.ground_truth.positions
    return float(np.sqrt(np.square(positions - positions.mean(axis=0)).sum(axis=1).mean()))


def check_sequences(spec: StudySpec) -> None:
    """Open every sequence of a study before any trial runs.

    Raises:
        SequenceError: One is unknown or missing.
        StudyError: One has no ground truth.
    """
    for sequence in (*spec.tune, *spec.held_out):
        never_moved_m(sequence, spec.data_root)
