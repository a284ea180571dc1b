"""SLAM-Control: fixed problems for agents that change a tracker's settings from frame to frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal

import gymnasium as gym

from dynslam_bench.core import SettingsError
from dynslam_bench.core.arguments import names_wrong_arguments
from dynslam_bench.envs.episode import AccuracyMinusCost

Split = Literal["train", "test", "recordings"]


@dataclass(frozen=True)
class ControlBenchmark:
    """A control problem: sequences that change within an episode, a tracker, what an agent sets, and what it earns.

    Attributes:
        id: ``<name>-v<version>``; a change of anything here is another version.
        summary: What is controlled.
        train: Sequences of the scenes 0 to 99.
        test: Sequences of held-out scenes.
        recordings: Recordings for a further test; they have to be fetched.
        tracker: Id of the tracker.
        settings: What differs from its defaults.
        control: Online settings that actions change.
        actions: For each discrete action the settings that it asks for, the default first; empty if
            actions are continuous (`SlamEnv`).
        reward: Reward of every frame.
        frames: Part of each sequence.
        stride: Every so many frames are taken.
    """

    id: str
    summary: str
    train: tuple[str, ...]
    test: tuple[str, ...]
    recordings: tuple[str, ...]
    tracker: str
    settings: Mapping[str, Any]
    control: tuple[str, ...]
    actions: tuple[Mapping[str, Any], ...]
    reward: AccuracyMinusCost
    frames: tuple[int, int]
    stride: int

    @names_wrong_arguments
    def make(
        self, split: Split = "train", index: int | Sequence[int] | None = None, **arguments: Any
    ) -> gym.Env[Any, Any]:
        """The environment of a split.

        Args:
            split: ``train``, ``test`` or ``recordings``.
            index: Which sequence of the split, or which ones; None for all. Of several, every
                episode draws one.
            **arguments: Other arguments of `SlamEnv`, e.g. ``observation`` or ``data_root``.

        Raises:
            SettingsError: No such split or sequence.
            DynslamError: Raised by `SlamEnv`: a sequence, a setting or an argument is unknown or
                does not fit. A recording that is not there names the command that fetches it.
        """
        from dynslam_bench.envs.slam_env import SlamEnv
        from dynslam_bench.envs.wrappers import DiscreteActions, SequenceSampler

        splits = {"train": self.train, "test": self.test, "recordings": self.recordings}
        if split not in splits:
            raise SettingsError(
                f"'{self.id}' has no split '{split}'", f"choose {', '.join(splits)}"
            )

        # the chosen sequences: all, several, or one
        every = range(len(splits[split]))
        if index is None:
            chosen = list(every)
        else:
            chosen = list(index) if isinstance(index, Iterable) else [index]
        if not chosen or not all(number in every for number in chosen):
            raise SettingsError(
                f"the split {split} of '{self.id}' has no sequence {index!r}",
                f"give 0 to {every[-1]}",
            )
        sequences = [splits[split][int(number)] for number in chosen]
        given: dict[str, Any] = {
            "settings": dict(self.settings),
            "control": self.control,
            "reward": self.reward,
            "frames": self.frames,
            "stride": self.stride,
            "device": "cpu",
            # under changing settings of features the cache would find no keypoints again
            "cache": self.reward.cost == "network_calls",
            "memory_map": True,
        }
        env: gym.Env[Any, Any] = SlamEnv(sequences[0], self.tracker, **(given | arguments))
        if self.actions:
            env = DiscreteActions(env, [dict(values) for values in self.actions])
        return env if len(sequences) == 1 else SequenceSampler(env, sequences, mode="random")


def _scenes(names: Sequence[str], numbers: range) -> tuple[str, ...]:
    """Scenes of rendered families in turn; each family has as many even scenes as odd ones, which change in reverse."""
    return tuple(f"synthetic/{names[n // 2 % len(names)]}?scene={n}" for n in numbers)


_SMALL = {"preprocessing.width": 320, "preprocessing.height": 240, "features.n_features": 500}
"""Images of a camera on a small computer, which keep a step cheap."""
_NEVER = 1_000_000
"""Every so many frames: more than an episode has."""

_BENCHMARKS = (
    ControlBenchmark(
        id="masks-v0",
        summary="when the segmentation network runs, and how far its masks are grown, in scenes that fill or empty",
        train=_scenes(["changing_crowd"], range(100)),
        test=_scenes(["changing_crowd"], range(100, 112)),
        recordings=("bonn/crowd",),
        tracker="mask-rcnn",
        settings=MappingProxyType({**_SMALL, "segmentation.n": _NEVER}),
        control=("segmentation.schedule", "segmentation.dilation_px"),
        actions=tuple(
            MappingProxyType(
                {"segmentation.schedule": schedule, "segmentation.dilation_px": dilation}
            )
            for schedule in ("every", "every_nth")
            for dilation in (15, 5, 25)
        ),
        reward=AccuracyMinusCost(weight=0.002, cost="network_calls"),
        frames=(0, 240),
        stride=2,
    ),
    ControlBenchmark(
        id="features-v0",
        summary="how many features are extracted, where they are searched and how often a keyframe is made, while the "
        "camera speeds up or slows down and the light fades or returns",
        train=_scenes(["changing_tempo", "changing_light"], range(100)),
        test=_scenes(["changing_tempo", "changing_light"], range(100, 112)),
        recordings=("tum/fr1/xyz", "tum/fr1/rpy"),
        tracker="orb-slam2",
        settings=MappingProxyType(_SMALL),
        control=(
            "features.n_features",
            "backend.tracking.radius_px",
            "backend.tracking.map_radius_px",
            "backend.keyframes.tracked_share",
        ),
        actions=(),
        reward=AccuracyMinusCost(weight=0.003, cost="keypoints"),
        frames=(0, 240),
        stride=2,
    ),
)
_BUDGET = replace(
    _BENCHMARKS[1],
    id="budget-v0",
    summary=f"{_BENCHMARKS[1].summary}, and keypoints cost five times as much at the end",
    reward=AccuracyMinusCost(weight=0.001, cost="keypoints", growth=4 / 119),
)
CONTROL_BENCHMARKS: Mapping[str, ControlBenchmark] = MappingProxyType(
    {benchmark.id: benchmark for benchmark in (*_BENCHMARKS, _BUDGET)}
)
"""The benchmarks by id."""


@names_wrong_arguments
def control_benchmark(id: str) -> ControlBenchmark:
    """The benchmark of an id.

    Raises:
        SettingsError: There is none.
    """
    if id not in CONTROL_BENCHMARKS:
        raise SettingsError(
            f"unknown control benchmark '{id}'", f"known: {', '.join(CONTROL_BENCHMARKS)}"
        )
    return CONTROL_BENCHMARKS[id]


def make_control(benchmark: str, **arguments: Any) -> gym.Env[Any, Any]:
    """`ControlBenchmark.make` of a benchmark by its id: what ``gym.make("dynslam/masks-v0", ...)`` calls."""
    return control_benchmark(benchmark).make(**arguments)
