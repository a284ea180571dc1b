"""Kernels compiled ahead, by a process of its own: two runs at a time would otherwise compile the same ones twice."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from .output import complain

FRAMES = 12
"""Of the made-up scene: enough for keyframes, bundle adjustment and culling."""


def compile_kernels(*, rendering: bool = True) -> None:
    """Use the kernels of tracking once, so that they lie compiled beside their sources (or in the user's cache folder).

    Args:
        rendering: Whether those that render sequences are compiled, too.
    """
    from dynslam_bench.envs import SlamEnv
    from dynslam_bench.sequences.synthetic import open_synthetic
    from dynslam_bench.testing import CornerSequence

    if rendering:
        open_synthetic("synthetic/walking_xyz?frames=2", None)[0]
    env = SlamEnv(CornerSequence(FRAMES), "emfoa-oft", settings={"segmentation.source": "oracle"})
    env.reset(seed=0)
    over = False
    while not over:
        outcome = env.step(env.neutral_action)
        over = outcome[2] or outcome[3]
    env.close()


@contextmanager
def compiled_ahead() -> Iterator[None]:
    """Compile the kernels of tracking while the body runs, and wait for them; if the body fails they are given up."""
    work = f"from {__name__} import {compile_kernels.__name__} as work; work(rendering=False)"
    with subprocess.Popen(
        [sys.executable, "-c", work], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            yield
        except BaseException:
            process.kill()
            raise
        if code := process.wait():
            complain(f"kernels could not be compiled ahead (exit code {code}): the first runs compile them")
