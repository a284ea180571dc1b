"""Action space, observation space and reward of the environment. Ground truth never enters an observation."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dynslam_bench.contracts import Camera, Frame, TrackResult
from dynslam_bench.core.errors import SettingsError, did_you_mean
from dynslam_bench.core.settings import (
    Parameter,
    Scalar,
    Settings,
    apply_overrides,
    flatten,
    parameters,
    why_unused,
)
from dynslam_bench.evaluation.online import OnlineSample


class ActionMap:
    """Maps actions to settings.

    Without controlled settings the action space is ``Discrete(1)``: its action changes nothing. Otherwise it is
    ``Box(-1, 1, (k,), float32)``, one coordinate a setting, in the order of `control`. With ``u = (a + 1) / 2``:

    - float: ``low + u * (high - low)``, or ``low * (high / low) ** u`` on a log scale;
    - int: the same, rounded to the nearest integer;
    - bool and categorical: the ``floor(u * n)``-th of the n choices, each with an equal share of the axis.

    A coordinate that is that of the neutral action leaves its setting exactly as it is in `settings`; an action has 24
    bits a coordinate, from which most values come back changed in the last places.

    Args:
        settings: The settings of the episode; all others keep these values.
        control: Dotted names of online settings.

    Raises:
        SettingsError: A name is unknown or given twice, or its setting may not change in mid-episode, has no effect
            with these settings, or has a value outside the range that actions span.
    """

    def __init__(self, settings: Settings, control: Sequence[str]) -> None:
        self.base = settings
        self.parameters: tuple[Parameter, ...] = _select(settings, control)
        self._values = {parameter.name: attrgetter(parameter.name)(settings) for parameter in self.parameters}
        self._neutral = self.encode(settings)

    @property
    def neutral(self) -> NDArray[np.float32]:
        """The action ``[k]`` that leaves the settings exactly as they are."""
        return self._neutral.copy()

    def space(self) -> spaces.Space[NDArray[np.float32]] | spaces.Discrete:
        """The action space."""
        if not self.parameters:
            return spaces.Discrete(1)
        return spaces.Box(-1.0, 1.0, (len(self.parameters),), np.float32)

    def settings(self, action: object) -> Settings:
        """The settings that an action asks for.

        Args:
            action: float ``[k]``; values beyond [-1, 1] are clipped. Without controlled settings 0.

        Raises:
            SettingsError: The action is none of the space: not 0, of another shape, no numbers, or NaN.
        """
        if not self.parameters:
            if not self.space().contains(action):
                raise SettingsError(
                    f"the action {reprlib.repr(action)} is not in Discrete(1)",
                    "without control the only action is 0; name settings in control to change them",
                )
            return self.base
        return apply_overrides(self.base, self.values(action))

    def values(self, action: object) -> dict[str, Scalar]:
        """Dotted name to value of the controlled settings under an action."""
        try:
            vector = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError):
            raise SettingsError(
                f"the action {reprlib.repr(action)} holds no numbers",
                f"one in [-1, 1] for each of {list(self._values)}",
            ) from None
        if vector.shape != (len(self._values),):
            raise SettingsError(
                f"the action has shape {vector.shape}, {len(self._values)} settings are controlled: "
                f"{', '.join(self._values)}"
            )
        if np.isnan(vector).any():
            raise SettingsError(f"the action holds NaN: {vector.tolist()}")
        shares = (np.clip(vector, -1.0, 1.0) + 1.0) / 2.0
        asked = zip(self.parameters, shares, vector.astype(np.float32) == self._neutral, strict=True)
        return {p.name: self._values[p.name] if same else _decode(p, float(u)) for p, u, same in asked}

    def encode(self, settings: Settings) -> NDArray[np.float32]:
        """The action ``[k]`` that asks for given settings; values beyond the search range are clipped to its ends."""
        flat = flatten(settings)
        shares = [_encode(p, flat[p.name]) for p in self.parameters]
        return np.asarray(np.clip(2.0 * np.array(shares, dtype=np.float64) - 1.0, -1.0, 1.0), dtype=np.float32)


def _select(settings: Settings, control: Sequence[str]) -> tuple[Parameter, ...]:
    if isinstance(control, str):
        raise SettingsError(f"control is the string '{control}'", "give a list of setting names")
    tunable = {parameter.name: parameter for parameter in parameters(type(settings))}
    online = {name: parameter for name, parameter in tunable.items() if parameter.online}
    chosen = []
    for name in control:
        if name not in online:
            if name in tunable or name in flatten(settings):
                raise SettingsError(f"setting '{name}' may not change in mid-episode", did_you_mean(name, online))
            hint = did_you_mean(name, online) or "this tracker has no online settings"
            raise SettingsError(f"unknown setting '{name}' in control", hint)
        parameter, value = online[name], attrgetter(name)(settings)
        if parameter in chosen:
            raise SettingsError(f"setting '{name}' is given twice in control")
        if reason := why_unused(settings, name):
            raise SettingsError(f"setting '{name}' in control has no effect: {reason}", "leave it out of control")
        if parameter.low is not None and parameter.high is not None and not parameter.low <= value <= parameter.high:
            raise SettingsError(
                f"setting '{name}' in control is {value:g}, actions span {parameter.low:g} to {parameter.high:g}",
                "set it within, or leave it out of control",
            )
        chosen.append(parameter)
    return tuple(chosen)


def _decode(parameter: Parameter, share: float) -> Scalar:
    if parameter.kind in ("bool", "categorical"):
        return parameter.choices[min(int(share * len(parameter.choices)), len(parameter.choices) - 1)]
    assert parameter.low is not None and parameter.high is not None
    low, high = float(parameter.low), float(parameter.high)
    value = low * (high / low) ** share if parameter.scale == "log" else low + share * (high - low)
    value = min(max(value, low), high)  # rounding may put a power slightly beyond its end
    return round(value) if parameter.kind == "int" else value


def _encode(parameter: Parameter, value: Scalar) -> float:
    if parameter.kind in ("bool", "categorical"):
        return (parameter.choices.index(value) + 0.5) / len(parameter.choices)
    assert parameter.low is not None and parameter.high is not None
    low, high, x = float(parameter.low), float(parameter.high), float(value)
    if parameter.scale == "log":
        return math.log(max(x, low) / low) / math.log(high / low)
    return (x - low) / (high - low)


ObservationKind = Literal["stats", "rgbd"]
MAX_DEPTH_M = 20.0
"""Upper end of the depth image in ``rgbd`` observations, metres; farther values are clipped."""

STATS_LAYOUT: tuple[tuple[str, str], ...] = (
    ("initialising", "1 while the tracker initialises, else 0"),
    ("ok", "1 if the frame was tracked, else 0"),
    ("lost", "1 if the tracker is lost, else 0"),
    ("lost_streak", "n / (n + 10) of the frames n that were lost in a row, this one included"),
    ("progress", "frame index / last index"),
    ("keypoints", "n / (n + 1000) of the keypoints found"),
    ("culled", "culled / found keypoints"),
    ("matches", "matches / kept keypoints"),
    ("inliers", "inliers / matches"),
    ("residual", "r / (r + 1 px) of the reprojection residual r"),
    ("mask_fraction", "share of the image taken for dynamic"),
    ("map_points", "n / (n + 5000) of the map points"),
    ("keyframes", "n / (n + 100) of the keyframes"),
    ("keyframe", "1 if this frame became a keyframe, else 0"),
    ("motion_x", "tanh(x / 0.1 m) of the estimated motion since the previous frame, in the previous camera frame"),
    ("motion_y", "likewise, y"),
    ("motion_z", "likewise, z (forward)"),
    ("motion_rx", "tanh(r / 0.1 rad) of the rotation vector of that motion"),
    ("motion_ry", "likewise, y"),
    ("motion_rz", "likewise, z"),
    ("brightness", "mean grey level / 255"),
    ("contrast", "standard deviation of the grey level / 128"),
    ("depth_valid", "share of the pixels with depth"),
    ("depth_median", "d / (d + 3 m) of the median valid depth d"),
)
"""Name and meaning of every entry of the ``stats`` observation, in order. What a tracker does not report is 0."""

_SIGNED = np.array([name.startswith("motion_") for name, _ in STATS_LAYOUT])


def stats_space() -> spaces.Box:
    """``Box`` of float32 ``[24]``: entries in [0, 1], the motion's in [-1, 1]; see `STATS_LAYOUT`."""
    low = np.where(_SIGNED, -1.0, 0.0).astype(np.float32)
    return spaces.Box(low, np.ones_like(low), dtype=np.float32)


def rgbd_space(camera: Camera) -> spaces.Dict:
    """``Dict`` of ``rgb`` uint8 ``[H, W, 3]``, ``depth`` float32 ``[H, W]`` metres (0 missing) and ``stats``."""
    size = (camera.height, camera.width)
    return spaces.Dict(
        {
            "rgb": spaces.Box(0, 255, (*size, 3), np.uint8),
            "depth": spaces.Box(0.0, MAX_DEPTH_M, size, np.float32),
            "stats": stats_space(),
        }
    )


def stats_observation(
    frame: Frame, result: TrackResult, *, progress: float, lost_streak: int, motion: NDArray[np.float64] | None
) -> NDArray[np.float32]:
    """The vector of `STATS_LAYOUT` for one tracked frame; finite whatever the tracker reports.

    Args:
        frame: The frame.
        result: What the tracker gave for it.
        progress: Index of the frame, over that of the sequence's last one.
        lost_streak: Frames lost in a row, this one included.
        motion: Twist ``[6]`` of the estimated motion since the previous frame; None if either frame has no pose.
    """
    stats = result.stats
    keypoints = _stat(stats, "keypoints")
    culled = _stat(stats, "culled")
    matches = _stat(stats, "matches")
    motion = np.zeros(6) if motion is None else np.tanh(motion / 0.1)
    gray = frame.rgb[::4, ::4].mean(axis=2, dtype=np.float32)
    depth = frame.depth[::4, ::4]
    valid = depth[(depth > 0) & np.isfinite(depth)]
    values = [
        float(result.state == "initialising"),
        float(result.state == "ok"),
        float(result.state == "lost"),
        _saturate(lost_streak, 10.0),
        progress,
        _saturate(keypoints, 1000.0),
        _ratio(culled, keypoints),
        _ratio(matches, keypoints - culled),
        _ratio(_stat(stats, "inliers"), matches),
        _saturate(_stat(stats, "residual_px"), 1.0),
        _stat(stats, "mask_fraction"),
        _saturate(_stat(stats, "map_points"), 5000.0),
        _saturate(_stat(stats, "keyframes"), 100.0),
        float(_stat(stats, "keyframe") > 0),
        *motion,
        float(gray.mean()) / 255.0,
        float(gray.std()) / 128.0,
        valid.size / max(depth.size, 1),
        _saturate(float(np.median(valid)), 3.0) if valid.size else 0.0,
    ]
    return np.clip(np.asarray(values, dtype=np.float32), np.where(_SIGNED, -1.0, 0.0), 1.0).astype(np.float32)


def rgbd_observation(frame: Frame, stats: NDArray[np.float32]) -> dict[str, NDArray[np.uint8] | NDArray[np.float32]]:
    """Copies of the images, and the vector of `stats_observation`."""
    depth = np.nan_to_num(frame.depth, nan=0.0, posinf=MAX_DEPTH_M, neginf=0.0)
    return {
        "rgb": np.array(frame.rgb, dtype=np.uint8),
        "depth": np.clip(depth, 0.0, MAX_DEPTH_M).astype(np.float32),
        "stats": stats,
    }


def _stat(stats: Mapping[str, float], name: str) -> float:
    value = float(stats.get(name, 0.0))
    return value if np.isfinite(value) else 0.0


def _saturate(value: float, scale: float) -> float:
    return max(value, 0.0) / (max(value, 0.0) + scale)


def _ratio(part: float, whole: float) -> float:
    return min(max(part / whole, 0.0), 1.0) if whole > 0 else 0.0


RewardKind = Literal["neg_rpe", "neg_pose_error"]


def _frame_error(error: OnlineSample) -> float:
    moved = error.frame_trans_m or 0.0
    return -max(moved - error.lost_way_m, 0.0) if error.tracked else -2.0 * moved


def _pose_error(error: OnlineSample) -> float:
    return -min(error.trans_m, error.way_m) if error.tracked else -error.way_m


REWARDS: dict[str, Callable[[OnlineSample], float]] = {
    "neg_rpe": _frame_error,
    "neg_pose_error": _pose_error,
}
"""Reward in metres of a frame that has ground truth, by name; other frames earn 0.

- ``neg_rpe``: minus the translational error of the motion since the previous frame; needs no alignment and adds up.
  A frame without a tracked pose costs twice the true motion: it did not move, and it has to catch up. The first tracked
  pose after it is a jump from the last one (see `OnlineError`), which costs only the error beyond the charged path. So
  reporting a loss never earns more than repeating the last pose, and staying lost never more than recovering.
- ``neg_pose_error``: minus the causal translational pose error, at most the length of the true path so far (an error of
  100 %). A frame without a tracked pose earns minus that length: no pose, however far it has drifted, earns less, so
  that getting lost pays only before the first tracked pose, which begins the episode's frame of reference.

The sum over an episode is not the ATE, which the last step's ``episode_metrics`` give under the protocol.
"""
