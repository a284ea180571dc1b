"""The tables of systems in `docs/baselines.md`, from the specs.

    python tests/trackers/baseline_rows.py

rewrites them; a test compares. A sentence that several systems share is a numbered note; their own follow in a list.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "baselines.md"
BEGIN, END = "<!-- written from the specs -->\n", "<!-- end -->\n"
ORDER = ("own", "faithful-code", "faithful-paper", "inspired", "assumed", "external", "control")
SHARED = 3
"""Systems that make a sentence a note."""


def table() -> str:
    """One row a tracker by provenance and id, the notes that rows share, and what is each one's own."""
    from dynslam_bench.trackers.registry import all_specs

    specs = sorted(all_specs(), key=lambda spec: (ORDER.index(spec.provenance), spec.id))
    uses = Counter(sentence for spec in specs for sentence in spec.assumptions)
    notes = [sentence for sentence, count in uses.items() if count >= SHARED]
    rows = ["| id | provenance | what it does | notes |\n", "| --- | --- | --- | --- |\n"]
    remarks = []
    for spec in specs:
        numbers = ", ".join(str(number) for number, note in enumerate(notes, 1) if note in spec.assumptions)
        rows.append(f"| `{spec.id}` | {spec.provenance} | {spec.summary} | {numbers} |\n")
        sentences = [sentence for sentence in (*spec.assumptions, spec.remarks) if sentence and sentence not in notes]
        if sentences:
            remarks.append(f"- `{spec.id}`: {'; '.join(sentences)}\n")
    numbered = [f"{number}. {note}\n" for number, note in enumerate(notes, 1)]
    parts = (rows, ["Notes:\n"], numbered, ["Assumptions and remarks of single systems:\n"], remarks)
    return "\n".join("".join(part) for part in parts)


def shown(page: str) -> str:
    """The tables as a page has them."""
    return page.partition(BEGIN)[2].partition(END)[0]


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    written, text = table(), PAGE.read_text(encoding="utf-8")
    PAGE.write_text(text.replace(shown(text), written), encoding="utf-8")
