"""The LaTeX of a report compiles and fits a column, whatever the trackers are called; CSV and Markdown are harmless."""

import csv
import re
import shutil
import subprocess

import pytest
from reports_fake_store import add_run

from dynslam_bench.reports import build_report
from dynslam_bench.reports.tables.table import Column, Table, TableCell, escape_latex, to_csv, to_latex, to_markdown
from dynslam_bench.runs.store import RunStore

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
def made(tmp_path_factory):
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
def test_latex_compiles_and_fits_a_column(made):
    (made.latex.parent / "paper.tex").write_text(DOCUMENT)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    told = subprocess.run(command, cwd=made.latex.parent, capture_output=True, check=False)
    log = (made.latex.parent / "paper.log").read_text(errors="replace")
    assert told.returncode == 0, log[-2000:]
    assert (made.latex.parent / "paper.pdf").stat().st_size > 10_000
    assert re.findall(r"Overfull \\hbox.*", log) == []
    assert re.findall(r"Missing character.*|LaTeX Warning: Float too large.*", log) == []


def test_captions_are_short_and_name_no_ids(made):
    text = made.latex.read_text()
    captions = re.findall(r"\\caption\{(.*)\}", text)
    assert len(captions) > 8
    for caption in captions:
        assert len(caption) < 140 and re.search(r"[0-9a-f]{12}", caption) is None, caption
        assert "tum-rgbd/v1" in caption
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
    cells = [[TableCell("=HYPERLINK(1)"), TableCell("-1.5", value=-1.5)], [TableCell("@x"), TableCell("+2")]]
    table = Table("t", "a\n# b", "c\n\n# d <i>", [Column("=1+1", numeric=False), Column("y")], cells)
    assert to_csv(table).splitlines() == ["'=1+1,y", "'=HYPERLINK(1),-1.5", "'@x,'+2"]
    markdown = to_markdown(table)
    assert "## a # b" in markdown and "\nc # d &lt;i>" in markdown


def test_a_spreadsheet_takes_no_name_for_a_formula(store, tmp_path):
    for label in ("=cmd|' /C calc'!A0", "+1", "@sum", "-2+3", "\x1b[2J\u202e"):
        add_run(store, f"t{label}", "s/a", label=label, n=40)
    paths = build_report(store, tmp_path / "report", title="one\n# two\n<script>")
    cells = [cell for path in paths.csv.values() for line in csv.reader(path.open()) for cell in line]
    assert sum(cell.startswith("'") for cell in cells) >= 16
    for cell in cells:
        assert not cell.startswith(("=", "+", "@")) and (cell[:1] != "-" or float(cell) < 0), cell
    assert paths.markdown.read_text().startswith("# one # two &lt;script>\n")
    for path in (*paths.csv.values(), paths.markdown, paths.latex):
        assert not set(path.read_text()) & {"\x1b", "\u202e"}, path
