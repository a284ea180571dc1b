"""Every command line that the README and the docs print is one that the program takes."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer.main

from dynslam_bench.cli.app import app, expand_lists
from dynslam_bench.sequences.catalogue import entry_of
from dynslam_bench.trackers import TRACKERS

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MADE_UP = ("path/", "./", "/", "grey/")
"""How names begin that stand for a reader's own files and plug-ins."""


def documented() -> list[str]:
    """The program's command lines in the fenced blocks of all pages, without comments."""
    lines = []
    for page in PAGES:
        for block in re.findall(r"^```bash\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
            joined = block.replace("\\\n", " ")
            lines += [line for line in joined.splitlines() if line.startswith("dynslam-bench ")]
    return lines


@pytest.mark.parametrize("line", documented())
def test_the_documented_command_parses(line: str) -> None:
    words = expand_lists(shlex.split(line, comments=True)[1:])
    command: Any = typer.main.get_command(app)
    assert command.commands, "the command line has no verbs"
    while commands := getattr(command, "commands", None):  # a group, of whichever click typer brings
        name = words.pop(0) if words and words[0] in commands else "make"  # the default verb of `DefaultGroup`
        assert name in commands, f"there is no '{words[:1]}' below '{command.name}'"
        command = commands[name]
    context = command.make_context(command.name, words, resilient_parsing=False)
    if command.name == "run" and "tracker" in context.params:
        tracker = context.params["tracker"]
        assert ":" in tracker or tracker in {entry.spec.id for entry in TRACKERS.all()}, f"no tracker '{tracker}'"
        for sequence in context.params["sequences"]:
            assert sequence.startswith(("synthetic/", *MADE_UP)) or entry_of(sequence) is not None, sequence
