"""The table of systems in `docs/baselines.md`, from the specs.

    python tests/trackers/baseline_rows.py

rewrites it; a test compares.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "baselines.md"
HEAD = "| id | provenance | what it does | assumptions and remarks |\n| --- | --- | --- | --- |\n"
ORDER = ("own", "faithful-code", "faithful-paper", "inspired", "assumed", "external", "control")


def table() -> str:
    """Header and one row a tracker, by provenance and id."""
    from dynslam_bench.trackers.registry import all_specs

    rows = []
    for spec in sorted(all_specs(), key=lambda spec: (ORDER.index(spec.provenance), spec.id)):
        told = "; ".join(spec.assumptions) + (f" ({spec.remarks})" if spec.remarks else "")
        rows.append(f"| `{spec.id}` | {spec.provenance} | {spec.summary} | {told.strip()} |\n")
    return HEAD + "".join(rows)


def shown(page: str) -> str:
    """The table as a page has it: from its header to the next empty line."""
    begin = page.index(HEAD)
    return page[begin : page.index("\n\n", begin) + 1]


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    rows, text = table(), PAGE.read_text(encoding="utf-8")
    PAGE.write_text(text.replace(shown(text), rows), encoding="utf-8")
