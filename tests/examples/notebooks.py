"""The notebooks, run cell by cell as a Jupyter kernel would, the last value of each cell shown."""

from __future__ import annotations

import ast
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))


def cells(notebook: Path) -> list[dict[str, Any]]:
    """All cells of a notebook."""
    return json.loads(notebook.read_text(encoding="utf-8"))["cells"]


def play(notebook: Path, changes: Mapping[str, str]) -> list[Any]:
    """Run a notebook and return the values that its cells show.

    Args:
        notebook: The file.
        changes: Texts of its code and their replacements, for shorter runs; each has to occur.
    """
    code = ["".join(cell["source"]) for cell in cells(notebook) if cell["cell_type"] == "code"]
    for old, new in changes.items():
        assert any(old in text for text in code), f"{notebook.name} has no {old!r}"
        code = [text.replace(old, new) for text in code]
    names: dict[str, Any] = {}
    shown = []
    for text in code:
        *before, last = ast.parse(text).body
        if not isinstance(last, ast.Expr):
            before.append(last)
        exec(compile(ast.Module(before, []), str(notebook), "exec"), names)
        if isinstance(last, ast.Expr):
            shown.append(eval(compile(ast.Expression(last.value), str(notebook), "eval"), names))
    return [value for value in shown if value is not None]
