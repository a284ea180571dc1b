"""The tour of the rooms in CONTRIBUTING is true."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text()
CONTENT = {
    "dynslam_bench/flow/moth_flame.py": r"Eq\. 13",
    "dynslam_bench/culling/epipolar.py": r"Eq\. 25|Eq\. 23",
    "dynslam_bench/runs/store.py": r"run\.json",
    "reports/tables/": r"Table\(",
    "dynslam_bench/slam/pipeline.py": r"def track\(",
    "dynslam_bench/contracts/tracker.py": r"class Tracker\(Protocol\)",
    "dynslam_bench/trackers/systems/dynaslam.py": r"compose\(",
    "dynslam_bench/evaluation/protocol.py": r"class Protocol",
    "dynslam_bench/slam/keyframes.py": r"def ",
    "dynslam_bench/sequences/synthetic/people.py": r"skeleton",
}
"""What must be found behind each answer for it to be one."""


def answers() -> list[str]:
    section = TEXT.partition("## Where is ...?")[2].partition("\n## ")[0]
    return re.findall(r"\? \| `([^`]+)` \|", section)


def test_ten_questions_are_answered() -> None:
    assert sorted(answers()) == sorted(CONTENT)


@pytest.mark.parametrize("path", sorted(CONTENT))
def test_the_answer_is_there(path: str) -> None:
    place = ROOT / path
    files = sorted(place.glob("*.py")) if path.endswith("/") else [place]
    assert any(re.search(CONTENT[path], file.read_text()) for file in files), f"{path} no longer holds {CONTENT[path]}"


def test_every_room_is_on_the_tour() -> None:
    tour = TEXT.partition("## A tour of the rooms")[2].partition("\n## ")[0]
    named = {name.rpartition("/")[2] for name in re.findall(r"`([\w/]+)`", tour)}
    rooms = {
        init.parent.name for init in (*(ROOT / "dynslam_bench").glob("*/__init__.py"), *ROOT.glob("*/__init__.py"))
    }
    assert not rooms - named - {"dynslam_bench", "tests"}


def doors() -> list[tuple[list[str], str]]:
    """Every door of the tour, with the rooms of its line."""
    tour = TEXT.partition("## A tour of the rooms")[2].partition("\n## ")[0]
    lines = [line.split("|")[1:-1] for line in tour.splitlines() if line.startswith("| `")]
    cells = [(re.findall(r"`([\w/]+)`", rooms), re.findall(r"`([\w/.]+)`", named)) for rooms, _, named in lines]
    return [(rooms, door) for rooms, named in cells for door in named]


def test_every_door_is_in_its_room() -> None:
    assert len(doors()) > 15
    for rooms, door in doors():
        places = [base / room / door for room in rooms for base in (ROOT, ROOT / "dynslam_bench")]
        assert any(place.exists() for place in places), f"there is no {door} in {rooms}"


def test_kernels_are_compiled_in_one_way() -> None:
    users = [file for room in ("dynslam_bench", "envs", "tuning", "reports") for file in (ROOT / room).rglob("*.py")]
    found = [file.relative_to(ROOT) for file in users if re.search(r"\b(njit|jit)\(|@n?jit", file.read_text())]
    assert found == [Path("dynslam_bench/core/compiled.py")]
