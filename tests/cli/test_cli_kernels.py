"""Kernels that are compiled ahead of the demonstration's runs."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from dynslam_bench.cli.demo import compile_flow, compile_tracking, compiled_ahead
from dynslam_bench.flow.propagation import motions_of
from dynslam_bench.flow.refinement import similarity_lucas_kanade
from dynslam_bench.slam.bundle_adjustment import adjust_bundle
from dynslam_bench.slam.map_kernels import refresh


def program(folder: Path, text: str) -> str:
    path = folder / "python"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


NOTHING_IS_LEFT = """
import sys
from numba.core.dispatcher import Dispatcher
from dynslam_bench.cli.demo import compile_flow, compile_tracking
from dynslam_bench.envs import SlamEnv
from dynslam_bench.testing import CornerSequence

def ready():
    modules = [module for name, module in sys.modules.items() if name.startswith("dynslam_bench")]
    found = {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    return {(kernel.py_func.__qualname__, signature) for kernel in found for signature in kernel.signatures}

compile_flow()
compile_tracking()
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


def test_it_uses_the_kernels_of_flow_and_of_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    adjusted = []

    def noted(*given: Any) -> Any:
        adjusted.append(given)
        return adjust_bundle(*given)

    monkeypatch.setattr("dynslam_bench.slam.local_mapping.adjust_bundle", noted)
    compile_flow()
    compile_tracking()
    for kernel in (similarity_lucas_kanade, motions_of, refresh):
        assert kernel.signatures, kernel
    assert adjusted, "the scene is long enough for a bundle"


def test_its_failure_is_one_line_and_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "executable", program(tmp_path, "exit 7"))
    with compiled_ahead():
        pass
    assert capsys.readouterr().err.count("compiled ahead (exit code 7, 7)") == 1


def test_nothing_is_left_of_it_when_rendering_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", program(tmp_path, "exec sleep 60"))
    started = time.monotonic()
    with pytest.raises(KeyError), compiled_ahead():
        raise KeyError
    assert time.monotonic() - started < 30
