"""Frames in and out of the environment: trackers cannot write into them, and videos play at the sequence's rate."""

import pickle
from copy import deepcopy
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from helpers.envs_toys import FIXED, ToySequence, write_folder

from dynslam_bench.contracts import Frame, TrackerContext, TrackerSpec, TrackResult
from dynslam_bench.contracts.checks import raised_by_tracker
from dynslam_bench.core import SequenceError
from dynslam_bench.core.settings import Settings
from dynslam_bench.envs import GENERIC_ID, DropFrames, RecordTimings, SequenceSampler, SlamEnv

# The frame rate of pictures.


def in_hertz(folder: Path, rate: float) -> str:
    """The toy sequence of 30 Hz, played at another rate."""
    write_folder(folder)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        lines = []
        for line in (folder / name).read_text().splitlines():
            if not line.startswith("#"):
                stamp, _, rest = line.partition(" ")
                line = f"{100 + (float(stamp) - 100) * 30 / rate:.6f} {rest}"
            lines.append(line)
        (folder / name).write_text("\n".join(lines) + "\n")
    camera = (folder / "camera.toml").read_text()
    (folder / "camera.toml").write_text(camera.replace("fps = 30.0", f"fps = {rate}"))
    return str(folder)


@pytest.mark.parametrize(
    ("rate", "cut", "expected"),
    [
        (30.0, {}, 30),
        (30.0, {"stride": 3}, 10),
        (30.0, {"frames": "2:10"}, 30),
        (30.0, {"frames": (1, None), "stride": 2}, 15),
        (25.0, {"stride": 2}, 12.5),
        (10.0, {"stride": 3, "window": 3}, 10 / 3),
    ],
)
def test_pictures_play_at_the_rate_of_the_frames_that_are_seen(
    tmp_path, rate, cut, expected
) -> None:
    folder = in_hertz(tmp_path / "rec", rate)
    env = gym.make(GENERIC_ID, sequence=folder, tracker=FIXED, render_mode="rgb_array", **cut)
    wrapped = RecordTimings(DropFrames(env, share=0.1))
    for layer in (
        env,
        env.unwrapped,
        wrapped,
        deepcopy(env.unwrapped),
        pickle.loads(pickle.dumps(env.unwrapped)),
    ):
        assert layer.metadata["render_fps"] == pytest.approx(expected)
        assert layer.metadata["render_modes"] == ["rgb_array"]
    assert env.unwrapped.sequence.fps == pytest.approx(expected)
    assert SlamEnv.metadata["render_fps"] == 30, "environments do not share it"


@pytest.mark.parametrize(
    ("id", "arguments", "expected"),
    [
        ("dynslam/synthetic-walking_xyz-v0", {"stride": 3}, 10),
        ("dynslam/synthetic-sitting_rpy-v0", {"frames": "0:40", "stride": 5}, 6),
        ("dynslam/features-v0", {"index": 0, "memory_map": False}, 15),
        ("dynslam/budget-v0", {"index": [0, 1], "memory_map": False, "stride": 6}, 5),
    ],
)
def test_registered_environments_do_so_too(id, arguments, expected) -> None:
    env = gym.make(id, render_mode="rgb_array", **arguments)
    assert env.metadata["render_fps"] == expected
    assert isinstance(env.metadata["render_fps"], int), (
        "some of Gymnasium's tools want a whole number"
    )


def test_another_sequence_brings_its_rate_and_one_that_cannot_be_opened_does_not(tmp_path) -> None:
    slow = in_hertz(tmp_path / "slow", 10.0)
    fast = in_hertz(tmp_path / "fast", 30.0)
    env = gym.make(GENERIC_ID, sequence=fast, tracker=FIXED, render_mode="rgb_array", stride=2)
    env.reset(options={"sequence": slow})
    assert env.metadata["render_fps"] == 5
    with pytest.raises(SequenceError):
        env.reset(options={"sequence": fast, "window": (0, 99)})
    assert env.metadata["render_fps"] == 5
    sampled = SequenceSampler(env, [fast, slow])
    rates = []
    for seed in (0, 1, 2):
        sampled.reset(seed=seed)
        rates.append(sampled.metadata["render_fps"])
    assert rates == [15, 5, 15]


# What a tracker is given it cannot write.


class InMemory(ToySequence):
    """Keeps its frames and masks, as a data set of somebody else's may."""

    def __init__(self) -> None:
        super().__init__(4)
        self.kept = [super(InMemory, self).__getitem__(index) for index in range(4)]
        self.kept_masks = [ToySequence().masks[index] for index in range(4)]
        self.masks = self.kept_masks

    def __getitem__(self, index: int) -> Frame:
        return self.kept[index]

    def digest(self) -> str:
        return "kept"


class Vandal:
    """Writes into something that it was given, at frame 1."""

    def __init__(self, settings: Settings, context: TrackerContext) -> None:
        self.what = settings.what
        self.context = context

    def reset(self, camera, *, rng) -> None:
        self.camera = camera

    def track(self, frame: Frame) -> TrackResult:
        if frame.index == 1:
            match self.what:
                case "rgb":
                    frame.rgb[0, 0] = 0
                case "depth":
                    frame.depth *= 2.0
                case "whole rgb":
                    frame.rgb[...] = 0
                case "a view":
                    np.asarray(frame.rgb).reshape(-1)[0] = 1
                case "masks":
                    self.context.masks[1].instances[:] = 0
                case "classes":
                    self.context.masks[1].class_names.clear()
                case "camera":
                    self.camera.matrix[0, 0] = 1.0
        return TrackResult(np.eye(4), "ok")


class VandalSettings(Settings):
    what: str = "rgb"


VANDAL = TrackerSpec("vandal", f"{__file__}:Vandal", label="Vandal", settings=VandalSettings)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["rgb", "depth", "whole rgb", "a view", "masks", "camera"])
def test_a_tracker_that_writes_fails_by_its_own_fault_and_changes_nothing(what) -> None:
    sequence = InMemory()
    untouched = InMemory()
    env = SlamEnv(sequence, VANDAL, settings={"what": what})
    env.reset(seed=0)
    with pytest.raises(ValueError, match="read-only") as caught:
        env.step(0)
    assert raised_by_tracker(caught.value)
    unchanged(sequence, untouched)
    assert sequence.camera.matrix[0, 0] == sequence.camera.fx


def unchanged(sequence: InMemory, untouched: InMemory) -> None:
    """Frames and masks are what they were, and their owner may still write them."""
    for frame, masks, first, first_masks in zip(
        sequence.kept, sequence.kept_masks, untouched.kept, untouched.kept_masks, strict=True
    ):
        np.testing.assert_array_equal(frame.rgb, first.rgb)
        np.testing.assert_array_equal(frame.depth, first.depth)
        np.testing.assert_array_equal(masks.instances, first_masks.instances)
        assert masks.class_names == first_masks.class_names
        assert frame.rgb.flags.writeable
        assert frame.depth.flags.writeable


@pytest.mark.slow
def test_names_of_classes_are_the_tracker_s_own_copy() -> None:
    sequence = InMemory()
    untouched = InMemory()
    env = SlamEnv(sequence, VANDAL, settings={"what": "classes"})
    env.reset(seed=0)
    env.step(0)
    unchanged(sequence, untouched)


class Keeper:
    """Keeps the frames that it is given."""

    def __init__(self, settings: Settings) -> None:
        self.frames: list[Frame] = []

    def reset(self, camera, *, rng) -> None:
        self.frames.clear()

    def track(self, frame: Frame) -> TrackResult:
        self.frames.append(frame)
        return TrackResult(np.eye(4), "ok")


KEEPER = TrackerSpec("keeper", f"{__file__}:Keeper", label="Keeper", settings=Settings)


@pytest.mark.parametrize("kind", ["memory", "folder", "rendered", "preprocessed"])
def test_no_pixel_is_copied_and_no_frame_can_be_written(tmp_path, kind) -> None:
    sequence = {
        "memory": lambda: InMemory(),
        "folder": lambda: str(write_folder(tmp_path / "rec")),
        "rendered": lambda: "synthetic/walking_xyz?scene=0&frames=2",
        "preprocessed": lambda: str(write_folder(tmp_path / "rec")),
    }[kind]()
    env = SlamEnv(sequence, KEEPER, data_root=tmp_path)
    if kind == "preprocessed":
        env.frame_transforms.append(
            lambda frame: Frame(frame.index, frame.timestamp, frame.rgb + 1, frame.depth + 1)
        )
    observation, _ = env.reset(seed=0)
    env.step(0)
    for frame in env._tracker.frames:
        for image in (frame.rgb, frame.depth):
            assert not image.flags.writeable
            assert image.base is not None, "a view"
    if kind == "memory":
        assert np.shares_memory(env._tracker.frames[1].rgb, sequence.kept[1].rgb)
    assert observation.flags.writeable


def test_observations_can_be_written_and_reach_neither_tracker_nor_sequence() -> None:
    sequence = InMemory()
    untouched = InMemory()
    env = SlamEnv(sequence, KEEPER, observation="rgbd")
    observation, _ = env.reset(seed=0)
    for key in ("rgb", "depth"):
        observation[key][:] = 0
    np.testing.assert_array_equal(env._tracker.frames[0].rgb, untouched.kept[0].rgb)
    unchanged(sequence, untouched)
