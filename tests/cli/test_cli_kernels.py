"""Kernels that are compiled ahead of the demonstration's runs."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import pytest

from dynslam_bench.cli.kernels import compile_kernels, compiled_ahead
from dynslam_bench.flow.daisy.refinement import similarity_lucas_kanade
from dynslam_bench.flow.searches.propagation import motions_of
from dynslam_bench.slam.bundle.schur import adjust_bundle
from dynslam_bench.slam.mapping.map_kernels import refresh


def program(folder: Path, text: str) -> str:
    path = folder / "python"
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


def test_it_uses_the_kernels_of_flow_and_of_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    adjusted = []

    def noted(*given: Any) -> Any:
        adjusted.append(given)
        return adjust_bundle(*given)

    monkeypatch.setattr("dynslam_bench.slam.mapping.local_mapping.adjust_bundle", noted)
    compile_kernels(rendering=False)
    for kernel in (similarity_lucas_kanade, motions_of, refresh):
        assert kernel.signatures, kernel
    assert adjusted, "the scene is long enough for a bundle"


def test_its_failure_is_one_line_and_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "executable", program(tmp_path, "exit 7"))
    with compiled_ahead():
        pass
    assert capsys.readouterr().err.count("compiled ahead (exit code 7)") == 1


def test_nothing_is_left_of_it_when_rendering_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", program(tmp_path, "exec sleep 60"))
    started = time.monotonic()
    with pytest.raises(KeyError), compiled_ahead():
        raise KeyError
    assert time.monotonic() - started < 30
