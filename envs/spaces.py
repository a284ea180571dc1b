"""Action space and observation space of the environment. Ground truth enters the part ``privileged`` alone."""

import math
import reprlib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from typing import Any

import cv2
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dynslam_bench.contracts import Camera, Frame, TrackResult
from dynslam_bench.core import SettingsError, did_you_mean
from dynslam_bench.core.arguments import names_wrong_arguments
from dynslam_bench.core.settings import (
    Parameter,
    Scalar,
    Settings,
    apply_overrides,
    flatten,
    parameters,
    why_unused,
)
from dynslam_bench.envs.episode import Episode
from dynslam_bench.geometry import se3


class ActionMap:
    """Maps actions to settings.

    Without controlled settings the action space is ``Discrete(1)``: its action changes nothing.
    Otherwise it is ``Box(-1, 1, (k,), float32)``, one coordinate a setting, in the order of
    `control`. With ``u = (a + 1) / 2``:

    - float: ``low + u * (high - low)``, or ``low * (high / low) ** u`` on a log scale;
    - int: that number, rounded to the nearest integer;
    - bool and categorical: the ``floor(u * n)``-th of the n choices, each with an equal share of the axis.

    A coordinate that is that of the neutral action leaves its setting exactly as it is in
    `settings`; an action has 24 bits a coordinate, from which most values come back changed in the
    last places.

    Args:
        settings: The settings of the episode; all others keep these values.
        control: Dotted names of online settings.

    Raises:
        SettingsError: A name is unknown or given twice, or its setting may not change in
            mid-episode, has no effect with these settings, or has a value outside the range that
            actions span.
    """

    @names_wrong_arguments
    def __init__(self, settings: Settings, control: Sequence[str]) -> None:
        self.base = settings
        self.parameters: tuple[Parameter, ...] = _select(settings, control)
        self._values = {
            parameter.name: attrgetter(parameter.name)(settings) for parameter in self.parameters
        }
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
            SettingsError: The action is none of the space: not 0, of another shape, no numbers, or
                NaN.
        """
        if self.parameters:
            return apply_overrides(self.base, self.values(action))
        if not self.space().contains(action):
            raise SettingsError(
                f"the action {reprlib.repr(action)} is not in Discrete(1)",
                "without control the only action is 0; name settings in control to change them",
            )
        return self.base

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
        # shares u of the axes [k], from 0 to 1; neutral coordinates leave the settings' own values
        shares = (np.clip(vector, -1.0, 1.0) + 1.0) / 2.0
        is_neutral = vector.astype(np.float32) == self._neutral
        values = {}
        for parameter, share, keep in zip(self.parameters, shares, is_neutral, strict=True):
            name = parameter.name
            values[name] = self._values[name] if keep else _decode(parameter, float(share))
        return values

    def of(self, values: Mapping[str, Any]) -> NDArray[np.float32]:
        """The action ``[k]`` that asks for values of controlled settings; see `SlamEnv.action_of`."""
        for name in values:
            if name not in self._values:
                raise SettingsError(
                    f"setting '{name}' is not in control", did_you_mean(name, self._values)
                )
        settings = apply_overrides(self.base, values)
        for parameter in self.parameters:
            value = attrgetter(parameter.name)(settings)
            _check_range(parameter, value, f"setting '{parameter.name}'")
        return self.encode(settings)

    def encode(self, settings: Settings) -> NDArray[np.float32]:
        """The action ``[k]`` that asks for given settings; values beyond the search range are clipped to its ends."""
        flat = flatten(settings)
        shares = [_encode(parameter, flat[parameter.name]) for parameter in self.parameters]
        action = 2.0 * np.array(shares, dtype=np.float64) - 1.0
        return np.asarray(np.clip(action, -1.0, 1.0), dtype=np.float32)


def _select(settings: Settings, control: Sequence[str]) -> tuple[Parameter, ...]:
    """The parameters of the settings that actions change, in the order of `control`; see `ActionMap`."""
    # a list of names of online settings
    if isinstance(control, str):
        raise SettingsError(f"control is the string '{control}'", "give a list of setting names")
    online = {
        parameter.name: parameter for parameter in parameters(type(settings), online_only=True)
    }
    chosen = []
    for name in control:
        if name not in online:
            fault = f"unknown setting '{name}' in control"
            if name in flatten(settings):
                fault = f"setting '{name}' may not change in mid-episode"
            hint = did_you_mean(name, online) or "this tracker has no online settings"
            raise SettingsError(fault, hint)
        # once each, with an effect, and with a finite range for the actions
        parameter = online[name]
        if parameter in chosen:
            raise SettingsError(f"setting '{name}' is given twice in control")
        if reason := why_unused(settings, name):
            raise SettingsError(
                f"setting '{name}' in control has no effect: {reason}", "leave it out of control"
            )
        _check_range(parameter, attrgetter(name)(settings), f"setting '{name}' in control")
        chosen.append(parameter)
    return tuple(chosen)


def _check_range(parameter: Parameter, value: Any, title: str) -> None:
    """Refuse a number that lies outside of what actions span.

    Raises:
        SettingsError: It does.
    """
    if parameter.low is None or parameter.high is None:
        return
    if not parameter.low <= value <= parameter.high:
        raise SettingsError(
            f"{title} is {value:g}, actions span {parameter.low:g} to {parameter.high:g}",
            "set it within, or leave it out of control",
        )


def _decode(parameter: Parameter, share: float) -> Scalar:
    """The value of a setting at a share ``u``, 0 to 1, of its axis; see `ActionMap`."""
    if parameter.low is None or parameter.high is None:
        n = len(parameter.choices)
        return parameter.choices[min(int(share * n), n - 1)]
    low = float(parameter.low)
    high = float(parameter.high)
    value: float
    if parameter.scale == "log":
        value = low * (high / low) ** share
    else:
        value = low + share * (high - low)
    # rounding may put a power slightly beyond its end
    value = float(min(max(value, low), high))
    return round(value) if parameter.kind == "int" else value


def _encode(parameter: Parameter, value: Scalar) -> float:
    """The share ``u`` of a setting's axis at which a value lies: the inverse of `_decode`."""
    if parameter.low is None or parameter.high is None:
        return (parameter.choices.index(value) + 0.5) / len(parameter.choices)
    low = float(parameter.low)
    high = float(parameter.high)
    x = float(value)
    if parameter.scale == "log":
        return math.log(max(x, low) / low) / math.log(high / low)
    return (x - low) / (high - low)


MAX_DEPTH_M = 20.0
"""Upper end of the depth image in observations, metres; farther values are clipped."""
GRAY_SIZE = (60, 80)
"""Rows and columns of the part ``gray``."""
MOST_KEYPOINTS = 256
"""Rows of the part ``keypoints``."""
KEYPOINT_LAYOUT: tuple[tuple[str, str], ...] = (
    ("x", "column / width of the image"),
    ("y", "row / height"),
    ("depth", "d / (d + 3 m) of the depth d there, 0 where it is missing"),
    ("static", "1 if the tracker kept it, 0 if it was culled"),
    ("masked", "1 if it lies under the dynamic mask"),
)
"""Name and meaning of every column of the part ``keypoints``, in order."""
PRIVILEGED_LAYOUT: tuple[tuple[str, str], ...] = (
    ("known", "1 if the frame has ground truth, else 0"),
    ("pose_error_trans", "e / (e + 1 m) of the causal translational pose error e"),
    ("pose_error_rot", "causal rotational pose error / 180 degrees"),
    ("frame_error_trans", "tanh(e / 0.1 m) of the frame-to-frame translational error e"),
    ("frame_error_rot", "frame-to-frame rotational error / 180 degrees"),
    (
        "motion_x",
        "tanh(x / 0.1 m) of the true motion since the previous frame, in the previous camera frame",
    ),
    ("motion_y", "tanh(y / 0.1 m) of that motion"),
    ("motion_z", "tanh(z / 0.1 m) of that motion, z is forward"),
    ("motion_rx", "tanh(rx / 0.1 rad) of the rotation vector of that motion"),
    ("motion_ry", "tanh(ry / 0.1 rad) of that rotation vector"),
    ("motion_rz", "tanh(rz / 0.1 rad) of that rotation vector"),
)
"""Name and meaning of every entry of the part ``privileged``, in order: for a critic, never for the agent itself."""

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
    (
        "motion_x",
        "tanh(x / 0.1 m) of the estimated motion since the previous frame, in the previous camera frame",
    ),
    ("motion_y", "tanh(y / 0.1 m) of that motion"),
    ("motion_z", "tanh(z / 0.1 m) of that motion, z is forward"),
    ("motion_rx", "tanh(rx / 0.1 rad) of the rotation vector of that motion"),
    ("motion_ry", "tanh(ry / 0.1 rad) of that rotation vector"),
    ("motion_rz", "tanh(rz / 0.1 rad) of that rotation vector"),
    ("brightness", "mean grey level / 255"),
    ("contrast", "standard deviation of the grey level / 128"),
    ("depth_valid", "share of the pixels with depth"),
    ("depth_median", "d / (d + 3 m) of the median valid depth d"),
)
"""Name and meaning of every entry of the ``stats`` observation, in order. What a tracker does not report is 0."""

_SIGNED = np.array([name.startswith("motion_") for name, _ in STATS_LAYOUT])
"""Flags ``[24]`` of the entries of ``stats`` that may be negative."""


def stats_space() -> spaces.Box:
    """``Box`` of float32 ``[24]``: entries in [0, 1], the motion's in [-1, 1]; see `STATS_LAYOUT`."""
    low = np.where(_SIGNED, -1.0, 0.0).astype(np.float32)
    return spaces.Box(low, np.ones_like(low), dtype=np.float32)


def observation_space(observation: str | Sequence[str], camera: Camera) -> spaces.Space[Any]:
    """``Box`` of the vector for ``stats``, else the ``Dict`` of the named parts.

    Raises:
        SettingsError: A part is unknown.
    """
    if observation == "stats":
        return stats_space()
    size = (camera.height, camera.width)
    most = MOST_KEYPOINTS
    part_spaces: dict[str, dict[str, spaces.Space[Any]]] = {
        "stats": {"stats": stats_space()},
        "rgb": {"rgb": spaces.Box(0, 255, (*size, 3), np.uint8)},
        "depth": {"depth": spaces.Box(0.0, MAX_DEPTH_M, size, np.float32)},
        "gray": {"gray": spaces.Box(0, 255, (*GRAY_SIZE, 1), np.uint8)},
        "keypoints": {
            "keypoints": spaces.Box(0.0, 1.0, (most, len(KEYPOINT_LAYOUT)), np.float32),
            "keypoints_mask": spaces.MultiBinary(most),
        },
        "privileged": {"privileged": spaces.Box(-1.0, 1.0, (len(PRIVILEGED_LAYOUT),), np.float32)},
    }
    parts = observation_parts(observation)
    for part in parts:
        if part not in part_spaces:
            raise SettingsError(
                f"unknown observation '{part}'",
                f"stats, rgbd, or a list of {', '.join(part_spaces)}",
            )
    return spaces.Dict({key: space for part in parts for key, space in part_spaces[part].items()})


def observation_parts(observation: str | Sequence[str]) -> tuple[str, ...]:
    """The parts that an observation is made of."""
    if observation == "rgbd":
        return ("rgb", "depth", "stats")
    return (observation,) if isinstance(observation, str) else tuple(observation)


def observe(
    parts: Iterable[str], frame: Frame, result: TrackResult, episode: Episode, progress: float
) -> Any:
    """Observation of the last frame; only the parts that are asked for are computed.

    Args:
        parts: Names of the parts, see `SlamEnv`.
        frame: The frame as the tracker saw it.
        result: The tracker's result on it.
        episode: The episode up to this frame.
        progress: Index of the frame over the last index, 0 to 1.

    Returns:
        Arrays by key; the part ``keypoints`` has two, itself and ``keypoints_mask``.
    """
    observed: dict[str, Any] = {}
    for part in parts:
        match part:
            case "stats":
                motion = _estimated_motion(episode)
                observed[part] = stats_observation(
                    frame, result, progress=progress, lost_streak=episode.lost_streak, motion=motion
                )
            case "rgb":
                observed[part] = np.array(frame.rgb, dtype=np.uint8)
            case "depth":
                depth = np.nan_to_num(frame.depth, nan=0.0, posinf=MAX_DEPTH_M, neginf=0.0)
                observed[part] = np.clip(depth, 0.0, MAX_DEPTH_M).astype(np.float32)
            case "gray":
                gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
                small = cv2.resize(gray, GRAY_SIZE[::-1], interpolation=cv2.INTER_AREA)
                observed[part] = small[..., None]
            case "keypoints":
                observed[part], observed["keypoints_mask"] = keypoint_tokens(frame, result)
            case "privileged":
                observed[part] = privileged_observation(episode)
    return observed


def _estimated_motion(episode: Episode) -> NDArray[np.float64]:
    """Twist ``[6]`` of the estimated motion since the previous frame; 0 if either has no pose."""
    poses = [
        outcome.T_world_cam for outcome in episode.outcomes[-2:] if outcome.T_world_cam is not None
    ]
    if len(poses) < 2:
        return np.zeros(6)
    return se3.log(se3.inverse(poses[0]) @ poses[1])


def keypoint_tokens(
    frame: Frame, result: TrackResult
) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
    """The tracker's keypoints as a set of fixed size; of more than `MOST_KEYPOINTS`, evenly many along their list.

    Returns:
        float32 ``[N, 5]`` (`KEYPOINT_LAYOUT`), rows beyond the keypoints 0, and int8 ``[N]``, 1
        where there is one.
    """
    tokens = np.zeros((MOST_KEYPOINTS, len(KEYPOINT_LAYOUT)), np.float32)
    is_keypoint = np.zeros(MOST_KEYPOINTS, np.int8)

    # choose at most `MOST_KEYPOINTS` keypoints, evenly spread over their list
    xy = np.zeros((0, 2)) if result.keypoints_xy is None else np.asarray(result.keypoints_xy)
    keep = np.ones(len(xy)) if result.keypoints_keep is None else np.asarray(result.keypoints_keep)
    rows = np.linspace(0, len(xy) - 1, min(len(xy), MOST_KEYPOINTS)).astype(np.intp)

    # depth and dynamic mask at the nearest pixels
    height, width = frame.depth.shape
    x, y = xy[rows].T
    nearest_row = np.rint(y).astype(np.intp).clip(0, height - 1)
    nearest_column = np.rint(x).astype(np.intp).clip(0, width - 1)
    pixels = (nearest_row, nearest_column)
    z = np.nan_to_num(frame.depth[pixels], nan=0.0, posinf=MAX_DEPTH_M).clip(0, MAX_DEPTH_M)
    masked = np.zeros(len(rows)) if result.dynamic_mask is None else result.dynamic_mask[pixels]

    # the columns of `KEYPOINT_LAYOUT`, each in [0, 1]
    columns = [x / width, y / height, z / (z + 3.0), keep[rows], masked]
    tokens[: len(rows)] = np.stack(columns, axis=1).clip(0, 1)
    is_keypoint[: len(rows)] = 1
    return tokens, is_keypoint


def privileged_observation(episode: Episode) -> NDArray[np.float32]:
    """Errors and true motion of the last frame, float32 ``[11]`` (`PRIVILEGED_LAYOUT`); 0 without ground truth."""
    values = np.zeros(len(PRIVILEGED_LAYOUT))
    now = episode.outcomes[-1].error
    before = episode.outcomes[-2].error if len(episode.outcomes) > 1 else None
    if now is not None:
        # errors of the pose, and of the motion since the previous frame
        values[0] = 1.0
        values[1] = now.trans_m / (now.trans_m + 1.0)
        values[2] = now.rot_deg / 180.0
        values[3] = np.tanh((now.frame_trans_m or 0.0) / 0.1)
        values[4] = (now.frame_rot_deg or 0.0) / 180.0
    if now is not None and before is not None:
        # the true motion, a twist [6]
        true_motion = se3.log(se3.inverse(before.T_world_true) @ now.T_world_true)
        values[5:] = np.tanh(true_motion / 0.1)
    return values.astype(np.float32)


def stats_observation(
    frame: Frame,
    result: TrackResult,
    *,
    progress: float,
    lost_streak: int,
    motion: NDArray[np.float64],
) -> NDArray[np.float32]:
    """The vector of `STATS_LAYOUT` for one tracked frame; finite whatever the tracker reports.

    Args:
        frame: The frame.
        result: What the tracker gave for it.
        progress: Index of the frame, over that of the sequence's last one.
        lost_streak: Frames lost in a row, this one included.
        motion: Twist ``[6]`` of the estimated motion since the previous frame; 0 if either frame
            has no pose.
    """
    # what the tracker reports; 0 for what it does not
    finite = {name: float(value) for name, value in result.stats.items() if np.isfinite(value)}
    stats = defaultdict(float, finite)
    keypoints = stats["keypoints"]
    matches = stats["matches"]

    # image and depth, every fourth row and column
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
        _ratio(stats["culled"], keypoints),
        _ratio(matches, keypoints - stats["culled"]),
        _ratio(stats["inliers"], matches),
        _saturate(stats["residual_px"], 1.0),
        stats["mask_fraction"],
        _saturate(stats["map_points"], 5000.0),
        _saturate(stats["keyframes"], 100.0),
        float(stats["keyframe"] > 0),
        *np.tanh(motion / 0.1),
        float(gray.mean()) / 255.0,
        float(gray.std()) / 128.0,
        valid.size / max(depth.size, 1),
        _saturate(float(np.median(valid)), 3.0) if valid.size else 0.0,
    ]
    lowest = np.where(_SIGNED, -1.0, 0.0)
    return np.clip(np.asarray(values, dtype=np.float32), lowest, 1.0).astype(np.float32)


def _saturate(value: float, scale: float) -> float:
    """A number from 0 on in [0, 1); `scale` becomes 0.5."""
    return max(value, 0.0) / (max(value, 0.0) + scale)


def _ratio(part: float, whole: float) -> float:
    """A share in [0, 1]; 0 of nothing."""
    return min(max(part / whole, 0.0), 1.0) if whole > 0 else 0.0
