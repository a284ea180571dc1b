"""The program of an entry's tracker: what is frozen, and what of it has changed."""

import contextlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dynslam_bench.core.libraries import library_identity
from dynslam_bench.core.reads import ABSENT, UNREADABLE, BaseFolders, Reads, Verifier
from dynslam_bench.rounds.files import Entry, Program
from dynslam_bench.runs.identity import resolve
from dynslam_bench.runs.own_code import is_file, is_outside_package, module_of

_BEFORE_ENTRIES = re.compile(r"/[^\"\s]*?/(?=entries/)")
"""The part of an absolute path that differs from machine to machine: the round's folder."""
_PLUGIN_FILES = "plugin:"
_ENTRY_FILES = "work:/entries/"
"""Beginnings of names of files that lie beside the plug-in and below the round's ``entries``, see `BaseFolders`."""
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
