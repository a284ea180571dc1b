"""Kernels compiled ahead, by processes of their own: two runs at a time would otherwise compile the same ones twice."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from .output import complain

FRAMES = 12
"""Of the made-up scene: enough for keyframes and bundle adjustment."""
POINTS = 64
"""Whose flow is looked for: enough for every phase of the search."""


def compile_kernels() -> None:
    """Use all kernels once, so that they lie compiled beside their sources (or in the user's cache folder)."""
    compile_rendering()
    compile_flow()
    compile_tracking()


def compile_rendering() -> None:
    """Use the kernels that render sequences."""
    from dynslam_bench.sequences.synthetic import open_synthetic

    open_synthetic("synthetic/walking_xyz?frames=2", None)[0]


def compile_flow() -> None:
    """Use the kernels of the flow of `emfoa-oft`, about half of all that track."""
    import numpy as np

    from dynslam_bench.flow.build_flow import build_flow
    from dynslam_bench.testing import CornerSequence
    from dynslam_bench.trackers.systems.emfoa_oft import EmfoaOftSettings

    scene = CornerSequence(2)
    flow = build_flow(EmfoaOftSettings().flow)
    target, reference = (flow.prepare(np.ascontiguousarray(scene[index].rgb[:, :, 1])) for index in (0, 1))
    size = scene.camera.width - 1, scene.camera.height - 1
    points = (np.random.default_rng(0).random((POINTS, 2)) * size).astype(np.float32)
    flow.track(reference, target, points, guess=points)


def compile_tracking() -> None:
    """Use the kernels of features and of the map."""
    from dynslam_bench.envs import SlamEnv
    from dynslam_bench.testing import CornerSequence

    env = SlamEnv(CornerSequence(FRAMES), "orb-slam2")
    env.reset(seed=0)
    over = False
    while not over:
        outcome = env.step(env.neutral_action)
        over = outcome[2] or outcome[3]
    env.close()


@contextmanager
def compiled_ahead() -> Iterator[None]:
    """Compile the kernels of flow and tracking while the body runs, and wait; if the body fails they are given up."""
    with ExitStack() as started:
        processes = [
            started.enter_context(
                subprocess.Popen(
                    [sys.executable, "-c", f"from {__name__} import {work.__name__} as work; work()"],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            )
            for work in (compile_flow, compile_tracking)
        ]
        try:
            yield
        except BaseException:
            for process in processes:
                process.kill()
            raise
        if failed := [str(code) for process in processes if (code := process.wait())]:
            complain(
                f"kernels could not be compiled ahead (exit code {', '.join(failed)}): the first runs compile them"
            )
