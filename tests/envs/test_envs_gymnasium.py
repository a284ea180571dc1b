"""The environment keeps Gymnasium's rules, for every registered id."""

import contextlib
import copy
import itertools
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from helpers.envs_play import QUIET, checked, play, stepped
from helpers.envs_toys import SPEC, STEP_M, TARGET, ToySequence, ToyTracker, truth

import dynslam_bench.envs
from dynslam_bench.core.errors import DynslamError, SequenceError, SettingsError, TrackerError
from dynslam_bench.core.settings import apply_overrides
from dynslam_bench.envs import (
    CONTROL_BENCHMARKS,
    GENERIC_ID,
    REWARDS,
    AccuracyMinusCost,
    DegradeFrames,
    DropFrames,
    Episode,
    FrameOutcome,
    NegWindowError,
    SequenceSampler,
    SlamEnv,
    control_benchmark,
    env_id,
    register_envs,
)
from dynslam_bench.evaluation import OnlineError, evaluate
from dynslam_bench.evaluation.protocol import MONOCULAR, Protocol, get_protocol
from dynslam_bench.geometry import Trajectory, se3
from dynslam_bench.sequences.catalogue import sequence_ids
from dynslam_bench.sequences.synthetic.ids import SYNTHETIC_IDS

FINAL = Protocol.model_validate(
    get_protocol("tum-rgbd/v1").model_dump() | {"id": "f/v1", "trajectory": "final"}
)
CONTROL = ["noise.level_m", "noise.clip", "noise.passes", "noise.enabled"]


@pytest.mark.slow
@pytest.mark.parametrize("name", SYNTHETIC_IDS[::8])
def test_every_family_passes_the_checker_without_a_warning(name: str) -> None:
    checked(
        gym.make(env_id(name), tracker="constant-velocity", render_mode="rgb_array", frames=[0, 8])
    )


@pytest.mark.slow
def test_the_default_tracker_passes_the_checker() -> None:
    small = {"preprocessing.width": 320, "preprocessing.height": 240}
    checked(
        gym.make(
            "dynslam/synthetic-sitting_xyz-v0",
            render_mode="rgb_array",
            frames=[0, 4],
            settings=small,
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "kwargs",
    [{}, {"observation": "rgbd"}, {"control": CONTROL}]
    + [
        {"reward": reward, "lost_after": 3, "window": 6}
        for reward in (*REWARDS, AccuracyMinusCost(weight=0.1))
    ],
)
def test_every_kind_of_environment_passes_the_checker(kwargs: dict) -> None:
    for sequence in (
        ToySequence(12),
        ToySequence(12, has_truth=False),
        ToySequence(12, hole=(0, 4)),
    ):
        checked(
            gym.make(
                GENERIC_ID, sequence=sequence, tracker=TARGET, render_mode="rgb_array", **kwargs
            )
        )


def test_all_listed_sequences_are_registered_and_registering_again_changes_nothing() -> None:
    before = dict(gym.registry)
    ids = register_envs()
    assert dict(gym.registry) == before
    assert ids[0] == "dynslam/Sequence-v0"
    assert {
        "dynslam/tum-fr3-walking_xyz-v0",
        "dynslam/synthetic-walking_xyz-v0",
        "dynslam/bonn-crowd-v0",
    } <= set(ids)
    assert len(ids) == len(set(ids)) == 1 + len(CONTROL_BENCHMARKS) + len(sequence_ids())
    assert all(gym.spec(name).max_episode_steps is None for name in ids)


def test_made_environment_is_made_again_from_its_json(toy_folder: str) -> None:
    env = gym.make(GENERIC_ID, sequence=toy_folder, tracker=TARGET, frames=[3, 20], control=CONTROL)
    env = dynslam_bench.envs.DropFrames(dynslam_bench.envs.RecordTimings(env), frame_time_s=0.05)
    assert env.spec is not None
    duplicate = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(duplicate, dynslam_bench.envs.DropFrames)
    assert env.reset(seed=3)[0].tobytes() == duplicate.reset(seed=3)[0].tobytes()
    assert duplicate.action_space == env.action_space


def test_one_seed_gives_identical_bytes_and_pickle_an_equal_environment(toy_folder: str) -> None:
    env = SlamEnv(toy_folder, TARGET, control=CONTROL, settings={"noise.level_m": 0.002})
    first = rollout(env, 20, 5)
    duplicate = pickle.loads(pickle.dumps(env))
    assert duplicate.settings == env.settings
    assert duplicate.action_space == env.action_space
    assert first == rollout(env, 20, 5) == rollout(duplicate, 20, 5) != rollout(env, 20, 6)


@pytest.mark.slow
def test_async_vector_env(toy_folder: str) -> None:
    kwargs = {"sequence": toy_folder, "tracker": TARGET, "frames": [0, 3]}
    make = lambda: gym.make("dynslam_bench.envs:dynslam/Sequence-v0", **kwargs)  # noqa: E731
    alone = make()
    with contextlib.closing(gym.vector.AsyncVectorEnv([make], context="spawn")) as vector:
        observations, _ = vector.reset(seed=[1])
        assert observations.shape == (1, 24)
        assert observations[0].tobytes() == alone.reset(seed=1)[0].tobytes()
        for _ in range(2):
            _, rewards, _, truncated, infos = vector.step(vector.action_space.sample())
            reward = alone.step(0)[1]
    assert truncated.all()
    assert rewards[0] == reward < 0
    assert infos["episode_metrics"]["ate_rmse_m"].shape == (1,)


def rollout(env: SlamEnv, steps: int, seed: int) -> bytes:
    """Everything that an episode gives, as bytes; actions are drawn from the seed."""
    env.action_space.seed(seed)
    outcomes = [env.reset(seed=seed), *(env.step(env.action_space.sample()) for _ in range(steps))]
    env.close()
    assert not any(any(outcome[2:4]) for outcome in outcomes[1:])
    parts = [
        [array.tobytes() for array in (outcome[0], outcome[-1].pop("pose"))] for outcome in outcomes
    ]
    return repr((parts, outcomes)).encode()


# Copies of an environment in mid-episode: they go on alike, and apart.


def test_wrappers_are_copied_with_it() -> None:
    env = stepped(DegradeFrames(SlamEnv(ToySequence(10), TARGET, observation="rgbd"), noise=0.2), 2)
    duplicate = copy.deepcopy(env)
    assert len(duplicate.unwrapped.frame_transforms) == 1
    assert duplicate.unwrapped is not env.unwrapped
    np.testing.assert_array_equal(*(one.step(0)[0]["rgb"] for one in (env, duplicate)))


MOTION_M = float(np.hypot(STEP_M, 0.002))


@pytest.mark.parametrize(
    ("reward", "error"),
    [("neg_rpe", "frame_error_trans_m"), ("neg_pose_error", "pose_error_trans_m")],
)
def test_rewards_are_minus_the_errors_in_info(reward: str, error: str) -> None:
    rewards, infos, _ = play(SlamEnv(ToySequence(12), TARGET, reward=reward))
    assert rewards == [-info[error] for info in infos[1:]]
    assert min(rewards) < 0


def test_errors_against_an_independent_computation() -> None:
    env = SlamEnv(ToySequence(12), TARGET)
    _, infos, _ = play(env)
    estimate = env.online_trajectory().T_world_cam
    true = truth(12)
    for i, info in enumerate(infos[1:], start=1):
        for kind, first in (("pose", 0), ("frame", i - 1)):
            error = np.linalg.inv(np.linalg.inv(true[first]) @ true[i]) @ (
                np.linalg.inv(estimate[first]) @ estimate[i]
            )
            assert info[f"{kind}_error_trans_m"] == pytest.approx(
                np.linalg.norm(error[:3, 3]), abs=1e-12
            )
            angle = np.rad2deg(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)))
            assert info[f"{kind}_error_rot_deg"] == pytest.approx(angle, abs=1e-5)


def test_lost_frames_cost_twice_the_way_and_the_way_back_nothing() -> None:
    env = SlamEnv(ToySequence(12), TARGET, settings=QUIET | {"mode": "lost", "at": 4, "until": 7})
    rewards, infos, _ = play(env)
    # frames 4, 5, 6
    assert np.allclose(rewards, [0, 0, 0, *[-2 * MOTION_M] * 3, 0, 0, 0, 0, 0], atol=1e-9)
    assert [info["tracking_state"] for info in infos if "pose" not in info] == ["lost"] * 3
    assert infos[-1]["episode_metrics"]["coverage"] == pytest.approx(9 / 12)


@pytest.mark.parametrize("reward", ["neg_rpe", "neg_pose_error"])
def test_quitting_never_pays(reward: str) -> None:
    lost = QUIET | {"mode": "lost", "at": 4}
    whole, _, _ = play(SlamEnv(ToySequence(20), TARGET, settings=lost, reward=reward))
    short, infos, ends = play(
        SlamEnv(ToySequence(20), TARGET, settings=lost, reward=reward, lost_after=3)
    )
    # frames 1 to 3, then 3 lost ones
    assert len(short) == 6
    # terminated, truncated
    assert ends[-1] == (True, False)
    assert sum(short) == pytest.approx(sum(whole), abs=1e-12)
    assert infos[-1]["episode_metrics"]["coverage"] == pytest.approx(4 / 20)


def test_a_tracker_that_never_begins_is_charged_too() -> None:
    rewards, infos, _ = play(
        SlamEnv(ToySequence(8), TARGET, settings={"mode": "initialising", "at": 0})
    )
    metrics = infos[-1]["episode_metrics"]
    assert np.allclose(rewards, -2 * MOTION_M, atol=1e-9)
    assert "ate_rmse_m" not in metrics
    assert metrics["coverage"] == 0


def test_without_ground_truth_or_scale_errors_are_left_out() -> None:
    """A monocular tracker has errors under a Sim(3) protocol alone."""
    monocular = replace(SPEC, sensors="rgb")
    for env in (
        SlamEnv(ToySequence(8, has_truth=False), TARGET),
        SlamEnv(ToySequence(8), monocular),
    ):
        rewards, infos, _ = play(env)
        assert rewards == [0.0] * 7
        assert not any(
            key.startswith(("pose_error", "frame_error")) for info in infos for key in info
        )
        assert infos[-1]["episode_metrics"] == {
            "coverage": 1.0,
            "frames": 8.0,
            "tracked_frames": 8.0,
        }
    _, infos, _ = play(SlamEnv(ToySequence(8), monocular, protocol=MONOCULAR))
    assert infos[-1]["episode_metrics"]["ate_rmse_m"] > 0


def test_a_tracker_that_needs_depth_is_refused_where_there_is_none() -> None:
    sequence = ToySequence(8)
    sequence.has_depth = False
    with pytest.raises(TrackerError, match="needs depth"):
        SlamEnv(sequence, SPEC)
    assert len(play(SlamEnv(sequence, replace(SPEC, sensors="rgb")))[0]) == 7


def test_a_hole_in_the_ground_truth() -> None:
    _, infos, _ = play(SlamEnv(ToySequence(12, hole=(4, 8)), TARGET))
    assert ["pose_error_trans_m" in info for info in infos] == [True] * 4 + [False] * 4 + [True] * 4
    assert "frame_error_trans_m" not in infos[8]
    assert "frame_error_trans_m" in infos[9]
    assert all(
        np.isfinite(value) for info in infos for value in info.values() if isinstance(value, float)
    )


def test_the_last_info_carries_the_metrics_of_the_protocol() -> None:
    env = SlamEnv(ToySequence(40), TARGET, protocol="evo-default")
    _, infos, _ = play(env)
    assert "episode_metrics" not in infos[-2]
    assert infos[-1]["protocol"] == "evo-default"
    want = evaluate(
        env.online_trajectory(),
        env.sequence.ground_truth,
        "evo-default",
        input_timestamps=env.sequence.timestamps,
    ).metrics
    assert {key: infos[-1]["episode_metrics"][key] for key in want} == want


def test_info_holds_the_pose_and_no_times_and_timings_do() -> None:
    env = SlamEnv(ToySequence(5), TARGET)
    _, infos, _ = play(env)
    assert not any("time" in key and key != "timestamp" for info in infos for key in info)
    assert len(env.timings) == 5
    assert list(env.timings[0]) == ["read", "total", "processor", "features", "tracking"]
    poses = np.array([info["pose"] for info in infos])
    again = se3.from_quaternion(poses[:, :3], poses[:, 3:])
    assert poses.dtype == np.float64
    assert np.allclose(again, env.online_trajectory().T_world_cam, atol=1e-12)


def test_frames_and_stride_cut_the_sequence(toy_folder: str) -> None:
    env, in_memory = (
        SlamEnv(of, TARGET, frames="10:40", stride=3) for of in (toy_folder, ToySequence(60))
    )
    assert len(env.sequence) == 10
    assert np.diff(env.sequence.timestamps) == pytest.approx(0.1, abs=1e-5)
    assert np.allclose(in_memory.sequence.timestamps, env.sequence.timestamps, atol=1e-5)


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"tracker": "emfoa-otf"}, DynslamError, "unknown tracker 'emfoa-otf'.*emfoa-oft"),
        (
            {"settings": {"nois.level_m": 1}},
            SettingsError,
            "unknown setting 'nois.level_m'.*noise.level_m",
        ),
        ({"settings": {"noise.level_m": 7.0}}, SettingsError, "'noise.level_m' is 7.0"),
        (
            {"control": ["noise.levelm"]},
            SettingsError,
            "unknown setting 'noise.levelm'.*noise.level_m",
        ),
        (
            {"control": ["noise.seedless"]},
            SettingsError,
            "'noise.seedless' may not change in mid-episode",
        ),
        ({"control": ["mode"]}, SettingsError, "'mode' may not change in mid-episode"),
        ({"control": ["noise.clip", "noise.clip"]}, SettingsError, "twice"),
        ({"control": "noise.clip"}, SettingsError, "list of setting names"),
        ({"reward": "neg_ate"}, SettingsError, "unknown reward 'neg_ate'"),
        ({"observation": "pixels"}, SettingsError, "unknown observation 'pixels'"),
        ({"protocol": "tum-rgbd/v2"}, DynslamError, "unknown protocol 'tum-rgbd/v2'.*tum-rgbd/v1"),
        ({"device": "gpu"}, SettingsError, "unknown device 'gpu'"),
        ({"device": "cuda:99"}, SettingsError, "cuda:99"),
        ({"render_mode": "human"}, SettingsError, "unknown render mode"),
        ({"lost_after": 0}, SettingsError, "lost_after is 0"),
        ({"threads": 0}, SettingsError, "threads is 0"),
        ({"stride": 0}, SequenceError, "stride is 0"),
        ({"frames": (5, 6)}, SequenceError, "1 frames here, an episode needs 2"),
        ({"frames": (50, 60)}, SequenceError, "hold none of the 12 frames"),
        ({"frames": (5, 2)}, SequenceError, "5:2"),
        ({"frames": (1, 2, 3)}, SequenceError, "no range of frames"),
        ({"sequence": "tum/fr3/walkingxyz"}, SequenceError, "did you mean 'tum/fr3/walking_xyz'"),
        ({"sequence": 5}, SettingsError, r"sequence is 5 \(give str \| FrameSequence\)"),
        ({"tracker": 5}, SettingsError, r"tracker is 5 \(give str \| TrackerSpec\)"),
        (
            {"settings": 5},
            SettingsError,
            r"settings is 5 \(give Mapping\[str, Any\] \| Settings \| None\)",
        ),
        ({"settings": {1: 2}}, SettingsError, "settings is {1: 2}"),
        ({"control": [1]}, SettingsError, r"control is \(1,\) \(give Sequence\[str\]\)"),
        ({"protocol": None}, SettingsError, r"protocol is None \(give str \| Protocol\)"),
        ({"window": 2.5}, SettingsError, r"window is 2.5 \(give int \| None\)"),
        ({"stride": "x"}, SettingsError, r"stride is 'x' \(give int\)"),
        ({"device": 0}, SettingsError, r"device is 0 \(give str\)"),
    ],
)
def test_bad_input_is_one_clear_line(kwargs: dict, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        SlamEnv(**{"sequence": ToySequence(12), "tracker": TARGET} | kwargs)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda env: env.reset(options={"sequence": 5}), "sequence is 5"),
        (lambda env: env.reset(options={"settings": 5}), "settings is 5"),
        (lambda env: env.reset(options=5), r"options is 5 \(give dict\[str, Any\] \| None\)"),
        (lambda env: env.reset(seed="x"), r"seed is 'x' \(give int \| None\)"),
        (lambda env: env.action_of([1]), r"values is \[1\] \(give Mapping\[str, Any\]\)"),
        (lambda env: env.drop_frames("x"), r"count is 'x' \(give int\)"),
        (lambda env: env.restore_state(5), r"state is 5 \(give EpisodeState\)"),
        (lambda env: DropFrames(env, speed="x"), r"speed is 'x' \(give float\)"),
        (lambda env: SequenceSampler(env, 5), r"sequences is 5 \(give Sequence\[str\]\)"),
        (lambda env: DegradeFrames(env, blur="x"), r"blur is 'x' \(give float\)"),
        (lambda env: DegradeFrames(env, seed=-1), "seed of the degradation is -1"),
        (lambda env: AccuracyMinusCost(weight="x"), r"weight is 'x' \(give float\)"),
        (
            lambda env: AccuracyMinusCost(cost="x"),
            "unknown cost 'x'.*network_calls, keypoints, processor_s",
        ),
        (lambda env: AccuracyMinusCost(growth=float("nan")), "no finite numbers"),
        (lambda env: NegWindowError(0), "a window has 0 frames"),
        (lambda env: control_benchmark([]), r"id is \[\] \(give str\)"),
        (lambda env: control_benchmark("masks-v0").make([]), r"split is \[\] \(give Split\)"),
    ],
)
def test_arguments_of_a_wrong_type_are_named_with_what_they_should_be(call, message: str) -> None:
    env = SlamEnv(ToySequence(6), TARGET)
    env.reset(seed=0)
    with pytest.raises(SettingsError, match=message):
        call(env)
    assert len(play(env)[0]) == 5


def test_steps_out_of_order() -> None:
    env = SlamEnv(ToySequence(3), TARGET)
    with pytest.raises(DynslamError, match="before reset"):
        env.step(0)
    play(env)
    with pytest.raises(DynslamError, match="episode is over after frame 2"):
        env.step(0)
    env.close()
    assert len(play(env, seed=1)[0]) == 2


def test_reset_options() -> None:
    env = SlamEnv(ToySequence(6), TARGET)
    env.reset(seed=0)
    env.reset(seed=0, options={"settings": {"noise.enabled": False}, "sequence": ToySequence(9)})
    assert len(env.sequence) == 9
    assert env.settings.noise.enabled is False
    assert env.step(0)[4]["frame_error_trans_m"] == pytest.approx(0, abs=1e-12), "another tracker"
    with pytest.raises(SettingsError, match="unknown reset option 'sequnce'"):
        env.reset(options={"sequnce": "x"})


def test_a_tracker_that_cannot_be_steered(toy_folder: str) -> None:
    env = SlamEnv(toy_folder, TARGET.replace(":SPEC", ":FIXED"), control=["noise.clip"])
    with pytest.raises(TrackerError, match="toy-fixed' cannot change its settings in mid-episode"):
        env.reset()


def test_the_final_trajectory_is_that_of_the_frames_so_far() -> None:
    """Asking in mid-episode freezes nothing: the end's metrics are those of a run that was never asked."""
    asked, quiet = (stepped(SlamEnv(ToySequence(12), TARGET, protocol=FINAL), 0) for _ in range(2))
    for index in range(1, 12):
        asked.step(0)
        quiet.step(0)
        assert len(asked.final_trajectory()) == index + 1
        assert asked.episode_metrics()["coverage"] == 1.0
    assert asked.episode_metrics() == quiet.episode_metrics()


def test_coverage_is_that_of_the_trajectory_that_is_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tracker that answers `finalize` with a few poses does not get the coverage of its online states."""
    whole = ToyTracker.finalize
    monkeypatch.setattr(ToyTracker, "finalize", lambda self: whole(self).select(slice(0, 4)))
    spec = replace(SPEC, entry_point="helpers.envs_toys:ToyTracker")
    for protocol, tracked in ((FINAL, 4), ("tum-rgbd/v1", 12)):
        metrics = play(SlamEnv(ToySequence(12), spec, protocol=protocol))[1][-1]["episode_metrics"]
        assert (metrics["tracked_frames"], metrics["coverage"]) == (tracked, tracked / 12)


def test_a_reset_that_fails_ends_the_episode_and_changes_nothing(tmp_path: Path) -> None:
    (damaged := tmp_path / "damaged.npz").write_bytes(b"no map")
    env = SlamEnv(ToySequence(12), "emfoa-oft?masks=none")
    env.reset(seed=0)
    settings = env.settings
    sequence = env.sequence
    for options, words in (
        ({"settings": {"backend.map.localisation_only": True}}, "needs a map"),
        ({"settings": _only_localising(settings)}, "needs a map"),
        ({"settings": {"epipolar.threshold_px": 1.25}, "sequence": "no/such"}, "no/such"),
        ({"colour": 1}, "unknown reset option"),
        ({"settings": {"backend.map.file": str(damaged)}}, "damaged.npz"),
    ):
        with pytest.raises(DynslamError, match=words):
            env.reset(options=options)
        assert (env.settings, env.sequence) == (settings, sequence)
        assert env.final_trajectory() is None
        with pytest.raises(DynslamError, match="before reset"):
            env.step(env.neutral_action)
    with pytest.raises(SettingsError, match="needs a map"):
        SlamEnv(ToySequence(12), "emfoa-oft?masks=none", settings=_only_localising(settings))
    env.reset(seed=0)
    env.step(env.neutral_action)


def _only_localising(settings: Any) -> Any:
    """Complete settings that do not go together."""
    return apply_overrides(settings, {"backend.map.localisation_only": True})


@pytest.mark.parametrize(
    "stamps",
    [
        [0.0, 0.1, 0.1, 0.2],
        [0.0, 0.2, 0.1, 0.3],
        [0.0, 0.1, np.nan, 0.3],
        [0.0, 0.1, 0.1 + 2e-7, 0.2],
    ],
)
def test_stamps_that_do_not_tell_frames_apart_are_refused_before_anything_runs(
    stamps: list[float],
) -> None:
    sequence = ToySequence(4)
    sequence.timestamps = np.array(stamps)
    with pytest.raises(SequenceError, match=r"stamps|ns apart"):
        SlamEnv(sequence, TARGET)


# What episodes earn, over random ones: with `neg_pose_error`, getting lost never pays.


EPISODES = 12


def episode(seed: int) -> tuple[Trajectory, np.ndarray, np.ndarray]:
    """A true path with holes, estimates that drift little or wildly, and which frames are tracked."""
    rng = np.random.default_rng(seed)
    # metres and radians a frame
    moves = [se3.exp(rng.normal(size=6)), *se3.exp(rng.normal(0, 0.02, (39, 6)))]
    true = np.array(list(itertools.accumulate(moves, np.matmul)))
    drift = np.cumsum(rng.normal(0, 10 ** rng.uniform(-4, 0), (len(true), 6)), axis=0)
    stamps = np.arange(len(true)) / 30.0
    known = rng.random(len(true)) > rng.choice([0.0, 0.3])
    known[0] = True
    return (
        Trajectory(stamps[known], true[known]),
        true @ se3.exp(drift),
        rng.random(len(true)) > rng.choice([0.0, 0.4]),
    )


def rewards(name: str, truth: Trajectory, poses: np.ndarray, tracked: np.ndarray) -> np.ndarray:
    online = OnlineError(truth)
    so_far = Episode()
    earned = []
    for index, (pose, ok) in enumerate(zip(poses, tracked, strict=True)):
        error = online.update(index / 30.0, pose if ok else None)
        so_far.add(FrameOutcome(index, index / 30.0, "ok", None, {}, {}, error))
        earned.append(REWARDS[name](so_far))
    return np.array(earned)


@pytest.mark.parametrize("seed", range(EPISODES))
def test_losing_a_tracked_frame_raises_no_frames_reward(seed: int) -> None:
    """Every frame but the one that begins the frame of reference is lost, alone, and from it on to the end."""
    truth, poses, tracked = episode(seed)
    earned = rewards("neg_pose_error", truth, poses, tracked)
    for frame in range(int(np.argmax(tracked)) + 1, len(poses), 5):
        for lost in (np.s_[frame], np.s_[frame:]):
            fewer = tracked.copy()
            fewer[lost] = False
            assert (rewards("neg_pose_error", truth, poses, fewer) <= earned + 1e-12).all()


@pytest.mark.parametrize("seed", range(EPISODES))
def test_no_episode_earns_less_than_one_that_is_lost_throughout(seed: int) -> None:
    truth, poses, tracked = episode(seed)
    nothing = rewards("neg_pose_error", truth, poses, np.zeros(len(poses), bool))
    way = np.r_[0, np.cumsum(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1))]
    known = np.isin(np.arange(len(poses)) / 30.0, truth.timestamps)
    assert nothing[known] == pytest.approx(-way, abs=1e-12)
    assert not nothing[~known].any()
    assert (rewards("neg_pose_error", truth, poses, tracked) >= nothing - 1e-12).all()
    still = rewards(
        "neg_pose_error",
        truth,
        np.repeat(np.eye(4)[None], len(poses), axis=0),
        np.ones(len(poses), bool),
    )
    assert (still >= nothing - 1e-12).all()


@pytest.mark.parametrize("seed", range(EPISODES))
def test_under_neg_rpe_admitting_a_loss_never_earns_more_than_repeating_the_last_pose(
    seed: int,
) -> None:
    truth, poses, tracked = episode(seed)
    tracked[0] = True
    repeated = poses[np.maximum.accumulate(np.where(tracked, np.arange(len(poses)), 0))]
    admitted = rewards("neg_rpe", truth, poses, tracked)
    kept = rewards("neg_rpe", truth, repeated, np.ones(len(poses), bool))
    assert (np.cumsum(admitted) <= np.cumsum(kept) + 1e-12).all(), "wherever the episode ends"
    assert admitted[tracked & np.r_[True, tracked[:-1]]] == pytest.approx(
        kept[tracked & np.r_[True, tracked[:-1]]]
    )
    if not tracked.all():
        assert admitted.sum() < kept.sum()


def test_under_neg_rpe_the_way_back_costs_nothing_and_a_wrong_one_its_error() -> None:
    stamps = np.arange(60) / 30.0
    true = np.repeat(np.eye(4)[None], 60, axis=0)
    true[:, 0, 3] = np.cumsum(np.r_[0, np.full(59, 0.01)])
    tracked = np.ones(60, bool)
    tracked[20:50] = False
    truth = Trajectory(stamps, true)
    earned = rewards("neg_rpe", truth, true, tracked)
    assert earned[20:50] == pytest.approx(-0.02)
    assert not np.delete(earned, np.s_[20:50]).any()
    wrong = true.copy()
    wrong[50:, 0, 3] += 0.3
    assert rewards("neg_rpe", truth, wrong, tracked)[50] == pytest.approx(-0.3)
    tracked[50:] = False
    assert rewards("neg_rpe", truth, true, tracked).sum() < earned.sum(), (
        "to stay lost does not pay"
    )
