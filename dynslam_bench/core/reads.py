"""Files, variables and modules that foreign code read while a run was made, and whether they are still the same.

A run is valid as long as all that it read is unchanged. `runs.process.recorder` records what
plug-ins and programs read. This module holds the record (`Reads`) and compares it with what is
there now (`Verifier`).
"""

import hashlib
import importlib.machinery
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from dynslam_bench.core.fingerprint import path_digest
from dynslam_bench.core.programs import folders_of, is_counted
from dynslam_bench.core.records import Record, digest

ABSENT = ""
"""Stands for what was looked for and was not there."""
UNREADABLE = "unreadable"
"""Stands for what is there and cannot be read."""
INSTALLED = "installed"
"""Place of a module that lies beside its distribution's metadata; the distribution tells its content."""
SEARCH_PATHS = ("PYTHONPATH", "LD_LIBRARY_PATH", "LD_PRELOAD")
"""Environment variables whose folders count in their order (`Reads.search`)."""
COMMAND = "command "
"""Begins, in `Reads.search`, the name of a command that was looked up on ``PATH``."""
ALL_VARIABLES = "all names"
"""Stands, in `Reads.environment`, for the names of all variables that are set; it comes after each ``$NAME``."""
BYTE_CODE_FOLDER = "__pycache__"
"""Python writes it beside every source that it imports; its content tells nothing that the sources do not."""
_SETTLED_NS = 2_000_000_000
"""Digests of files that are younger are not kept: a change within the same tick of the clock would not show."""
_METADATA = (".dist-info", ".egg-info")
"""Endings of the names of folders that hold a distribution's metadata."""
_NOT_CONTENT = ("..", ".pyc", ".dist-info")
"""Lines of a distribution's RECORD with these differ between installations of the same files."""
_SUFFIXES = tuple(importlib.machinery.all_suffixes())
"""Endings of files that Python imports as modules."""


def _sorted(entries: dict[str, str]) -> dict[str, str]:
    return dict(sorted(entries.items()))


Entries = Annotated[dict[str, str], AfterValidator(_sorted)]
"""Name to digest, sorted by name: what was read in another order is the same record."""


class Reads(Record):
    """Digests of what foreign code read, by name; `ABSENT` stands for what was not there.

    Names of files begin in the folders of `BaseFolders`.

    Attributes:
        files: SHA-256 of each file's bytes. A name that ends in a slash is that of a folder whose
            whole content counts.
        folders: Digest of the names in each folder that was listed.
        links: Where each file or folder lies that was reached through symbolic links.
        environment: Digest of the value of each environment variable, by ``$NAME``. Values may be
            secrets: eight digits show that one has changed and are too few to find it. Where all
            variables were listed, the digest of their names, too, by `ALL_VARIABLES`: code that
            looks for names with a beginning sees one that is set later.
        search: The paths on which libraries and modules are searched; what each command was found
            to be.
        modules: Where each module that was asked for was found, by its top-level name.
        distributions: Version and digest of the RECORD of each distribution whose modules were
            imported.
        programs: Digest of each file and folder that the processes of external programs were made
            of: executables, libraries, and what their command lines name.
    """

    files: Entries = Field(default_factory=dict)
    folders: Entries = Field(default_factory=dict)
    links: Entries = Field(default_factory=dict)
    environment: Entries = Field(default_factory=dict)
    search: Entries = Field(default_factory=dict)
    modules: Entries = Field(default_factory=dict)
    distributions: Entries = Field(default_factory=dict)
    programs: Entries = Field(default_factory=dict)


def digest_of(reads: Reads) -> str:
    """Sixteen hexadecimal digits that stand for all that was read."""
    return digest(reads, 16)


# -- names -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BaseFolders:
    """The folders in which names of files begin, so that names are equal on machines of equal layout.

    Args:
        plugin: The folder of the plug-in's file; None for a plug-in that is installed.
        work: The working folder. It is no base where the home folder lies in it, e.g. ``/``: what
            lies there would have another name in each working folder.
    """

    plugin: Path | None
    work: Path

    @cached_property
    def _folders(self) -> list[tuple[str, str]]:
        """Each label with its folder, as it is written and with its links followed; the first that fits counts."""
        home = Path.home()
        labelled: list[tuple[str, Path]] = []
        if self.plugin is not None:
            labelled.append(("plugin:", self.plugin))
        if not home.is_relative_to(self.work):
            labelled.append(("work:", self.work))
        labelled.append(("~", home))

        folders = []
        for label, folder in labelled:
            spellings = dict.fromkeys((os.path.abspath(folder), os.path.realpath(folder)))
            folders += [(label, spelling.rstrip(os.sep)) for spelling in spellings]
        return folders

    def name(self, path: str) -> str:
        """The name of an absolute path."""
        for label, folder in self._folders:
            if path == folder or path.startswith(folder + os.sep):
                return label + path[len(folder) :]
        return path

    def path(self, name: str) -> str:
        """The absolute path of a name."""
        for label, folder in self._folders:
            if name == label or name.startswith(label + os.sep):
                return folder + name[len(label) :]
        return name

    def names(self, folders: Iterable[str]) -> str:
        """A search path such as ``PYTHONPATH`` with the names of its folders."""
        return os.pathsep.join(map(self.name, folders))


# -- what is there now -----------------------------------------------------------------------------

_DIGESTS: dict[tuple[str, str, int, int, int, int], str] = {}
"""Digests by kind, path, size, times and inode, for the life of this process."""


def remembered(kind: str, path: str, compute: Callable[[], str]) -> str:
    """A value that is computed from a file, once in this process while the file's size, times and inode stay the same.

    Raises:
        OSError: It is not there.
    """
    status = os.stat(path)
    key = (kind, path, status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino)
    value = _DIGESTS.get(key)
    if value is not None:
        return value
    value = compute()
    age_ns = time.time_ns() - max(status.st_mtime_ns, status.st_ctime_ns)
    if age_ns > _SETTLED_NS:
        _DIGESTS[key] = value
    return value


def content_now(path: str) -> str:
    """SHA-256 of what lies at a path: of a file's bytes, or of names and contents of everything in a folder.

    `ABSENT` where nothing is there, `UNREADABLE` where it cannot be read.
    """
    try:
        if os.path.isdir(path):
            return path_digest(Path(path))
        return remembered("file", path, lambda: path_digest(Path(path)))
    except (FileNotFoundError, NotADirectoryError):
        return ABSENT
    except (OSError, ValueError):
        return UNREADABLE


def names_in(folder: str) -> list[str]:
    """The sorted names in a folder, without that of compiled byte code.

    Raises:
        OSError: It is not there, is no folder or cannot be read.
    """
    return sorted(name for name in os.listdir(folder) if name != BYTE_CODE_FOLDER)


def digest_of_names(names: Sequence[str]) -> str:
    """Digest of the sorted names in a folder."""
    return digest(list(names), 16)


def folder_now(folder: str) -> str:
    """Digest of the names in a folder; `ABSENT` where there is none, `UNREADABLE` where they cannot be listed."""
    try:
        return digest_of_names(names_in(folder))
    except (FileNotFoundError, NotADirectoryError):
        return ABSENT
    except OSError:
        return UNREADABLE


def link_now(path: str, base_folders: BaseFolders) -> str:
    """The name of what a path leads to through symbolic links; `ABSENT` where it leads through none."""
    target = base_folders.name(os.path.realpath(path))
    return ABSENT if target == base_folders.name(path) else target


def value_digest(value: str | None) -> str:
    """Digest of an environment variable's value; `ABSENT` where it is not set."""
    return ABSENT if value is None else digest(value, 8)


def variables_now(environment: Mapping[str, str]) -> str:
    """Digest of the names of the variables that are set, of those whose values count."""
    return digest_of_names(sorted(filter(is_counted, environment)))


def search_now(name: str, environment: Mapping[str, str], base_folders: BaseFolders) -> str:
    """The folders of a search path, or the file that a command runs.

    Args:
        name: An environment variable that holds a search path; or `COMMAND` and the command's name.
        environment: The environment variables.
        base_folders: Where names of files begin.

    Returns:
        The names of the folders, or of the file; `ABSENT` where there is none.
    """
    if name.startswith(COMMAND):
        command = shutil.which(name[len(COMMAND) :], path=environment.get("PATH"))
        return ABSENT if command is None else base_folders.name(os.path.abspath(command))
    return base_folders.names(folders_of(environment.get(name, "")))


class ImportPath:
    """The modules and distributions on an import path, as they lie on the disk when they are asked for first.

    Args:
        path: For example ``sys.path``.
    """

    def __init__(self, path: Sequence[str]) -> None:
        self.folders = list(dict.fromkeys(os.path.abspath(folder) for folder in path))

    @cached_property
    def _names(self) -> dict[str, frozenset[str]]:
        """The names in each folder that is there; archives on the path have none."""
        names = {}
        for folder in self.folders:
            if os.path.isdir(folder):
                names[folder] = frozenset(os.listdir(folder))
        return names

    @cached_property
    def distributions(self) -> dict[str, str]:
        """The folder (or file) with the metadata of each distribution, by its normalised name; the first one counts."""
        metadata: dict[str, str] = {}
        for folder, names in self._names.items():
            for name in sorted(names):
                if not name.endswith(_METADATA):
                    continue
                # NAME-VERSION.dist-info
                distribution = _normalised(name.partition("-")[0])
                metadata.setdefault(distribution, os.path.join(folder, name))
        return metadata

    def distribution(self, name: str) -> str:
        """Version and digest of the RECORD of a distribution; `ABSENT` where it is not installed.

        Where a system's packager has left the RECORD out, the metadata stand for it.
        """
        metadata = self.distributions.get(name)
        if metadata is None:
            return ABSENT
        # NAME-VERSION.dist-info
        version = os.path.basename(metadata).rpartition(".")[0].partition("-")[2]
        file = self.record_of(name)
        if os.path.isdir(file):
            return version
        return f"{version} {remembered('record', file, lambda: _record_digest(file))}"

    def record_of(self, name: str) -> str:
        """The RECORD of a distribution that is installed, or the file that stands for it."""
        metadata = self.distributions[name]
        for part in ("RECORD", "METADATA", "PKG-INFO"):
            file = os.path.join(metadata, part)
            if os.path.isfile(file):
                return file
        return metadata

    @cached_property
    def _by_module(self) -> dict[str, list[tuple[str, str]]]:
        """The names of the distributions that bring each top-level module, with the beginning of its files' paths."""
        distributions: dict[str, list[tuple[str, str]]] = {}
        for name, metadata in self.distributions.items():
            site_packages = os.path.dirname(metadata) + os.sep
            for top in _top_level_names(metadata):
                distributions.setdefault(top, []).append((name, site_packages))
        return distributions

    def distributions_of(self, top: str, file: str) -> list[str]:
        """The names of the distributions that a module comes from; empty where its file lies beside none of them.

        Args:
            top: Its top-level name.
            file: Its file.
        """
        candidates = self._by_module.get(top, ())
        return [name for name, site_packages in candidates if file.startswith(site_packages)]

    def distributions_at(self, file: str) -> list[str]:
        """The names of the distributions that bring the module in which a file lies; empty where there is none."""
        for folder in self.folders:
            if not file.startswith(folder + os.sep):
                continue
            # package/module.py, or module.py itself
            first_part = file[len(folder) + 1 :].partition(os.sep)[0]
            names = self.distributions_of(first_part.partition(".")[0], file)
            if names:
                return names
        return []

    def read_all(self) -> None:
        """Read what is installed, so that this process and those that it forks remember it."""
        for name in self.distributions:
            self.distribution(name)
        self.distributions_of("", "")

    def find(self, top: str) -> str:
        """The file or folder of a top-level module, as Python would find it; `ABSENT` where it is not on the path."""
        namespace = ABSENT
        for folder, names in self._names.items():
            place = os.path.join(folder, top)
            # a package wins over a module of its name in the same folder
            if top in names and os.path.isfile(os.path.join(place, "__init__.py")):
                return place
            for suffix in _SUFFIXES:
                if top + suffix in names:
                    return place + suffix
            # a folder without __init__.py counts only where no later folder has the module
            if top in names and not namespace and os.path.isdir(place):
                namespace = place
        return namespace

    def place(self, top: str, base_folders: BaseFolders) -> str:
        """Place of a top-level module: `INSTALLED`, the name of its file or folder, or `ABSENT`."""
        module_file = self.find(top)
        if module_file:
            neighbours = self._names[os.path.dirname(module_file)]
            if any(name.endswith(_METADATA) for name in neighbours):
                return INSTALLED
        return base_folders.name(module_file)


def _normalised(distribution: str) -> str:
    """The name of a distribution as PEP 503 normalises it."""
    return re.sub(r"[-_.]+", "-", distribution).lower()


def _record_digest(file: str) -> str:
    """Digest of the lines of a RECORD, which hold the SHA-256 of each file, in any order."""
    text = Path(file).read_text(encoding="utf-8", errors="replace")
    links, byte_code, metadata = _NOT_CONTENT
    lines = [
        line
        for line in text.splitlines()
        # any() takes five times as long
        if links not in line and byte_code not in line and metadata not in line
    ]
    return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()[:12]


def _top_level_names(metadata: str) -> set[str]:
    """The top-level modules of a distribution, by its list of files or else by what its metadata say."""
    record = Path(metadata, "RECORD")
    if record.is_file():
        names = remembered("modules", str(record), lambda: "\n".join(sorted(_first_parts(record))))
        return set(names.split("\n"))
    declared = Path(metadata, "top_level.txt")
    if declared.is_file():
        return set(declared.read_text(encoding="utf-8").split())
    return set()


def _first_parts(record: Path) -> set[str]:
    """The names of the modules that lie where the files of a RECORD begin."""
    # the first folder, or the file itself, of each line
    lines = record.read_text(encoding="utf-8", errors="replace").split("\n")
    parts = {line.partition("/")[0] for line in lines}
    parts = {part.partition(",")[0] for part in parts}
    modules = {part.partition(".")[0] for part in parts if not part.endswith(_METADATA)}
    return modules - {"", BYTE_CODE_FOLDER}


# -- comparing -------------------------------------------------------------------------------------


class Verifier:
    """Compares what runs read with what is there now; looks at everything once, however many runs have read it.

    Args:
        path: The import path of the runs; None for that of this process.
        environment: Environment variables of the runs; None for those of this process.
    """

    def __init__(
        self, path: Sequence[str] | None = None, environment: Mapping[str, str] | None = None
    ) -> None:
        self._imports = ImportPath(sys.path if path is None else path)
        self._environment = dict(os.environ if environment is None else environment)
        self._now: dict[tuple[str, str, BaseFolders], str] = {}
        self._unchanged: dict[tuple[str, BaseFolders], dict[str, str]] = {}

    def changed(self, reads: Reads, base_folders: BaseFolders) -> str:
        """The first thing that has changed, in words: ``the file weights/net.onnx``; empty where nothing has.

        Args:
            reads: What a run read.
            base_folders: Where names of files begin now.
        """
        for section in _SECTIONS:
            entries = getattr(reads, section)
            # most runs of a plug-in read the same
            if self._unchanged.get((section, base_folders)) == entries:
                continue
            for name, before in entries.items():
                key = (section, name, base_folders)
                now = self._now.get(key)
                if now is None:
                    now = self._look(section, name, base_folders)
                    self._now[key] = now
                if now != before:
                    return _in_words(section, name, before)
            self._unchanged[section, base_folders] = entries
        return ""

    def _look(self, section: str, name: str, base_folders: BaseFolders) -> str:
        """The digest that an entry of `Reads` would get now."""
        match section:
            case "search":
                return search_now(name, self._environment, base_folders)
            case "environment" if name == ALL_VARIABLES:
                return variables_now(self._environment)
            case "environment":
                return value_digest(self._environment.get(name.removeprefix("$")))
            case "modules":
                return self._imports.place(name, base_folders)
            case "distributions":
                return self._imports.distribution(name)
            case "folders":
                return folder_now(base_folders.path(name))
            case "links":
                return link_now(base_folders.path(name), base_folders)
        return content_now(base_folders.path(name))


_SECTIONS = (
    "search",
    "environment",
    "modules",
    "distributions",
    "folders",
    "files",
    "links",
    "programs",
)
"""The attributes of `Reads` in the order in which they are compared: what explains most comes first."""


def _in_words(section: str, name: str, before: str) -> str:
    """A name in words for an entry of `Reads`."""
    short = re.sub("^(plugin|work):/", "", name)
    match section:
        case "search" if name.startswith(COMMAND):
            return f"the place of the {name}"
        case "search":
            return name
        case "environment" if name == ALL_VARIABLES:
            return "the list of environment variables"
        case "environment":
            return f"the environment variable {name.removeprefix('$')}"
        case "modules":
            return f"the place of the module {name}"
        case "distributions":
            return f"{name} {before.partition(' ')[0]}"
        case "folders":
            return f"the names in the folder {short}"
        case "links":
            return f"the target of the link {short}"
    if name.endswith(os.sep):
        content = f"the content of the folder {short.rstrip(os.sep)}"
    else:
        content = f"the file {short}"
    return f"{content} of a program" if section == "programs" else content
