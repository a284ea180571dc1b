from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.extend(str(Path(__file__).resolve().parents[1] / package) for package in ("envs", "core", "reports"))

from envs_toys import write_folder

from dynslam_bench.runs import RunStore


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A toy sequence of 60 frames in TUM layout."""
    return str(write_folder(tmp_path_factory.mktemp("toys") / "toy", 60))


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    ready = RunStore(tmp_path / "results")
    ready.prepare()
    return ready
