"""Terminals that cannot show every character: output with question marks, and no traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

LABEL = "caf\xe9 \u2013 \U0001f600"


@pytest.fixture(scope="module")
def results(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    truth = walk / "groundtruth.txt"
    done = program(
        "import", truth, "--tracker", "theirs", "--label", LABEL, "--sequence", walk, "--online", "--results", folder
    )
    assert done.returncode == 0, done.stderr
    return folder


def program(*arguments: object, **environment: str) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "dynslam_bench", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, env={**os.environ, **environment}, check=False)


ENCODINGS = {
    "latin-1": {"PYTHONIOENCODING": "latin-1"},
    "ascii": {"PYTHONIOENCODING": "ascii"},
    "C": {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_report_is_shown_on_every_terminal(encoding: str, results: Path, tmp_path: Path) -> None:
    done = program("report", results, "-o", tmp_path, **ENCODINGS[encoding])
    assert done.returncode == 0 and not done.stderr
    assert "caf" in done.stdout.decode("latin-1") and b"?" in done.stdout
    assert LABEL in (tmp_path / "report.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("arguments", "code"), [(("--help",), 0), (("run", "nobody", "nowhere\u2013"), 1)])
def test_help_and_errors_are_shown_too(arguments: tuple[str, ...], code: int) -> None:
    done = program(*arguments, **ENCODINGS["ascii"])
    assert done.returncode == code and b"Traceback" not in done.stderr and (done.stdout or done.stderr)
