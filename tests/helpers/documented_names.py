"""What pages and docstrings name in backticks, and everything that the code knows by a name."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("dynslam_bench", "envs", "tuning", "reports")
PAGES = [
    page
    for page in [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
    if not page.read_text(encoding="utf-8").startswith("<!-- Made by ")
]
"""All pages but those that are made of the code."""
SUFFIXES = r"(?:py|toml|md|jsonl|json|csv|txt|html|png|mp4|ply|yml|yaml|xz|tex)"


@dataclass(frozen=True)
class Mention:
    """A text in backticks.

    Attributes:
        where: File and line.
        text: What stands between the backticks.
    """

    where: str
    text: str


def sources() -> list[Path]:
    """All Python files of the package."""
    return [file for package in PACKAGES for file in sorted((ROOT / package).rglob("*.py"))]


@cache
def read(file: Path) -> tuple[list[tuple[int, str]], set[str]]:
    """A file's docstrings with their lines; its names, and its other texts with their words."""
    nodes = list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
    docstrings = {id(node): (node.lineno, str(node.value)) for node in _docstrings(nodes)}
    names = {name for node in nodes for name in _names_of(node)}
    for node in nodes:
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in docstrings
        ):
            names |= {node.value, *re.findall(r"[A-Za-z0-9_][A-Za-z0-9_-]*", node.value)}
    return list(docstrings.values()), names


@cache
def words() -> frozenset[str]:
    """Every identifier of the code, and every word of its string constants that are no docstrings."""
    names: set[str] = set()
    for file in [*sources(), *sorted((ROOT / "tests").rglob("*.py"))]:
        names |= {*read(file)[1], file.stem, *file.parent.relative_to(ROOT).parts}
    data = [
        file
        for package in PACKAGES
        for kind in ("toml", "csv")
        for file in (ROOT / package).rglob(f"*.{kind}")
    ]
    for file in [*data, ROOT / "pyproject.toml"]:
        names.update(re.findall(r"[A-Za-z_][A-Za-z0-9_-]*", file.read_text(encoding="utf-8")))
    return frozenset(names)


def _names_of(node: ast.AST) -> Iterator[str]:
    match node:
        case (
            ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name) | ast.keyword(arg=str(name))
            | ast.FunctionDef(name=name) | ast.ClassDef(name=name)
        ):  # fmt: skip
            yield name
        case ast.Import(names=names) | ast.ImportFrom(names=names):
            for alias in names:
                yield from (alias.asname or alias.name).split(".")


def _docstrings(nodes: list[ast.AST]) -> Iterator[ast.Constant]:
    """The docstrings of a module: of itself, its classes and functions, and those below assignments."""
    for node in nodes:
        for statement in (
            getattr(node, "body", []) if not isinstance(node, ast.Lambda | ast.IfExp) else []
        ):
            match statement:
                case ast.Expr(value=ast.Constant(value=str()) as docstring):
                    yield docstring


def in_pages() -> Iterator[Mention]:
    """Inline code of all pages (fenced blocks are commands, which are tested elsewhere, or made-up files)."""
    for page in PAGES:
        text = re.sub(
            r"^```.*?^```",
            lambda m: "\n" * m.group().count("\n"),
            page.read_text(),
            flags=re.S | re.M,
        )
        for found in re.finditer(r"`([^`\n]+)`", text):
            line = text.count("\n", 0, found.start()) + 1
            yield Mention(f"{page.relative_to(ROOT)}:{line}", found.group(1).replace("\\|", "|"))


def in_docstrings() -> Iterator[Mention]:
    """Single and double backticks of all docstrings of the package."""
    for file in sources():
        for line, text in read(file)[0]:
            for found in re.finditer(r"(`+)([^`\n]+)\1", text):
                yield Mention(f"{file.relative_to(ROOT)}:{line}", found.group(2))


def exists(path: str) -> bool:
    """Whether a path is there, from the root, from the package, or from a package (``culling/epipolar.py``)."""
    return any(
        (base / path).exists()
        for base in (ROOT, ROOT / "dynslam_bench", ROOT / "docs", ROOT.parent)
    )
