"""The Gymnasium environment: one sequence is one episode, one step runs a whole tracker on one frame."""

from __future__ import annotations

import math
import operator
import re
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, SupportsFloat, cast

import gymnasium as gym
import numpy as np
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

import dynslam_bench
from dynslam_bench.contracts import (
    Frame,
    FrameMasks,
    MaskSource,
    Tracker,
    TrackerContext,
    TrackerSpec,
    Trajectory,
    exact_stamps,
    timestamps_ns,
)
from dynslam_bench.contracts import Sequence as FrameSequence
from dynslam_bench.contracts.checks import (
    check_frame,
    check_result,
    check_sensors,
    check_trajectory,
    tracker_code,
)
from dynslam_bench.contracts.sequence import read_only, read_only_masks
from dynslam_bench.core import (
    DynslamError,
    EvaluationError,
    SequenceError,
    SettingsError,
    TrackerError,
    stage_cache_folder,
)
from dynslam_bench.core.arguments import names_wrong_arguments
from dynslam_bench.core.fingerprint import content_digest
from dynslam_bench.core.records import digest
from dynslam_bench.core.seeding import derive_seed
from dynslam_bench.core.settings import Reconfigurable, Settings, apply_overrides
from dynslam_bench.envs.episode import (
    REWARDS,
    Episode,
    FrameOutcome,
    FrameState,
    Reward,
    RewardKind,
    fixed_info,
    frame_info,
)
from dynslam_bench.envs.rendering import Canvas
from dynslam_bench.envs.spaces import ActionMap, observation_parts, observation_space, observe
from dynslam_bench.evaluation import OnlineError, Protocol, evaluate, get_protocol
from dynslam_bench.evaluation.comparison import tracked_frames
from dynslam_bench.geometry import refuse_close
from dynslam_bench.segmentation.build_segmenter import segmentation_source
from dynslam_bench.sequences import PreprocessingSettings, SequenceView, open_sequence
from dynslam_bench.sequences.cameras import check_camera
from dynslam_bench.sequences.catalogue import parse_frames
from dynslam_bench.trackers.registry import TRACKERS, build_tracker, resolve_settings

FrameTransform = Callable[[Frame], Frame]
"""Changes a frame before the tracker sees it."""
Frames = Sequence[int | None] | str | None
"""Part of a sequence: ``(start, stop)``, ``"start:stop"`` with either end open, or None for all."""
_EPISODE_ATTRIBUTES = (
    "_tracker",
    "_errors",
    "episode",
    "frame",
    "result",
    "_final",
    "settings",
    "_actions",
    "window",
    "_np_random",
    "_np_random_seed",
)
"""Attributes of an environment that belong to its episode: what `SlamEnv.clone_state` copies."""
_OPTION_ATTRIBUTES = (
    "settings",
    "_actions",
    "sequence",
    "_whole",
    "window",
    "_source",
    "metadata",
)
"""Attributes that the options of `SlamEnv.reset` change: what it restores where it fails."""


@dataclass(frozen=True, eq=False)
class EpisodeState:
    """A copy of an episode in its middle, made by `SlamEnv.clone_state`; it can be restored any number of times.

    Attributes:
        origin: Description by name of everything that it depends on: sequence, tracker, control,
            settings, reward, protocol, `lost_after` and version of this package.
        parts: Copies of the environment's attributes that belong to the episode, by name.
    """

    origin: Mapping[str, str]
    parts: Mapping[str, Any]


class SlamEnv(gym.Env[Any, Any], EzPickle):
    """Visual SLAM on one sequence as an environment.

    `reset` tracks frame 0; every `step` runs the full pipeline on the next frame, so an episode of
    a sequence with N frames has N - 1 steps. All randomness of the tracker comes from the
    environment's seed.

    **Action.** ``Discrete(1)`` without `control` (pure evaluation); otherwise ``Box(-1, 1, (k,))`` over the named
    online settings (see `ActionMap`), in force from the frame of the step on; an episode begins
    with `settings`. The tracker then needs the method of `core.settings.Reconfigurable`,
    ``configure(settings)``: it takes the complete settings, of which only online fields differ from
    those it was built with, and ``reset`` brings those back.

    **Observation.** ``stats``: float32 ``[24]`` (see `STATS_LAYOUT`); ``rgbd``: a dict with ``rgb``,
    ``depth`` and ``stats``; a list of parts: a dict of them. The parts: ``stats``; ``rgb`` uint8
    ``[H, W, 3]``; ``depth`` float32 ``[H, W]`` metres, 0 missing; ``gray`` uint8 ``[60, 80, 1]``;
    ``keypoints`` float32 ``[256, 5]`` (see `KEYPOINT_LAYOUT`) with ``keypoints_mask`` int8
    ``[256]``; ``privileged`` float32 ``[11]`` (see `PRIVILEGED_LAYOUT`), which alone holds
    something of the ground truth, for a critic.

    **Reward** in metres: see `REWARDS`. Frames without a tracked pose, and all remaining ones when `lost_after` ends an
    episode, cost twice the true motion (``neg_rpe``: not having moved, and having to catch up), or
    the length of the true path so far (``neg_pose_error``).

    **Info**: ``frame_index``, ``timestamp``, ``window`` (int64 ``[2]``: first frame of the episode and one past its
    last), ``tracking_state`` (``initialising``, ``ok``, ``lost``), ``stats`` (the tracker's
    diagnostics); ``pose`` float64 ``[7]`` (tx ty tz qx qy qz qw, camera to world) of tracked
    frames; ``pose_error_trans_m`` and ``pose_error_rot_deg`` (cumulative, causal: not an ATE),
    ``frame_error_trans_m`` and ``frame_error_rot_deg`` (motion since the previous frame) where
    there is ground truth. The last step adds ``episode_metrics`` under the protocol named by
    ``protocol``. What is not defined is left out, never NaN; with `fixed_info` it is 0 and its
    flag, ``has_`` before the name, False, so that keys and types are always the same. Wall-clock
    times are no part of it: see `timings`.

    **Monocular trackers** (`TrackerSpec.sensors` is ``rgb``) give poses in a unit of their own. No pose error is known
    as frames come: none is given, and the reward is 0. The last step's metrics need a protocol with
    Sim(3) alignment.

    **End**: ``truncated`` at the end of the sequence, ``terminated`` after `lost_after` lost frames in a row.

    Args:
        sequence: Id, path of a folder in TUM layout, or an opened sequence.
        tracker: Id, ``id:value``, ``module:Attr``, ``file.py:Attr``, or a spec.
        settings: Overrides of the tracker's settings by dotted name, or its complete settings.
        control: Dotted names of the online settings that actions change.
        observation: ``stats``, ``rgbd``, or a list of parts.
        reward: A name of `REWARDS`, or a callable ``reward(episode) -> float`` that is asked after
            every frame.
        protocol: Id of the protocol of the episode's metrics; its tolerance also joins frames and
            ground truth.
        frames: Part of the sequence, ``(start, stop)`` or ``"start:stop"``; None for all.
        stride: Take every so many frames.
        window: Frames of an episode: each `reset` draws a stretch of so many frames; None for all
            frames.
        lost_after: End the episode after so many lost frames in a row, initialising ones not
            counted; None never.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        render_mode: ``rgb_array`` or None.
        data_root: Folder of the recorded sequences; None for the default one.
        camera: Name or file of the camera for folders that do not say theirs; None to read it from
            the folder.
        threads: Threads that the tracker may use.
        cache: Whether features and network masks come from the stage cache where they are stored;
            poses and reported stage times are the same either way.
        fixed_info: Whether ``info`` has the same keys on every step, as Minari needs.
        memory_map: Whether all frames are decoded once into a file of the stage cache that
            environments and processes share (2.2 MB a frame of 640 x 480).

    Raises:
        DynslamError: Unknown or unfit sequence, tracker, setting, reward, protocol or device, or
            fewer than 2 frames.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012
    """Each environment has its own, with the frame rate of its sequence, stride included."""
    sequence: FrameSequence
    """The frames of the episode."""
    window: tuple[int, int]
    """The episode's frames in the sequence as it was opened: the first, and one past the last."""

    @names_wrong_arguments
    def __init__(
        self,
        sequence: str | FrameSequence,
        tracker: str | TrackerSpec = "emfoa-oft",
        *,
        settings: Mapping[str, Any] | Settings | None = None,
        control: Sequence[str] = (),
        observation: str | Sequence[str] = "stats",
        reward: RewardKind | Reward = "neg_rpe",
        protocol: str | Protocol = "tum-rgbd/v1",
        frames: Frames = None,
        stride: int = 1,
        window: int | None = None,
        lost_after: int | None = None,
        device: str = "auto",
        render_mode: str | None = None,
        data_root: str | Path | None = None,
        camera: str | Path | None = None,
        threads: int = 1,
        cache: bool = False,
        fixed_info: bool = False,
        memory_map: bool = False,
    ) -> None:
        # keep the arguments: pickling makes the environment again from them
        given = {
            name: value for name, value in locals().items() if name not in ("self", "__class__")
        }
        # EzPickle keeps the arguments: unpickling makes the environment again
        EzPickle.__init__(self, given.pop("sequence"), given.pop("tracker"), **given)
        if render_mode not in (None, "rgb_array"):
            raise SettingsError(f"unknown render mode '{render_mode}'", "choose rgb_array")
        if not callable(reward) and reward not in REWARDS:
            raise SettingsError(
                f"unknown reward '{reward}'", f"choose {' or '.join(REWARDS)}, or give a callable"
            )
        _check_least("lost_after", lost_after, 1)
        _check_least("threads", threads, 1)
        _check_least("window", window, 2)

        # what stays for all episodes
        self.render_mode = render_mode
        self.protocol = get_protocol(protocol)
        self.tracker_spec = TRACKERS.get(tracker) if isinstance(tracker, str) else tracker
        self.frame_transforms: list[FrameTransform] = []
        """Applied in order to every frame before the tracker sees it; wrappers add to it."""
        self._observation_parts = observation_parts(observation)
        self._observation = observation
        self._reward: Reward = reward if callable(reward) else REWARDS[reward]
        self._window_length = window
        self._fixed_info = fixed_info
        self._lost_after = lost_after
        self.device = resolve_device(device)
        self._threads = threads
        self._cache = str(stage_cache_folder()) if cache else None
        self._open_sequence = partial(
            open_frames,
            data_root=data_root,
            camera=camera,
            frames=frames,
            stride=stride,
            memory_map=memory_map,
        )
        # a text stays one: `ActionMap` refuses it by what the user wrote, not by its letters
        self._control = tuple(control) if not isinstance(control, str) else control
        self._tracker: Tracker | None = None

        # what options of `reset` replace, and the spaces that follow from it
        self._use_settings(settings)
        self._use_sequence(sequence)
        # fail here where no masks are available, not at frame 0
        segmentation_source(self.settings, self.sequence, fetch=False)
        self.action_space = self._actions.space()
        self.observation_space = observation_space(observation, self.sequence.camera)

        # no episode has begun before the first `reset`
        self.episode = Episode()
        self._final: Trajectory | None = None
        self._canvas: Canvas | None = None

    @property
    def neutral_action(self) -> Any:
        """The action that keeps the settings the episode begins with."""
        return self._actions.neutral if self._actions.parameters else 0

    @property
    def exact_stamps(self) -> dict[float, int]:
        """The nanoseconds of every frame's stamp by its seconds: a float of Unix time does not hold them."""
        return exact_stamps(self.sequence)

    @property
    def timings(self) -> list[dict[str, float]]:
        """Seconds by stage of every frame so far: ``read``, ``total`` and the tracker's stages (see `FrameOutcome`)."""
        return [dict(outcome.timings) for outcome in self.episode.outcomes]

    @names_wrong_arguments
    def action_of(self, values: Mapping[str, Any]) -> NDArray[np.float32]:
        """The action that asks for values of controlled settings, by dotted name; all others stay as they are.

        Raises:
            SettingsError: A name is not in `control`, or a value is not within the range that
                actions span.
        """
        return self._actions.of(values)

    def online_trajectory(self) -> Trajectory:
        """Poses of the frames that were tracked, each as it was when the frame came."""
        return self.episode.trajectory().with_exact(self.exact_stamps)

    def final_trajectory(self) -> Trajectory | None:
        """The tracker's trajectory after its last optimisation of the map; None if it has no ``finalize``.

        Raises:
            TrackerContractError: ``finalize`` returned something else.
        """
        finalize = getattr(self._tracker, "finalize", None)
        if self._final is None and finalize is not None:
            with tracker_code():
                final = finalize()
            self._final = check_trajectory(final, self.tracker_spec.id).with_exact(
                self.exact_stamps
            )
        return self._final

    @property
    def measured(self) -> dict[str, Any]:
        """Measurements of its program and ``notes`` by an adapter of this package; empty for other trackers."""
        if not self.tracker_spec.entry_point.startswith("dynslam_bench."):
            return {}
        return dict(getattr(self._tracker, "measured", {}))

    def map_outputs(self) -> Any:
        """The tracker's keyframes and map points (``slam.outputs.MapOutputs``); None if it offers none."""
        outputs = getattr(self._tracker, "map_outputs", None)
        with tracker_code():
            return outputs() if outputs is not None else None

    def save_map(self, path: Path | str, made_by: str = "") -> None:
        """Write the tracker's map to a file from which a later run may start; `made_by` says in words by which run.

        Raises:
            DynslamError: The tracker cannot save its map, or has none; the file cannot be written.
        """
        save = getattr(self._tracker, "save_map", None)
        if save is None:
            why = "has not begun: call reset()" if self._tracker is None else "cannot save its map"
            raise TrackerError(f"tracker '{self.tracker_spec.id}' {why}")
        with tracker_code():
            save(Path(path), made_by)

    @names_wrong_arguments
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode and track frame 0.

        Args:
            seed: Seed of everything random; None goes on from the previous episode.
            options: ``sequence`` and ``settings`` replace those of the constructor from this
                episode on; ``window``, ``(first, one past the last)``, says which of its frames
                this episode is made of.

        Raises:
            DynslamError: Unknown option, a window that does not fit, or a new sequence whose images
                do not fit the observation space.
            TrackerError: The tracker cannot be built or broke its contract. Whatever fails before
                frame 0 is tracked, settings and sequence stay as they were, and no episode runs.
        """
        super().reset(seed=seed)
        self.episode = Episode()
        self._final = None

        # take the options and reset the tracker; where that fails, nothing has changed
        before = {name: vars(self)[name] for name in _OPTION_ATTRIBUTES}
        try:
            self._apply_options(options or {})
            tracker = self._build_or_reuse_tracker()
            with tracker_code():
                # undo what actions have set, before `reset`: a tracker may copy its settings there
                if self._actions.parameters:
                    tracker.configure(self.settings)  # type: ignore[attr-defined]
                rng = np.random.default_rng(derive_seed(self.np_random))
                tracker.reset(self.sequence.camera, rng=rng)
        except Exception:
            vars(self).update(before)
            self.close()
            raise

        # track frame 0; the poses of a monocular tracker have no causal errors
        self._errors = OnlineError(
            self.sequence.ground_truth if self.tracker_spec.metric else None, self.protocol.max_dt
        )
        self._canvas = None
        self._track_next(tracker)
        return self._observe(), self._info()

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Track the next frame.

        Raises:
            DynslamError: `reset` was not called, or the episode is over.
            SettingsError: The action does not fit the action space.
            TrackerError: The tracker broke its contract.
        """
        # apply the action
        tracker = self._running_tracker()
        settings = self._actions.settings(action)
        if self._actions.parameters:
            with tracker_code():
                tracker.configure(settings)  # type: ignore[attr-defined]

        # track the frame
        self._track_next(tracker)
        outcomes = self.episode.outcomes
        reward = outcomes[-1].reward

        # end the episode: lost for too long, or no frame is left
        terminated = self._lost_after is not None and self.episode.lost_streak >= self._lost_after
        truncated = len(outcomes) == self._n_frames
        if terminated:
            # all remaining frames cost what lost ones do, without being part of the episode
            rest = Episode(list(outcomes))
            reward += sum(
                self._add_untracked(rest, "lost") for _ in self.sequence.timestamps[len(outcomes) :]
            )
        self.episode.over = terminated or truncated
        return self._observe(), float(reward), terminated, truncated, self._info()

    @names_wrong_arguments
    def drop_frames(self, count: int) -> float:
        """Let the next `count` frames pass without tracking them, as a camera does while the tracker is busy.

        Dropped frames count as not tracked. The last frame of the sequence is never dropped.

        Returns:
            The sum of their rewards: each costs what a lost frame does.

        Raises:
            DynslamError: The episode is not running, or fewer frames are left.
        """
        self._running_tracker()
        left = self._n_frames - 1 - self.episode.next_index
        if not 0 <= count <= left:
            raise DynslamError(f"cannot drop {count} frames, {left} are left before the last one")
        return sum(self._add_untracked(self.episode, "dropped") for _ in range(count))

    def clone_state(self) -> EpisodeState:
        """A copy of the whole episode: tracker, errors, random numbers, position. Wrappers' own state is no part of it.

        Sequence, networks and past frames are shared, not copied.

        Raises:
            DynslamError: `reset` was not called.
            TrackerError: The tracker cannot be copied, e.g. because it is an external program.
        """
        if self._tracker is None or not self.episode.outcomes:
            raise DynslamError("clone_state() was called before reset()")
        parts = {name: vars(self)[name] for name in _EPISODE_ATTRIBUTES}
        return EpisodeState(self._origin(), self._copied(parts, {}))

    @names_wrong_arguments
    def restore_state(self, state: EpisodeState) -> None:
        """Go back to a copied episode; the steps that follow are equal to the bit to those that followed the copy.

        Raises:
            DynslamError: The state is of other frames, or of another tracker, control, reward,
                protocol, version, or of other settings or another `lost_after`.
        """
        origin = self._origin()
        for name, value in state.origin.items():
            if origin[name] != value:
                raise DynslamError(
                    f"the state is of {name} {value}, this environment has {origin[name]}",
                    "restore it where it was cloned, or in an environment that was made alike",
                )
        parts = self._copied(state.parts, {})
        self.close()
        self._canvas = None
        vars(self).update(parts)
        self.sequence = _frames_of_window(self._whole, self.window)

    def _origin(self) -> dict[str, str]:
        """Description of everything an episode's state depends on; equal where the state can be restored."""
        whole = self._whole
        frames = digest([whole.digest(), content_digest(whole.timestamps)])
        return {
            "sequence": f"'{whole.id}' ({len(whole)} frames from {whole.timestamps[0]:.6f} s, {frames})",
            "tracker": f"'{self.tracker_spec.id}'",
            "control": str(list(self._control)),
            "settings": digest(self.settings.model_dump(mode="json")),
            "reward": getattr(self._reward, "__qualname__", repr(self._reward)),
            "protocol": f"{self.protocol.id} [{self.protocol.digest()}]",
            "lost_after": str(self._lost_after),
            "version": dynslam_bench.__version__,
        }

    def episode_metrics(self) -> dict[str, float]:
        """The metrics of the frames so far under the protocol: plain floats by name, without undefined ones.

        ``coverage``, ``frames`` and ``tracked_frames`` of the scored trajectory, and the metrics of
        `evaluate` where there is ground truth and the protocol finds something to evaluate.
        """
        # the trajectory that the protocol asks for; without a final one the online one
        final = self.final_trajectory() if self.protocol.trajectory == "final" else None
        trajectory = self.online_trajectory() if final is None else final

        # stamps of the frames so far; after the end of all, tracked or not
        due = self.sequence.timestamps
        if not self.episode.over:
            due = due[: self.episode.next_index]
        tracked = 0
        with suppress(EvaluationError):  # a final trajectory whose stamps are of no frame
            tracked = int(tracked_frames(trajectory, due).sum())
        counts = {
            "coverage": tracked / len(due) if len(due) else 0.0,
            "frames": float(len(due)),
            "tracked_frames": float(tracked),
        }

        # errors; of a monocular tracker only where the alignment finds the scale
        truth = self.sequence.ground_truth
        if truth is None or not (self.tracker_spec.metric or self.protocol.finds_scale):
            return counts
        with suppress(EvaluationError):  # too little was tracked; the coverage says so
            metrics = evaluate(trajectory, truth, self.protocol, input_timestamps=due).metrics
            counts |= {
                name: float(value) for name, value in metrics.items() if math.isfinite(value)
            }
        return counts

    def render(self) -> NDArray[np.uint8] | None:
        """The current frame with its features and masks beside the trajectory, uint8 ``[H, W, 3]``."""
        if self.render_mode is None:
            gym.logger.warn(
                "render() was called without a render mode: make the environment with 'rgb_array'"
            )
            return None
        if not self.episode.outcomes:
            raise DynslamError("render() was called before reset()")
        if self._canvas is None:
            self._canvas = Canvas(self.sequence, self.tracker_spec.label)
        return self._canvas.draw(self.frame, self.result, self.episode)

    def close(self) -> None:
        """Close the tracker; the environment may be reset again."""
        tracker = self._tracker
        self._tracker = None
        close = getattr(tracker, "close", None)
        if close is not None:
            with tracker_code():
                close()

    def __deepcopy__(self, memo: dict[int, Any]) -> SlamEnv:
        """An independent copy at the same frame of the episode, with a tracker of its own.

        The sequence, the specs and the settings are shared: they are never changed.

        Raises:
            TrackerError: The tracker cannot be copied, e.g. because it is an external program.
        """
        copied = object.__new__(type(self))
        memo[id(self)] = copied
        vars(copied).update(self._copied(dict(vars(self), _canvas=None), memo))
        return copied

    def _copied(self, parts: Mapping[str, Any], memo: dict[int, Any]) -> dict[str, Any]:
        """Deep copies of attributes, which share what is never changed."""
        shared = (
            self.sequence,
            self._whole,
            self._source,
            self.tracker_spec,
            self.protocol,
            self.settings,
        )
        memo |= {id(value): value for value in (*shared, self.sequence.ground_truth)}

        # the tracker first: only that may refuse
        try:
            deepcopy(parts["_tracker"], memo)
        except Exception as error:
            raise TrackerError(
                f"tracker '{self.tracker_spec.id}' cannot be copied in mid-episode: {type(error).__name__}: {error}",
                "make a second environment, or give the tracker a __deepcopy__",
            ) from error
        return deepcopy(dict(parts), memo)

    @names_wrong_arguments
    def _use_settings(
        self, settings: Mapping[str, Any] | Settings | None, before: Settings | None = None
    ) -> None:
        """Take settings, complete or as overrides: of the tracker's defaults, or of those before."""
        if not isinstance(settings, Settings):
            if before is None:
                settings = resolve_settings(self.tracker_spec, settings)
            else:
                settings = apply_overrides(before, settings or {})
        if not isinstance(settings, self.tracker_spec.settings):
            raise SettingsError(
                f"tracker '{self.tracker_spec.id}' takes {self.tracker_spec.settings.__name__}, "
                f"not {type(settings).__name__}"
            )
        settings.verify()
        self.settings: Settings = settings
        self._actions = ActionMap(self.settings, self._control)

    @names_wrong_arguments
    def _use_sequence(self, sequence: str | FrameSequence) -> None:
        """Open a sequence and check that tracker, protocol and window fit it."""
        opened = self._open_sequence(sequence, preprocessing=preprocessing_of(self.settings))
        check_frames(opened)
        self.protocol.check_sequence(opened.id)
        check_sensors(self.tracker_spec, opened)
        if self._window_length is not None and self._window_length > len(opened):
            raise SettingsError(
                f"a window of {self._window_length} frames is longer than '{opened.id}', which has {len(opened)} here",
                f"give window={len(opened)} or less",
            )
        self.sequence = self._whole = opened
        self.metadata = {**type(self).metadata, "render_fps": _whole_or_float(opened.fps)}
        self.window = (0, len(opened))
        self._source = sequence

    def _apply_options(self, options: Mapping[str, Any]) -> None:
        """Take the options of `reset`: settings, sequence and window."""
        for unknown in sorted(set(options) - {"sequence", "settings", "window"}):
            raise SettingsError(
                f"unknown reset option '{unknown}'", "known: sequence, settings, window"
            )
        if {"sequence", "settings"} & set(options):
            self.close()  # the next tracker is built for other settings or another sequence

        # settings; other preprocessing needs the sequence opened again
        preprocessing = preprocessing_of(self.settings)
        camera = self.sequence.camera
        if "settings" in options:
            self._use_settings(options["settings"], self.settings)
            if preprocessing_of(self.settings) != preprocessing:
                options = {"sequence": self._source, **options}

        # another sequence has to fit the observation space, which cannot change
        if "sequence" in options:
            self._use_sequence(options["sequence"])
            size = (camera.width, camera.height)
            new_size = (self.sequence.camera.width, self.sequence.camera.height)
            if {"rgb", "depth"} & set(self._observation_parts) and size != new_size:
                raise SequenceError(
                    f"images of {new_size} pixels do not fit the observation space of {size}"
                )

        # window: the one asked for, a random one of the window's length, or all frames
        window = (0, len(self._whole))
        if options.get("window") is not None:
            window = parse_window(options["window"], self._whole)
        elif self._window_length is not None:
            first = int(self.np_random.integers(window[1] - self._window_length + 1))
            window = (first, first + self._window_length)
        if window != self.window:
            if self._whole.masks is not None:
                # the tracker may hold the exact masks, which are numbered as the frames
                self.close()
            self.sequence = _frames_of_window(self._whole, window)
            self.window = window

    def _build_or_reuse_tracker(self) -> Tracker:
        """The tracker for the current settings and sequence; it is built where there is none.

        Raises:
            TrackerError: It cannot be built, or cannot change settings although `control` asks for it.
        """
        if self._tracker is None:
            masks = self.sequence.masks
            context = TrackerContext(
                sequence_id=self.sequence.id,
                masks=None if masks is None else _ReadOnlyMasks(masks),
                device=self.device,
                threads=self._threads,
                fps=self.sequence.fps,
                cache=self._cache,
            )
            with tracker_code():
                self._tracker = build_tracker(self.tracker_spec, self.settings, context)
            if self._actions.parameters and not isinstance(self._tracker, Reconfigurable):
                raise TrackerError(
                    f"tracker '{self.tracker_spec.id}' cannot change its settings in mid-episode",
                    "it has no configure(settings) method: leave control empty",
                )
        return self._tracker

    def _running_tracker(self) -> Tracker:
        """The tracker of an episode that runs.

        Raises:
            DynslamError: `reset` was not called, or the episode is over.
        """
        if self._tracker is None or not self.episode.outcomes:
            raise DynslamError("step() was called before reset()")
        if self.episode.over:
            raise DynslamError(
                f"the episode is over after frame {self.episode.next_index - 1}", "call reset()"
            )
        return self._tracker

    def _track_next(self, tracker: Tracker) -> None:
        """Read the next frame, track it, and append what came of it.

        Raises:
            SequenceError: The frame cannot be read, or does not fit the sequence's camera.
            TrackerContractError: The tracker broke its contract.
        """
        # read the frame, with the user's transforms
        index = self.episode.next_index
        read_start = time.perf_counter()
        self._final = None
        frame = _read_frame(self.sequence, index)
        for transform in self.frame_transforms:
            frame = transform(frame)
        frame = read_only(frame)

        # track it, with wall-clock and processor time; errors inside count as the tracker's
        track_start = time.perf_counter()
        processor_start = time.process_time()
        with tracker_code():
            result = tracker.track(frame)
        total = time.perf_counter() - track_start
        processor = time.process_time() - processor_start
        result = check_result(result, frame, self.tracker_spec.id)

        # times in seconds; cached stages report what they take without the cache, so the total grows
        # with them. The detector works beside the others
        if result.stats.get("cached_stages"):
            inside = (seconds for stage, seconds in result.timings.items() if stage != "detector")
            uncached = max(total, sum(inside))
            processor = processor + uncached - total
            total = uncached
        timings = {"read": track_start - read_start, "total": total, "processor": processor}
        for stage, seconds in result.timings.items():
            if stage not in timings:
                timings[stage] = float(seconds)

        # errors and reward
        self.frame = frame
        self.result = result
        pose = np.array(result.T_world_cam, dtype=np.float64) if result.state == "ok" else None
        error = self._errors.update(frame.timestamp, pose)
        outcome = FrameOutcome(
            index,
            frame.timestamp,
            result.state,
            pose,
            result.stats,
            timings,
            error,
            motion_covariance=None if pose is None else result.motion_covariance,
        )
        self._add_with_reward(self.episode, outcome)

    def _add_with_reward(self, episode: Episode, outcome: FrameOutcome) -> float:
        """Append a frame's outcome with its reward; returns the reward in metres."""
        episode.add(outcome)
        reward = float(self._reward(episode))
        episode.outcomes[-1] = replace(outcome, reward=reward)
        return reward

    def _add_untracked(self, episode: Episode, state: FrameState) -> float:
        """Append the next frame as one without a pose; returns its reward in metres."""
        index = episode.next_index
        stamp = float(self.sequence.timestamps[index])
        error = self._errors.update(stamp, None)
        outcome = FrameOutcome(index, stamp, state, None, {}, {}, error)
        return self._add_with_reward(episode, outcome)

    @property
    def _n_frames(self) -> int:
        """Frames of the episode."""
        return self.window[1] - self.window[0]

    def _observe(self) -> Any:
        """The observation of the last tracked frame: the vector for ``stats``, else a dict of parts."""
        progress = self.episode.outcomes[-1].index / max(self._n_frames - 1, 1)
        observed = observe(self._observation_parts, self.frame, self.result, self.episode, progress)
        return observed["stats"] if self._observation == "stats" else observed

    def _info(self) -> dict[str, Any]:
        """The ``info`` of the last frame, at the end with the metrics of the episode."""
        info = frame_info(self.episode.outcomes[-1]) | {"window": np.array(self.window)}
        if self.episode.over:
            info |= {"episode_metrics": self.episode_metrics(), "protocol": self.protocol.id}
        return fixed_info(info, self.protocol) if self._fixed_info else info


def _frames_of_window(whole: FrameSequence, window: tuple[int, int]) -> FrameSequence:
    """The frames ``window[0]`` to ``window[1] - 1`` of a sequence, as a view."""
    if window == (0, len(whole)):
        return whole
    return cast("FrameSequence", SequenceView(whole, *window))


def _check_least(name: str, number: int | None, least: int) -> None:
    """Refuse a number that is too small; None is no limit.

    Raises:
        SettingsError: It is smaller than `least`.
    """
    if number is not None and operator.index(number) < least:
        raise SettingsError(f"{name} is {number}", f"give a number >= {least}")


@dataclass(frozen=True, eq=False)
class _ReadOnlyMasks:
    """A `MaskSource` whose masks a tracker cannot write."""

    base: MaskSource

    def __getitem__(self, index: int) -> FrameMasks:
        return read_only_masks(self.base[index])


def _whole_or_float(rate: float) -> int | float:
    """A frame rate as an int where it is a whole number, as some of Gymnasium's tools want it."""
    return int(rate) if float(rate).is_integer() else float(rate)


def _read_frame(sequence: FrameSequence, index: int) -> Frame:
    """A frame that fits the sequence's camera; any error in reading it becomes a `SequenceError`."""
    try:
        frame = sequence[index]
        check_frame(frame, sequence.camera)
    except MemoryError:
        raise
    # a data set of the user's may raise anything
    except Exception as error:
        ours = isinstance(error, DynslamError)
        fault = error.args[0] if ours else f"{type(error).__name__}: {error}".rstrip(": ")
        hint = getattr(error, "hint", "") if ours else ""
        raise SequenceError(
            f"frame {index} of '{sequence.id}' cannot be read: {fault}", hint
        ) from error
    return frame


# What an environment, and a run, is made of: the sequence and its part, and the device.


def open_frames(
    sequence: str | FrameSequence,
    data_root: str | Path | None,
    camera: str | Path | None,
    frames: Frames,
    stride: int,
    preprocessing: PreprocessingSettings | None = None,
    *,
    memory_map: bool = False,
) -> FrameSequence:
    """The sequence, preprocessed and cut to the chosen frames.

    Args:
        sequence: An id, a folder, or a sequence object.
        data_root: Folder of the sequences.
        camera: Camera of a folder that does not name its own.
        frames: Part of the sequence.
        stride: Take every so many frames.
        preprocessing: Applied to every frame.
        memory_map: Whether the frames are decoded once, see `sequences.decoded.Decoded`.

    Raises:
        SequenceError: Unknown, missing or damaged sequence, or no frames are left.
    """
    start, stop = parse_frames(frames)
    if isinstance(sequence, str | Path):
        sequence = open_sequence(
            sequence, data_root=data_root, camera=camera, preprocessing=preprocessing
        )
    elif preprocessing is not None and preprocessing.changes_images:
        from dynslam_bench.sequences.preprocessing import Preprocessed

        sequence = cast("FrameSequence", Preprocessed(sequence, preprocessing))
    if (start, stop, stride) != (0, None, 1):
        sequence = cast("FrameSequence", SequenceView(sequence, start, stop, stride))
    if memory_map:
        from dynslam_bench.sequences.decoded import Decoded

        sequence = cast("FrameSequence", Decoded(sequence))
    return sequence


def parse_window(window: Frames, sequence: FrameSequence) -> tuple[int, int]:
    """First frame of a window and one past its last.

    Raises:
        SequenceError: It does not lie within the sequence, or has fewer than two frames.
    """
    first, stop = parse_frames(window)
    stop = len(sequence) if stop is None else stop
    if not 0 <= first < stop - 1 < len(sequence):
        raise SequenceError(
            f"the window {first}:{stop} is no part of '{sequence.id}', which has {len(sequence)} frames here",
            f"give two frames or more within 0:{len(sequence)}",
        )
    return first, stop


def check_frames(sequence: FrameSequence) -> None:
    """Refuse a sequence that is too short for an episode, or whose camera, frame rate or stamps nobody could mean.

    Raises:
        SequenceError: It has fewer than two frames, a camera that `check_camera` refuses, a frame
            rate that is no number above 0, stamps that do not increase, or two frames or true poses
            less than 1 us apart.
    """
    if len(sequence) < 2:
        raise SequenceError(
            f"'{sequence.id}' has {len(sequence)} frames here, an episode needs 2 or more"
        )
    check_camera(sequence.camera, f"the camera of '{sequence.id}'")
    if not 0 < sequence.fps < math.inf:
        raise SequenceError(
            f"the frame rate of '{sequence.id}' is {sequence.fps} Hz", "it is a number above 0"
        )

    # stamps increase, and are 1 us apart at least
    stamps = np.asarray(sequence.timestamps, dtype=np.float64)
    wrong = np.flatnonzero(~(np.diff(stamps) > 0))
    if len(wrong):
        at = int(wrong[0]) + 1
        raise SequenceError(
            f"'{sequence.id}' has {len(wrong)} of {len(stamps)} stamps that are not later than the one before, first "
            f"that of frame {at}: {stamps[at]} after {stamps[at - 1]} s",
            "each frame has a stamp of its own, in seconds, ascending",
        )
    refuse_close(timestamps_ns(sequence), f"frames of '{sequence.id}'", SequenceError)
    if sequence.ground_truth is not None:
        refuse_close(
            sequence.ground_truth.timestamps_ns, f"ground truth of '{sequence.id}'", SequenceError
        )


def preprocessing_of(settings: Settings) -> PreprocessingSettings | None:
    """The group ``preprocessing`` of a tracker's settings; None for trackers without one."""
    group = getattr(settings, "preprocessing", None)
    return group if isinstance(group, PreprocessingSettings) else None


@names_wrong_arguments
def resolve_device(device: str = "auto") -> str:
    """``cpu`` or ``cuda:N`` for ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.

    ``auto`` is the first CUDA device, or the CPU where there is none. Torch is imported only if a
    driver is present.

    Raises:
        SettingsError: The name is not understood, or the machine has no such device.
    """
    if device == "cpu":
        return "cpu"
    if device != "auto" and not re.fullmatch(r"cuda(:\d+)?", device):
        raise SettingsError(f"unknown device '{device}'", "write auto, cpu, cuda or cuda:N")

    # without the device of a driver (NVIDIA, WSL, AMD) there is no need to import torch
    count = 0
    if any(Path(node).exists() for node in ("/dev/nvidiactl", "/dev/dxg", "/dev/kfd")):
        import torch

        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if device == "auto":
        return "cuda:0" if count else "cpu"
    index = int(device.partition(":")[2] or 0)
    if index >= count:
        raise SettingsError(
            f"device '{device}' was asked for, this machine has {count} CUDA devices",
            "use --device cpu",
        )
    return f"cuda:{index}"
