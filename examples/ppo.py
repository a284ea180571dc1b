"""PPO changes a tracker's settings at every frame: stable-baselines3, extra [rl].

    pip install stable-baselines3
    python examples/ppo.py [STEPS]

It trains on rendered scenes and is evaluated on another one, beside the default settings. The default of
2000 steps shows that everything works and no more: an agent that is worth its frames takes far longer.
"""

import sys

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor

import dynslam_bench.envs  # noqa: F401, registers the environments
from dynslam_bench.envs import SequenceSampler

CONTROL = ["features.fast_threshold", "backend.tracking.map_radius_px"]


def make(sequence: str, frames: int) -> gym.Env:
    """One episode is one sequence; the action says which settings hold on the next frame."""
    return gym.make(
        "dynslam/Sequence-v0",
        sequence=sequence,
        tracker="orb-slam2",
        control=CONTROL,
        frames=(0, frames),
        lost_after=10,
    )


def earned(env: gym.Env, policy) -> float:
    """The rewards of an episode: minus the error of the motion from frame to frame, metres."""
    observation, _ = env.reset(seed=0)
    total, over = 0.0, False
    while not over:
        observation, reward, terminated, truncated, _ = env.step(policy(observation))
        total, over = total + float(reward), terminated or truncated
    return total


def main(steps: str | int = 2000, frames: int = 60, scenes: int = 4) -> None:
    train = [f"synthetic/sitting_xyz?scene={scene}" for scene in range(scenes)]
    env = Monitor(SequenceSampler(make(train[0], frames), train))
    agent = PPO("MlpPolicy", env, n_steps=min(256, int(steps)), batch_size=min(64, int(steps)), seed=0, device="cpu")
    agent.learn(int(steps))

    held_out = make("synthetic/sitting_xyz?scene=100", frames)
    print(f"default settings:   {earned(held_out, lambda _: held_out.unwrapped.neutral_action):.4f} m")
    learned = earned(held_out, lambda observation: agent.predict(observation, deterministic=True)[0])
    print(f"after {steps} steps:     {learned:.4f} m")


if __name__ == "__main__":
    main(*sys.argv[1:2])
