"""Digests of file contents, remembered while the files are unchanged.

A digest is remembered on disk (``digests/`` in the cache folder) for one state of its files: path, size, times of
modification and of change, and inode of each. A file that changed within the last `_SETTLED_NS` is hashed again,
because a second change could leave the same times.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import os
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from .errors import DynslamError
from .files import write_atomic
from .folders import digest_cache_folder

_BLOCK = 1 << 20
_SETTLED_NS = 2_000_000_000
_MEMORY: dict[str, str] = {}


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content.

    Raises:
        OSError: It cannot be read.
    """
    return _remembered("file", [path], lambda: _sha256(path))


def files_digest(files: Iterable[Path], root: Path) -> str:
    """SHA-256 of the contents of files and of their names below a root; their order does not matter.

    Raises:
        OSError: One cannot be read.
    """
    ordered = sorted(files)
    return _remembered("files", ordered, lambda: _of_all(ordered, root, _sha256))


def contents_digest(files: Iterable[Path]) -> str:
    """SHA-256 of the contents of files in the given order, whatever they are called; Python sources by their syntax.

    Raises:
        OSError: One cannot be read.
    """
    ordered = list(files)
    return _remembered("contents", ordered, lambda: _joined(_code_digest(file) for file in ordered))


def code_files_digest(files: Iterable[Path], root: Path) -> str:
    """As `files_digest`, but Python sources count by `syntax_digest`.

    Raises:
        OSError: One cannot be read.
    """
    ordered = sorted(files)
    return _remembered("code", ordered, lambda: _of_all(ordered, root, _code_digest))


def path_digest(path: Path) -> str:
    """SHA-256 of a file's content, or of the names and contents of all files in a folder.

    Raises:
        OSError: Something cannot be read.
    """
    if path.is_file():
        return file_digest(path)
    return files_digest((file for file in path.rglob("*") if file.is_file()), path)


def syntax_digest(source: bytes) -> str:
    """SHA-256 of a Python source's syntax tree without comments, layout and docstrings.

    It does not depend on the version of Python that parses it. What cannot be parsed counts by its bytes.
    """
    try:
        words = "\0".join(_tokens_of(ast.parse(source)))
    except (SyntaxError, ValueError, RecursionError):
        return hashlib.sha256(source).hexdigest()
    return hashlib.sha256(words.encode(errors="backslashreplace")).hexdigest()


def _tokens_of(node: Any) -> Iterator[str]:
    """A syntax tree as text tokens; empty fields, which differ between versions of Python, are left out."""
    if isinstance(node, ast.AST):
        yield f"({type(node).__name__}"
        for name, value in ast.iter_fields(node):
            if value is not None and value != [] and name not in ("ctx", "kind", "type_comment"):
                yield name
                yield from _tokens_of(value)
        yield ")"
    elif isinstance(node, list):
        for each in node:
            if not _is_docstring(each):
                yield from _tokens_of(each)
    else:
        yield repr(node)


def _is_docstring(node: Any) -> bool:
    """Whether a statement is a string alone, which does nothing."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _code_digest(file: Path) -> str:
    return syntax_digest(file.read_bytes()) if file.suffix == ".py" else _sha256(file)


def _of_all(files: Iterable[Path], root: Path, hashed: Callable[[Path], str]) -> str:
    return _joined(f"{file.relative_to(root).as_posix()}\0{hashed(file)}" for file in files)


def _joined(lines: Iterable[str]) -> str:
    whole = hashlib.sha256()
    for line in lines:
        whole.update(f"{line}\n".encode(errors="surrogateescape"))
    return whole.hexdigest()


def _sha256(path: Path) -> str:
    whole = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            whole.update(block)
    return whole.hexdigest()


def _remembered(kind: str, files: list[Path], compute: Callable[[], str]) -> str:
    state, newest = _files_state(files)
    key = hashlib.sha256(f"{kind}\0{state}".encode()).hexdigest()
    if key in _MEMORY:
        return _MEMORY[key]
    entry = digest_cache_folder() / key[:40]
    with contextlib.suppress(OSError):
        stored = entry.read_text(encoding="ascii", errors="replace")
        if len(stored) == 64:
            _MEMORY[key] = stored
            return stored
    found = compute()
    if is_settled(newest):
        _MEMORY[key] = found
        with contextlib.suppress(DynslamError):  # a cache that cannot be written costs time only
            write_atomic(entry, found)
    return found


def is_settled(newest_ns: int | None) -> bool:
    """Whether files whose newest time is this may be remembered: a change within the same tick would not show.

    Args:
        newest_ns: Time in nanoseconds since 1970; None without a file.
    """
    return newest_ns is not None and time.time_ns() - newest_ns > _SETTLED_NS


def _files_state(files: Iterable[Path]) -> tuple[str, int]:
    """Digest of path, size, times and inode of each file, and the newest of the times in nanoseconds.

    Raises:
        OSError: One is not there.
    """
    whole, newest = hashlib.sha256(), 0
    for file in files:
        path = os.fspath(file)
        if not os.path.isabs(path):  # noqa: PTH117 - thousands of files: pathlib takes several times as long
            path = os.path.abspath(path)  # noqa: PTH100
        stat = os.stat(path)  # noqa: PTH116
        newest = max(newest, stat.st_mtime_ns, stat.st_ctime_ns)
        text = f"{path}\0{stat.st_size},{stat.st_mtime_ns},{stat.st_ctime_ns},{stat.st_ino}\n"
        whole.update(text.encode(errors="surrogateescape"))
    return whole.hexdigest(), newest
