"""What a result was made of: digests of code, weights, machine and content.

Run ids and the stage cache's keys are made of these and nothing else, so that what is another run is another entry.
Everything is read from files and folders: no plug-in is imported to know its digest.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import dynslam_bench

from .code_files import files_below, foreign_modules, imported_modules, is_code, program_files
from .digests import code_files_digest, path_digest
from .errors import PluginError
from .records import digest
from .settings import Settings, flatten, named
from .version import release

OPENCV = ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python")
"""The distributions that bring OpenCV; more than one may be installed, over each other."""
_STAGES_NEED = ("numpy", "torch", "numba")
"""Further distributions whose version may change a stage's result."""
_OWN = "dynslam_bench"
_FILE_PREFIXES = ("onnx", "weights", "recorded")
_LONGEST_PATH = 1000


# -- what settings name ------------------------------------------------------------------------------------------------


def named_files(settings: Settings) -> dict[str, Path]:
    """The files and folders that settings name, by the setting's name, where they are there.

    A setting counts that is declared to name a file (`core.settings.names`, or of type `Path`), that carries one of the
    prefixes ``onnx:``, ``weights:`` and ``recorded:``, or that is written as the path of a file: with a separator. A
    bare word is a word, whatever lies in the working folder.
    """
    texts = {name: value for name, (kind, value) in named(settings).items() if kind == "file"}
    for name, value in flatten(settings).items():
        for path, text in _texts(name, value):
            prefix, _, argument = text.partition(":")
            if path in texts:
                continue
            if prefix in _FILE_PREFIXES and argument:
                texts[path] = argument
            elif os.sep in text and len(text) < _LONGEST_PATH and Path(text).expanduser().is_file():
                texts[path] = text
    paths = {name: Path(text).expanduser() for name, text in texts.items()}
    return {name: path for name, path in paths.items() if path.exists()}


def named_digests(settings: Settings) -> dict[str, str]:
    """Digest of the content of every file and folder that settings name, by the setting's name.

    Raises:
        PluginError: One cannot be read.
    """
    found = {}
    for name, path in named_files(settings).items():
        try:
            found[name] = path_digest(path)[:16]
        except OSError as error:
            raise PluginError(f"cannot read {path}, which the setting '{name}' names: {error.strerror}") from error
    return found


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


def code_digest(entry_point: str, rooms: Sequence[str]) -> str:
    """Digest of the code behind an entry point as it lies on the disk now: this package's rooms and a plug-in's files.

    A plug-in in a file counts with the code of its folder and the data files that this names, one in a package with all
    files of its top-level package. Python sources count by their syntax: comments and docstrings change nothing.

    Args:
        entry_point: ``module:Attr`` or ``file.py:Attr``.
        rooms: The rooms of this package that it may use, e.g. ``features``.

    Raises:
        PluginError: The plug-in's files cannot be found or read.
    """
    return digest([package_digest(tuple(rooms)), plugin_digest(entry_point)])


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
    try:
        if module.endswith(".py"):
            file = Path(module).expanduser().resolve()
            files = program_files(file.parent)
            return digest([code_files_digest(files, file.parent), _dependencies(foreign_modules(file))])
        places = _folders_of(top)
        names = imported_modules(file for place in places for file in _files_of(place)) - {top}
        return digest([[_whole(place) for place in places], _dependencies(names)])
    except OSError as error:
        raise PluginError(f"cannot read the code of plug-in '{entry_point}': {error}") from error


def _dependencies(modules: set[str]) -> dict[str, str]:
    """What modules beside this package and the standard library are: versions, or digests of development code.

    Those that cannot be found are left out: an import that may fail.

    Raises:
        OSError: A file cannot be read.
    """
    found: dict[str, str] = {}
    waiting = set(modules)
    while waiting:
        top = waiting.pop()
        if top in found or top == _OWN or top in sys.stdlib_module_names:
            continue
        try:
            places = _folders_of(top)
        except (PluginError, ImportError, ValueError):
            continue
        if any(part in ("site-packages", "dist-packages") for part in places[0].parts):
            found[top] = distribution_of_module(top)[1]
        else:
            found[top] = digest([_whole(place) for place in places])
            waiting |= imported_modules(file for place in places for file in _files_of(place))
    return found


def distribution_of_module(module: str) -> tuple[str, str]:
    """Name and version of the distribution that a module comes from; empty where it is not known."""
    names = _distributions().get(module.partition(".")[0], ())
    return (names[0], distribution_version(names[0])) if names else ("", "")


@cache
def _distributions() -> Mapping[str, Sequence[str]]:
    return importlib.metadata.packages_distributions()


@cache
def package_digest(rooms: tuple[str, ...]) -> str:
    """Digest of the code of rooms of this package; read once a process, as its modules are."""
    folders = [Path(folder) / room for folder in dynslam_bench.__path__ for room in rooms]
    codes = {folder: [file for file in files_below(folder) if is_code(file)] for folder in folders if folder.is_dir()}
    return digest([[folder.name, code_files_digest(files, folder)] for folder, files in codes.items()])


def _files_of(place: Path) -> list[Path]:
    return [place] if place.is_file() else list(files_below(place))


def _whole(place: Path) -> str:
    return code_files_digest(_files_of(place), place.parent if place.is_file() else place)


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
    found = [f"{name} {number}" for name in OPENCV if (number := distribution_version(name))]
    if found or find_spec("cv2") is None:
        return ", ".join(found)
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
    found = {"dynslam-bench": release(), "opencv": opencv_version(), **versions}
    return digest({"node": platform.node(), "cpu": _cpu_name(), "versions": found})


def content_digest(*arrays: NDArray[Any]) -> str:
    """Digest of the bytes, shapes and types of arrays."""
    state = hashlib.blake2b(digest_size=16)
    for array in arrays:
        state.update(f"{array.dtype.str}{array.shape}".encode())
        state.update(np.ascontiguousarray(array).data)
    return state.hexdigest()


def _cpu_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
