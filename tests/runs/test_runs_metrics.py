"""Stored metrics hold for one version of the evaluation code and one content of what they were computed from."""

from __future__ import annotations

from pathlib import Path

import pytest
from envs_toys import TARGET

from dynslam_bench.evaluation.protocol import get_protocol
from dynslam_bench.runs import RunRecord, RunSpec, RunStore, run_one, score
from dynslam_bench.runs.store import list_runs, rescore

PROTOCOL = get_protocol("tum-rgbd/v1")


@pytest.fixture
def record(store: RunStore, toy_folder: str) -> RunRecord:
    made = run_one(RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 12)), store)
    score(store, made)
    return made


def listed_error(store: RunStore) -> float:
    ((row,), unreadable) = list_runs(store)
    assert not unreadable
    return row["ate_rmse_m"]


def shift(path: Path, column: int, by: float) -> None:
    """Move one coordinate of every second pose of a trajectory file."""
    lines = path.read_text().splitlines()
    for at, line in enumerate(lines):
        words = line.split()
        if not line.startswith("#") and at % 2:
            words[column] = f"{float(words[column]) + by:.6f}"
            lines[at] = " ".join(words)
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("file", ["trajectory", "truth"])
def test_an_edited_trajectory_or_truth_is_scored_again(file: str, store: RunStore, record: RunRecord) -> None:
    before = listed_error(store)
    part = store.root / "sequences" / record.sequence.part / "groundtruth.txt"
    shift(part if file == "truth" else store.folder(record.run_id) / "trajectory_online.txt", 1, 0.2)
    assert store.metrics(record, PROTOCOL) is None
    assert listed_error(store) > before + 0.05
    assert score(store, record).metrics["ate_rmse_m"] == listed_error(store)
    assert store.metrics(record, PROTOCOL) is not None


def test_errors_of_other_evaluation_code_are_computed_again(
    store: RunStore, record: RunRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = store.metrics(record, PROTOCOL)
    assert stored is not None and stored.code and stored.inputs
    doubled = {name: 2 * value for name, value in stored.online.metrics.items()}
    wrong = stored.online.model_copy(update={"metrics": doubled})
    store.add_metrics(stored.model_copy(update={"online": wrong, "code": "of an older version"}))
    assert score(store, record).metrics == stored.metrics
    monkeypatch.setattr("dynslam_bench.runs.store.evaluation_code", lambda: "newer")
    assert store.metrics(record, PROTOCOL) is None
    assert score(store, record).code == "newer"


def test_rescoring_says_what_has_changed(store: RunStore, record: RunRecord) -> None:
    (same,) = rescore(store)
    assert (same.protocol, same.runs, same.changed) == ("tum-rgbd/v1", 1, ())
    stored = store.metrics(record, PROTOCOL)
    store.add_metrics(stored.model_copy(update={"online": None}))
    (other,) = rescore(store)
    assert other.changed == (record.run_id,)
    assert store.metrics(record, PROTOCOL) == stored
