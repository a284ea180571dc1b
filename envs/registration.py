"""Gymnasium ids: one for every listed sequence, and a generic one."""

from __future__ import annotations

import gymnasium as gym

from dynslam_bench.sequences.catalogue import sequence_ids

NAMESPACE = "dynslam"
GENERIC_ID = f"{NAMESPACE}/Sequence-v0"
_ENTRY_POINT = "dynslam_bench.envs:SlamEnv"


def env_id(sequence: str) -> str:
    """The environment id of a listed sequence, e.g. ``dynslam/tum-fr3-walking_xyz-v0``."""
    return f"{NAMESPACE}/{sequence.replace('/', '-')}-v0"


def register_envs() -> list[str]:
    """Register all environments that are not registered yet; calling it again changes nothing.

    Every id makes a `SlamEnv`; the generic one needs ``sequence=``. There is no ``max_episode_steps``: the sequence
    ends the episode.

    Returns:
        All ids, the generic one first.
    """
    ids: dict[str, dict[str, str]] = {GENERIC_ID: {}} | {env_id(name): {"sequence": name} for name in sequence_ids()}
    for name, kwargs in ids.items():
        if name not in gym.registry:
            gym.register(id=name, entry_point=_ENTRY_POINT, kwargs=kwargs)
    return list(ids)
