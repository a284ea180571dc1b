"""Gymnasium environments, wrappers and rendering.

Importing this package registers ``dynslam/<sequence>-v0`` for every listed sequence and ``dynslam/Sequence-v0``; in
worker processes write ``gym.make("dynslam_bench.envs:dynslam/Sequence-v0", sequence=...)``.
"""

from __future__ import annotations

from dynslam_bench.contracts.checks import TrackerContractError

from .control import ActionMap
from .degrade_frames import Degradation, DegradeFrames
from .device import resolve_device
from .drop_frames import DropFrames
from .observation import STATS_LAYOUT
from .record_timings import RecordTimings
from .record_trajectory import RecordTrajectory
from .registration import GENERIC_ID, env_id, register_envs
from .reward import REWARDS
from .sequence_sampler import SequenceSampler
from .slam_env import SlamEnv
from .small_images import SmallImages

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
