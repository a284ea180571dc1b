"""Copies of an environment in mid-episode."""

from __future__ import annotations

from copy import deepcopy
from typing import TYPE_CHECKING, Any

from dynslam_bench.core.errors import TrackerError

if TYPE_CHECKING:
    from .slam_env import SlamEnv

_SHARED = ("sequence", "_source", "tracker_spec", "protocol", "settings")
"""What nobody writes to."""


def deep_copy(env: SlamEnv, memo: dict[int, Any]) -> SlamEnv:
    """The environment at the same frame of its episode, with a tracker of its own: both go on alike, apart.

    What nobody writes to is shared: the sequence, the specs and the settings.

    Raises:
        TrackerError: The tracker cannot be copied, as a program of its own cannot.
    """
    parts = vars(env)
    for name in _SHARED:
        memo[id(parts[name])] = parts[name]
    copied = memo[id(env)] = object.__new__(type(env))
    try:
        tracker = deepcopy(parts["_tracker"], memo)
    except Exception as error:
        raise TrackerError(
            f"tracker '{env.tracker_spec.id}' cannot be copied in mid-episode: {type(error).__name__}: {error}",
            "make a second environment, or give the tracker a __deepcopy__",
        ) from error
    rest = {name: value for name, value in parts.items() if name not in ("_tracker", "_canvas")}
    vars(copied).update(deepcopy(rest, memo), _tracker=tracker, _canvas=None)
    return copied
