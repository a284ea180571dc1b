"""Tables: the frames behind them, and the formats that they are written in."""

import re
from pathlib import Path

import pytest

from dynslam_bench.reports.tables.table import Column, Table, TableCell, emphasise, to_csv, to_latex, to_markdown


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
    assert to_csv(table) == "name,G: x,G: y\na|b_* imported,0.51234,\nc,,2\n"
    latex = to_latex(table)
    assert r"\caption{A \& B.}" in latex
    assert r"\multicolumn{2}{c}{G}" in to_latex(
        Table("t", "t", "", table.columns, [[*table.rows[0][:2], TableCell("1")]])
    )
    assert r"a\textbar{}b\_* & \textbf{0.5} &  \\" in latex


def test_a_column_in_which_nothing_is_written_is_in_the_csv_only():
    columns = [Column("tracker", numeric=False), Column("p"), Column("ATE")]
    rows = [[TableCell("a"), TableCell(), TableCell("1.0", value=1.0)]]
    table = Table("t", "Title", "Caption.", columns, rows)
    assert to_csv(table).splitlines()[0] == "tracker,p,ATE"
    assert "| tracker | ATE |" in to_markdown(table) and " p " not in to_latex(table)
    full = Table("t", "Title", "Caption.", columns, [*rows, [TableCell("b"), TableCell("0.04"), TableCell("2.0")]])
    assert "| tracker | p | ATE |" in to_markdown(full)
    assert "| tracker | p | ATE |" in to_markdown(Table("t", "Title", "Caption.", columns, []))


def test_the_page_s_python_goes_as_it_stands(made, monkeypatch):
    pytest.importorskip("matplotlib", reason="pandas draws with it")
    page = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "report.md"
    (text,) = re.findall(r"^```python\n(.*?)^```", page.read_text(), flags=re.S | re.M)
    monkeypatch.chdir(made[0].root.parent)
    names = {}
    exec(compile(text, "docs/how-to/report.md", "exec"), names)
    assert len(names["board"].frame()) == len(names["frame"]) > 5
