"""Wrappers: timings, trajectories, sequences, small images, degraded and dropped frames."""

import dataclasses
import math
import operator
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, SupportsFloat

import cv2
import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from dynslam_bench.contracts import Frame, stage_seconds
from dynslam_bench.core import SettingsError
from dynslam_bench.core.arguments import names_wrong_arguments
from dynslam_bench.core.seeding import stream
from dynslam_bench.envs.slam_env import SlamEnv
from dynslam_bench.envs.spaces import MAX_DEPTH_M
from dynslam_bench.geometry import write_tum


class SlamWrapper(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Base of the wrappers of a `SlamEnv`.

    Args:
        env: A `SlamEnv`, wrapped or not.
        **arguments: Arguments of the wrapper's constructor, for the environment's spec.

    Raises:
        SettingsError: It is another environment.
    """

    def __init__(self, env: gym.Env[Any, Any], **arguments: Any) -> None:
        RecordConstructorArgs.__init__(self, **arguments)
        gym.Wrapper.__init__(self, env)
        if not isinstance(env.unwrapped, SlamEnv):
            raise SettingsError(
                f"{type(self).__name__} wraps a SlamEnv, not a {type(env.unwrapped).__name__}"
            )
        self._base = env.unwrapped


class RecordTimings(SlamWrapper):
    """Adds ``info["timings"]``: seconds of the frame by stage (see `FrameOutcome.timings`).

    Times differ from run to run, so an environment with this wrapper is not deterministic in its
    ``info``.

    Args:
        env: A `SlamEnv`, wrapped or not.
    """

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset, with the times of frame 0 in ``info``."""
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, info | {"timings": self._base.timings[-1]}

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step, with the frame's times in ``info``."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        timed = info | {"timings": self._base.timings[-1]}
        return observation, reward, terminated, truncated, timed

    def summary(self) -> dict[str, dict[str, float]]:
        """``median`` and ``p95`` of every stage over the episode so far, seconds (0 where a stage did not run)."""
        tracked = [frame for frame in self._base.timings if frame]
        summary = {}
        for stage, seconds in stage_seconds(tracked).items():
            p95 = float(np.percentile(seconds, 95))
            summary[stage] = {"median": float(np.median(seconds)), "p95": p95}
        return summary


class RecordTrajectory(SlamWrapper):
    """Writes the online trajectory of every episode that ends, in TUM's format.

    Args:
        env: A `SlamEnv`, wrapped or not.
        path: Target file; ``{episode}`` in its name becomes the episode's number, from 0. Without
            it, a later episode replaces the file of an earlier one.
    """

    def __init__(self, env: gym.Env[Any, Any], path: str | Path) -> None:
        super().__init__(env, path=str(path))
        self._pattern = str(path)
        self._episode = -1
        self.written: list[Path] = []
        """The files so far, in order."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._episode += 1
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step; the last step of an episode writes its file.

        Raises:
            DynslamError: The file cannot be written.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            path = Path(self._pattern.replace("{episode}", str(self._episode)))
            comment = f"{self._base.tracker_spec.id} on {self._base.sequence.id}, online"
            write_tum(path, self._base.online_trajectory(), comment=comment)
            self.written.append(path)
        return observation, reward, terminated, truncated, info


@names_wrong_arguments
class SequenceSampler(SlamWrapper):
    """Begins every episode on another sequence of a list, for training agents and for evaluation.

    Args:
        env: A `SlamEnv`, wrapped or not.
        sequences: Ids or folders; with ``rgbd`` observations all must have the same image size.
        mode: ``round_robin`` takes them in order, from the ``seed``-th on (cyclic), so that
            sub-environments of a vector environment, whose seeds follow each other, begin apart;
            ``random`` draws from the wrapper's own generator, which a `reset` with a seed seeds.

    Raises:
        SettingsError: No sequences, or an unknown mode.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        sequences: Sequence[str],
        mode: Literal["round_robin", "random"] = "round_robin",
    ) -> None:
        if isinstance(sequences, str) or not sequences:
            raise SettingsError(f"SequenceSampler takes a list of sequences, not {sequences!r}")
        super().__init__(env, sequences=list(sequences), mode=mode)
        if mode not in ("round_robin", "random"):
            raise SettingsError(f"unknown mode '{mode}'", "known: round_robin, random")
        self._sequences = tuple(sequences)
        self._mode = mode
        self._next = 0
        self._rng = gym.utils.seeding.np_random(None)[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode on the next sequence; ``options["sequence"]`` wins over the sampler.

        A seed also sets the sampler: to the seed's sequence, or to its first draw.
        """
        if seed is not None:
            self._next = seed
            # apart from the environment's own numbers
            self._rng = stream(seed, "sequences")
        count = len(self._sequences)
        if self._mode == "round_robin":
            number = self._next % count
        else:
            number = int(self._rng.integers(count))
        self._next += 1
        options = {"sequence": self._sequences[number]} | (options or {})
        self._shown = str(options["sequence"])
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, info | {"sequence": self._shown}

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step, with the sequence in ``info`` as after `reset`."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, info | {"sequence": self._shown}


@names_wrong_arguments
class DiscreteActions(SlamWrapper, gym.ActionWrapper[Any, Any, Any]):
    """Makes the action the choice of one of a few settings, ``Discrete(n)``.

    "Segment now?" is
    ``[{"segmentation.schedule": "every_nth"}, {"segmentation.schedule": "every"}]`` with a setting
    ``segmentation.n`` that no episode reaches. "Keyframe now?" is
    ``[{"backend.keyframes.schedule": "none"}, {"backend.keyframes.schedule": "every"}]``: the frame
    of the step becomes one if it is tracked with more than 15 inliers.

    Args:
        env: A `SlamEnv`, wrapped or not, made with ``control``.
        actions: For each action the values of controlled settings by dotted name; the others stay
            as they are.

    Raises:
        SettingsError: No actions, or one that `SlamEnv.action_of` refuses.
    """

    def __init__(self, env: gym.Env[Any, Any], actions: Sequence[Mapping[str, Any]]) -> None:
        if not actions or not all(isinstance(values, Mapping) for values in actions):
            raise SettingsError(
                f"DiscreteActions takes a list of settings by name, one an action, not {actions!r}"
            )
        super().__init__(env, actions=[dict(values) for values in actions])
        for values in actions:
            self._base.action_of(values)
        self._actions = tuple(actions)
        self.action_space = spaces.Discrete(len(actions))

    def action(self, action: Any) -> NDArray[np.float32]:
        """The environment's own action."""
        if not self.action_space.contains(action):
            raise SettingsError(f"the action {action!r} is not in {self.action_space}")
        return self._base.action_of(self._actions[int(action)])


@names_wrong_arguments
class SmallImages(SlamWrapper, gym.ObservationWrapper[Any, Any, Any]):
    """Makes ``rgbd`` observations small 8-bit images, colour and depth, as stable-baselines3 expects images.

    ``rgb`` becomes uint8 ``[height, width, 3]``, averaged over the pixels that fall together;
    ``depth`` becomes uint8 ``[height, width, 1]``, the nearest pixel's, in steps of 20 m / 254: 0
    is missing, 255 is 20 m or more. ``stats`` stays.

    Args:
        env: A `SlamEnv`, wrapped or not, made with ``observation="rgbd"``.
        width: Width of the images, pixels; stable-baselines3's convolutions need 36 at least.
        height: Height of the images, pixels; stable-baselines3's convolutions need 36 at least.

    Raises:
        SettingsError: The environment shows no images, or an image would have no pixels.
    """

    def __init__(self, env: gym.Env[Any, Any], width: int = 80, height: int = 60) -> None:
        super().__init__(env, width=width, height=height)
        space = env.observation_space
        if not isinstance(space, spaces.Dict) or not {"rgb", "depth"} <= set(space):
            raise SettingsError(
                "SmallImages needs the images rgb and depth", 'use observation="rgbd"'
            )
        if min(width, height) < 1:
            raise SettingsError(f"an image of {width} x {height} pixels has none")
        self._size = (width, height)
        images = {
            "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
            "depth": spaces.Box(0, 255, (height, width, 1), np.uint8),
        }
        self.observation_space = spaces.Dict({**space.spaces, **images})

    def observation(self, observation: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """The observation with small images in place of its own."""
        rgb = cv2.resize(observation["rgb"], self._size, interpolation=cv2.INTER_AREA)
        depth = cv2.resize(observation["depth"], self._size, interpolation=cv2.INTER_NEAREST)
        steps = np.where(depth > 0, 1 + np.rint(254 * (depth / MAX_DEPTH_M)), 0)
        return {**observation, "rgb": rgb, "depth": steps.astype(np.uint8)[..., None]}


class DegradeFrames(SlamWrapper):
    """Adds seeded lighting changes, glare, shadow, motion blur and noise to every frame.

    The degradation of a frame depends on the seed, the strengths and the frame's index only, so all
    trackers see the same images. Strength 0 leaves the frame alone, 1 is the worst. Colour is
    degraded; depth only by `depth_noise`.

    Args:
        env: A `SlamEnv`, wrapped or not.
        **strengths: The fields of `Degradation`.

    Raises:
        SettingsError: A strength lies outside [0, 1].
    """

    def __init__(self, env: gym.Env[Any, Any], **strengths: Any) -> None:
        super().__init__(env, **strengths)
        self._base.frame_transforms.append(Degradation(**strengths))


@names_wrong_arguments
@dataclasses.dataclass(frozen=True)
class Degradation:
    """Degrades frames, the same way for the same index.

    Attributes:
        lighting: Brightness and colour balance drift slowly and flicker: gain between 1 and
            ``1 - 0.75 * lighting``.
        glare: A bright blob that wanders over the image and saturates it: up to ``0.45 * glare`` of
            the image's width.
        shadow: A soft-edged half plane that sweeps over the image and darkens it to
            ``1 - 0.85 * shadow``.
        blur: Linear motion blur of up to ``25 * blur`` pixels, in a direction that changes from
            frame to frame.
        noise: Gaussian noise of standard deviation ``40 * noise`` grey levels.
        depth_noise: Depth noise of standard deviation ``0.02 * depth_noise * z^2`` metres (z in
            metres), and a share ``0.3 * depth_noise`` of the pixels loses its depth.
        seed: Seed of the degradation, apart from the tracker's.
    """

    lighting: float = 0.0
    glare: float = 0.0
    shadow: float = 0.0
    blur: float = 0.0
    noise: float = 0.0
    depth_noise: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if operator.index(self.seed) < 0:
            raise SettingsError(
                f"the seed of the degradation is {self.seed}, expected a whole number >= 0"
            )
        for name, value in vars(self).items():
            if name != "seed" and not 0.0 <= value <= 1.0:
                raise SettingsError(
                    f"degradation '{name}' is {value}, expected a strength in [0, 1]"
                )

    def __call__(self, frame: Frame) -> Frame:
        """The degraded copy of a frame."""
        # light: colour balance, shadow and glare
        image = frame.rgb.astype(np.float32)
        if self.lighting:
            image *= self._gain(frame.index)
        if self.shadow:
            image *= self._shade(frame.index, *image.shape[:2])[..., None]
        if self.glare:
            image += self._blob(frame.index, *image.shape[:2])[..., None]

        # motion blur and noise, in this order of draws
        rng = stream(self.seed, "degrade", frame.index)
        if self.blur:
            kernel = _motion_kernel(25.0 * self.blur, rng)
            image = np.asarray(cv2.filter2D(np.clip(image, 0, 255), -1, kernel), dtype=np.float32)
        if self.noise:
            image = image + rng.normal(0.0, 40.0 * self.noise, image.shape).astype(np.float32)
        depth = self._noisy_depth(frame.depth, rng) if self.depth_noise else frame.depth
        rgb = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        return dataclasses.replace(frame, rgb=rgb, depth=depth)

    def _phase(self, name: str, count: int) -> NDArray[np.float64]:
        """Phases of the waves of one degradation, radians ``[count]``; the same for all frames."""
        return stream(self.seed, "degrade", name).uniform(0.0, 2.0 * math.pi, count)

    def _gain(self, index: int) -> NDArray[np.float32]:
        """Gain of red, green and blue ``[3]``: a drift over 90 frames with a flicker, and a tint over 150 frames."""
        slow, colour, flicker = self._phase("lighting", 3)
        level = (
            0.5
            + 0.4 * math.sin(2 * math.pi * index / 90.0 + slow)
            + 0.1 * math.sin(1.9 * index + flicker)
        )
        tint = 0.1 * self.lighting * math.sin(2 * math.pi * index / 150.0 + colour)
        gain = 1.0 - 0.75 * self.lighting * level
        return np.array([gain * (1 + tint), gain, gain * (1 - tint)], np.float32)

    def _shade(self, index: int, height: int, width: int) -> NDArray[np.float32]:
        """Gain of every pixel ``[H, W]``: a half plane that turns over 400 frames and sweeps over 120 is darker."""
        sweep, turn = self._phase("shadow", 2)
        angle = turn + 2 * math.pi * index / 400.0
        offset = 0.35 * math.sin(2 * math.pi * index / 120.0 + sweep) * width
        y, x = np.mgrid[0:height, 0:width].astype(np.float32)
        # signed distance from the edge in pixels; the edge is a sigmoid of it
        distance = (x - width / 2) * math.cos(angle) + (y - height / 2) * math.sin(angle) - offset
        dark = 1.0 / (1.0 + np.exp(np.clip(-distance / (0.02 * width), -30, 30)))
        return np.asarray(1.0 - 0.85 * self.shadow * dark, dtype=np.float32)

    def _blob(self, index: int, height: int, width: int) -> NDArray[np.float32]:
        """Grey levels ``[H, W]`` to add: a Gaussian blob that wanders and pulses."""
        along, up, pulse = self._phase("glare", 3)
        centre_x = width * (0.5 + 0.4 * math.sin(2 * math.pi * index / 140.0 + along))
        centre_y = height * (0.5 + 0.35 * math.sin(2 * math.pi * index / 100.0 + up))
        pulse_factor = 0.75 + 0.25 * math.sin(2 * math.pi * index / 60.0 + pulse)
        radius = 0.45 * self.glare * width * pulse_factor / 2
        y, x = np.mgrid[0:height, 0:width].astype(np.float32)
        squared = ((x - centre_x) ** 2 + (y - centre_y) ** 2) / max(radius, 1.0) ** 2
        return np.asarray(510.0 * np.exp(-squared), dtype=np.float32)

    def _noisy_depth(
        self, depth: NDArray[np.float32], rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """Depth ``[H, W]`` in metres with noise that grows with its square, and with gaps."""
        draws = rng.normal(size=depth.shape)
        noisy = depth + draws * (0.02 * self.depth_noise) * depth.astype(np.float64) ** 2
        lost = (rng.random(depth.shape) < 0.3 * self.depth_noise) | (depth <= 0)
        return np.where(lost, 0.0, np.maximum(noisy, 1e-3)).astype(np.float32)


def _motion_kernel(length: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """A line of up to `length` pixels through the centre, in a random direction, that sums to 1."""
    extent = length * rng.uniform(0.5, 1.0)
    angle = rng.uniform(0.0, math.pi)
    half = max(math.ceil(extent / 2), 1)
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    along = x * math.cos(angle) + y * math.sin(angle)
    across = np.abs(-x * math.sin(angle) + y * math.cos(angle))
    kernel = np.clip(1.0 - across, 0.0, 1.0) * np.clip(extent / 2 + 0.5 - np.abs(along), 0.0, 1.0)
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)


WARM_UP_FRAMES = 12
"""Tracked off the clock: enough for keyframes and bundle adjustment, so every kernel and network has run once."""


@names_wrong_arguments
class DropFrames(SlamWrapper):
    """Feeds the tracker only the frames that a live camera would have left it, or drops frames at random.

    Real-time mode: frame i arrives at its stamp. When the tracker is done with a frame it takes the
    newest one that has arrived, or waits for the next; those in between are dropped. They count as
    not tracked (coverage) and cost what lost ones do, added to the reward of the step that dropped
    them. The last frame is never dropped. With measured times the episode depends on the machine,
    and `step` waits for the frame: what works beside tracking (a network, threads of an external
    system) has the time that it has live. `frame_time_s` makes it reproducible.

    Compiling kernels and loading networks is no work of a frame: before the first measured episode
    the tracker tracks the first `WARM_UP_FRAMES` frames off the clock and is reset.

    Args:
        env: A `SlamEnv`, wrapped or not.
        speed: Playback speed; 2 halves the time between frames.
        frame_time_s: What the tracker's step counts as, seconds; None for the measured time.
        share: In place of the real-time mode, drop each frame with this probability.
        seed: Seed of the random drops.

    Raises:
        SettingsError: A value lies outside its range.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        *,
        speed: float = 1.0,
        frame_time_s: float | None = None,
        share: float | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(env, speed=speed, frame_time_s=frame_time_s, share=share, seed=seed)
        if not speed > 0:
            raise SettingsError(f"speed is {speed}, expected a number > 0")
        if frame_time_s is not None and not frame_time_s >= 0:
            raise SettingsError(f"frame_time_s is {frame_time_s}, expected seconds >= 0")
        if share is not None and not 0 <= share < 1:
            raise SettingsError(f"share is {share}, expected a probability in [0, 1)")
        self._speed = speed
        self._frame_time_s = frame_time_s
        self._share = share
        self._seed = seed
        self._live = share is None and frame_time_s is None
        self._warm = not self._live
        # seconds of the latest step outside of tracking; the wait is shorter by them
        self._overhead_s = 0.0

    @property
    def dropped(self) -> int:
        """Frames dropped in this episode so far."""
        return sum(outcome.state == "dropped" for outcome in self._base.episode.outcomes)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; the clock starts when frame 0 arrives, and the tracker is warm then."""
        base = self._base
        if not self._warm:
            # track some frames off the clock
            numbers = base.np_random
            base.reset(seed=0, options=options)
            while not base.episode.over and base.episode.next_index < WARM_UP_FRAMES:
                base.step(base.neutral_action)
            # the random numbers go on from where they were
            base.np_random = numbers
            self._warm = True
        observation, info = self.env.reset(seed=seed, options=options)
        base.episode.free_at = self._arrivals()[0] + self._busy_s()
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Drop what the tracker missed, then track the next frame."""
        # drop the frames that passed
        episode = self._base.episode
        target = self._next_frame(episode.next_index)
        charged = self._base.drop_frames(target - episode.next_index)

        # wait for the frame, less the time that the last step took outside of tracking
        idle_s = max(self._arrivals()[target] - episode.free_at, 0.0)
        if self._live:
            time.sleep(max(idle_s - self._overhead_s, 0.0))

        # track it, and move the clock on
        start = time.perf_counter()
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._overhead_s = time.perf_counter() - start - self._busy_s()
        episode.free_at += idle_s + self._busy_s()
        return observation, float(reward) + charged, terminated, truncated, info

    def _next_frame(self, index: int) -> int:
        """Index of the frame that is tracked next, `index` or a later one."""
        last = len(self._base.sequence) - 1

        # at random: the first frame that is not dropped
        if self._share is not None:
            for later in range(index, last):
                if stream(self._seed, "drop", later).random() >= self._share:
                    return later
            return last

        # in real time: the newest that has arrived when the tracker is done
        free_at = self._base.episode.free_at
        newest = int(np.searchsorted(self._arrivals(), free_at, side="right")) - 1
        return min(max(newest, index), last)

    def _arrivals(self) -> Any:
        """Times when the frames arrive, seconds ``[N]``."""
        return self._base.sequence.timestamps / self._speed

    def _busy_s(self) -> float:
        """Seconds that the tracker was busy with the last frame."""
        measured_s = self._base.episode.outcomes[-1].timings["total"]
        return measured_s if self._frame_time_s is None else self._frame_time_s
