"""Records that somebody else made, on a terminal: no escape sequence, no traceback, and the others are shown."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

FIXTURE = Path(__file__).resolve().parents[1] / "fixtures" / "before_rebuild" / "results"
HOSTILE = "\x1b[2J\x1b]0;owned\x07\u202egnp\n"


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Two runs, one of which names itself and all it knows by escape sequences."""
    folder = shutil.copytree(FIXTURE, tmp_path / "results")
    path = folder / "runs" / "a7abe04996a79cc4" / "run.json"
    record = json.loads(path.read_text())
    record |= {"reason": HOSTILE, "notes": [HOSTILE], "command": [HOSTILE], "overrides": {HOSTILE: HOSTILE}}
    record["tracker"] |= {"id": HOSTILE, "label": HOSTILE}
    record["sequence"] |= {"id": HOSTILE}
    path.write_text(json.dumps(record))
    return folder


def harmless(text: str) -> bool:
    return not set(text) & {"\x1b", "\x07", "\u202e"}


@pytest.mark.parametrize("arguments", [("list",), ("show", "a7ab"), ("list", "--json"), ("show", "a7ab", "--json")])
def test_names_are_shown_as_text(cli, results: Path, arguments: tuple[str, ...]) -> None:
    code, out, err = cli("runs", *arguments, "--results", results)
    assert code == 0 and harmless(out + err) and "owned" in out


def test_errors_are_shown_as_text(cli, results: Path) -> None:
    code, out, err = cli("runs", "show", HOSTILE, "--results", results)
    assert code == 1 and harmless(out + err) and err.startswith("error: there is no run")
    assert err.count("\n") == 1


def test_one_unreadable_record_is_named_and_the_others_are_listed(cli, results: Path) -> None:
    (results / "runs" / "a7abe04996a79cc4" / "run.json").write_bytes(b"\xff\xfe")
    code, out, err = cli("runs", "list", "--results", results)
    assert code == 0 and "e7f8d4df9db4bb16" in out
    assert err.startswith("unreadable: ") and err.count("\n") == 1 and "is not a text file" in err


def test_half_characters_of_the_command_line_end_in_one_line(cli, results: Path) -> None:
    code, _, err = cli("run", "caf\udce9", "synthetic/walking_xyz", "--results", results)
    assert code == 1 and "caf\\udce9" in err and err.count("\n") == 1
