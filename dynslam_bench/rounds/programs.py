"""The program of an entry's tracker: what is frozen, and what of it has changed."""

import contextlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dynslam_bench.core import RunError, file_sha256, translate_errors
from dynslam_bench.core.libraries import library_identity
from dynslam_bench.core.reads import (
    ABSENT,
    BYTE_CODE_FOLDER,
    UNREADABLE,
    BaseFolders,
    Reads,
    Verifier,
)
from dynslam_bench.rounds.files import Entry, Program
from dynslam_bench.runs.identity import resolve
from dynslam_bench.runs.own_code import is_file, is_outside_package, module_of

_BEFORE_ENTRIES = re.compile(r"/[^\"\s]*?/(?=entries/)")
"""The part of an absolute path that differs from machine to machine: the round's folder."""
_PLUGIN_FILES = "plugin:"
_WORK_FILES = "work:/"
_ENTRY_FILES = "work:/entries/"
"""Beginnings of names of files beside the plug-in, in the round's folder, below its ``entries``; see `BaseFolders`."""
_VERSION = "its version"


@contextlib.contextmanager
def working_in(folder: Path) -> Iterator[None]:
    """Make a folder the working folder while the block lasts: entries name their files from the round's folder."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def program_of(name: str, identity: Mapping[str, Any]) -> Program:
    """The frozen part of a run's identity.

    Args:
        name: Name of the entry, whose files lie in ``entries/NAME``, or beside the plug-in.
        identity: As a run's record has it, or as `ResolvedRun.identity` gives it before the run: then
            what a plug-in reads is not known yet.
    """
    # the code: of each part, of packages that the tracker needs, its own version
    code = {str(part): str(digest) for part, digest in identity.get("source", {}).items()}
    code |= {f"package {top}": str(text) for top, text in identity.get("requires", {}).items()}
    for part in identity.get("parts", ()):
        if is_outside_package(part) and not is_file(part):
            package = module_of(part).partition(".")[0]
            code[f"package {package}"] = library_identity(package)
    code[_VERSION] = str(identity.get("tracker_version", ""))

    # the files that a plug-in or a program has read, without those of the system: these differ by machine
    files = {}
    reads = identity.get("reads")
    if reads is not None:
        read = Reads.model_validate(reads)
        own = (_PLUGIN_FILES, f"{_ENTRY_FILES}{name}/")
        for file, content in {**read.programs, **read.files}.items():
            if file.startswith(own) and content not in (ABSENT, UNREADABLE):
                files[file] = content
    return Program(
        settings=_portable(identity.get("settings", {})),
        code=_portable(code),
        weights=_portable(identity.get("weights", {})),
        files=files,
    )


def folder_listing(folder: Path) -> dict[str, str]:
    """SHA-256 of every file in a folder by its path from there, without compiled byte code; none without a folder.

    Raises:
        RunError: Something in it is a link or cannot be read.
    """
    listing = {}
    for path in sorted(folder.rglob("*")):
        inside = path.relative_to(folder)
        if BYTE_CODE_FOLDER in inside.parts:
            continue
        if path.is_symlink():
            raise RunError(f"{path} is a link", "put the file in its place")
        if path.is_file():
            with translate_errors(RunError, f"cannot read {path}"):
                listing[inside.as_posix()] = file_sha256(path)
    return listing


def other_folder(entry: Entry, root: Path) -> str:
    """The first file of ``entries/NAME`` that is extra, missing or changed since it was frozen; empty for none.

    Raises:
        RunError: Something in it is a link or cannot be read.
    """
    here = folder_listing(root / "entries" / entry.name)
    for file in sorted(here.keys() | entry.folder.keys()):
        path = f"entries/{entry.name}/{file}"
        if file not in here:
            return f"{path} is missing"
        if file not in entry.folder:
            return f"{path} is extra"
        if here[file] != entry.folder[file]:
            return f"{path} was changed"
    return ""


def foreign_read(entry: str, folder: Mapping[str, str], identity: Mapping[str, Any]) -> str:
    """A file of the round's folder that a run has read and that is none of the entry's own; empty for none.

    Args:
        entry: Name of the entry.
        folder: The entry's own files with their SHA-256, as `folder_listing` gives them.
        identity: As the run's record has it.
    """
    reads = identity.get("reads")
    if reads is None:
        return ""
    read = Reads.model_validate(reads)
    own = f"{_ENTRY_FILES}{entry}/"
    for name, content in sorted({**read.programs, **read.files}.items()):
        is_beside_plugin = name.startswith(_PLUGIN_FILES) and not name.endswith("/")
        if is_beside_plugin and BYTE_CODE_FOLDER not in name:
            if content not in (ABSENT, UNREADABLE, *folder.values()):
                return name
        is_file_of_round = name.startswith(_WORK_FILES) and not name.endswith("/")
        if not is_file_of_round or content in (ABSENT, UNREADABLE) or BYTE_CODE_FOLDER in name:
            continue
        if not name.startswith(own):
            return name.removeprefix(_WORK_FILES)
        if folder.get(name.removeprefix(own)) != content:
            return name.removeprefix(_WORK_FILES)
    return ""


def _portable(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values in which paths into a round's ``entries`` begin there, as JSON gives them back."""
    text = _BEFORE_ENTRIES.sub("", json.dumps(values, default=str))
    return dict(json.loads(text))


def what_changed(entry: Entry, root: Path, sequence: str) -> str:
    """The first part of an entry's tracker that is another one here, in words; empty where it is the frozen one.

    Args:
        entry: The entry.
        root: The round's folder, which is the working folder.
        sequence: A sequence, on which nothing is run.

    Raises:
        DynslamError: The tracker is not here, or its settings do not fit.
    """
    resolved = resolve(entry.spec(sequence))
    # what the entrant has written
    folders = BaseFolders(plugin=resolved.base_folders.plugin, work=root)
    if changed := Verifier().changed(Reads(files=entry.program.files), folders):
        return changed
    return difference(entry.program, program_of(entry.name, resolved.identity))


def difference(frozen: Program, now: Program) -> str:
    """The first thing in which two programs differ, in words; files that only one of them has read do not count."""
    if name := _first_difference(frozen.settings, now.settings):
        return f"the setting {name}, which was {frozen.settings.get(name)!r} and is {now.settings.get(name)!r},"
    if name := _first_difference(frozen.code, now.code):
        return name if name == _VERSION else f"the code of {module_of(name)}"
    if name := _first_difference(frozen.weights, now.weights):
        return f"the weights of {name}"
    common = frozen.files.keys() & now.files.keys()
    return next((name for name in sorted(common) if frozen.files[name] != now.files[name]), "")


def _first_difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """The first name under which two tables hold different values; empty where they are equal."""
    names = sorted(before.keys() | now.keys())
    return next((name for name in names if before.get(name) != now.get(name)), "")
