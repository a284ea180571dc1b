"""Records that somebody else made, on a terminal: no escape sequence, no traceback, and the others are shown."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from dynslam_bench.runs import RunSpec, run_many

HOSTILE = "\x1b[2J\x1b]0;owned\x07\u202egnp\n"


@pytest.fixture(scope="module")
def stored(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs, the latest of which holds escape sequences in all of its texts."""
    folder = tmp_path_factory.mktemp("results")
    specs = [RunSpec(tracker="never-move", sequence=str(walk), seed=seed) for seed in (0, 1)]
    _, last = run_many(specs, results=folder)
    path = folder / "runs" / last.run_id / "run.json"
    record = json.loads(path.read_text())
    record |= {"reason": HOSTILE, "notes": [HOSTILE], "command": [HOSTILE], "overrides": {HOSTILE: HOSTILE}}
    record["tracker"] |= {"id": HOSTILE, "label": HOSTILE}
    record["sequence"] |= {"id": HOSTILE}
    path.write_text(json.dumps(record))
    return folder


@pytest.fixture
def results(stored: Path, tmp_path: Path) -> Path:
    return shutil.copytree(stored, tmp_path / "results", symlinks=True)


def hostile_run(results: Path) -> str:
    return next(path.parent.name for path in results.glob("runs/*/run.json") if "owned" in path.read_text())


def harmless(text: str) -> bool:
    return not set(text) & {"\x1b", "\x07", "\u202e"}


@pytest.mark.parametrize("arguments", [("list",), ("show", "RUN"), ("list", "--json"), ("show", "RUN", "--json")])
def test_names_are_shown_as_text(cli, results: Path, arguments: tuple[str, ...]) -> None:
    run = hostile_run(results)
    code, out, err = cli("runs", *[run if word == "RUN" else word for word in arguments], "--results", results)
    assert code == 0 and harmless(out + err) and "owned" in out


def test_errors_are_shown_as_text(cli, results: Path) -> None:
    code, out, err = cli("runs", "show", HOSTILE, "--results", results)
    assert code == 1 and harmless(out + err) and err.startswith("error: there is no run")
    assert err.count("\n") == 1


def test_one_unreadable_record_is_named_and_the_others_are_listed(cli, results: Path) -> None:
    (results / "runs" / hostile_run(results) / "run.json").write_bytes(b"\xff\xfe")
    code, out, err = cli("runs", "list", "--results", results)
    assert code == 0 and "never-move" in out
    assert err.startswith("unreadable: ") and err.count("\n") == 1 and "is not a text file" in err


def test_half_characters_of_the_command_line_end_in_one_line(cli, results: Path) -> None:
    code, _, err = cli("run", "caf\udce9", "synthetic/walking_xyz", "--results", results)
    assert code == 1 and "caf\\udce9" in err and err.count("\n") == 1
