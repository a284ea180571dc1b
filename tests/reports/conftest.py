"""One filled store and its report."""

import pytest
from helpers.reports_fake_store import add_run, fill

from dynslam_bench.reports import build_report
from dynslam_bench.runs.store import RunStore


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """One filled store and its report, made once."""
    root = tmp_path_factory.mktemp("results")
    store = fill(root / "results", seeds=(0, 1))
    add_run(
        store,
        "orb-slam3",
        "synthetic/walking_xyz",
        kind="imported",
        label="ORB-SLAM3",
        error=0.08,
        frame_s=None,
    )
    return store, build_report(store, root / "report")


@pytest.fixture
def store(tmp_path):
    """An empty store."""
    return RunStore(tmp_path / "results")
