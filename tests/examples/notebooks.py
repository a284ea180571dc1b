"""The notebooks, run by a Jupyter kernel, or as one would: cell by cell, the last value of each shown."""

from __future__ import annotations

import ast
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))


def cells(notebook: Path) -> list[dict[str, Any]]:
    """All cells of a notebook."""
    return json.loads(notebook.read_text(encoding="utf-8"))["cells"]


def changed(notebook: Path, code: list[str], changes: Mapping[str, str] | None) -> list[str]:
    """Code of a notebook's cells with texts replaced; each has to occur."""
    for old, new in (changes or {}).items():
        assert any(old in text for text in code), f"{notebook.name} has no {old!r}"
        code = [text.replace(old, new) for text in code]
    return code


def play_in_a_kernel(notebook: Path, folder: Path, changes: Mapping[str, str] | None = None) -> list[dict[str, Any]]:
    """Run a notebook in a Jupyter kernel of this interpreter, and return the outputs of its cells.

    Args:
        notebook: The file.
        folder: Where the kernel works.
        changes: As in `play`.

    Raises:
        CellExecutionError: A cell raises.
    """
    import nbformat
    from nbclient import NotebookClient

    played = nbformat.read(notebook, as_version=4)
    code = [cell for cell in played.cells if cell.cell_type == "code"]
    for cell, source in zip(code, changed(notebook, [cell.source for cell in code], changes), strict=True):
        cell.source = source
    client = NotebookClient(played, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(folder)}})
    client.execute(env=os.environ | {"PYTHONPATH": os.pathsep.join([str(EXAMPLES.parent), *sys.path])})
    return [output for cell in code for output in cell.outputs]


def play(notebook: Path, changes: Mapping[str, str] | None = None) -> list[Any]:
    """Run a notebook and return the values that its cells show.

    Args:
        notebook: The file.
        changes: Texts of its code and what stands in their place, for shorter runs; each has to occur.
    """
    code = changed(
        notebook, ["".join(cell["source"]) for cell in cells(notebook) if cell["cell_type"] == "code"], changes
    )
    names: dict[str, Any] = {}
    shown = []
    for text in code:
        *before, last = ast.parse(text).body
        exec(compile(ast.Module(before, []), str(notebook), "exec"), names)
        if isinstance(last, ast.Expr):
            shown.append(eval(compile(ast.Expression(last.value), str(notebook), "eval"), names))
        else:
            exec(compile(ast.Module([last], []), str(notebook), "exec"), names)
    return [value for value in shown if value is not None]
