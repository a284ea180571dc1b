"""Modules of this package that a module uses, and the digest of their code.

The closure of a module holds itself and all modules of this package that it reaches by import
statements, wherever in the source they stand. A package's ``__init__`` that passes a name on is
looked through: the name counts with the module that defines it. What a text names is no import:
entry points of plug-ins, tables of lazy names.

Sources count by their syntax: comments, layout and docstrings change nothing.
"""

import ast
import hashlib
import importlib.util
import json
import struct
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import DynslamError, RunError
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.folders import digest_cache_folder

PACKAGE = __name__.partition(".")[0]
"""The top-level package that this module belongs to."""
_PLUMBING = (
    "arguments",
    "code_files",
    "download",
    "errors",
    "files",
    "fingerprint",
    "folders",
    "kernel_cache",
    "kernel_code",
    "libraries",
    "module_graph",
    "plugins",
    "programs",
    "reads",
    "records",
    "sanitise",
    "version",
)
PLUMBING = tuple(f"{PACKAGE}.core.{name}" for name in _PLUMBING)
"""Modules that name faults, find, fetch, store and digest files, and load plug-ins: no number passes through them."""
SETTLED_NS = 2_000_000_000
"""Least age of a file whose content is remembered: a change within the same tick of the clock would not show."""
_BYTE_CODE_HEADER = struct.Struct("<4sIII")
"""Python's magic number, flags, second of the source's modification and its size (PEP 552)."""
_PARSING = threading.Lock()
"""Held while a source is parsed, see `parsed`."""

Reference = tuple[str, str]
"""A module of this package, and a name that is taken from it; the empty name stands for the module itself."""


@dataclass(frozen=True)
class ModuleCode:
    """One module's source: digest, imports and the names that it imports.

    Attributes:
        digest: Digest of the source's syntax, see `_tree_digest`; of its bytes where it cannot be parsed.
        imports: What it imports from this package.
        names: What each name stands for that it imports at its top level, by the name that it has
            in this module.
    """

    digest: str
    imports: list[Reference]
    names: dict[str, Reference]


class ModuleGraph:
    """The modules of this package with their imports.

    Args:
        modules: What is known of each module, by its name.
    """

    def __init__(self, modules: Mapping[str, ModuleCode]) -> None:
        self.modules = modules
        self._packages = {module.rpartition(".")[0] for module in modules}

    def closure(self, roots: Iterable[str], without: Iterable[str] = ()) -> list[str]:
        """All modules that modules use, themselves among them, sorted.

        Args:
            roots: Names of modules; those that do not belong to this package are left out.
            without: Modules that are left out, with what only they use.
        """
        left_out = set(without)
        reached: set[str] = set()
        waiting = [root for root in roots if root in self.modules]
        while waiting:
            module = waiting.pop()
            if module in reached or module in left_out:
                continue
            reached.add(module)
            for source, name in self.modules[module].imports:
                defining = self.defining_module(source, name)
                if defining is not None:
                    waiting.append(defining)
        return sorted(reached)

    def digest(self, roots: Iterable[str], without: Iterable[str] = ()) -> str:
        """SHA-256 of the syntax of all modules in a closure, with their names; see `closure`."""
        return self.code_digest(self.closure(roots, without))

    def code_digest(self, modules: Iterable[str]) -> str:
        """SHA-256 of the syntax of modules, with their names."""
        state = hashlib.sha256()
        for module in sorted(modules):
            state.update(f"{module}\0{self.modules[module].digest}\n".encode())
        return state.hexdigest()

    def defining_module(self, source: str, name: str) -> str | None:
        """The module that defines what is imported; None where it does not belong to this package.

        Args:
            source: The module that the import statement names.
            name: The name that is taken from it; empty for the module itself.
        """
        followed: set[Reference] = set()
        while (source, name) not in followed:  # two packages may pass a name on to each other
            followed.add((source, name))
            # from package import module
            if name and f"{source}.{name}" in self.modules:
                return f"{source}.{name}"
            if source not in self.modules:
                return None
            # a package's __init__ is looked through, a module defines what it passes on
            passed_on = self.modules[source].names.get(name)
            if passed_on is None or source not in self._packages:
                return source
            source, name = passed_on
        return source


@cache
def module_graph() -> ModuleGraph:
    """The graph of this package as it lay on the disk when this process asked first.

    Raises:
        OSError: A source cannot be read.
    """
    return read_module_graph()


def read_module_graph() -> ModuleGraph:
    """The graph of this package as it lies on the disk now.

    What was read of a file is remembered in the user's cache while the file's size and times stay
    the same: parsing all files takes more than a second.

    Raises:
        OSError: A source cannot be read.
    """
    # each checkout and installation has a file of its own
    places = "\0".join(str(place) for place in sys.modules[PACKAGE].__path__)
    places_digest = hashlib.sha256(places.encode(errors="surrogateescape")).hexdigest()
    memory = digest_cache_folder() / f"modules-{places_digest[:16]}.json"
    remembered = _read_remembered(memory)

    # read what is new or has changed
    modules = {}
    stamps = {}
    for name, file in module_files().items():
        status = file.stat()
        changed_ns = max(status.st_mtime_ns, status.st_ctime_ns)
        stamp = f"{status.st_size},{status.st_mtime_ns},{status.st_ctime_ns},{status.st_ino}"
        old_stamp, code = remembered.get(name, ("", None))
        if code is None or old_stamp != stamp:
            code = read_module(name, file.read_bytes())
        modules[name] = code
        is_settled = time.time_ns() - changed_ns > SETTLED_NS
        stamps[name] = stamp if is_settled else ""

    # remember what has settled
    entries = {name: (stamps[name], code) for name, code in modules.items() if stamps[name]}
    if entries != remembered:
        _remember(memory, entries)
    return ModuleGraph(modules)


def module_files() -> dict[str, Path]:
    """The source of every module of this package, by the module's name."""
    files: dict[str, Path] = {}
    for place in map(Path, sys.modules[PACKAGE].__path__):
        if place.name == PACKAGE:
            files |= {_module_name(file, place): file for file in place.glob("*.py")}
        for folder in sorted(place.iterdir()):
            # in a checkout the folders beside the package are on its path, the package itself among
            # them
            if folder.name != PACKAGE and (folder / "__init__.py").is_file():
                files |= {_module_name(file, place): file for file in sorted(folder.rglob("*.py"))}
    return files


@cache
def check_byte_code() -> None:
    """Refuse byte code that is older than its source, once a process.

    Python takes byte code for current while the source's size and its second of modification are
    those at which it was compiled. It does not see an edit of equal length within that second: the
    old code would run under the new source's digest.

    Raises:
        RunError: A module's byte code is older than its source.
    """
    for name, file in module_files().items():
        byte_code = Path(importlib.util.cache_from_source(file))
        try:
            source = file.stat()
            if byte_code.stat().st_mtime_ns >= source.st_mtime_ns:
                continue
            header = byte_code.read_bytes()[: _BYTE_CODE_HEADER.size]
        except OSError:  # it was not compiled, or nothing was stored
            continue
        if len(header) < _BYTE_CODE_HEADER.size:
            continue
        _, _, second, size = _BYTE_CODE_HEADER.unpack(header)
        if (second, size) == (int(source.st_mtime) & 0xFFFFFFFF, source.st_size & 0xFFFFFFFF):
            raise RunError(
                f"the byte code of {name} is older than its source: that was edited within a second after it was read",
                f"touch {file}, and start again",
            )


def _module_name(file: Path, place: Path) -> str:
    """The name of a module, from its file and the folder on the package's path that this lies in."""
    parts = file.relative_to(place).with_suffix("").parts
    if parts[-1] == "__init__":
        parts = parts[:-1]
    return ".".join((PACKAGE, *parts))


def _read_remembered(memory: Path) -> dict[str, tuple[str, ModuleCode]]:
    """Stamp and code of each module that was remembered; empty where nothing can be read."""
    entries = {}
    try:
        stored = json.loads(memory.read_text(encoding="utf-8"))
        for name, entry in stored.items():
            # JSON has lists in place of pairs
            imports = [(source, imported) for source, imported in entry["imports"]]
            names = {own: (source, imported) for own, (source, imported) in entry["names"].items()}
            entries[name] = (entry["stamp"], ModuleCode(entry["digest"], imports, names))
    # it is missing, cut off or of another version
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
    return entries


def _remember(memory: Path, entries: Mapping[str, tuple[str, ModuleCode]]) -> None:
    """Store stamp and code of each module, as `_read_remembered` reads them."""
    stored = {name: {"stamp": stamp, **asdict(code)} for name, (stamp, code) in entries.items()}
    try:
        write_atomic(memory, json.dumps(stored))
    except DynslamError:
        return  # a cache that cannot be written costs time only


# -- one source ------------------------------------------------------------------------------------


def read_module(name: str, source: bytes) -> ModuleCode:
    """Parse a module's source for its digest and its imports; one that cannot be parsed imports nothing.

    Args:
        name: The module.
        source: Its text.
    """
    try:
        tree = parsed(source)
        syntax = _tree_digest(tree)
    except (SyntaxError, ValueError, RecursionError):
        return ModuleCode(hashlib.sha256(source).hexdigest(), [], {})
    imports: set[Reference] = set()
    for statement in _import_statements(tree):
        imports |= set(_references(statement).values())

    # names that the module, or a package, passes on
    names: dict[str, Reference] = {}
    for statement in tree.body:
        names |= _references(statement)
    return ModuleCode(syntax, sorted(imports), names)


def _import_statements(node: ast.AST) -> Iterator[ast.AST]:
    """All import statements below a node but those that only type checkers read."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.expr):
            continue  # holds no statements
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child
        elif isinstance(child, ast.If) and ast.unparse(child.test).endswith("TYPE_CHECKING"):
            for statement in child.orelse:
                yield from _import_statements(ast.Module([statement], []))
        else:
            yield from _import_statements(child)


def _references(statement: ast.AST) -> dict[str, Reference]:
    """References to this package's names in an import statement, by the name that the statement binds."""
    references: dict[str, Reference] = {}
    if isinstance(statement, ast.Import):
        for alias in statement.names:
            if alias.name.partition(".")[0] == PACKAGE:
                references[alias.asname or alias.name] = (alias.name, "")
    elif isinstance(statement, ast.ImportFrom):
        source = statement.module or ""
        if source.partition(".")[0] == PACKAGE:
            for alias in statement.names:
                references[alias.asname or alias.name] = (source, alias.name)
    return references


def parsed(source: bytes) -> ast.Module:
    """`ast.parse`, one thread at a time: in Python 3.11 two at once can fail with a SystemError.

    Raises:
        SyntaxError: It is no Python of this version.
        ValueError: It holds a null byte.
        RecursionError: It is nested too deeply.
    """
    with _PARSING:
        return ast.parse(source)


def _tree_digest(tree: ast.Module) -> str:
    """SHA-256 of a Python source's syntax tree without comments, layout and docstrings.

    It does not depend on the version of Python that parses it.
    """
    tokens: list[str] = []
    _append_tokens(tree, tokens)
    return hashlib.sha256("\0".join(tokens).encode(errors="backslashreplace")).hexdigest()


def _append_tokens(node: Any, tokens: list[str]) -> None:
    """Append a syntax tree's text tokens; empty fields, which differ between versions of Python, are left out."""
    if isinstance(node, ast.AST):
        tokens.append(f"({type(node).__name__}")
        for name in node._fields:
            value = getattr(node, name, None)
            if value is not None and value != [] and name not in ("ctx", "kind", "type_comment"):
                tokens.append(name)
                _append_tokens(value, tokens)
        tokens.append(")")
    elif isinstance(node, list):
        for inner in node:
            if not _is_docstring(inner):
                _append_tokens(inner, tokens)
    else:
        tokens.append(repr(node))


def _is_docstring(node: Any) -> bool:
    """Whether a statement is a string alone, which does nothing."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )
