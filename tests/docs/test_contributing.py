"""CONTRIBUTING says where things are, and names every package."""

from __future__ import annotations

import re

import pytest
from documented_names import ROOT

TEXT = (ROOT / "CONTRIBUTING.md").read_text()
CONTENT = {
    "dynslam_bench/flow/moth_flame.py": r"Eq\. 13",
    "dynslam_bench/flow/label_search.py": r"def move_moths\(",
    "dynslam_bench/culling/epipolar.py": r"Eq\. 25|Eq\. 23",
    "dynslam_bench/runs/store.py": r"def publish\(",
    "reports/tables/": r"Table\(",
    "dynslam_bench/slam/pipeline.py": r"def track\(",
    "dynslam_bench/slam/keyframes.py": r"def needed\(",
    "dynslam_bench/slam/loop_closing.py": r"def _merge\(",
    "dynslam_bench/contracts/tracker.py": r"class Tracker\(Protocol\)",
    "dynslam_bench/trackers/systems/dynaslam.py": r"compose",
    "dynslam_bench/evaluation/protocol.py": r"class Protocol",
    "dynslam_bench/evaluation/evaluate.py": r"(?m)^METRICS",
    "dynslam_bench/sequences/catalogue.py": r"DatasetSpec",
    "dynslam_bench/sequences/synthetic/people.py": r"skeleton",
}
"""The files that answer a question, and a pattern in each that is the answer."""


def test_the_questions_are_answered() -> None:
    assert sorted(re.findall(r"\? \| `([^`]+)` \|", TEXT)) == sorted(CONTENT)


@pytest.mark.parametrize("path", sorted(CONTENT))
def test_the_answer_is_there(path: str) -> None:
    files = sorted((ROOT / path).glob("*.py")) if path.endswith("/") else [ROOT / path]
    assert any(re.search(CONTENT[path], file.read_text()) for file in files)


def test_every_package_is_named() -> None:
    packages = [*(ROOT / "dynslam_bench").glob("*/__init__.py"), *ROOT.glob("*/__init__.py")]
    assert not {init.parent.name for init in packages} - set(re.findall(r"\w+", TEXT)) - {"tests"}
