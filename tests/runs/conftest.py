from pathlib import Path

import pytest

from dynslam_bench.runs import RunStore


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    ready = RunStore(tmp_path / "results")
    ready.prepare()
    return ready
