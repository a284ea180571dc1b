"""Gymnasium environments, wrappers and rendering.

Importing this package registers ``dynslam/<sequence>-v0`` for every listed sequence and ``dynslam/Sequence-v0``; in
worker processes write ``gym.make("dynslam_bench.envs:dynslam/Sequence-v0", sequence=...)``.
"""

from __future__ import annotations

from dynslam_bench.contracts.checks import TrackerContractError
from dynslam_bench.envs.arguments import resolve_device
from dynslam_bench.envs.registration import GENERIC_ID, env_id, register_envs
from dynslam_bench.envs.slam_env import SlamEnv
from dynslam_bench.envs.spaces import REWARDS, STATS_LAYOUT, ActionMap
from dynslam_bench.envs.wrappers import (
    Degradation,
    DegradeFrames,
    DropFrames,
    RecordTimings,
    RecordTrajectory,
    SequenceSampler,
    SmallImages,
)

__all__ = [
    "GENERIC_ID",
    "REWARDS",
    "STATS_LAYOUT",
    "ActionMap",
    "Degradation",
    "DegradeFrames",
    "DropFrames",
    "RecordTimings",
    "RecordTrajectory",
    "SequenceSampler",
    "SlamEnv",
    "SmallImages",
    "TrackerContractError",
    "env_id",
    "register_envs",
    "resolve_device",
]

register_envs()
