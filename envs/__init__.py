"""Gymnasium environments, wrappers and rendering.

Importing this package loads no tracker. It registers ``dynslam/<sequence>-v0`` for every listed sequence,
``dynslam/Sequence-v0``, and the benchmarks ``dynslam/masks-v0``, ``dynslam/features-v0`` and
``dynslam/budget-v0``; in worker processes write
``gym.make("dynslam_bench.envs:dynslam/Sequence-v0", sequence=...)``.
"""

from typing import TYPE_CHECKING, Any

import gymnasium as gym

from dynslam_bench.core.arguments import names_wrong_arguments
from dynslam_bench.envs.control_benchmarks import (
    CONTROL_BENCHMARKS,
    ControlBenchmark,
    control_benchmark,
    make_control,
)
from dynslam_bench.sequences.catalogue import sequence_ids

if TYPE_CHECKING:
    from dynslam_bench.contracts import TrackerContractError
    from dynslam_bench.envs.episode import (
        REWARDS,
        AccuracyMinusCost,
        Episode,
        FrameOutcome,
        NegWindowError,
    )
    from dynslam_bench.envs.slam_env import EpisodeState, SlamEnv, resolve_device
    from dynslam_bench.envs.spaces import (
        KEYPOINT_LAYOUT,
        PRIVILEGED_LAYOUT,
        STATS_LAYOUT,
        ActionMap,
    )
    from dynslam_bench.envs.wrappers import (
        Degradation,
        DegradeFrames,
        DiscreteActions,
        DropFrames,
        RecordTimings,
        RecordTrajectory,
        SequenceSampler,
        SmallImages,
    )

_HOMES = {
    "AccuracyMinusCost": "envs.episode",
    "ActionMap": "envs.spaces",
    "Degradation": "envs.wrappers",
    "DegradeFrames": "envs.wrappers",
    "DiscreteActions": "envs.wrappers",
    "DropFrames": "envs.wrappers",
    "Episode": "envs.episode",
    "EpisodeState": "envs.slam_env",
    "FrameOutcome": "envs.episode",
    "KEYPOINT_LAYOUT": "envs.spaces",
    "NegWindowError": "envs.episode",
    "PRIVILEGED_LAYOUT": "envs.spaces",
    "REWARDS": "envs.episode",
    "RecordTimings": "envs.wrappers",
    "RecordTrajectory": "envs.wrappers",
    "STATS_LAYOUT": "envs.spaces",
    "SequenceSampler": "envs.wrappers",
    "SlamEnv": "envs.slam_env",
    "SmallImages": "envs.wrappers",
    "TrackerContractError": "contracts",
    "resolve_device": "envs.slam_env",
}

__all__ = [
    "CONTROL_BENCHMARKS",
    "GENERIC_ID",
    "KEYPOINT_LAYOUT",
    "PRIVILEGED_LAYOUT",
    "REWARDS",
    "STATS_LAYOUT",
    "AccuracyMinusCost",
    "ActionMap",
    "ControlBenchmark",
    "Degradation",
    "DegradeFrames",
    "DiscreteActions",
    "DropFrames",
    "Episode",
    "EpisodeState",
    "FrameOutcome",
    "NegWindowError",
    "RecordTimings",
    "RecordTrajectory",
    "SequenceSampler",
    "SlamEnv",
    "SmallImages",
    "TrackerContractError",
    "control_benchmark",
    "env_id",
    "make_control",
    "register_envs",
    "resolve_device",
]

GENERIC_ID = "dynslam/Sequence-v0"


@names_wrong_arguments
def env_id(sequence: str) -> str:
    """The environment id of a listed sequence, e.g. ``dynslam/tum-fr3-walking_xyz-v0``."""
    return f"dynslam/{sequence.replace('/', '-')}-v0"


def register_envs() -> list[str]:
    """Register all environments that are not registered yet; calling it again changes nothing.

    Every id makes a `SlamEnv`; the generic one needs ``sequence=``, that of a `ControlBenchmark`
    takes the arguments of its `make`. There is no ``max_episode_steps``: the sequence ends the
    episode.

    Returns:
        All ids: the generic one, those of the benchmarks, those of the sequences.
    """
    ids: dict[str, tuple[str, dict[str, str]]] = {GENERIC_ID: ("SlamEnv", {})}
    ids |= {f"dynslam/{name}": ("make_control", {"benchmark": name}) for name in CONTROL_BENCHMARKS}
    ids |= {env_id(name): ("SlamEnv", {"sequence": name}) for name in sequence_ids()}
    for name, (maker, kwargs) in ids.items():
        if name not in gym.registry:
            gym.register(id=name, entry_point=f"dynslam_bench.envs:{maker}", kwargs=kwargs)
    return list(ids)


register_envs()


def __getattr__(name: str) -> Any:
    """The names of this package, loaded on first use: importing it stays quick."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"dynslam_bench.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
