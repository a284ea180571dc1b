"""The signature table: published classes by the written rule, measured classes, and the table of a small store."""

import importlib.util
import sys
from itertools import product
from pathlib import Path

import pytest

from dynslam_bench.core.errors import DynslamError
from dynslam_bench.runs import RunStore

TESTS = Path(__file__).resolve().parents[2]


def load(name: str, path: Path):
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


signatures = load("baseline_signatures", TESTS / "benchmarks" / "baseline_signatures.py")
fake = load("signatures_fake_store", TESTS / "reports" / "reports_fake_store.py")


@pytest.mark.parametrize(
    ("ate", "coverage", "broken", "expected"),
    [
        (0.012, 1.0, False, "survives"),
        (0.031, 1.0, False, "between"),
        (0.15, 1.0, False, "fails"),
        (0.012, 0.79, False, "fails"),
        (0.012, 1.0, True, "fails"),
        (float("nan"), 1.0, False, "fails"),
    ],
)
def test_measured_classes(ate: float, coverage: float, broken: bool, expected: str) -> None:
    assert signatures.classify(ate, coverage, 0.3, 0.01, broken) == expected


@pytest.mark.parametrize(
    ("tracker", "sequence", "expected"),
    [
        ("orb-slam2", "walking_xyz", "fails"),  # 0.459 to 0.752 of 0.307 never-move
        ("dynaslam-g", "walking_rpy", "fails"),  # 0.251
        ("dynaslam-g", "walking_halfsphere", "survives"),  # 0.035 of 3 x 0.025
        ("ds-slam", "walking_rpy", "fails"),
        ("yolo-slam", "walking_rpy", "fails"),
        ("dai-slam", "walking_xyz", "between"),  # 0.087: neither
        ("dynaslam", "sitting_static", "survives"),
        ("di-slam", "walking_xyz", None),  # nothing published that could be read
    ],
)
def test_published_classes(tracker: str, sequence: str, expected: str | None) -> None:
    assert signatures.published_class(tracker, signatures.recorded(f"synthetic/{sequence}?scene=3")) == expected


def test_table_of_a_store_of_computed_trajectories(tmp_path: Path) -> None:
    store = RunStore(tmp_path)
    replica = "synthetic/walking_rpy"
    for seed, (tracker, options) in product(
        (0, 1),
        {
            "mask-rcnn": {"error": 0.004, "overrides": {"segmentation.source": "oracle"}},
            "dynaslam-n": {"provenance": "faithful-code"},
            "orb-slam2": {"error": 0.5, "provenance": "faithful-code"},
            "yolo-slam": {},
            "cfp-slam": {"provenance": "inspired"},
            "dai-slam": {"lost": range(90)},
            "di-slam": {"provenance": "inspired"},
        }.items(),
    ):
        fake.add_run(store, tracker, replica, seed, **{"error": 0.005} | options)
    text = signatures.report(tmp_path)
    verdicts = {
        line.split("|")[1].strip(): line.rsplit("|", 2)[1].strip()
        for line in text.splitlines()
        if line.startswith("| `")
    }
    assert verdicts == {
        "`dynaslam-n`": "match",
        "`orb-slam2`": "match",
        "`yolo-slam`": "**miss**",
        "`dai-slam`": "match",
        "`cfp-slam`": "match (not counted)",
    }
    assert "match: 3 of 4 (75 %; the bar is 75 %)" in text
    assert "yolo-slam on walking_rpy: survives" in text and "published fails" in text


def test_a_store_without_the_reference_system_is_a_clear_error(tmp_path: Path) -> None:
    fake.add_run(RunStore(tmp_path), "orb-slam2", "synthetic/walking_xyz", 0)
    with pytest.raises(DynslamError, match=r"exact masks on synthetic/walking_xyz.*suite 'dynamic'"):
        signatures.report(tmp_path)
