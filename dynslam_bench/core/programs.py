"""Files that the processes of a program are made of, and the environment variables that a program gets.

What a program opens cannot be seen from outside. What its processes show can: the executable, the
libraries and other files that are mapped into memory, the files and folders that the command line
names.
"""

import contextlib
import os
import re
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import psutil

RESULT_VARIABLES = (
    # where libraries and modules are searched
    "LD_LIBRARY_PATH",
    "LD_PRELOAD",
    "DYLD_LIBRARY_PATH",
    "PYTHONPATH",
    "PYTHONHOME",
    "PYTHONHASHSEED",
    # how numbers and times are read and written: a decimal comma cuts numbers short
    "LANG",
    "LANGUAGE",
    "LC_ALL",
    "LC_CTYPE",
    "LC_NUMERIC",
    "LC_TIME",
    "LC_COLLATE",
    "TZ",
    # on what is computed, and in which order sums are made
    "CUDA_VISIBLE_DEVICES",
    "CUDA_LAUNCH_BLOCKING",
    "CUBLAS_WORKSPACE_CONFIG",
    "NVIDIA_TF32_OVERRIDE",
    "OMP_DYNAMIC",
    "OMP_SCHEDULE",
    "OPENBLAS_CORETYPE",
    "MKL_CBWR",
    "MKL_DYNAMIC",
    "OPENCV_CPU_DISABLE",
    "OPENCV_OPENCL_DEVICE",
    "OPENCV_OPENCL_RUNTIME",
    "LIBGL_ALWAYS_SOFTWARE",
)
"""Programs get these variables, and their values count: each can change a result."""
RUN_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "BLIS_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "NUMBA_CACHE_DIR",
    "TMPDIR",
    "DYNSLAM_BENCH_ISOLATED",
    "DYNSLAM_BENCH_CACHE",
    "DYNSLAM_BENCH_DATA",
    "DYNSLAM_BENCH_WEIGHTS",
)
"""Programs get these variables. A run sets them by its settings, or they name places of data that counts by itself."""
PLACE_VARIABLES = (
    # found through these, programs and files count by their content
    "PATH",
    "HOME",
    "USER",
    "LOGNAME",
    "SHELL",
    "VIRTUAL_ENV",
    "CONDA_PREFIX",
    "XDG_CACHE_HOME",
    "XDG_CONFIG_HOME",
    "XDG_DATA_HOME",
    "XDG_DATA_DIRS",
    "XDG_CONFIG_DIRS",
    "XDG_RUNTIME_DIR",
    # where windows are shown, without which viewers do not start
    "DISPLAY",
    "WAYLAND_DISPLAY",
    "XAUTHORITY",
    "QT_QPA_PLATFORM",
    "TERM",
    "PYTHONUNBUFFERED",
    "PYTHONDONTWRITEBYTECODE",
    "PYTHONSAFEPATH",
)
"""Programs get these variables, and their values do not count."""
SESSION_VARIABLES = (
    "_",
    "PWD",
    "OLDPWD",
    "SHLVL",
    "TEMP",
    "TMP",
    "COLORTERM",
    "COLUMNS",
    "LINES",
    "LS_COLORS",
    "WINDOWID",
    "SSH_CLIENT",
    "SSH_CONNECTION",
    "SSH_TTY",
    "SSH_AUTH_SOCK",
    "DBUS_SESSION_BUS_ADDRESS",
    "SESSION_MANAGER",
    "XDG_SESSION_ID",
    "XDG_VTNR",
    "XDG_SEAT",
    "TMUX",
    "TMUX_PANE",
    "STY",
    "INVOCATION_ID",
    "JOURNAL_STREAM",
    "TERM_SESSION_ID",
    "VSCODE_IPC_HOOK_CLI",
    "PYTEST_CURRENT_TEST",
    "DYNSLAM_BENCH_PLUGINS",
    "DYNSLAM_BENCH_START",
)
"""These name the terminal, the login or the moment, or say how this package finds plug-ins and starts runs.

Programs do not get them, and their values do not count: a run gets the list of its own plug-ins
alone, whose code counts."""
DECLARED_VARIABLE = "dynslam_bench.declared_variable"
"""Announced (`sys.audit`) of each variable, its argument, that a program's settings declare, set or not."""
_UNCOUNTED = frozenset((*RUN_VARIABLES, *PLACE_VARIABLES, *SESSION_VARIABLES))
"""The variables whose values do not count."""
_LIBRARIES = "LD_LIBRARY_PATH"
_OF_OPENCV = re.compile(r"/cv2/\.\./\.\./lib\w*/?$")
"""The folders that ``import cv2`` adds to ``LD_LIBRARY_PATH``."""
_NOT_FILES = ("/proc/", "/sys/", "/dev/", "/memfd:", "/SYSV", "[")
"""Beginnings of what is mapped, or named, and is no file on a disk."""
_REMOVED = " (deleted)"
"""Stands behind the name of a mapped file that was removed."""


def is_counted(variable: str) -> bool:
    """Whether the value of an environment variable counts where foreign code looks it up."""
    return variable not in _UNCOUNTED


def program_environment(
    declared: Iterable[str] = (), environment: Mapping[str, str] | None = None
) -> dict[str, str]:
    """The environment variables that a program gets: those that are listed above or declared, and no others.

    A result cannot depend on a variable that is not declared.

    Args:
        declared: Names of further variables that the program's settings declare; their values
            count.
        environment: Where values are taken from; None for this process's variables.
    """
    for name in declared:
        sys.audit(DECLARED_VARIABLE, name)
    source = os.environ if environment is None else environment
    names = (*RESULT_VARIABLES, *RUN_VARIABLES, *PLACE_VARIABLES, *declared)
    variables = {name: source[name] for name in names if name in source}
    if _LIBRARIES in variables:
        variables[_LIBRARIES] = os.pathsep.join(folders_of(variables[_LIBRARIES]))
    return variables


def folders_of(search_path: str) -> list[str]:
    """The folders of a search path, but for those that ``import cv2`` adds to ``LD_LIBRARY_PATH`` in its process."""
    return [
        folder
        for folder in search_path.split(os.pathsep)
        if folder and not _OF_OPENCV.search(folder)
    ]


# -- what a command names --------------------------------------------------------------------------


@dataclass(frozen=True)
class Command:
    """A program with its arguments.

    Attributes:
        words: The program and its arguments.
        folder: Its working folder.
    """

    words: tuple[str, ...]
    folder: str

    def executable(self, search_path: str | None = None) -> str:
        """The file of the program; empty where there is none.

        Args:
            search_path: The folders in which a bare name is searched; None for ``PATH``.
        """
        if os.sep in self.words[0]:
            return os.path.normpath(os.path.join(self.folder, self.words[0]))
        return shutil.which(self.words[0], path=search_path) or ""

    def named(self, words: Sequence[str] | None = None) -> set[str]:
        """The files and folders that are there among its arguments, also behind ``=``.

        Args:
            words: Only these of them; None for all.
        """
        arguments = self.words[1:] if words is None else words
        texts: set[str] = set()
        for word in arguments:
            texts |= {word, word.partition("=")[2]}  # --config=FILE

        paths = set()
        for text in texts - {""}:
            path = os.path.normpath(os.path.join(self.folder, os.path.expanduser(text)))
            if is_file_name(path) and _is_there(path):
                paths.add(path)
        return paths


def is_file_name(path: str) -> bool:
    """Whether a path can be that of a file on a disk, and is none of the system's own or of its devices."""
    return path.startswith(os.sep) and not path.startswith(_NOT_FILES)


def _is_there(path: str) -> bool:
    try:
        return os.path.exists(path)
    except ValueError:  # a null byte
        return False


# -- what processes show ---------------------------------------------------------------------------


@dataclass
class ProgramReads:
    """Files and commands of a program's processes.

    Attributes:
        files: Executables and everything that is mapped into memory, each with its time of
            modification when it was seen first, in nanoseconds; None where it was not there.
        replaced: Files of `files` that were removed while they were mapped: another file lies in
            their place.
        commands: The command of each process.
    """

    files: dict[str, int | None] = field(default_factory=dict)
    replaced: set[str] = field(default_factory=set)
    commands: set[Command] = field(default_factory=set)


def look_at(process: psutil.Process, reads: ProgramReads) -> None:
    """Add what one process shows; nothing where it has ended."""
    with contextlib.suppress(psutil.Error, OSError):
        words = process.cmdline()
        mapped = mapped_files(process.pid)
        if words:
            reads.commands.add(Command(tuple(words), process.cwd()))
        for file in {process.exe(), *mapped}:
            if is_file_name(file):
                reads.files.setdefault(file, modified_time_ns(file))
            if mapped.get(file) and os.path.exists(file):
                reads.replaced.add(file)


def modified_time_ns(file: str) -> int | None:
    """The time of modification of a file in nanoseconds; None where it is not there."""
    try:
        return os.stat(file).st_mtime_ns
    except OSError:
        return None


def mapped_files(pid: int) -> dict[str, bool]:
    """The files that are mapped into a process's memory, and whether each was removed since.

    Empty where the system does not tell.

    Raises:
        OSError: The process has ended or is another user's.
        psutil.Error: The process has ended or is another user's, on systems without ``/proc``.
    """
    maps = Path(f"/proc/{pid}/maps")
    if maps.is_file():
        return dict(_paths_in(maps.read_text(errors="surrogateescape").splitlines()))
    process = psutil.Process(pid)
    if not hasattr(process, "memory_maps"):  # macOS
        return {}
    return {entry.path: False for entry in process.memory_maps() if is_file_name(entry.path)}


def _paths_in(maps: Sequence[str]) -> Iterator[tuple[str, bool]]:
    """The paths in a table of mapped memory, its sixth column, which may hold spaces; and whether each was removed."""
    for line in maps:
        columns = line.split(maxsplit=5)
        if len(columns) == 6 and is_file_name(columns[5]):
            path = columns[5].removesuffix(_REMOVED)
            yield path, path != columns[5]
