"""Measured tables lie in `docs/results/`, each with its command, commit, date, machine and data."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest
from documented_names import ROOT
from prose import tables, user_pages

SCRIPT = ROOT / "tests" / "benchmarks" / "results.py"
RESULTS = sorted({*(ROOT / "docs" / "results").glob("*.md")} - {ROOT / "docs" / "results" / "README.md"})

SIGN = r"[\d.,±+~<>/()\[\];:\s-]"
UNIT = r"(?<![A-Za-z])(?:mm|cm|m|ms|s|%|MB|px|fps)(?![A-Za-z])"
NUMBERS = re.compile(rf"(?:{SIGN}|{UNIT}|\bto\b|\bx\b)*")
FIGURE = re.compile(rf"\d\.\d|\d ?{UNIT}|±")


def is_figure(cell: str) -> bool:
    """Whether a cell is a number with a fraction or a unit, or several, and nothing else."""
    plain = cell.replace("*", "")
    return NUMBERS.fullmatch(plain) is not None and FIGURE.search(plain) is not None


def measured(text: str) -> list[str]:
    """The headers of a page's tables in which two cells or more are figures."""
    return [
        " | ".join(table[0]) for table in tables(text) if sum(is_figure(cell) for row in table[1:] for cell in row) >= 2
    ]


@pytest.mark.parametrize("page", user_pages(), ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_outside_of_results_holds_no_measured_table(page: Path) -> None:
    if page not in RESULTS:
        assert measured(page.read_text(encoding="utf-8")) == [], "move it: docs/results/README.md"


def test_measured_tables_are_told_from_others() -> None:
    errors = "| sequence | ATE mm |\n| --- | --- |\n| fr1_xyz | **4.94** ± 0.07 |\n| fr1_rpy | 5.92 [5.1 - 6.2] |\n"
    assert measured(errors) == ["sequence | ATE mm"]
    assert measured("| system | share |\n| --- | --- |\n| a | 31 % |\n| b | 5 % |\n") == ["system | share"]
    ids = "| ids | frames |\n| --- | --- |\n| `loop_room`: laps of 21 m at 0.45 m/s | 2400 |\n| `fast_desk` | 600 |\n"
    assert measured(ids) == []
    ranges = (
        "| status | when |\n| --- | --- |\n| `timeout` | no frame within 120 s |\n| `lost` | below 0.02 s apart |\n"
    )
    assert measured(ranges) == []


@pytest.mark.parametrize("page", RESULTS, ids=lambda page: page.stem)
def test_every_table_says_how_it_was_made(page: Path) -> None:
    spec = importlib.util.spec_from_file_location("results", SCRIPT)
    assert spec is not None and spec.loader is not None
    results = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(results)
    text = page.read_text(encoding="utf-8")
    sections = results.sections(text)
    assert sections and measured(text.partition("\n## ")[0]) == [], "a table above the first section"
    for title, section in sections.items():
        block, made = results.COMMANDS.search(section), results.MADE.search(section)
        assert block is not None and made is not None, title
        assert section.index(block[0]) < section.index(made[0]), title
        assert re.search(r"^(?:\||```text)", section[section.index(made[0]) :], re.MULTILINE), title
        scripts = re.findall(r"tests/benchmarks/\w+\.py", block[1])
        assert [script for script in scripts if not (ROOT / script).exists()] == [], title


def test_a_section_is_made_of_what_its_command_prints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = importlib.util.spec_from_file_location("results", SCRIPT)
    assert spec is not None and spec.loader is not None
    results = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(results)
    section = "## Sums\n\nA sum.\n\n```bash\nprintf '| a |\\n| --- |\\n| %s |\\n' $((2 + 3))\n```\n\n"
    made = results.remade(section, "none")
    assert made.startswith(section) and made.endswith("data: none.*\n\n| a |\n| --- |\n| 5 |\n\n")
    again = results.remade(made.replace("| 5 |", "| 7 |\n\nRemarks on 7."))
    assert again == made and results.sections("# T\n\nx\n\n" + made) == {"Sums": made}
    with pytest.raises(SystemExit, match="--data"):
        results.remade(section)
