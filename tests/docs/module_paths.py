"""Dotted paths into the package: where a text names them, and whether something is there."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from documented_names import ROOMS, ROOT

PATH = re.compile(r"(?<![\w./-])(?:dynslam_bench(?:\.[A-Za-z_]\w*)+|(?:envs|reports|tuning)(?:\.[a-z_]\w*){2,})")
"""Into the package, or into a room of the checkout's own by two names (one may be a file: `reports.csv`)."""
FROM = re.compile(r"from (dynslam_bench[\w.]*) import (?:\(([\w,\s]+)\)|([\w, ]+))")


def taken(code: str) -> Iterator[tuple[int, str]]:
    """Line and path of everything that a Python text takes from the package, in its code or in a text within it."""
    for node in ast.walk(ast.parse(code)):
        found: list[str] = []
        match node:
            case ast.ImportFrom(module=str(module), names=names, level=0) if module.split(".")[0] == "dynslam_bench":
                found = [f"{module}.{alias.name}" for alias in names]
            case ast.Import(names=names):
                found = [alias.name for alias in names if alias.name.startswith("dynslam_bench.")]
            case ast.Constant(value=str(text)):
                found = PATH.findall(text)
                for module, several, one_line in FROM.findall(text):
                    words = [name.split(" as ")[0].strip() for name in (several or one_line).split(",")]
                    found += [f"{module}.{word}" for word in words if word]
        yield from ((node.lineno, path) for path in found)


def is_there(path: str) -> bool:
    """Whether a path is a module, or a name in one (what follows that name is not looked at)."""
    place, parts = ROOT, path.split(".")
    if parts[0] == "dynslam_bench" and len(parts) > 1 and parts[1] in ROOMS:
        parts = parts[1:]
    for part in parts:
        module = place / "__init__.py" if place != ROOT else None
        if (place / part / "__init__.py").is_file():
            place = place / part
        elif (place / f"{part}.py").is_file():
            rest = parts[parts.index(part) + 1 :]
            return not rest or rest[0] in names_of(place / f"{part}.py")
        else:
            return module is not None and part in names_of(module)
    return True


@cache
def names_of(module: Path) -> frozenset[str]:
    """The names that a module defines or imports, and those that its `__getattr__` knows as texts."""
    found: set[str] = set()
    waiting: list[ast.stmt] = list(ast.parse(module.read_text(encoding="utf-8")).body)
    while waiting:
        node = waiting.pop()
        match node:
            case ast.FunctionDef(name="__getattr__"):
                waiting += [child for child in ast.walk(node) if isinstance(child, ast.Import | ast.ImportFrom)]
                lazy = [each for each in ast.walk(ast.parse(module.read_text())) if isinstance(each, ast.Constant)]
                found |= {each.value for each in lazy if isinstance(each.value, str)}
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                found.add(name)
            case ast.Import(names=names) | ast.ImportFrom(names=names):
                found |= {(alias.asname or alias.name).split(".")[0] for alias in names}
            case ast.Assign(targets=targets):
                found |= {each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)}
            case ast.AnnAssign(target=ast.Name(id=name)):
                found.add(name)
            case ast.If(body=body, orelse=other) | ast.For(body=body, orelse=other):
                waiting += [*body, *other]
            case ast.Try(body=body, handlers=handlers):
                waiting += [*body, *(each for handler in handlers for each in handler.body)]
    return frozenset(found)
