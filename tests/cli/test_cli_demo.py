"""The demonstration: its closing sentences, and kernels compiled ahead."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from dynslam_bench.cli import demo
from dynslam_bench.cli.demo import compiled_ahead, tell
from dynslam_bench.core.records import digest
from dynslam_bench.reports.model.row import RunRow


def row(tracker: str, ate_m: float, sequence: str = "synthetic/walking_xyz?scene=100&frames=100") -> RunRow:
    return RunRow.model_validate({
        "run_id": digest([tracker, sequence], 16), "status": "ok", "n_frames": 100, "n_tracked": 100, "coverage": 1.0,
        "tracker": {"id": tracker, "label": tracker},
        "sequence": {"id": sequence, "part": "0" * 16, "frames": 100, "duration_s": 3, "fps": 30, "ground_truth": True,
                     "block": "0" * 16},
        "protocol_id": "p", "protocol_digest": "d", "hold_last_pose_ate_m": ate_m,
    })  # fmt: skip


@pytest.mark.parametrize(
    ("culled_m", "verdict"), [(0.004, "5.0 times smaller"), (0.018, ""), (0.06, "3.0 times larger")]
)
def test_the_verdict_is_that_of_the_numbers(culled_m: float, verdict: str) -> None:
    rows = [row("orb-slam2", 0.02), row("mask-rcnn", culled_m), row("never-move", 0.1)]
    first, *rest = tell([*rows, row("orb-slam2", 0.003, "synthetic/sitting_xyz?scene=104")])
    assert "20.0 mm" in first and f"{1e3 * culled_m:.1f} mm" in first and verdict in first
    assert ("times" in first) == bool(verdict) and len(rest) == 1, "no sentence where nothing was culled"


NOTHING_IS_LEFT = """
import sys
from numba.core.dispatcher import Dispatcher
from dynslam_bench.cli.demo import compile_kernels
from dynslam_bench.envs import SlamEnv
from dynslam_bench.testing import CornerSequence

def ready():
    modules = [module for name, module in sys.modules.items() if name.startswith("dynslam_bench")]
    kernels = {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    return {(kernel.py_func.__qualname__, signature) for kernel in kernels for signature in kernel.signatures}

compile_kernels()
before = ready()
env = SlamEnv(CornerSequence(12), "emfoa-oft", settings={"segmentation.source": "oracle"})
env.reset(seed=0)
while not env.step(env.neutral_action)[3]:
    pass
print(len(before) > 20, sorted(name for name, _ in ready() - before))
"""


def test_nothing_is_left_for_the_first_run_to_compile() -> None:
    done = subprocess.run([sys.executable, "-c", NOTHING_IS_LEFT], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1:] == ["True []"], done.stdout + done.stderr


def test_the_compiling_process_ends_when_rendering_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo.subprocess, "Popen", lambda *_, popen=subprocess.Popen, **__: popen(["sleep", "60"]))
    began = time.monotonic()
    with pytest.raises(KeyError), compiled_ahead():
        raise KeyError
    assert time.monotonic() - began < 30
