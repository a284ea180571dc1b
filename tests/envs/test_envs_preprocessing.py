"""The paper's preprocessing is a group of the tracker's settings; the environment's frames follow it."""

from __future__ import annotations

import numpy as np

from dynslam_bench.envs import SlamEnv

SEQUENCE = "synthetic/sitting_xyz?frames=4"
HALF = {"preprocessing.width": 320, "preprocessing.height": 240}


def test_frames_are_resized_and_the_intrinsics_with_them() -> None:
    env = SlamEnv(SEQUENCE, "orb-slam2", settings=HALF)
    assert (env.sequence.camera.width, env.sequence.camera.height, env.sequence.camera.fx) == (320, 240, 535.4 / 2)
    env.reset(seed=0)
    info = [env.step(0)[4] for _ in range(3)][-1]
    assert info["tracking_state"] == "ok" and info["pose_error_trans_m"] < 0.05


def test_a_reset_may_change_it() -> None:
    env = SlamEnv(SEQUENCE, "orb-slam2")
    plain = env.sequence[1].rgb
    env.reset(seed=0, options={"settings": {"preprocessing.normalisation": "equalise"}})
    changed = env.sequence[1].rgb
    assert changed.shape == plain.shape and np.abs(changed.astype(int) - plain).mean() > 2
