"""Tables: the frames behind them, and the formats that they are written in."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from reports_fake_store import add_run, fill

from dynslam_bench.core.errors import ReportError
from dynslam_bench.reports import build_report, compare
from dynslam_bench.reports.tables.table import (
    Column,
    Table,
    TableCell,
    csv_text,
    emphasise,
    escape_latex,
    to_latex,
    to_markdown,
)
from dynslam_bench.runs.store import RunStore


def test_best_and_second_share_their_marks():
    assert emphasise([3.0, 1.0, 2.0, 1.0, None]) == ["", "best", "second", "best", ""]
    assert emphasise([1.0, None]) == ["", ""]


def test_tables_in_every_format():
    table = Table(
        "t",
        "A & B",
        "50 % of_it.",
        [Column("name", numeric=False), Column("x", "G"), Column("y", "G")],
        [
            [TableCell("a|b_*", tag="imported"), TableCell("0.5", "±0.1", 0.51234, "best"), TableCell()],
            [TableCell("c"), TableCell(), TableCell("2")],
        ],
    )
    assert "| a\\|b\\_\\* (imported) | **0.5** ±0.1 |  |" in to_markdown(table)
    assert csv_text(table.frame()) == "name,G: x,G: y\na|b_* imported,0.51234,\nc,,2\n"
    latex = to_latex(table)
    assert r"\caption{A \& B.}" in latex and r"\multicolumn{2}{c}{G}" in latex
    assert r"a\textbar{}b\_* & \textbf{0.5} &  \\" in latex


def test_a_column_in_which_nothing_is_written_is_in_the_csv_only():
    columns = [Column("tracker", numeric=False), Column("p"), Column("ATE")]
    rows = [[TableCell("a"), TableCell(), TableCell("1.0", value=1.0)]]
    table = Table("t", "Title", "Caption.", columns, rows)
    assert csv_text(table.frame()).splitlines()[0] == "tracker,p,ATE"
    assert "| tracker | ATE |" in to_markdown(table) and " p " not in to_latex(table)
    for others in ([*rows, [TableCell("b"), TableCell("0.04"), TableCell("2.0")]], []):
        assert "| tracker | p | ATE |" in to_markdown(Table("t", "Title", "Caption.", columns, others))


def test_the_page_s_python_goes_as_it_stands(made, monkeypatch):
    pytest.importorskip("matplotlib", reason="pandas draws with it")
    page = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "report.md"
    (text,) = re.findall(r"^```python\n(.*?)^```", page.read_text(), flags=re.S | re.M)
    monkeypatch.chdir(made[0].root.parent)
    names = {}
    exec(compile(text, "docs/how-to/report.md", "exec"), names)
    assert len(names["board"].frame()) == len(names["frame"]) > 5


needs_tex = pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs pdflatex")
NAMES = (
    "ORB-SLAM2 (our back end)",
    'quotes "here" and `there`',
    r"100 % of_it & {\bf $x^2$} #1 ~ \end{table}",
    "émoji 😀 猫",
    "<b>bold</b>",
    "a name that goes on and on until no column of a page could hold it",
)
DOCUMENT = (
    "\\documentclass[twocolumn]{article}\\usepackage{booktabs}\\begin{document}\\input{report.tex}\\end{document}"
)


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    """Six oddly named trackers on five sequences, one of which fails everywhere."""
    root = tmp_path_factory.mktemp("latex")
    store = RunStore(root / "results")
    for number in range(5):
        for place, label in enumerate(NAMES):
            add_run(
                store, f"t{place}", f"synthetic/walking_halfsphere_{number}", label=label, n=40,
                error=0.01 * (1 + place + 0.1 * number), status="crashed" if place == 4 else "ok",
                lost=(5, 6) if place == 1 else (),
            )  # fmt: skip
    return build_report(store, root / "report")


@needs_tex
def test_latex_compiles_and_fits_a_column(odd):
    (odd.latex.parent / "paper.tex").write_text(DOCUMENT)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    subprocess.run(command, cwd=odd.latex.parent, capture_output=True, check=True)
    log = (odd.latex.parent / "paper.log").read_text(errors="replace")
    assert (odd.latex.parent / "paper.pdf").stat().st_size > 10_000
    assert re.findall(r"Overfull \\hbox.*|Missing character.*|LaTeX Warning: Float too large.*", log) == []


def test_captions_are_short_and_name_no_ids(odd):
    text = odd.latex.read_text()
    captions = re.findall(r"\\caption\{(.*)\}", text)
    assert len(captions) > 8
    for caption in captions:
        assert len(caption) < 140 and "tum-rgbd/v1" in caption and not re.search(r"[0-9a-f]{12}", caption), caption
    assert "synthetic/" not in text and text.count(r"\begin{table}") == len(captions)
    assert r"$^*$\,our back end" in text


def test_latex_stands_in_blocks_and_floats():
    names = [Column("tracker", numeric=False), *(Column(f"walking_xyz_{i}", "high dynamic") for i in range(12))]
    rows = [[TableCell(f"t{i}"), *(TableCell(f"{10 * i + j}.5") for j in range(12))] for i in range(15)]
    text = to_latex(Table("t", "T", "long", names, rows), "p")
    assert text.count(r"\begin{tabular}") > text.count(r"\caption{T, protocol p") > 1
    assert sorted(re.findall(r"(\d+\.5)", text)) == sorted(f"{10 * i + j}.5" for i in range(15) for j in range(12))


def test_no_name_is_more_than_a_name():
    assert escape_latex("a\nb\x00c") == "a b c"
    assert escape_latex("😀 é 猫 “q”") == "[U+1F600] é [U+732B] ``q''"
    cells = [
        [TableCell("=HYPERLINK(1)"), TableCell("-1.5", value=-1.5)], [TableCell("@x"), TableCell("+2")],
        [TableCell("\x1b[2J\u202e"), TableCell()],
    ]  # fmt: skip
    table = Table("t", "a\n# b", "c\n\n# d <i>", [Column("=1+1", numeric=False), Column("y")], cells)
    assert csv_text(table.frame()).splitlines() == ["'=1+1,y", "'=HYPERLINK(1),-1.5", "'@x,'+2", "\\x1b[2J\\u202e,"]
    markdown = to_markdown(table)
    assert "## a # b" in markdown and "\nc # d &lt;i>" in markdown
    assert not set(markdown + to_latex(table)) & {"\x1b", "\u202e"}


def test_compare_finds_what_changed(made, tmp_path):
    store, paths = made
    walking = ["synthetic/walking_xyz", "synthetic/walking_rpy"]
    better = fill(tmp_path / "b", {"orb-slam2": 0.10, "mask-rcnn": 0.002}, walking, seeds=(0, 1))
    comparison = compare(store, better)
    changed, same = (comparison.overall[f"{name} (our back end)"] for name in ("Mask R-CNN", "ORB-SLAM2"))
    assert changed.value == pytest.approx(0.1, rel=0.1) and same.value == pytest.approx(1.0)
    assert np.isnan(changed.high)  # two sequences give no interval
    verdicts = {row[0].text: row[5].text for row in comparison.table.rows if row[1].text.startswith("all ")}
    assert verdicts["Mask R-CNN (our back end)"] == "B better on 2 of 2, too few to tell"
    assert verdicts["ORB-SLAM2 (our back end)"] == "equal"
    assert (comparison.only_a, comparison.only_b) == (8 + 8 + 1 + 3 * 4, 0)
    itself = compare(paths.data.parent, paths.data).overall
    assert len(itself) == 6 and all(interval.value == 1 for interval in itself.values())
    assert "| Mask R-CNN (our back end) | all 2 sequences |" in to_markdown(comparison.table)


def test_compare_refuses_what_has_nothing_in_common(made, tmp_path):
    store, _ = made
    other = RunStore(tmp_path / "b")
    add_run(other, "new-tracker", "s/a")
    with pytest.raises(ReportError, match=r"\(41 runs\) and .* \(1 runs\) have no tracker and sequence in common"):
        compare(store, other)


def test_compare_pairs_runs_of_different_settings_and_says_what_differs(tmp_path):
    before, after = RunStore(tmp_path / "a"), RunStore(tmp_path / "b")
    for name in [f"s/{i}" for i in range(6)]:
        add_run(before, "ours", name, error=0.05, overrides={"epipolar.threshold_px": 1.0})
        add_run(after, "ours", name, error=0.02, overrides={"epipolar.threshold_px": 2.0})
        add_run(before, "same", name)
        add_run(after, "same", name)
    found = compare(before, after)
    name = "ours · epipolar.threshold_px=1.0 → ours · epipolar.threshold_px=2.0"
    assert found.differences == {name: ["epipolar.threshold_px: 1.0 in A, 2.0 in B"], "same": []}
    assert found.overall.keys() == found.differences.keys() and found.overall[name].high < 1
    assert (found.only_a, found.only_b) == (0, 0) and "What differs" in found.table.caption
    verdicts = {cells[0].text: cells[5].text for cells in found.table.rows if cells[1].text.startswith("all ")}
    assert verdicts[name] == "better"


def test_compare_takes_the_nearest_settings_and_leaves_the_rest(tmp_path):
    before, after = RunStore(tmp_path / "a"), RunStore(tmp_path / "b")
    add_run(before, "ours", "s/a")
    for seed in (0, 1):
        add_run(after, "ours", "s/a", seed, overrides={"x": 1})
    add_run(after, "ours", "s/a", overrides={"x": 1, "y": 2})
    found = compare(before, after)
    assert list(found.differences.values()) == [["x: default in A, 1 in B"]]
    assert (found.only_a, found.only_b) == (0, 1)
    assert found.table.rows[0][-1].text == "1 + 1", "of the repeats that both have"
