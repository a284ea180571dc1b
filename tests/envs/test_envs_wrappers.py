"""The wrappers: timings, trajectories, dropped and degraded frames, sampling."""

import time
import warnings
from dataclasses import replace

import numpy as np
import pytest
from envs_toys import FIXED, TARGET, FixedTracker, ToySequence, images, write_folder

import dynslam_bench.envs  # noqa: F401
from dynslam_bench.contracts.sequence import Frame
from dynslam_bench.core.errors import DynslamError, SettingsError
from dynslam_bench.envs import (
    Degradation,
    DegradeFrames,
    DropFrames,
    RecordTimings,
    RecordTrajectory,
    SequenceSampler,
    SlamEnv,
    SmallImages,
)
from dynslam_bench.envs.spaces import MAX_DEPTH_M
from dynslam_bench.geometry.trajectory_files import read_tum


def play(env) -> list[tuple]:
    env.reset(seed=0)
    steps = []
    while not steps or not (steps[-1][2] or steps[-1][3]):
        steps.append(env.step(0))
    return steps


def test_record_timings() -> None:
    env = RecordTimings(SlamEnv(ToySequence(6), TARGET))
    for info in (env.reset(seed=0)[1], *(env.step(0)[4] for _ in range(5))):
        assert info["timings"]["features"] == 0.001 and info["timings"]["total"] > 0
    assert env.summary()["features"] == {"median": 0.001, "p95": 0.001}


def test_record_trajectory(tmp_path) -> None:
    base = SlamEnv(ToySequence(6), TARGET, settings={"mode": "lost", "at": 2, "until": 4})
    env = RecordTrajectory(base, tmp_path / "run_{episode}.txt")
    for episode in range(2):
        play(env)
        written = read_tum(tmp_path / f"run_{episode}.txt")
        assert len(written) == 4
        assert np.allclose(written.T_world_cam, base.online_trajectory().T_world_cam, atol=1e-8)
    assert [path.name for path in env.written] == ["run_0.txt", "run_1.txt"]


@pytest.mark.parametrize(
    ("frame_time_s", "speed", "tracked"),
    [
        (0.9 / 30, 1.0, [*range(1, 11)]),
        (1.9 / 30, 1.0, [1, 3, 5, 7, 9, 10]),
        (0.9 / 30, 2.0, [1, 3, 5, 7, 9, 10]),
        (100.0, 1.0, [10]),  # slower than the whole sequence: it still gets the last frame
    ],
)
def test_a_busy_tracker_misses_frames(frame_time_s: float, speed: float, tracked: list[int]) -> None:
    env = DropFrames(SlamEnv(ToySequence(11), TARGET), frame_time_s=frame_time_s, speed=speed)
    steps = play(env)
    assert [step[4]["frame_index"] for step in steps] == tracked and env.dropped == 10 - len(tracked)
    assert steps[-1][3] and steps[-1][4]["episode_metrics"]["coverage"] == pytest.approx((1 + len(tracked)) / 11)


def test_dropped_frames_cost_the_error_of_not_moving() -> None:
    quiet = {"noise.enabled": False}
    whole = sum(step[1] for step in play(SlamEnv(ToySequence(11), TARGET, settings=quiet)))
    dropping = play(DropFrames(SlamEnv(ToySequence(11), TARGET, settings=quiet), frame_time_s=1.9 / 30))
    motion = np.hypot(0.01, 0.002)
    assert whole == pytest.approx(0, abs=1e-9)
    assert sum(step[1] for step in dropping) == pytest.approx(-8 * motion, abs=1e-6)  # 4 dropped, 4 ways back


def test_random_drops_are_seeded_and_near_their_share() -> None:
    def seen(seed: int) -> list[int]:
        env = DropFrames(SlamEnv(ToySequence(200), TARGET), share=0.3, seed=seed)
        return [step[4]["frame_index"] for step in play(env)]

    assert seen(1) == seen(1) != seen(2)
    assert 120 < len(seen(1)) < 160 and seen(1)[-1] == 199


def test_dropping_more_than_is_left() -> None:
    env = SlamEnv(ToySequence(5), TARGET)
    env.reset(seed=0)
    with pytest.raises(DynslamError, match="cannot drop 4 frames, 3 are left"):
        env.drop_frames(4)


@pytest.mark.parametrize("kind", ["lighting", "glare", "shadow", "blur", "noise"])
def test_degradation_grows_with_its_strength_and_repeats(kind: str) -> None:
    frame = Frame(7, 1.0, *images(7))
    changes = []
    for strength in (0.0, 0.3, 1.0):
        degraded = Degradation(**{kind: strength}, seed=3)(frame)
        assert degraded.rgb.dtype == np.uint8 and degraded.rgb.shape == frame.rgb.shape
        assert (Degradation(**{kind: strength}, seed=3)(frame).rgb == degraded.rgb).all()
        assert (degraded.depth == frame.depth).all()
        changes.append(float(np.abs(degraded.rgb.astype(float) - frame.rgb).mean()))
    assert changes[0] == 0 and 0 < changes[1] < changes[2]
    assert (Degradation(**{kind: 1.0}, seed=4)(frame).rgb != Degradation(**{kind: 1.0}, seed=3)(frame).rgb).any()


def test_what_each_degradation_does() -> None:
    gray = Frame(20, 1.0, np.full((120, 160, 3), 120, np.uint8), np.full((120, 160), 2.0, np.float32))
    dark = Degradation(lighting=1.0)(gray).rgb
    assert dark.mean() < 120
    shadow = Degradation(shadow=1.0)(gray).rgb[..., 0]
    assert shadow.min() == pytest.approx(0.15 * 120, abs=2) and shadow.max() == pytest.approx(120, abs=2)
    glare = Degradation(glare=1.0)(gray).rgb[..., 0]
    assert (glare == 255).any() and glare.min() >= 120
    noise = Degradation(noise=0.5)(gray).rgb.astype(float)
    assert noise.std() == pytest.approx(20, rel=0.05) and noise.mean() == pytest.approx(120, abs=0.5)
    depth = Degradation(depth_noise=1.0)(gray).depth
    assert (depth == 0).mean() == pytest.approx(0.3, abs=0.02)
    assert depth[depth > 0].std() == pytest.approx(0.08, rel=0.05)
    edge = Frame(20, 1.0, np.repeat(np.uint8([[[0]] * 80 + [[200]] * 80] * 120), 3, axis=2), gray.depth)
    blurred = Degradation(blur=1.0)(edge).rgb[60, :, 0].astype(int)
    assert ((blurred > 5) & (blurred < 195)).sum() > 3 and blurred[0] == 0 and blurred[-1] == 200


def test_degraded_frames_reach_the_tracker_and_the_observation() -> None:
    env = DegradeFrames(SlamEnv(ToySequence(5), TARGET, observation="rgbd"), noise=0.5, seed=1)
    seen, _ = env.reset(seed=0)
    assert (seen["rgb"] != images(0)[0]).mean() > 0.9
    assert (seen["rgb"] == env.unwrapped.frame.rgb).all()


@pytest.mark.parametrize(
    ("wrapper", "arguments"),
    [(DegradeFrames, {"blur": 1.5}), (DegradeFrames, {"noise": -0.1}), (SequenceSampler, {"sequences": []})]
    + [(DropFrames, arguments) for arguments in ({"speed": 0}, {"frame_time_s": -1}, {"share": 1.0})],
)
def test_arguments_outside_their_range(wrapper: type, arguments: dict) -> None:
    with pytest.raises(SettingsError):
        wrapper(SlamEnv(ToySequence(5), TARGET), **arguments)


def test_sequence_sampler(toy_folder: str, tmp_path) -> None:
    other = str(write_folder(tmp_path / "other", 8))

    def drawn(mode: str, seed: int) -> list[str]:
        env = SequenceSampler(SlamEnv(toy_folder, TARGET), [toy_folder, other], mode=mode)
        return [env.reset(seed=seed if first else None)[1]["sequence"] for first in (True, *[False] * 7)]

    assert drawn("round_robin", 0) == [toy_folder, other] * 4
    assert drawn("random", 5) == drawn("random", 5) != drawn("random", 6) and set(drawn("random", 5)) == {
        toy_folder,
        other,
    }


class Compiles(FixedTracker):
    """Takes long over the first frames that it ever sees, as what compiles its kernels does."""

    slow_frames = 0
    resets = 0

    def reset(self, camera, *, rng):
        super().reset(camera, rng=rng)
        type(self).resets += 1
        self.drawn = rng.random()

    def track(self, frame):
        if type(self).slow_frames < 3:
            type(self).slow_frames += 1
            time.sleep(0.4)
        return super().track(frame)


def test_compiling_is_no_work_of_a_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Compiles, "slow_frames", 0)
    monkeypatch.setattr(Compiles, "resets", 0)
    spec = replace(FIXED, entry_point=f"{__name__}:Compiles")
    env = DropFrames(SlamEnv(ToySequence(20), spec), speed=0.5)
    play(env)
    assert Compiles.slow_frames == 3 and env.dropped == 0 and Compiles.resets == 2
    play(env)
    assert Compiles.resets == 3  # it is warm


def test_warming_up_leaves_the_random_numbers_where_they_are() -> None:
    def drawn(env) -> list[float]:
        found = []
        for seed in (3, None, None):
            env.reset(seed=seed)
            found.append(env.unwrapped._tracker.drawn)  # the tracker's first random number has no public name
        return found

    def make() -> SlamEnv:
        return SlamEnv(ToySequence(4), replace(FIXED, entry_point=f"{__name__}:Compiles"))

    assert drawn(DropFrames(make())) == drawn(make())


# Small images for agents: what they show, and that stable-baselines3 has nothing to say about them.


def test_they_show_the_same_smaller() -> None:
    env = SmallImages(SlamEnv(ToySequence(4), TARGET, observation="rgbd"), width=40, height=36)
    seen, _ = env.reset(seed=0)
    assert seen in env.observation_space and seen["rgb"].shape == (36, 40, 3) and seen["depth"].shape == (36, 40, 1)
    whole = env.unwrapped.frame
    assert abs(float(seen["rgb"].mean()) - float(whole.rgb.mean())) < 3


def test_depth_keeps_missing_apart_and_is_right_to_half_a_step() -> None:
    env = SmallImages(SlamEnv(ToySequence(4), TARGET, observation="rgbd"))
    shown = {"rgb": np.zeros((60, 80, 3), np.uint8), "depth": np.linspace(0, MAX_DEPTH_M, 4800, dtype=np.float32)}
    shown["depth"] = shown["depth"].reshape(60, 80)
    steps = env.observation(shown)["depth"][..., 0].astype(float)
    assert (steps == 0).sum() == 1 and steps[0, 0] == 0 and steps[-1, -1] == 255
    metres = (steps - 1) * MAX_DEPTH_M / 254
    assert np.abs(metres - shown["depth"]).ravel()[1:].max() <= 0.5 * MAX_DEPTH_M / 254 + 1e-6


@pytest.mark.parametrize(("observation", "width"), [("stats", 80), ("rgbd", 0)])
def test_what_it_cannot_wrap_is_refused(observation: str, width: int) -> None:
    with pytest.raises(SettingsError):
        SmallImages(SlamEnv(ToySequence(4), TARGET, observation=observation), width=width)


def test_stable_baselines3_takes_it_without_a_word() -> None:
    checks = pytest.importorskip("stable_baselines3.common.env_checker", reason="the extra [rl] is not installed")
    env = SmallImages(
        SlamEnv(ToySequence(6), TARGET, observation="rgbd", control=["noise.level_m"]), width=40, height=36
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checks.check_env(env)
    with pytest.warns(UserWarning, match="unconventional shape"):
        checks.check_env(SlamEnv(ToySequence(6), TARGET, observation="rgbd", control=["noise.level_m"]))
