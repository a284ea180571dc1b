"""What the pages and the template of a new tracker import from this package: contracts, settings and errors."""

import ast
import re
from pathlib import Path

from documented_names import ROOT

from dynslam_bench.testing.template import write_tracker_template

PAGES = ("reference/plugins.md", "how-to/dataset.md", "how-to/filter.md", "how-to/segmenter.md")
OPEN = {"dynslam_bench.contracts", "dynslam_bench.core.settings", "dynslam_bench.core.errors"}
COMPOSING = "dynslam_bench.trackers.systems.composition"
"""Puts filters on our back end: the one thing that a plug-in may take from us that is no contract."""

RULES = "dynslam_bench.culling.semantic"
"""The filter that an own one is put beside."""


def imports(code: str) -> list[tuple[str, str]]:
    """Module and name of everything that a text takes from this package."""
    nodes = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.ImportFrom)]
    taken = [(node.module or "", alias.name) for node in nodes for alias in node.names]
    return [(module, name) for module, name in taken if module.startswith("dynslam_bench")]


def test_plug_ins_import_from_the_contracts_only(tmp_path: Path) -> None:
    page = "\n".join((ROOT / "docs" / page).read_text(encoding="utf-8") for page in PAGES)
    texts = re.findall(r"^```python\n(.*?)^```", page, flags=re.S | re.M)
    taken = [pair for text in texts for pair in imports(text)]
    assert len(taken) > 10 and {module for module, _ in taken} <= OPEN | {COMPOSING, RULES}
    template = imports(write_tracker_template("my-slam", tmp_path).read_text())
    assert ("dynslam_bench.contracts", "TrackerSpec") in template and {module for module, _ in template} <= OPEN
