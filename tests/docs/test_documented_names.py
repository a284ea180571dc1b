"""What pages and docstrings name exists: files, settings, symbols, options, ids, links; made pages are not stale."""

import re
import shlex
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.main
from helpers.documented_names import (
    ROOT,
    SUFFIXES,
    Mention,
    exists,
    in_docstrings,
    in_pages,
    words,
)

from dynslam_bench.cli.app import app, expand_lists
from dynslam_bench.core.settings import field_names
from dynslam_bench.sequences.catalogue import entry_of
from dynslam_bench.testing.pytest_plugin import OPTIONS as CHECKED_KINDS
from dynslam_bench.trackers import TRACKERS

sys.path.insert(0, str(ROOT / ".ci" / "site"))

OF_USERS = ("results/", "path/", "~/", "videos/")
"""How paths begin that are made by runs or by the reader."""
FOREIGN = {
    "NUMBA_CACHE_LOCATOR_CLASSES",
    "_CacheLocator",
    "PR_SET_PDEATHSIG",
    "PR_SET_CHILD_SUBREAPER",
    "isInFrustum",
    "TrackLocalMap",
    "TrackWithMotionModel",
    "concurrent",
    "pd",
    "forkserver",
    "NUMBA_CACHE_DIR",
    "onnx",
    "MergeLocal",
    "ModelProto",
    "NeedNewKeyFrame",
    "TensorShapeProto",
    "TypeProto",
    "GraphProto",
    "ValueInfoProto",
    "Dimension",
    "PGPASSWORD",
    "run_grpc_proxy_server",
}
"""First parts of names that belong to other libraries and that our code never spells."""
FOREIGN_OPTIONS = {"--help", "--extra-index-url", "--no-deps", "--fixed_delta"}
"""Options of the help, of pip, and of the TUM benchmark's scripts."""
POSE = re.compile(r"[TR]_[a-z]+_[a-z]+")
"""Poses by their frames of reference; the notation, not a variable."""


@cache
def mentions() -> list[Mention]:
    """Mentions of all pages and docstrings; read when a test asks, not by every process that collects."""
    return [*in_pages(), *in_docstrings()]


@cache
def setting_names() -> frozenset[str]:
    """Dotted names of all settings of all trackers, and of every group of them."""
    names = {name for tracker in TRACKERS.all() for name in field_names(tracker.spec.settings)}
    return frozenset(names | {name.rpartition(".")[0] for name in names})


@cache
def program() -> Any:
    return typer.main.get_command(app)


@cache
def options() -> frozenset[str]:
    """Every option of every verb, and those that the benchmark scripts take."""
    found = set(FOREIGN_OPTIONS) | {f"--dynslam-{kind}" for kind in CHECKED_KINDS}
    waiting = [program()]
    while waiting:
        command = waiting.pop()
        found.update(
            name for taken in command.params for name in (*taken.opts, *taken.secondary_opts)
        )
        waiting += getattr(command, "commands", {}).values()
    scripts = Path(__file__).resolve().parents[1] / "benchmarks"
    return frozenset(
        found.union(
            *(re.findall(r'"(--[a-z-]+)"', file.read_text()) for file in scripts.glob("*.py"))
        )
    )


def missing(named: list[Mention], known: object) -> list[str]:
    assert named, "nothing was looked at"
    return sorted(
        {f"{mention.where}: {mention.text}" for mention in named if not known(mention.text)}
    )  # type: ignore[operator]


@pytest.mark.slow
def test_files_and_folders_exist() -> None:
    path = re.compile(r"(?:[\w.-]+/)+(?:[\w.-]+\.(?:py|toml|md|jsonl))?")
    named = [m for m in mentions() if path.fullmatch(m.text) and not m.text.startswith(OF_USERS)]
    assert not missing(
        named, lambda text: exists(text) or (text.endswith("/") and text.strip("/") in words())
    )


def test_settings_exist() -> None:
    groups = {name.partition(".")[0] for name in setting_names() if "." in name}
    dotted = re.compile(r"([a-z_]+(?:\.[a-z0-9_]+)+)(?: ?=.*)?")
    named = [
        Mention(m.where, found.group(1))
        for m in mentions()
        if (found := dotted.fullmatch(m.text))
        and found.group(1).partition(".")[0] in groups
        and not re.search(rf"\.{SUFFIXES}$", found.group(1))
    ]
    assert not missing(named, lambda text: text in setting_names() or _is_symbol(text))


def _is_symbol(text: str) -> bool:
    return exists(text.replace(".", "/") + ".py") or exists(
        text.rpartition(".")[0].replace(".", "/") + ".py"
    )


@pytest.mark.slow
def test_identifiers_exist() -> None:
    identifier = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)(?:\(\))?")
    named = [
        Mention(m.where, found.group(1))
        for m in mentions()
        if (found := identifier.fullmatch(m.text))
    ]
    assert not missing(
        named, lambda text: text in words() | FOREIGN or POSE.fullmatch(text) is not None
    )


def test_options_exist() -> None:
    option = re.compile(r"(?<![\w-])--[a-z][a-z_-]*")
    named = [Mention(m.where, found) for m in mentions() for found in option.findall(m.text)]
    assert not missing(named, lambda text: text in options())


# Every command line that the README and the docs print is one that the program takes.


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MADE_UP = ("path/", "./", "/", "grey/")
"""How names begin that stand for a reader's own files and plug-ins."""


def documented() -> list[str]:
    """The program's command lines in the fenced blocks of all pages, without comments."""
    return [
        line
        for page in PAGES
        for block in re.findall(r"^```bash\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
        for line in block.replace("\\\n", " ").splitlines()
        if line.startswith("dynslam-bench ")
    ]


@pytest.mark.parametrize("line", documented())
def test_the_documented_command_parses(line: str) -> None:
    words = expand_lists(shlex.split(line, comments=True)[1:])
    command = program()
    assert command.commands, "the command line has no verbs"
    # a group, of whichever click typer brings
    while commands := getattr(command, "commands", None):
        # the default verb of `DefaultGroup`
        name = words.pop(0) if words and words[0] in commands else "make"
        assert name in commands, f"there is no '{words[:1]}' below '{command.name}'"
        command = commands[name]
    context = command.make_context(command.name, words, resilient_parsing=False)
    if command.name == "run" and "tracker" in context.params:
        tracker = context.params["tracker"]
        assert ":" in tracker or tracker in {entry.spec.id for entry in TRACKERS.all()}, (
            f"no tracker '{tracker}'"
        )
        for sequence in context.params["sequences"]:
            assert (
                sequence.startswith(("synthetic/", *MADE_UP)) or entry_of(sequence) is not None
            ), sequence


# The reference pages that are made of the code are those that the code makes now, and all links
# between pages hold.


def test_reference_pages_are_those_of_the_code() -> None:
    from generated import reference_pages, schemas

    made = {f"docs/{page}": text for page, text in reference_pages().items()} | schemas()
    stale = [file for file, text in made.items() if (ROOT / file).read_text("utf-8") != text]
    assert stale == [], "write them again: python .ci/site/generated.py"


@pytest.mark.parametrize(
    "page",
    [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")],
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
def test_links_between_files_hold_without_the_site(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.S | re.M)
    links = re.findall(r"\]\((?![a-z]+:|#)([^)#\s]+)", text)
    assert [link for link in links if not (page.parent / link).exists()] == []
