"""Identity of what a result was made of: digests of code, weights, machine and content.

Run ids and the stage cache's keys are made of these, of the code in `core.module_graph`, and of
what plug-ins read (`core.reads`): where anything of it differs, so does the id.
"""

import contextlib
import hashlib
import importlib.metadata
import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dynslam_bench.core.code_files import leads_back
from dynslam_bench.core.errors import DynslamError, PluginError, translate_errors
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.folders import digest_cache_folder
from dynslam_bench.core.reading import file_sha256
from dynslam_bench.core.records import Record, digest
from dynslam_bench.core.settings import Settings, field_names, references_of
from dynslam_bench.core.version import release, version

OPENCV = (
    "opencv-python-headless",
    "opencv-python",
    "opencv-contrib-python-headless",
    "opencv-contrib-python",
)
"""The distributions that bring OpenCV; more than one may be installed, over each other."""
_STAGES_NEED = ("numpy", "torch", "numba")
"""Further distributions whose version may change a stage's result."""
_FILE_PREFIXES = ("onnx", "tflite", "weights", "recorded")
"""Segmenters' ids that begin so, with a colon, name a file or folder."""
_MANY_FILES = 200
"""A folder with more files holds data: a word that happens to be its name does not name it."""


# -- what settings name ----------------------------------------------------------------------------


def named_digests(settings: Settings, *, words: bool = False) -> dict[str, str]:
    """Digest of the content of every file and folder that settings name and that is there, by the setting's name.

    A setting counts that is declared to name a file (`core.settings.names`), a path in it at any
    depth of lists and tables, and a text with the prefix ``onnx:``, ``tflite:``,
    ``weights:`` or ``recorded:``.
    So does a text that is written as a path, with a separator, or as a file's name with an ending,
    where that is there. ``~`` and ``$VARIABLE`` are replaced. A bare word without an ending is a
    word, whatever lies in the working folder, unless `words` is set. The description of a tracker
    does not count: its version has what decides of it.

    Args:
        settings: The settings.
        words: Whether a bare word counts, too, where a file or a folder of at most `_MANY_FILES`
            files has that name: a plug-in may open it.

    Raises:
        PluginError: One cannot be read.
    """
    # declared names, also where nothing tells them from a word
    references = references_of(settings)
    texts = {name: value for name, (kind, value) in references.items() if kind == "file"}

    # then what is written as a path, at any depth of a setting's value
    descriptions = {name for name, (kind, _) in references.items() if kind == "description"}
    for name in field_names(type(settings)):
        if name in descriptions:
            continue
        for setting, value in _leaves_of(name, attrgetter(name)(settings)):
            text = _path_in(value)
            is_file = os.path.isfile(value)  # noqa: PTH113 - any text
            if not text and words and (is_file or _is_small_folder(value)):
                text = str(value)
            if text:
                texts.setdefault(setting, text)

    digests = {}
    for name, text in texts.items():
        digest_now = _digest_at(text, name)
        if digest_now:
            digests[name] = digest_now
    return digests


def named_digest(name: str, value: str | Path) -> str:
    """Digest of the content of the file or folder that one setting names; empty where there is none.

    Args:
        name: The setting, for messages.
        value: Its value, as `named_digests` reads it.

    Raises:
        PluginError: It cannot be read.
    """
    return _digest_at(_path_in(value) or str(value), name)


def _digest_at(text: str, setting: str) -> str:
    """Sixteen digits of the SHA-256 of what lies at a path, empty for nothing; ``~`` and ``$VARIABLE`` are replaced."""
    path = Path(os.path.expandvars(text)).expanduser()
    with translate_errors(PluginError, f"cannot read {path}, which the setting '{setting}' names"):
        return path_digest(path)[:16] if path.exists() else ""


def _path_in(value: str | Path) -> str:
    """The path that a setting's value names; empty for one that names none."""
    if isinstance(value, Path):
        return str(value)
    prefix, _, argument = value.partition(":")
    if prefix in _FILE_PREFIXES and argument:
        return argument
    path = os.path.expanduser(os.path.expandvars(value))  # noqa: PTH111 - any text, which Path may refuse
    is_written_as_path = os.sep in path
    is_written_as_file = bool(os.path.splitext(path)[1])  # noqa: PTH122
    if is_written_as_path and os.path.exists(path):  # noqa: PTH110
        return value
    if is_written_as_file and os.path.isfile(path):  # noqa: PTH113
        return value
    return ""


def _is_small_folder(value: str | Path) -> bool:
    """Whether a text is the name of a folder of few files, which is no results folder."""
    if not os.path.isdir(value) or not str(value).strip("."):  # noqa: PTH112 - any text
        return False
    if os.path.isdir(os.path.join(value, "runs")):  # noqa: PTH112, PTH118
        return False
    files = (name for _, _, names in os.walk(value) for name in names)
    return 0 < sum(1 for _ in islice(files, _MANY_FILES + 1)) <= _MANY_FILES


def _leaves_of(name: str, value: object) -> Iterator[tuple[str, str | Path]]:
    """All texts and paths in a setting's value, which may be nested, with their dotted names."""
    if isinstance(value, str | Path):
        yield name, value
    elif isinstance(value, Settings):
        for key, inner in value:
            yield from _leaves_of(f"{name}.{key}", inner)
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves_of(f"{name}.{key}", inner)
    elif isinstance(value, list | tuple | set | frozenset):
        for index, inner in enumerate(value):
            yield from _leaves_of(f"{name}.{index}", inner)


# -- installed distributions -----------------------------------------------------------------------


def distribution_of_module(module: str) -> tuple[str, str]:
    """Name and version of the distribution that a module comes from; empty where it is not known."""
    names = _distributions().get(module.partition(".")[0], ())
    if not names:
        return "", ""
    return names[0], distribution_version(names[0])


_distributions = cache(importlib.metadata.packages_distributions)


# -- machine and content ---------------------------------------------------------------------------


@cache
def opencv_version() -> str:
    """Every installed distribution of OpenCV with its version; that of the module for a build of one's own."""
    numbers = {name: distribution_version(name) for name in OPENCV}
    installed = [f"{name} {number}" for name, number in numbers.items() if number]
    if installed or find_spec("cv2") is None:
        return ", ".join(installed)
    import cv2

    return f"cv2 {cv2.__version__}"


def distribution_version(name: str) -> str:
    """Version of an installed distribution, empty if it is not there."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""


@cache
def machine_digest() -> str:
    """Short digest of the machine and the versions that change a stage's result or its cost."""
    versions = {name: distribution_version(name) for name in _STAGES_NEED}
    software = {"dynslam-bench": release(), "opencv": opencv_version(), **versions}
    return digest({"node": platform.node(), "cpu": _cpu_model(), "versions": software})


def content_digest(*arrays: NDArray[Any]) -> str:
    """Digest of the bytes, shapes and types of arrays: sixteen bytes of BLAKE2b, in hexadecimal."""
    state = hashlib.blake2b(digest_size=16)
    for array in arrays:
        state.update(f"{array.dtype.str}{array.shape}".encode())
        state.update(np.ascontiguousarray(array).data)
    return state.hexdigest()


# -- file contents, whose digests are remembered while the files are unchanged ---------------------

_SETTLED_NS = 2_000_000_000
"""Digests of files that are younger are not stored: a change within the same tick of the clock would not show."""


def contents_digest(files: Iterable[str | Path], root: Path | None = None) -> str:
    """SHA-256 of the contents of files.

    Args:
        files: The files.
        root: A folder above all of them: their names below it count, and their order does not. None:
            their order counts, and their names do not.

    Raises:
        OSError: One cannot be read.
    """
    ordered = list(files) if root is None else sorted(files)

    def compute() -> str:
        state = hashlib.sha256()
        for file in map(Path, ordered):
            name = "" if root is None else f"{file.relative_to(root).as_posix()}\0"
            state.update(f"{name}{file_sha256(file)}\n".encode(errors="surrogateescape"))
        return state.hexdigest()

    return _remembered(f"bytes {root}", ordered, compute)


def path_digest(path: Path) -> str:
    """SHA-256 of a file's content, or of the names and contents of all files in a folder.

    Raises:
        OSError: Something cannot be read.
    """
    if path.is_file():
        return _remembered("file", [path], lambda: file_sha256(path))
    files: list[Path] = []
    for place, folders, names in os.walk(path, followlinks=True):
        # os.walk goes into the folders that are left in this list
        folders[:] = [name for name in folders if not leads_back(Path(place, name))]
        entries = [Path(place, name) for name in names]
        files += [entry for entry in entries if entry.is_file()]
    return contents_digest(files, path)


def _remembered(kind: str, files: Sequence[str | Path], compute: Callable[[], str]) -> str:
    """A digest of files from the user's cache, or computed and stored there.

    Args:
        kind: What is computed.
        files: The files; the stored digest holds while path, size, times and inode of each stay.
        compute: Computes it: 64 hexadecimal digits.

    Raises:
        OSError: A file is not there, or cannot be read.
    """
    state, newest_ns = _files_state(files)
    key = hashlib.sha256(f"{kind}\0{state}".encode()).hexdigest()
    entry = digest_cache_folder() / key[:40]
    with contextlib.suppress(OSError):
        stored = entry.read_text(encoding="ascii", errors="replace")
        if len(stored) == 64:  # else it was cut off
            return stored

    value = compute()
    if time.time_ns() - newest_ns > _SETTLED_NS:
        with contextlib.suppress(DynslamError):  # a cache that cannot be written costs time only
            write_atomic(entry, value)
    return value


def _files_state(files: Sequence[str | Path]) -> tuple[str, int]:
    """Digest of path, size, times and inode of each file, and the newest of the times in nanoseconds.

    Raises:
        OSError: One is not there.
    """
    stats = [os.stat(file) for file in files]  # noqa: PTH116 - thousands: pathlib takes several times as long
    texts = [
        f"{os.path.abspath(file)}\0{stat.st_size},{stat.st_mtime_ns},{stat.st_ctime_ns},{stat.st_ino}\n"  # noqa: PTH100
        for file, stat in zip(files, stats, strict=True)
    ]
    newest = max((max(stat.st_mtime_ns, stat.st_ctime_ns) for stat in stats), default=0)
    return hashlib.sha256("".join(texts).encode(errors="surrogateescape")).hexdigest(), newest


# -- where and with what a run was made ------------------------------------------------------------

PACKAGES = ("numpy", "scipy", "torch", "numba", "gtsam", "gymnasium", "optuna")
"""The packages whose versions a run's record states."""


class Machine(Record):
    """The computer, without its name.

    Attributes:
        cpu: Model name.
        cores: Logical processors that the process may use.
        memory_gb: Main memory.
        system: Operating system and architecture.
        gpu: Name of the GPU the run used, empty without one.
    """

    cpu: str
    cores: int
    memory_gb: float
    system: str
    gpu: str = ""


class GitRevision(Record):
    """The checkout the package was imported from.

    Attributes:
        revision: Commit hash.
        dirty: Whether tracked files differ from it.
    """

    revision: str
    dirty: bool


@cache
def this_machine() -> Machine:
    """This computer."""
    # macOS has no affinity
    affinity = getattr(os, "sched_getaffinity", None)
    cores = (os.cpu_count() or 1) if affinity is None else len(affinity(0))
    memory_bytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return Machine(
        cpu=_cpu_model(),
        cores=cores,
        memory_gb=round(memory_bytes / 1e9, 1),
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
    )


@cache
def versions() -> dict[str, str]:
    """Versions of Python, of this package and of those that a result depends on; missing ones are left out."""
    numbers = {"python": platform.python_version(), "dynslam-bench": version()}
    numbers |= {name: distribution_version(name) for name in PACKAGES}
    numbers["opencv"] = opencv_version()
    return {name: number for name, number in numbers.items() if number}


@cache
def git_revision() -> GitRevision | None:
    """The commit of the checkout that the package lies in; None for an installed package or without git."""
    checkout = Path(__file__).resolve().parents[2]
    if not (checkout / "pyproject.toml").is_file() or not (checkout / ".git").exists():
        return None
    git = ("git", "-C", str(checkout))
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        changes = _output_of(*git, "status", "--porcelain", "--untracked-files=no")
        return GitRevision(revision=_output_of(*git, "rev-parse", "HEAD"), dirty=bool(changes))
    return None


def _output_of(*command: str) -> str:
    """The output of a command, without white space around it.

    Raises:
        OSError: It cannot be started.
        subprocess.SubprocessError: It fails, or takes longer than ten seconds.
    """
    ended = subprocess.run(command, check=True, capture_output=True, text=True, timeout=10)
    return ended.stdout.strip()


def _cpu_model() -> str:
    """The processor's name; that of the architecture where the system does not tell."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(errors="replace").splitlines() if info.is_file() else []
    for line in lines:
        if line.lower().startswith(("model name", "hardware")):  # the latter on ARM
            return line.partition(":")[2].strip()
    with contextlib.suppress(OSError, subprocess.SubprocessError):  # macOS
        return _output_of("sysctl", "-n", "machdep.cpu.brand_string")
    return platform.processor() or platform.machine()
