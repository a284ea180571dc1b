"""The pages' blocks of code: Python is run as it stands but for the lengths of sequences, TOML is read by readers."""

import ast
import contextlib
import doctest
import importlib
import io
import re
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers.documented_names import PAGES, ROOT, sources

from dynslam_bench.cli.app import start
from dynslam_bench.core.settings import flatten
from dynslam_bench.core.toml import parse_toml
from dynslam_bench.gate import load_gate
from dynslam_bench.sequences.cameras import read_camera
from dynslam_bench.sequences.synthetic.sealed import parse_salt, sealed_scene
from dynslam_bench.suites import load_suite
from dynslam_bench.testing.template import write_tracker_template
from dynslam_bench.trackers import TRACKERS
from dynslam_bench.tuning import read_study

pytestmark = pytest.mark.slow

SHORTER = {
    "frames=(0, 60)": "frames=(0, 4)",
    "frames=[0, 150]": "frames=[0, 4]",
    "offset=n) for n in range(3)": "offset=n, frames=(0, 4)) for n in range(2)",
    '"bonn/crowd",\n    frames="0:300"': '"synthetic/walking_xyz?frames=4",\n    frames="0:3"',
    "?scene=3&frames=150": "?scene=3&frames=4",
    "[40]": "[2]",
    "(40)": "(2)",
    '"synthetic/walking_xyz", cache_root': '"synthetic/walking_xyz?frames=2", cache_root',
}
"""What stands in the pages, and what is run in its place."""
RUN = {
    "README.md": 2,
    "docs/how-to/agent.md": 1,
    "docs/how-to/export.md": 1,
    "docs/how-to/pandas.md": 2,
    "docs/how-to/recording.md": 1,
    "docs/how-to/suite.md": 1,
    "docs/how-to/trajectory.md": 1,
    "docs/reference/environments.md": 2,
    "docs/reference/rendered.md": 1,
}
"""Pages, and how many of their first Python blocks are run here, one after the other in one namespace."""
A_RUN = (
    "from dynslam_bench.runs import RunSpec, run_many\n"
    "run_many([RunSpec(tracker='never-move', sequence='synthetic/walking_xyz', frames=(0, 4))])"
)
BEFORE = {"docs/how-to/export.md": A_RUN, "docs/how-to/pandas.md": A_RUN}
"""What a reader has done already: a run is stored."""
WITH_OUTPUT = {
    "docs/how-to/trajectory.md": "",
    "docs/tutorials/study.md": "mine.toml",
    "docs/tutorials/tracker.md": "",
}
"""Pages that show what commands print, and the file that their block of TOML is."""
ELSEWHERE = {
    "docs/how-to/dataset.md": (1, "tests/trackers/adapters/test_adapter_controls.py"),
    "docs/how-to/gate.md": (1, "tests/docs/test_snippets.py"),
    "docs/how-to/round.md": (1, "tests/docs/test_snippets.py"),
    "docs/how-to/filter.md": (2, "tests/trackers/adapters/test_adapter_controls.py"),
    "docs/how-to/program.md": (1, "tests/trackers/adapters/test_adapter_controls.py"),
    "docs/how-to/segmenter.md": (2, "tests/trackers/adapters/test_adapter_controls.py"),
    "docs/reference/plugins.md": (1, "tests/trackers/adapters/test_adapter_controls.py"),
    "docs/how-to/report.md": (1, "tests/reports/test_reports_build.py"),
    "docs/how-to/study.md": (2, "tests/tuning/test_studies.py"),
}
"""Pages with blocks of Python that another test runs, how many, and which."""


def blocks(page: Path | str, language: str = "python") -> list[str]:
    return re.findall(
        rf"^```{language}\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), flags=re.S | re.M
    )


def test_every_block_of_python_is_run_by_some_test() -> None:
    held = {str(page.relative_to(ROOT)): len(blocks(page)) for page in PAGES if blocks(page)}
    assert held == {
        page: RUN.get(page, 0) + ELSEWHERE.get(page, (0, ""))[0] for page in {*RUN, *ELSEWHERE}
    }
    for page, (_, test) in ELSEWHERE.items():
        assert Path(page).name in (ROOT / test).read_text(), f"{test} does not read {page}"


@pytest.mark.parametrize("page", RUN)
def test_a_page_s_python_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"cache_root": tmp_path}
    for text in [BEFORE.get(page, ""), *blocks(page)[: RUN[page]]]:
        for long, short in SHORTER.items():
            text = text.replace(long, short)
        exec(compile(text, page, "exec"), names)
    assert len(names) > 3, "it did something"


def outputs(page: str, language: str) -> list[tuple[str, str]]:
    """The blocks of a page that a block of text follows, each with that text."""
    return re.findall(
        rf"^```{language}\n([^`]*?)^```\n\n```text\n(.*?)^```",
        (ROOT / page).read_text(encoding="utf-8"),
        flags=re.S | re.M,
    )


def test_pages_that_show_outputs_are_compared() -> None:
    shown = {
        str(page.relative_to(ROOT))
        for page in PAGES
        if outputs(str(page), "bash") or outputs(str(page), "python")
    }
    assert shown == set(WITH_OUTPUT)


@pytest.mark.parametrize("page", WITH_OUTPUT)
def test_commands_print_what_the_page_shows(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    for code, shown in outputs(page, "python"):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, page, "exec"), {})
        assert printed.getvalue() == shown
    if WITH_OUTPUT[page]:
        Path(WITH_OUTPUT[page]).write_text(blocks(page, "toml")[0])
    for commands, shown in outputs(page, "bash"):
        lines = [shlex.split(line, comments=True) for line in commands.splitlines()]
        assert {line[0] for line in lines} == {"dynslam-bench"}
        printed = ""
        for line in lines:
            with pytest.raises(SystemExit) as ended:
                start(line[1:])
            told = capsys.readouterr()
            assert not ended.value.code, told.err
            printed += told.out
        options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
        assert doctest.OutputChecker().check_output(shown, printed, options), printed


def only_toml(page: str, folder: Path) -> Path:
    """A file with the one block of TOML of a page."""
    (text,) = blocks(page, "toml")
    (folder / "mine.toml").write_text(text)
    return folder / "mine.toml"


def test_the_suite_on_the_page_is_one(tmp_path: Path) -> None:
    suite = load_suite(only_toml("docs/how-to/suite.md", tmp_path))
    trackers = {"orb-slam2", "emfoa-oft", "never-move"}
    specs = list(suite.specs(trackers=tuple(sorted(trackers))))
    assert len(specs) == 4 * 2 * 2 * 3, (
        "three trackers and a row, two sequences, two variants, three offsets"
    )
    assert {spec.tracker for spec in specs} == trackers


def test_the_gate_s_fixture_on_the_page_is_used_as_it_says() -> None:
    names: dict[str, Any] = {}
    exec(compile(blocks("docs/how-to/gate.md")[0], "gate.md", "exec"), names)
    names["test_gate"](SimpleNamespace(rounds=1))
    with pytest.raises(AssertionError):
        names["test_gate"](SimpleNamespace(rounds=0))


def test_the_sealed_scene_is_derived_as_the_page_says() -> None:
    names: dict[str, Any] = {"salt": "00" * 31 + "2a"}
    exec(compile(blocks("docs/how-to/round.md")[0], "round.md", "exec"), names)
    salt = parse_salt(names["salt"])
    assert names["scene"] == sealed_scene(salt, "2026a", "walking_xyz", 17)


def test_the_gate_on_the_page_is_one(tmp_path: Path) -> None:
    gate = load_gate(only_toml("docs/how-to/gate.md", tmp_path))
    assert len(gate.cases()) == 2
    assert len(gate.cases(confirm=True)) == 1


@pytest.mark.parametrize("page", ["docs/how-to/study.md", "docs/tutorials/study.md"])
def test_the_studies_on_the_pages_are_some(page: str, tmp_path: Path) -> None:
    # further blocks are parts of a study
    (tmp_path / "mine.toml").write_text(blocks(page, "toml")[0])
    spec = read_study(tmp_path / "mine.toml")
    settings = flatten(TRACKERS.get(spec.tracker).settings())
    assert spec.instances(*spec.tune)
    assert spec.instances(*spec.held_out)
    assert spec.space.include
    for pattern in (*spec.space.include, *spec.space.fixed):
        assert any(name.startswith(pattern.rstrip("*")) for name in settings), pattern


def test_the_camera_on_the_page_is_one(tmp_path: Path) -> None:
    assert read_camera(only_toml("docs/how-to/recording.md", tmp_path)).fx == 535.4


def test_the_entry_point_on_the_page_is_of_a_group_that_is_read() -> None:
    (text,) = blocks("docs/reference/plugins.md", "toml")
    (group,) = parse_toml(text, "docs/reference/plugins.md")["project"]["entry-points"]
    assert group == f"dynslam_bench.{TRACKERS.kind}"


# The examples in docstrings are true.


def module_of(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(
        parts if parts[0] == "dynslam_bench" else ("dynslam_bench", *parts)
    ).removesuffix(".__init__")


WITH_EXAMPLES = [
    module_of(file) for file in sources() if ">>> " in file.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples_give_what_they_say(name: str) -> None:
    outcome = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert outcome.attempted > 0
    assert outcome.failed == 0


# What the pages and the template of a new tracker import from this package: contracts, settings and
# errors.


PLUGIN_PAGES = (
    "reference/plugins.md",
    "how-to/dataset.md",
    "how-to/filter.md",
    "how-to/segmenter.md",
)
OPEN = {"dynslam_bench.contracts", "dynslam_bench.core.settings", "dynslam_bench.core.errors"}
COMPOSING = "dynslam_bench.trackers.systems.composition"
"""Puts filters on our back end: the one thing that a plug-in may take from us that is no contract."""

RULES = "dynslam_bench.culling.semantic"
"""The filter that an own one is put beside."""


def imports(code: str) -> list[tuple[str, str]]:
    """Module and name of everything that a text takes from this package."""
    return [
        (node.module, alias.name)
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("dynslam_bench")
        for alias in node.names
    ]


def test_plug_ins_import_from_the_contracts_only(tmp_path: Path) -> None:
    page = "\n".join((ROOT / "docs" / page).read_text(encoding="utf-8") for page in PLUGIN_PAGES)
    taken = [
        pair
        for text in re.findall(r"^```python\n(.*?)^```", page, flags=re.S | re.M)
        for pair in imports(text)
    ]
    assert len(taken) > 10
    assert {module for module, _ in taken} <= OPEN | {COMPOSING, RULES}
    template = imports(write_tracker_template("my-slam", tmp_path).read_text())
    assert ("dynslam_bench.contracts", "TrackerSpec") in template
    assert {module for module, _ in template} <= OPEN
