from pathlib import Path

import pytest

from dynslam_bench.runs import RunStore


@pytest.fixture(autouse=True)
def scored_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores are computed in this process, where tests replace functions, although it has imported plug-ins."""
    monkeypatch.setattr("dynslam_bench.runs.store.has_imported_plugins", lambda: False)


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    ready = RunStore(tmp_path / "results")
    ready.prepare()
    return ready
