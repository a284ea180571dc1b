"""Announcements of what code in this process is about to do, made before it is done.

Python announces openings, listings, imports and programs to audit hooks (`sys.audit`). What is
looked up in ``os.environ`` is announced by a subclass of its class, in the same way. So are files
that are looked for (``os.path.exists``, ``Path.is_file``) and that are not there, by a function
in place of ``os.stat``.
"""

import os
import sys
from collections.abc import Callable, Collection, Iterator
from types import FrameType
from typing import Any

VARIABLE = "dynslam_bench.variable"
"""A variable, its argument, is looked up."""
ALL_VARIABLES = "dynslam_bench.variables"
"""The names of all variables are listed."""
VARIABLE_SET = "dynslam_bench.variable_set"
"""A variable, its argument, is set or removed."""
MISSING = "dynslam_bench.missing"
"""A file or folder, its argument, is looked for and not there."""

Listener = Callable[[FrameType, str, tuple[Any, ...]], None]
"""Gets the frame of the function that is about to do something, the event and its arguments."""

_listener: Listener | None = None
_events: frozenset[str] = frozenset()
_after_fork: Callable[[], None] | None = None
_is_hook_installed = False
_Environment: Any = type(os.environ)
"""The class of ``os.environ``."""
_stat = os.stat


def listen(
    listener: Listener | None,
    events: Collection[str] = (),
    after_fork: Callable[[], None] | None = None,
) -> None:
    """Let a listener hear announcements from now on, in place of any other.

    Args:
        listener: Called in the thread that does what is announced; None for nobody.
        events: What it hears.
        after_fork: Called in each process that is forked from this one.
    """
    global _listener, _events, _after_fork, _is_hook_installed
    if listener is not None and not _is_hook_installed:  # a hook stays for the life of the process
        sys.addaudithook(_announce)
        os.register_at_fork(after_in_child=_tell_of_fork)
        _is_hook_installed = True
    _listener = listener
    _events = frozenset(events)
    _after_fork = after_fork
    os.stat = _stat if listener is None else _announced_stat
    for variables in (os.environ, os.environb):
        variables.__class__ = _Environment if listener is None else AnnouncedEnvironment


def _announce(event: str, arguments: tuple[Any, ...]) -> None:
    if event in _events and _listener is not None:  # to look at a frame is announced, too
        _listener(sys._getframe(1), event, arguments)


def _tell_of_fork() -> None:
    if _after_fork is not None:
        _after_fork()


def _announced_stat(
    path: Any, *, dir_fd: int | None = None, follow_symlinks: bool = True
) -> os.stat_result:
    """``os.stat`` that announces what is not there."""
    try:
        return _stat(path, dir_fd=dir_fd, follow_symlinks=follow_symlinks)
    except (FileNotFoundError, NotADirectoryError):
        if dir_fd is None:
            sys.audit(MISSING, path)
        raise


# Python keeps in these which functions take descriptors and leave links alone
for _abilities in (os.supports_dir_fd, os.supports_fd, os.supports_follow_symlinks):
    _abilities.add(_announced_stat)


class AnnouncedEnvironment(_Environment):  # type: ignore[misc]
    """``os.environ`` that announces what is looked up in it, listed and set: `Mapping` builds the rest on these."""

    def __getitem__(self, key: Any) -> Any:
        sys.audit(VARIABLE, key)
        return super().__getitem__(key)

    def __iter__(self) -> Iterator[Any]:
        sys.audit(ALL_VARIABLES)
        return iter(super().__iter__())

    def __setitem__(self, key: Any, value: Any) -> None:
        sys.audit(VARIABLE_SET, key)
        super().__setitem__(key, value)

    def __delitem__(self, key: Any) -> None:
        sys.audit(VARIABLE_SET, key)
        super().__delitem__(key)
