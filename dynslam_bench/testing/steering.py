"""Conformance of steering: online settings act as building with them does, and end with the episode."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from dynslam_bench.contracts.result import TrackResult
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.contracts.tracker import Tracker
from dynslam_bench.core.errors import DynslamError
from dynslam_bench.core.settings import Parameter, Settings, apply_overrides
from dynslam_bench.core.steering import Steerable, steerable_parameters
from dynslam_bench.geometry.camera import Camera

from .report import NotApplicable, require

FEW = 6
"""Up to so many online settings are steered one by one; more of them all at once, to alternate ends."""
Episode = list[TrackResult]


def check_steering(
    build: Callable[[Settings], Tracker], settings: Settings, camera: Camera, frames: Sequence[Frame], seed: int
) -> None:
    """Check the contract of `core.steering.Steerable` on a tracker.

    Steered from before the first frame, an episode has to be that of a tracker built with the same settings; the one
    after it, unsteered, that of a fresh tracker. Where settings show in the second half of an episode, steering in
    its middle has to show there with one of them at least.

    Args:
        build: Constructs the tracker with settings.
        settings: The settings to start from.
        camera: Of the frames.
        frames: What to track.
        seed: Seed of the randomness.

    Raises:
        ConformanceError: It cannot be steered, does not obey, or does not forget.
        NotApplicable: It has no online settings, or they change nothing on these frames.
    """
    online = steerable_parameters(settings)
    if not online:
        raise NotApplicable("the tracker has no online settings")
    tracker = build(settings)
    names = ", ".join(parameter.name for parameter in online[:4]) + (", ..." if len(online) > 4 else "")
    found = f"marked online: {names}; but a {type(tracker).__name__} has no configure(settings)"
    require(isinstance(tracker, Steerable), found, "implement it (see core.steering), or take online=True away")
    fresh = _episode(tracker, camera, frames, seed)
    half = len(frames) // 2
    shown = False
    late: list[Settings] = []
    for ends in _ends(online):
        changed = apply_overrides(settings, ends)
        try:
            static = _episode(build(changed), camera, frames, seed)
        except DynslamError:
            continue  # the ends do not go together
        steered = _episode(tracker, camera, frames, seed, changed)
        again = _episode(tracker, camera, frames, seed)
        what = ", ".join(f"{name}={value}" for name, value in list(ends.items())[:4])
        at = first_difference(static, steered)
        found = f"configure() with {what} gives another result than building with it: {at}"
        require(not at, found, "configure() does not reach the part that uses the setting, or only later")
        at = first_difference(fresh, again)
        require(
            not at,
            f"after an episode steered to {what}, reset() does not bring back the settings: {at}",
            "remember the settings that it was built with, and put them into force in reset()",
        )
        shown = shown or bool(first_difference(fresh, static))
        late += [changed] if first_difference(fresh[half:], static[half:]) else []
    obeyed = any(first_difference(fresh, _episode(tracker, camera, frames, seed, changed, at=half)) for changed in late)
    cause = "the settings are read once, at the start; read them on every frame"
    require(
        obeyed or not late, f"configure() in mid-episode changes nothing, although building with {names} does", cause
    )
    if not shown:
        raise NotApplicable(f"{names} change nothing on this scene, at either end of their ranges")


def _ends(online: Sequence[Parameter]) -> Iterator[dict[str, Any]]:
    pairs = [(p.name, (p.choices[0], p.choices[-1]) if p.choices else (p.low, p.high)) for p in online]
    if len(pairs) <= FEW:
        yield from ({name: end} for name, ends in pairs for end in ends)
    else:
        yield {name: ends[number % 2] for number, (name, ends) in enumerate(pairs)}
        yield {name: ends[1 - number % 2] for number, (name, ends) in enumerate(pairs)}


def _episode(
    tracker: Any, camera: Camera, frames: Sequence[Frame], seed: int, settings: Settings | None = None, at: int = 0
) -> Episode:
    tracker.reset(camera, rng=np.random.default_rng(seed))
    results = []
    for number, frame in enumerate(frames):
        if settings is not None and number == at:
            tracker.configure(settings)
        results.append(tracker.track(frame))
    return results


def first_difference(first: Episode, second: Episode) -> str:
    """The first thing in which two episodes differ, bit for bit, for a message; empty if in none."""
    for index, (a, b) in enumerate(zip(first, second, strict=True)):
        if a.state != b.state:
            return f"frame {index}, states {a.state} and {b.state}"
        arrays = ("T_world_cam", "dynamic_mask", "keypoints_xy", "keypoints_keep")
        different = [name for name in arrays if not np.array_equal(_array(a, name), _array(b, name))]
        different += [key for key in {**a.stats, **b.stats} if a.stats.get(key) != b.stats.get(key)]
        if different:
            return f"frame {index}, {', '.join(different[:3])}"
    return ""


def _array(result: TrackResult, name: str) -> Any:
    value = getattr(result, name)
    return np.zeros(0) if value is None else value
