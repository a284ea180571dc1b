"""Which lines of a reader have run."""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any

Line = tuple[str, int]


class Coverage:
    """Counts the lines of some functions, classes and modules that have run while it watched.

    Args:
        covers: What is watched.
    """

    def __init__(self, covers: Iterable[Any]) -> None:
        self._codes = {code for each in covers for code in _codes(each)}
        self.lines: set[Line] = {(c.co_filename, line) for c in self._codes for line in _lines(c)}
        self.seen: set[Line] = set()

    @property
    def share(self) -> float:
        """Share of the lines that have run, 0 to 1."""
        return len(self.seen) / max(len(self.lines), 1)

    @property
    def code(self) -> str:
        """Names the code that is watched: another text, or another place in its file, is another name."""
        text = repr(sorted((Path(c.co_filename).name, c.co_firstlineno, c.co_code.hex()) for c in self._codes))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def missed(self) -> list[str]:
        """The lines that have not, as ``file:line``."""
        return sorted(f"{name.rpartition('/')[2]}:{line}" for name, line in self.lines - self.seen)

    def watch(self, call: Callable[[], object]) -> None:
        """Call a function, and note the lines that run."""
        outer = sys.gettrace()
        sys.settrace(self._enter)
        try:
            call()
        finally:
            sys.settrace(outer)
            self.seen &= self.lines

    def _enter(self, frame: FrameType, event: str, _: Any) -> Any:
        if frame.f_code not in self._codes:
            return None
        self.seen.add((frame.f_code.co_filename, frame.f_lineno))
        return self._line

    def _line(self, frame: FrameType, event: str, _: Any) -> Any:
        if event == "line":
            self.seen.add((frame.f_code.co_filename, frame.f_lineno))
        return self._line


def _codes(thing: Any) -> Iterator[CodeType]:
    if isinstance(thing, ModuleType):
        members = [value for value in vars(thing).values() if getattr(value, "__module__", "") == thing.__name__]
        for member in members:
            if inspect.isclass(member) or inspect.isfunction(inspect.unwrap(member) if callable(member) else member):
                yield from _codes(member)
        return
    if inspect.isclass(thing):
        for member in vars(thing).values():
            plain = getattr(member, "__func__", getattr(member, "fget", member))
            if inspect.isfunction(plain) and plain.__module__ == thing.__module__:
                yield from _codes(plain)
        return
    function = inspect.unwrap(getattr(thing, "__func__", thing))
    pending = [function.__code__]
    while pending:
        code = pending.pop()
        yield code
        pending += [constant for constant in code.co_consts if isinstance(constant, CodeType)]


def _lines(code: CodeType) -> set[int]:
    """The lines of a function's body; not its head, whose defaults ran when it was defined."""
    return {line for _, _, line in code.co_lines() if line is not None and line > code.co_firstlineno}
