"""What a result was made of: digests of code, weights, machine and content.

Run ids and the stage cache's keys are made of these and nothing else, so that what is another run is another entry.
Everything is read from files and folders: no plug-in is imported to know its digest.
"""

import ast
import contextlib
import hashlib
import importlib.metadata
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import dynslam_bench
from dynslam_bench.core.code_files import (
    files_below,
    foreign_modules,
    imported_modules,
    is_code,
    is_installed,
    leads_back,
    parsed,
    program_files,
)
from dynslam_bench.core.errors import DynslamError, PluginError, raising
from dynslam_bench.core.files import write_atomic
from dynslam_bench.core.folders import digest_cache_folder
from dynslam_bench.core.reading import file_sha256
from dynslam_bench.core.records import Record, digest
from dynslam_bench.core.settings import Settings, flatten, named
from dynslam_bench.core.version import release

OPENCV = ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python")
"""The distributions that bring OpenCV; more than one may be installed, over each other."""
_STAGES_NEED = ("numpy", "torch", "numba")
"""Further distributions whose version may change a stage's result."""
_OWN = "dynslam_bench"
_FILE_PREFIXES = ("onnx", "weights", "recorded")


# -- what settings name ------------------------------------------------------------------------------------------------


def named_digests(settings: Settings) -> dict[str, str]:
    """Digest of the content of every file and folder that settings name and that is there, by the setting's name.

    A setting counts that is declared to name a file (`core.settings.names`, or of type `Path`), and one with the prefix
    ``onnx:``, ``weights:`` or ``recorded:``. So does one that is written as the path of a file: with a separator. A
    bare word is a word, whatever lies in the working folder.

    Raises:
        PluginError: One cannot be read.
    """
    texts = {name: value for name, (kind, value) in named(settings).items() if kind == "file"}
    for name, value in flatten(settings).items():
        for setting, text in _texts(name, value):
            prefix, _, argument = text.partition(":")
            if prefix in _FILE_PREFIXES and argument:
                texts.setdefault(setting, argument)
            elif os.sep in text and os.path.isfile(Path(text).expanduser()):  # noqa: PTH113 - any text
                texts.setdefault(setting, text)
    digests = {}
    for name, text in texts.items():
        path = Path(text).expanduser()
        with raising(PluginError, f"cannot read {path}, which the setting '{name}' names"):
            if path.exists():
                digests[name] = path_digest(path)[:16]
    return digests


def _texts(name: str, value: object) -> Iterator[tuple[str, str]]:
    """All strings in a setting's value, which may be a free table of options, with their dotted names."""
    if isinstance(value, str):
        yield name, value
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _texts(f"{name}.{key}", inner)
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            yield from _texts(f"{name}.{index}", inner)


# -- code --------------------------------------------------------------------------------------------------------------


def code_digest(entry_point: str, packages: Sequence[str]) -> str:
    """Digest of the code behind an entry point as it is on the disk now: packages of ours and a plug-in's files.

    A plug-in in a file counts with the code of its folder and the data files that this names, one in a package with all
    files of its top-level package. Python sources count by their syntax: comments and docstrings change nothing.

    Args:
        entry_point: ``module:Attr`` or ``file.py:Attr``.
        packages: The subpackages of this package that it may use, e.g. ``features``.

    Raises:
        PluginError: The plug-in's files cannot be found or read.
    """
    return digest([package_digest(packages), plugin_digest(entry_point)])


def plugin_digest(entry_point: str) -> str:
    """Digest of a plug-in's own files and of what they import; empty for what this package brings.

    An imported module counts with the version of its distribution, or with its files where it is installed for
    development or lies on the path.

    Raises:
        PluginError: The files cannot be found or read.
    """
    module = entry_point.rpartition(":")[0]
    top = module.partition(".")[0]
    if top == _OWN and not module.endswith(".py"):
        return ""
    with raising(PluginError, f"cannot read the code of plug-in '{entry_point}'"):
        if module.endswith(".py"):
            file = Path(module).expanduser().resolve()
            files = program_files(file.parent)
            return digest([contents_digest(files, file.parent), _dependencies(foreign_modules(file))])
        places = _folders_of(top)
        names = imported_modules(file for place in places for file in _files_of(place)) - {top}
        return digest([[_whole(place) for place in places], _dependencies(names)])


def _dependencies(modules: set[str]) -> dict[str, str]:
    """What modules beside this package and the standard library are: versions, or digests of development code.

    Those that cannot be found are left out: an import that may fail.

    Raises:
        OSError: A file cannot be read.
    """
    digests: dict[str, str] = {}
    waiting = set(modules)
    while waiting:
        top = waiting.pop()
        if top in digests or top == _OWN or top in sys.stdlib_module_names:
            continue
        try:
            places = _folders_of(top)
        except (PluginError, ImportError, ValueError):
            continue
        if is_installed(places[0]):
            digests[top] = distribution_of_module(top)[1]
        else:
            digests[top] = digest([_whole(place) for place in places])
            waiting |= imported_modules(file for place in places for file in _files_of(place))
    return digests


def distribution_of_module(module: str) -> tuple[str, str]:
    """Name and version of the distribution that a module comes from; empty where it is not known."""
    names = _distributions().get(module.partition(".")[0], ())
    return (names[0], distribution_version(names[0])) if names else ("", "")


_distributions = cache(importlib.metadata.packages_distributions)


def package_digest(packages: Sequence[str]) -> str:
    """Digest of the code of packages of this package; read once a process, as its modules are."""
    return digest([[folder.name, _package_code(folder)] for folder in _own_folders(packages)])


def has_package_changed(packages: Sequence[str]) -> bool:
    """Whether the code of packages of this package differs from what this process read first."""
    return any(_package_code.__wrapped__(folder) != _package_code(folder) for folder in _own_folders(packages))


def _own_folders(packages: Sequence[str]) -> list[Path]:
    folders = (Path(place, name) for place in dynslam_bench.__path__ for name in packages)
    return [folder for folder in folders if folder.is_dir()]


@cache
def _package_code(folder: Path) -> str:
    return contents_digest([file for file in files_below(folder) if is_code(file)], folder)


def _files_of(place: Path) -> list[Path]:
    return [place] if place.is_file() else list(files_below(place))


def _whole(place: Path) -> str:
    return contents_digest(_files_of(place), place.parent if place.is_file() else place)


def _folders_of(top: str) -> list[Path]:
    """Where a top-level package or module lies: its folders (several for a namespace package) or its one file."""
    spec = getattr(sys.modules.get(top), "__spec__", None) or find_spec(top)
    if spec is not None and spec.submodule_search_locations:
        return [Path(folder) for folder in spec.submodule_search_locations]
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        raise PluginError(
            f"the code of '{top}' cannot be found, so its runs could not be told apart", "is it installed?"
        )
    return [Path(spec.origin)]


# -- machine and content -----------------------------------------------------------------------------------------------


@cache
def opencv_version() -> str:
    """Every installed distribution of OpenCV with its version; that of the module for a build of one's own."""
    versions = [f"{name} {number}" for name in OPENCV if (number := distribution_version(name))]
    if versions or find_spec("cv2") is None:
        return ", ".join(versions)
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
    """Digest of the bytes, shapes and types of arrays."""
    state = hashlib.blake2b(digest_size=16)
    for array in arrays:
        state.update(f"{array.dtype.str}{array.shape}".encode())
        state.update(np.ascontiguousarray(array).data)
    return state.hexdigest()


# -- file contents, whose digests are remembered while the files are unchanged ----------------------------------------

_SETTLED_NS = 2_000_000_000
"""Digests of files that are younger are not stored: a change within the same tick of the clock would not show."""


def contents_digest(files: Iterable[str | Path], root: Path | None = None, *, syntax: bool = True) -> str:
    """SHA-256 of the contents of files.

    Args:
        files: The files; without a root their order counts and their names do not.
        root: A folder; with one their names below it count and their order does not.
        syntax: Whether Python sources count by `syntax_digest`, and not by their bytes.

    Raises:
        OSError: One cannot be read.
    """
    ordered = list(files) if root is None else sorted(files)

    def compute() -> str:
        whole = hashlib.sha256()
        for file in map(Path, ordered):
            name = "" if root is None else f"{file.relative_to(root).as_posix()}\0"
            content = syntax_digest(file.read_bytes()) if syntax and file.suffix == ".py" else file_sha256(file)
            whole.update(f"{name}{content}\n".encode(errors="surrogateescape"))
        return whole.hexdigest()

    return _remembered(f"contents {root} {syntax}", ordered, compute)


def path_digest(path: Path) -> str:
    """SHA-256 of a file's content, or of the names and contents of all files in a folder.

    Raises:
        OSError: Something cannot be read.
    """
    if path.is_file():
        return _remembered("file", [path], lambda: file_sha256(path))
    files = []
    for place, folders, names in os.walk(path, followlinks=True):
        folders[:] = [name for name in folders if not leads_back(Path(place, name))]
        files += [file for name in names if (file := Path(place, name)).is_file()]
    return contents_digest(files, path, syntax=False)


def syntax_digest(source: bytes) -> str:
    """SHA-256 of a Python source's syntax tree without comments, layout and docstrings.

    It does not depend on the version of Python that parses it. What cannot be parsed counts by its bytes.
    """
    try:
        words = "\0".join(_tokens_of(parsed(source)))
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
        for inner in node:
            if not _is_docstring(inner):
                yield from _tokens_of(inner)
    else:
        yield repr(node)


def _is_docstring(node: Any) -> bool:
    """Whether a statement is a string alone, which does nothing."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _remembered(kind: str, files: Sequence[str | Path], compute: Callable[[], str]) -> str:
    state, newest = _files_state(files)
    key = hashlib.sha256(f"{kind}\0{state}".encode()).hexdigest()
    entry = digest_cache_folder() / key[:40]
    with contextlib.suppress(OSError):
        stored = entry.read_text(encoding="ascii", errors="replace")
        if len(stored) == 64:
            return stored
    value = compute()
    if time.time_ns() - newest > _SETTLED_NS:
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


# -- where and with what a run was made --------------------------------------------------------------------------------

PACKAGES = ("numpy", "scipy", "torch", "numba", "gtsam", "gymnasium", "optuna")


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
    affinity = getattr(os, "sched_getaffinity", None)
    return Machine(
        cpu=_cpu_model(),
        cores=len(affinity(0)) if affinity is not None else os.cpu_count() or 1,
        memory_gb=round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
    )


@cache
def versions() -> dict[str, str]:
    """Versions of Python, of this package and of those that a result depends on; missing ones are left out."""
    environment = {"python": platform.python_version(), "dynslam-bench": dynslam_bench.__version__}
    environment |= {name: distribution_version(name) for name in PACKAGES} | {"opencv": opencv_version()}
    return {name: number for name, number in environment.items() if number}


@cache
def git_revision() -> GitRevision | None:
    """The commit of the checkout that the package lies in; None for an installed package or without git."""
    checkout = Path(dynslam_bench.__file__).resolve().parent.parent
    if not (checkout / "pyproject.toml").is_file() or not (checkout / ".git").exists():
        return None
    git = ("git", "-C", str(checkout))
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        changes = _output_of(*git, "status", "--porcelain", "--untracked-files=no")
        return GitRevision(revision=_output_of(*git, "rev-parse", "HEAD"), dirty=bool(changes))
    return None


def _output_of(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=10).stdout.strip()


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    for line in info.read_text(errors="replace").splitlines() if info.is_file() else ():
        if line.lower().startswith(("model name", "hardware")):
            return line.partition(":")[2].strip()
    with contextlib.suppress(OSError, subprocess.SubprocessError):  # macOS
        return _output_of("sysctl", "-n", "machdep.cpu.brand_string")
    return platform.processor() or platform.machine()
