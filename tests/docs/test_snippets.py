"""The pages' Python, run as it stands but for the lengths of sequences."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from documented_names import ROOT

SHORTER = {"frames=(0, 60)": "frames=(0, 4)", "frames=[0, 150]": "frames=[0, 4]"}
RUN = {"README.md": 1, "docs/evaluation.md": 1, "docs/suites.md": 1, "docs/environments.md": 2}
"""Pages, and how many of their blocks are run here: those that need nothing from elsewhere."""


def blocks(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), flags=re.S | re.M)


@pytest.mark.parametrize("page", RUN)
def test_a_page_s_python_runs(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = blocks(page)[: RUN[page]]
    assert len(found) == RUN[page]
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for text in found:
        for long, short in SHORTER.items():
            text = text.replace(long, short)
        exec(compile(text, page, "exec"), names)
    assert capsys.readouterr().out.strip(), "what a page computes it prints"


def test_the_suite_on_the_page_is_one(tmp_path: Path) -> None:
    from dynslam_bench.suites import load_suite

    page = (ROOT / "docs" / "suites.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^```toml\n(.*?)^```", page, flags=re.S | re.M)
    (tmp_path / "mine.toml").write_text(text)
    suite = load_suite(tmp_path / "mine.toml")
    trackers = {"orb-slam2", "emfoa-oft", "never-move"}
    specs = suite.specs(trackers=tuple(sorted(trackers)))
    assert len(specs) == 4 * 2 * 2 * 3, "three trackers and a row, two sequences, two variants, three offsets"
    assert {spec.tracker for spec in specs} == trackers
