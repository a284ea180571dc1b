"""Quotes of a board for a paper or a post: a sentence, a LaTeX table that fits a column, and BibTeX entries."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

import dynslam_bench
from dynslam_bench.core.number_text import mm
from dynslam_bench.evaluation import Protocol
from dynslam_bench.reports.model.answers import limits, typical_error
from dynslam_bench.reports.model.board import Board
from dynslam_bench.reports.tables.table import (
    Table,
    TableCell,
    escape_latex,
    numbers,
    texts,
    to_latex,
)

_YEAR = re.compile(r"\b(?:19|20)\d\d\b")


def quotes(
    board: Board, protocol: Protocol, sentences: Sequence[str], columns: Mapping[str, Sequence[str]]
) -> dict[str, str]:
    """Heading to text of what can be quoted of a board.

    Args:
        board: The board.
        protocol: How errors were computed.
        sentences: What the board says in millimetres, and its verdict.
        columns: Heading of each column of errors to its sequences.
    """
    made = f"Computed with dynslam-bench {dynslam_bench.__version__}, protocol {protocol.id} [{protocol.digest()}]."
    sentence = " ".join(filter(None, [*sentences, limits(board), made]))
    return {
        "Sentence": sentence,
        "LaTeX table": to_latex(error_table(board, columns), protocol.id).strip(),
        "BibTeX": bibtex(board),
    }


def error_table(board: Board, columns: Mapping[str, Sequence[str]]) -> Table:
    """The trackers with their typical errors in millimetres, and how many of their runs succeeded."""
    rows = []
    for key in [*board.trackers, *board.final_only]:
        cells = [TableCell(board.names[key])]
        for names in columns.values():
            error_m = typical_error(board, key, names).median_m
            cells.append(TableCell("–" if error_m is None else mm(error_m), value=error_m))
        runs = board.runs(key)
        cells.append(TableCell(f"{sum(not row.failed for row in runs)}/{len(runs)}"))
        rows.append(cells)
    headings = [*texts("tracker"), *numbers(*columns, "succeeded")]
    brief = "Median absolute trajectory error over sequences, in mm"
    muted = board.unranked_rows([*board.trackers, *board.final_only])
    return Table("quote", "Errors", brief, headings, rows, muted, brief=brief)


def bibtex(board: Board) -> str:
    """An entry for this tool, and one for everything that the trackers and sequences of a board ask to cite."""
    version = escape_latex(dynslam_bench.__version__)
    entries = [
        "@software{dynslam-bench,\n"
        "  title = {dynslam-bench: a Gymnasium benchmarking and tuning toolkit for visual SLAM in dynamic scenes},\n"
        "  author = {{dynslam-bench contributors}},\n"
        f"  version = {{{version}}}\n"
        "}"
    ]
    firsts = [board.first(key) for key in [*board.trackers, *board.final_only]]
    cited = [(row.tracker.id, row.tracker.citation) for row in firsts]
    cited += [(row.sequence.id.partition("/")[0], row.sequence.citation) for row in board.rows]
    for citation, key in _first_keys(cited).items():
        year = _YEAR.search(citation)
        lines = [f"  note = {{{escape_latex(citation)}}}"]
        if year is not None:
            lines.append(f"  year = {{{year[0]}}}")
        body = ",\n".join(lines)
        entries.append(f"@misc{{{key},\n{body}\n}}")
    return "\n\n".join(entries)


def _first_keys(cited: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Citation to a key that no other has, of everything that has a citation."""
    keys: dict[str, str] = {}
    for name, citation in cited:
        if not citation or citation in keys:
            continue
        plain = re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-") or "cited"
        key = plain
        number = 2
        while key in keys.values():
            key = f"{plain}-{number}"
            number += 1
        keys[citation] = key
    return keys
