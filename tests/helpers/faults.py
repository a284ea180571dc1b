"""Faults at every file operation below a folder: a kill, a full disk, a read-only one, a folder that is removed.

`survey` runs a piece of work once undisturbed; then, for every operation and every fault, once with
the fault at that operation and once more to go on from there. What is disturbed is a fork of this
process, so `in_a_small_process` runs the tests: late in a session a fork of pytest's own process
takes fifty times as long.
"""

import builtins
import errno
import functools
import io
import os
import shutil
import signal
import subprocess
import sys
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dynslam_bench.core.errors import DynslamError

FAULTS = ("kill", "full", "read-only", "gone")
DONE = 0
TOLD = 3
RAW = 9
"""Exit codes of a piece of work: it came to its end, it gave one clear error, it let a raw one out."""
_CHANGES = (
    "os.rename",
    "os.remove",
    "os.mkdir",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.truncate",
)
_TAKES_SPACE = ("open", "os.mkdir", "os.symlink", "write")
_open = io.open


def in_a_small_process(test: Callable[..., None]) -> Callable[..., None]:
    """Run a test, whose fixtures are texts and paths, in an interpreter that has imported its module and no more."""

    @functools.wraps(test)
    def run(**fixtures: Any) -> None:
        arguments = {name: str(value) for name, value in fixtures.items()}
        code = f"""
import sys
from pathlib import Path
sys.path[:] = {sys.path}
from {test.__module__} import {test.__name__} as test
arguments = {arguments}
test.__wrapped__(**arguments | {{"tmp_path": Path(arguments["tmp_path"])}})
"""
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr

    return run


class Injector:
    """Counts the operations, and makes one of them fail.

    Args:
        root: The folder.
        at: Number of the operation, from 1; 0 for none.
        fault: One of `FAULTS`; a disk that is full or read-only stays so.
    """

    def __init__(self, root: Path, at: int = 0, fault: str = "kill") -> None:
        self.root = str(root)
        self.at = at
        self.fault = fault
        self.count = 0

    def install(self) -> None:
        """From now on, for the rest of this process."""
        sys.addaudithook(self._audit)
        io.open = builtins.open = self._opened

    def _audit(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            path, _, flags = arguments
            if (
                isinstance(flags, int)
                and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
                and self._is_below(path)
            ):
                self._operation(event)
        elif event == "ctypes.dlsym" and arguments[1] == "renameat2":
            self._operation("os.rename")
        elif event in _CHANGES and (
            self._is_below(*arguments[:2]) or any(a not in (-1, None) for a in arguments[2:3])
        ):
            self._operation(event)

    def _is_below(self, *paths: object) -> bool:
        return any(
            isinstance(path, (str, os.PathLike)) and os.fspath(path).startswith(self.root)
            for path in paths
        )

    def _operation(self, event: str, before: Callable[[], object] = lambda: None) -> None:
        self.count += 1
        if not self.at or self.count < self.at:
            return
        if self.fault == "kill":
            before()
            os.kill(os.getpid(), signal.SIGKILL)
        if self.fault == "gone" and self.count == self.at:
            self.at = 0
            shutil.rmtree(self.root, ignore_errors=True)
        if self.fault == "full" and event in _TAKES_SPACE:
            before()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if self.fault == "read-only":
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    def _opened(self, file: Any, mode: str = "r", *arguments: Any, **named: Any) -> Any:
        """A file that fails in the middle of what is written."""
        opened = _open(file, mode, *arguments, **named)
        if self._is_below(file) and set(mode) & set("wax+"):
            write = opened.write

            def torn(data: Any) -> Any:
                self._operation("write", lambda: (write(data[: len(data) // 2]), opened.flush()))
                return write(data)

            opened.write = torn
        return opened


@dataclass
class Survey:
    """What came of the faults.

    Attributes:
        operations: Operations of the undisturbed work.
        ends: How often the disturbed work ended how, by fault and exit code.
    """

    operations: int = 0
    ends: Counter[tuple[str, int]] = field(default_factory=Counter)


def survey(
    work: Callable[[], None],
    root: Path,
    *,
    begin: Callable[[], None] = lambda: None,
    halfway: Callable[[], None] = lambda: None,
    result: Callable[[], object],
    faults: tuple[str, ...] = FAULTS,
    every: int = 1,
) -> Survey:
    """Try every fault at every operation of a piece of work.

    Args:
        work: What is disturbed, and then done again.
        root: The folder that it works in; emptied before each trial.
        begin: Makes what is there before.
        halfway: Checks what the fault left, before `work` is done again.
        result: What is there afterwards; it has to be the same as without a fault.
        faults: Which.
        every: Only every so many operations.

    Raises:
        AssertionError: A raw error, or another result than without a fault; says where.
    """
    found = Survey()
    _fresh(root, begin)
    work()  # here, so that no fork has to import what it needs
    _fresh(root, begin)
    code, found.operations = in_fork(work, Injector(root))
    assert code == DONE, code
    expected = result()
    for fault in faults:
        for at in range(1, found.operations + 1, every):
            _fresh(root, begin)
            code, _ = in_fork(work, Injector(root, at, fault))
            found.ends[fault, code] += 1
            where = f"{fault} at operation {at} of {found.operations}"
            assert code in ((-signal.SIGKILL, DONE) if fault == "kill" else (DONE, TOLD)), (
                f"{where}: {code}"
            )
            if fault == "gone":
                _fresh(root, begin)
            halfway()
            try:
                work()  # here: a fork costs more than the work
            except Exception as error:
                raise AssertionError(f"after {where}: {error!r}") from error
            assert result() == expected, f"after {where}"
    return found


def in_fork(work: Callable[[], None], injector: Injector) -> tuple[int, int]:
    """Do a piece of work in a fork; its exit code (see `DONE`), and how many operations it took."""
    read_end, write_end = os.pipe()
    pid = os.fork()
    if pid == 0:
        code = RAW
        try:
            injector.install()
            work()
            code = DONE
        except DynslamError as error:
            code = TOLD if "\n" not in str(error) else RAW
        except BaseException:
            traceback.print_exc()
        finally:
            os.write(write_end, str(injector.count).encode())
            os._exit(code)
    os.close(write_end)
    with os.fdopen(read_end, "rb") as pipe:
        count = int(pipe.read() or 0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), count


def tree(root: Path) -> dict[str, bytes | str]:
    """Everything below a folder: files by their content, links by their target."""
    paths = [path for path in sorted(root.rglob("*")) if path.is_symlink() or path.is_file()]
    contents = [str(path.readlink()) if path.is_symlink() else path.read_bytes() for path in paths]
    return {
        str(path.relative_to(root)): content for path, content in zip(paths, contents, strict=True)
    }


def _fresh(root: Path, begin: Callable[[], None]) -> None:
    shutil.rmtree(root, ignore_errors=True)
    root.mkdir(parents=True)
    begin()
