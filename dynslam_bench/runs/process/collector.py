"""The collection of what a run read from a recorder's notes: files, modules, distributions and programs."""

import os
import re
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from dynslam_bench.core.code_files import files_below, files_of_command
from dynslam_bench.core.programs import (
    Command,
    ProgramReads,
    folders_of,
    is_counted,
    is_file_name,
    mapped_files,
    modified_time_ns,
)
from dynslam_bench.core.reads import (
    ABSENT,
    ALL_VARIABLES,
    COMMAND,
    SEARCH_PATHS,
    UNREADABLE,
    BaseFolders,
    ImportPath,
    Reads,
    content_now,
    digest_of_names,
    link_now,
    names_in,
    search_now,
    value_digest,
    variables_now,
)
from dynslam_bench.runs.process.origins import Origins

_LOADED_NS = time.time_ns()
"""Time when this module was loaded: modules that the fork server has loaded are older."""
_LONGEST_TEXT = 1 << 16
"""Text files of up to so many bytes are searched for names of files; longer ones are data."""
_LONGEST_SOURCE = 1 << 20
"""Python sources of up to so many bytes are searched, and files of programs for names of variables."""
_LONGEST_LIBRARY = 1 << 24
"""Bytes of the longest native library that is searched for names of variables."""
_MANY_FILES = 10_000
"""A folder with more files is not read whole where a program's arguments name it."""
_TEXT_SUFFIXES = (".yaml", ".yml", ".toml", ".json", ".cfg", ".ini", ".conf", ".txt", ".xml")
_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".exr", ".pgm", ".ppm", ".webp")
_VIDEOS = (".mp4", ".avi", ".mkv")
_NETWORKS = (
    ".onnx",
    ".pb",
    ".tflite",
    ".pt",
    ".pth",
    ".caffemodel",
    ".weights",
    ".engine",
    ".safetensors",
    ".bin",
    ".param",
    ".mnn",
)
_ARRAYS_AND_CLOUDS = (".h5", ".hdf5", ".ply", ".pcd")
_READ_IN_MACHINE_CODE = (*_IMAGES, *_VIDEOS, *_NETWORKS, *_ARRAYS_AND_CLOUDS)
"""Images, networks, arrays and clouds: OpenCV, onnxruntime, torch and others open them without a word."""
_WORD = re.compile(r"[\w./~+\-]*[A-Za-z][\w./~+\-]*")
"""A word of a text file that can be the name of a file."""
_QUOTED = re.compile(r"[\"']([^\"'\n]{1,200})[\"']")
"""A text in a Python source."""
_VARIABLE = re.compile(r"[A-Z][A-Z0-9_]{2,}")
"""A word in a text that can be the name of an environment variable."""
_FILE_NAME = re.compile(r"[\w./~+\-]*\w\.[A-Za-z]\w{0,9}")
"""A text that can be the name of a file: it has a suffix."""
_UP_TO_PLACEHOLDER = re.compile(r".*(?:\}|%[-+0-9.]*[a-zA-Z])")
"""A text up to its last placeholder: of ``{name}.onnx`` the ending is left."""
_SYSTEM_LIBRARY = re.compile(
    r"lib(?:c|m|dl|rt|util|pthread|resolv|nss_\w+|gcc_s|stdc\+\+|ssl|crypto|sqlite3|z|bz2|lzma|ffi|readline|ncursesw?|"
    r"tinfow?|panelw?|uuid|expat|mpdec|gdbm\w*|db|nsl|tirpc)[-.].*"
)
"""Libraries of the operating system that Python itself is linked with: they are updated often, and change no result."""
_OWN_DISTRIBUTION = "dynslam-bench"


class Stamp(NamedTuple):
    """State of a file that tells whether it is the same as before: its place on the disk, its size and its times.

    Attributes:
        device: The device.
        inode: The inode.
        size: Size in bytes.
        modified_ns: Time of modification in nanoseconds.
        changed_ns: Time of change in nanoseconds, of the content or the inode.
    """

    device: int
    inode: int
    size: int
    modified_ns: int
    changed_ns: int


def stamp_of(path: str) -> Stamp | None:
    """The stamp of what lies at a path, links followed; None where nothing is there or it cannot be looked at."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None
    return Stamp(
        status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
    )


def is_code(path: str) -> bool:
    """Whether a file is Python source, byte code or a native library, by its name."""
    return path.endswith((".py", ".pyc", ".so")) or ".so." in path


@dataclass
class FileNote:
    """A file that was opened.

    Attributes:
        stamp: What it was then; None where it was not there.
        digest: Digest of the file's content when it was opened; empty where it is still to be
            taken.
    """

    stamp: Stamp | None
    digest: str = ""


@dataclass
class Notes:
    """Files, folders, variables and commands that a recorder has noted so far.

    Attributes:
        files: Each file that was opened to be read.
        folders: The names in each folder that was listed; None where it was not there.
        variables: Environment variables that were looked up.
        has_all_variables: Whether all of them were listed: nobody announces what is looked up in a
            copy, or which beginning of a name is looked for.
        modules: Top-level names of modules that were imported, or could not be.
        metadata: Folders with the metadata of distributions whose version was asked for.
        commands: When each command was started first, in nanoseconds since the epoch.
        made: Files that the run has written or removed.
        made_folders: Beginnings of the paths of what lies in folders that it has made.
        missing: Files and folders that were looked for, and not there.
        changed: Files that were another when they were opened again.
    """

    files: dict[str, FileNote] = field(default_factory=dict)
    folders: dict[str, list[str] | None] = field(default_factory=dict)
    variables: set[str] = field(default_factory=set)
    has_all_variables: bool = False
    modules: set[str] = field(default_factory=set)
    metadata: set[str] = field(default_factory=set)
    commands: dict[Command, int] = field(default_factory=dict)
    made: set[str] = field(default_factory=set)
    made_folders: tuple[str, ...] = ()
    missing: set[str] = field(default_factory=set)
    changed: list[str] = field(default_factory=list)


@dataclass
class Modules:
    """The modules that are loaded, but Python's and this package's, and those that were asked for in vain.

    Attributes:
        imports: The import path on which they are found.
        places: Where each top-level module is found.
        distributions: Names of distributions, and whether they were loaded before the recorder was
            started.
        files: Files of modules that belong to no distribution, and whether they were loaded before
            the recorder was started.
        absent: Files that are not there, and would be loaded in place of modules of namespace
            packages.
    """

    imports: ImportPath
    places: dict[str, str] = field(default_factory=dict)
    distributions: dict[str, bool] = field(default_factory=dict)
    files: dict[str, bool] = field(default_factory=dict)
    absent: set[str] = field(default_factory=set)


class Collector:
    """Makes `Reads` of notes; knows what there was when the recorder was started, which is when this is made.

    Args:
        base_folders: The folders in which names of files begin.
        origins: Tells whose a file is.
        private: Beginnings of the paths of what the run owns.
    """

    def __init__(
        self, base_folders: BaseFolders, origins: Origins, private: tuple[str, ...]
    ) -> None:
        self.notes = Notes()
        self.programs = ProgramReads()
        self.began_ns = time.time_ns()
        self.environment = dict(os.environ)
        self._base_folders = base_folders
        self._origins = origins
        self._private = private
        self._path = list(sys.path)
        self._mapped = set(mapped_files(os.getpid()))
        self._loaded = {name.partition(".")[0] for name in sys.modules}
        self._texts: dict[tuple[str, Stamp], set[str]] = {}
        self._below: dict[str, list[str]] = {}
        self._files_by_command: dict[Command, set[str]] = {}
        self._variables: dict[Command, set[str]] = {}

    def collect(self, modules: Modules) -> Reads:
        """The record of what was read so far.

        Args:
            modules: The modules that are loaded now.
        """
        imports = modules.imports
        programs, distributions = self._programs(imports)

        # files that were seen opened count as they were then; a library's count by its distribution
        opened = {
            path: note.digest or self._content(path, note)
            for path, note in dict(self.notes.files).items()
            if path in modules.files or not is_code(path) or not imports.distributions_at(path)
        }
        # files that were opened unseen count as they are now
        unseen = self._libraries() | self._unseen_files(opened) | set(modules.files)
        files = opened | {path: content_now(path) for path in unseen - opened.keys()}
        # so do files that these name
        named, missing = self._named_files(files)
        files |= {path: content_now(path) for path in named - files.keys()}
        missing |= modules.absent | self._still_missing()
        files |= dict.fromkeys(missing - files.keys(), ABSENT)

        folders = {
            path: self._folder(path, names) for path, names in dict(self.notes.folders).items()
        }
        links = {path: link_now(path, self._base_folders) for path in (*files, *folders, *programs)}
        variables = self.notes.variables.union(*map(self._variables_of, dict(self.notes.commands)))
        variables |= self._variables_in(files)
        environment = {f"${key}": value_digest(self.environment.get(key)) for key in variables}
        if self.notes.has_all_variables:
            environment[ALL_VARIABLES] = variables_now(self.environment)
        asked_for = {
            name for name, folder in imports.distributions.items() if folder in self.notes.metadata
        }
        used_distributions = modules.distributions.keys() | distributions | asked_for

        name = self._base_folders.name
        return Reads(
            files={name(path): digest for path, digest in files.items()},
            folders={name(path): digest for path, digest in folders.items()},
            links={name(path): target for path, target in links.items() if target},
            environment=environment,
            search=self._search(),
            modules=modules.places,
            distributions={key: imports.distribution(key) for key in used_distributions},
            programs={self._name(path): content_now(path) for path in programs},
        )

    # -- what is an input --------------------------------------------------------------------------

    def is_output(self, path: str) -> bool:
        """Whether the run has made what lies at a path."""
        return path in self.notes.made or path.startswith(
            (*self._private, *self.notes.made_folders)
        )

    def is_made_by_program(self, stamp: Stamp | None) -> bool:
        """Whether a file was written after a program was started."""
        if stamp is None:
            return False
        first_start_ns = min(self.notes.commands.values(), default=sys.maxsize)
        return stamp.modified_ns >= first_start_ns

    def _is_input(self, path: str) -> bool:
        """Whether something lies at a path that was there before the run."""
        if not is_file_name(path) or self.is_output(path) or path in self.notes.missing:
            return False
        stamp = stamp_of(path)
        return stamp is not None and not self.is_made_by_program(stamp)

    def _name(self, path: str) -> str:
        """The name of a file, or of a folder whose whole content counts."""
        return self._base_folders.name(path) + (os.sep if os.path.isdir(path) else "")

    def _content(self, path: str, note: FileNote) -> str:
        """Digest of a file that was not taken when the file was opened."""
        content = content_now(path)
        return ABSENT if note.stamp is None and content != UNREADABLE else content

    def _still_missing(self) -> set[str]:
        """Paths that were looked for and are still missing at the end: the run made the others."""
        return {
            path
            for path in set(self.notes.missing)
            if not self.is_output(path) and not os.path.lexists(path)
        }

    def _folder(self, path: str, names: list[str] | None) -> str:
        """Digest of the names in a folder as it was listed.

        Files that the run itself has made or removed count as they are now: else the run would
        change what it has read.
        """
        if names is None:
            return ABSENT
        made = {
            os.path.basename(file) for file in set(self.notes.made) if os.path.dirname(file) == path
        }
        if made:
            names = sorted(set(names) - made | made.intersection(names_in(path)))
        return digest_of_names(names)

    def _unseen_files(self, opened: Mapping[str, str]) -> set[str]:
        """The images and networks in listed folders that nobody was seen to open: libraries open them unannounced."""
        unseen = set()
        for folder, names in dict(self.notes.folders).items():
            for name in names or ():
                if not name.lower().endswith(_READ_IN_MACHINE_CODE):
                    continue
                path = os.path.join(folder, name)
                if path not in opened and self._is_input(path):
                    unseen.add(path)
        return unseen

    def _search(self) -> dict[str, str]:
        """The search paths, and where commands were found that were named without a folder."""
        commands = {command.words[0] for command in dict(self.notes.commands)}
        names = (*SEARCH_PATHS, *(f"{COMMAND}{word}" for word in commands if os.sep not in word))
        return {name: search_now(name, self.environment, self._base_folders) for name in names}

    # -- what has changed while it was read --------------------------------------------------------

    def changed(self, modules: Modules) -> str:
        """The first thing that has changed since it was read, in words; empty where nothing has.

        Args:
            modules: The modules that are loaded now.
        """
        for path, note in self.notes.files.items():
            self.compare(path, note, stamp_of(path))
        if self.notes.changed:
            return f"the file {self.notes.changed[0]}"
        # a library of a program that was rebuilt while the program ran
        for path, modified_ns in dict(self.programs.files).items():
            if is_code(path) and self._is_rebuilt(path, modified_ns):
                return f"the file {path} of a program"
        # what nobody saw opened is as it was loaded if it is older than that
        for path, was_loaded in modules.files.items():
            if path not in self.notes.files and self._is_newer(path, was_loaded):
                return f"the file {path}"
        for name, was_loaded in modules.distributions.items():
            if self._is_newer(modules.imports.record_of(name), was_loaded):
                return f"the installed {name}"
        return ""

    def compare(self, path: str, note: FileNote, stamp: Stamp | None) -> None:
        """Note a file that is another than when it was opened first.

        Args:
            path: The file.
            note: What it was then.
            stamp: Its stamp now.
        """
        if stamp == note.stamp or path in self.notes.made:
            return
        if note.stamp is None and self.is_made_by_program(stamp):
            return
        if note.digest and content_now(path) == note.digest:
            note.stamp = stamp  # it was written again with the same content
        else:
            self.notes.changed.append(path)

    def _is_rebuilt(self, path: str, modified_ns: int | None) -> bool:
        """Whether another file lies now where a program has its code from.

        What was written after a program was started when it was seen first is the program's own.

        Args:
            path: The file.
            modified_ns: Its time of modification when it was seen first.
        """
        now_ns = modified_time_ns(path)
        first_start_ns = min(self.notes.commands.values(), default=sys.maxsize)
        if now_ns is None or modified_ns is None or self.is_output(path):
            return False
        if path in self.programs.replaced:
            return True
        return modified_ns < first_start_ns and now_ns != modified_ns

    def _is_newer(self, path: str, was_loaded: bool) -> bool:
        """Whether an input has changed since the recorder was started, or since this process loaded its libraries."""
        stamp = stamp_of(path)
        since_ns = _LOADED_NS if was_loaded else self.began_ns
        return stamp is not None and stamp.changed_ns > since_ns and self._is_input(path)

    # -- modules and libraries ---------------------------------------------------------------------

    def modules(self) -> Modules:
        """Look at the modules that are loaded now."""
        imports = ImportPath(self._path)
        modules = Modules(imports)
        file_of_top: dict[str, str] = {}
        for name, module in list(sys.modules.items()):
            file = vars(module).get("__file__") if hasattr(module, "__dict__") else None
            if not isinstance(file, str) or name == "__main__":
                continue
            if self._origins.of_file(file) in ("own", "python"):
                continue
            top = name.partition(".")[0]
            was_loaded = top in self._loaded
            distributions = imports.distributions_of(top, file) or imports.distributions_at(file)
            if _OWN_DISTRIBUTION in distributions:  # how it was installed in a checkout
                continue
            modules.distributions |= dict.fromkeys(distributions, was_loaded)
            if not distributions or self._origins.is_plugin(name):
                modules.files[_on_disk(file)] = was_loaded
                modules.absent |= _absent_before(name, file, imports.folders)
            file_of_top.setdefault(top, file)

        # where each is found on the import path
        for top, file in file_of_top.items():
            module_file = imports.find(top)
            if module_file and file.startswith(module_file):  # else a plug-in has changed the path
                modules.places[top] = imports.place(top, self._base_folders)

        # modules that were asked for and are not loaded
        for top in set(self.notes.modules) - sys.modules.keys():
            modules.places[top] = imports.place(top, self._base_folders)
            distributions = imports.distributions_of(top, imports.find(top))
            modules.distributions |= dict.fromkeys(distributions, False)

        modules.files = {
            path: loaded for path, loaded in modules.files.items() if self._is_input(path)
        }
        return modules

    def _libraries(self) -> set[str]:
        """The files that were mapped into memory since the start, or because a search path named them."""
        mapped = set(mapped_files(os.getpid()))
        # those that a search path of the loader names
        preloaded = set(re.split("[: ]", self.environment.get("LD_PRELOAD", "")))
        folders = folders_of(self.environment.get("LD_LIBRARY_PATH", ""))
        beginnings = tuple(f"{os.path.realpath(folder)}{os.sep}" for folder in folders)
        named = {path for path in mapped if path in preloaded or path.startswith(beginnings)}
        # those that are new
        new = {path for path in mapped - self._mapped if self._origins.of_file(path) == "foreign"}
        new = {path for path in new if not _SYSTEM_LIBRARY.fullmatch(os.path.basename(path))}
        return set(filter(self._is_input, named | new))

    # -- programs ----------------------------------------------------------------------------------

    def _programs(self, imports: ImportPath) -> tuple[set[str], set[str]]:
        """The files and folders that programs are made of, and the distributions of this environment that they use."""
        files = set(self.programs.files)
        for command in {**self.notes.commands, **dict.fromkeys(self.programs.commands)}:
            if command not in self._files_by_command:
                self._files_by_command[command] = self._files_of(command)
            files |= self._files_by_command[command]
        inputs: set[str] = set()
        distributions: set[str] = set()
        for file in files:
            origin = self._origins.of_file(file)
            names = imports.distributions_at(file) if origin == "library" else []
            distributions |= set(names)
            if not names and origin in ("library", "foreign"):
                inputs |= self._unwritten(file)
        return inputs, distributions

    def _files_of(self, command: Command) -> set[str]:
        """The executable of a command, the files and folders that it names, and what these name or import."""
        executable = command.executable(self.environment.get("PATH"))
        # code is looked for in files, not in folders that an argument names
        arguments = [
            word for word in command.words[1:] if not any(map(os.path.isdir, command.named([word])))
        ]
        reached = files_of_command([command.words[0], *arguments], Path(command.folder))
        files = {executable, *map(str, reached)} - {""}
        return files | {path for path in command.named() if not self._is_too_wide(path)}

    def _variables_of(self, command: Command) -> set[str]:
        """The environment variables whose names are written in a command or in its files.

        Those that are not set count, too, except in binary files: there thousands of words look like
        a variable's name.
        """
        if command not in self._variables:
            names = set(_VARIABLE.findall(" ".join(command.words)))
            for file in filter(os.path.isfile, self._files_by_command[command]):
                content = Path(file).read_bytes()
                if b"\0" in content:
                    names |= {name for name in self.environment if os.fsencode(name) in content}
                elif len(content) <= _LONGEST_SOURCE:
                    names |= set(_VARIABLE.findall(content.decode(errors="replace")))
            self._variables[command] = {
                name for name in names if is_counted(name) and name not in SEARCH_PATHS
            }
        return self._variables[command]

    def _variables_in(self, files: Iterable[str]) -> set[str]:
        """The variables that foreign libraries, or sources that name ``getenv``, hold the names of.

        Machine code looks variables up unannounced. Of a library those count that are set. Where all
        variables were listed, sources count that name ``environ``: one that is not set may be looked
        up in a copy.
        """
        marks = [b"getenv", b"environ"] if self.notes.has_all_variables else [b"getenv"]
        names: set[str] = set()
        set_now = set(filter(is_counted, self.environment)) - set(SEARCH_PATHS)
        for file in files:
            # only code of others counts
            stamp = stamp_of(file)
            if stamp is None or not is_code(file) or self._origins.of_file(file) != "foreign":
                continue
            # in a source every word that may name a variable, in a library those that are set
            if file.endswith(".py"):
                content = Path(file).read_bytes()
                if any(mark in content for mark in marks):
                    names |= {word for word in self._words(file) if _VARIABLE.fullmatch(word)}
            elif stamp.size <= _LONGEST_LIBRARY and os.path.isfile(file):
                content = Path(file).read_bytes()
                names |= {name for name in set_now if os.fsencode(name) in content}
        # variables that the run itself has set are no input
        names -= {name.removeprefix("$") for name in self.notes.made}
        return {name for name in names if is_counted(name) and name not in SEARCH_PATHS}

    def _is_too_wide(self, folder: str) -> bool:
        """Whether a folder holds so much that a program that is told of it does not read it all."""
        places = [
            str(self._base_folders.work),
            str(self._base_folders.plugin),
            str(Path.home()),
            sys.prefix,
            *self._path,
        ]
        inside = folder.rstrip(os.sep) + os.sep
        if any(place == folder or place.startswith(inside) for place in places):
            return True
        count = 0
        for _, _, names in os.walk(folder):
            count += len(names)
            if count > _MANY_FILES:
                return True
        return False

    def _unwritten(self, path: str) -> set[str]:
        """A file or folder, if nothing in it was written by the run; else the files in the folder that were not."""
        if not os.path.isdir(path):
            return {path} if self._is_input(path) else set()
        files = {os.path.join(place, name) for place, _, names in os.walk(path) for name in names}
        inputs = set(filter(self._is_input, files))
        return {path} if inputs == files and self._is_input(path) else inputs

    # -- files that are named in texts -------------------------------------------------------------

    def _named_files(self, texts: Iterable[str]) -> tuple[set[str], set[str]]:
        """The files that foreign sources and small text files name, and those that sources name and that are not there.

        A name is looked for in the folder of the text, in that of the plug-in and in the working
        folder. A bare name of a file, or the ending of a network's file, is also looked for in all
        folders below that of the text: ``folder / f"{name}.onnx"``. Of a folder that a text names by its
        path the networks in it count.
        """
        named: set[str] = set()
        missing: set[str] = set()
        texts = list(texts)
        opened_names = set(map(os.path.basename, texts))
        for text in texts:
            for word in self._words(text):
                # where the file may be, by the folders of the text and of the run
                places = self._places_of(word, text)
                there = {place for place in places if os.path.isfile(place)}
                if not there and word not in opened_names:
                    there = self._files_below(os.path.dirname(text), word)
                    there |= _networks_in({place for place in places if os.sep in word})
                named |= there
                # a name in a source may be looked for without being there
                if not there and text.endswith(".py") and _can_be_missing(word):
                    missing |= places
        missing = {path for path in missing if not self.is_output(path)}
        return set(filter(self._is_input, named)), missing

    def _files_below(self, folder: str, word: str) -> set[str]:
        """The files of that name, or of that ending of a network's file, in all folders below one.

        Of a folder with very many files the first ones are looked at; hidden folders, environments,
        results and images of recordings are left out (`files_below`).
        """
        ending = _UP_TO_PLACEHOLDER.sub("", word)
        is_ending = ending.lower() in (*_NETWORKS, *_ARRAYS_AND_CLOUDS)
        if not is_ending and _FILE_NAME.fullmatch(word) is None:
            return set()
        if folder not in self._below:
            self._below[folder] = [*map(str, islice(files_below(Path(folder)), _MANY_FILES))]
        if is_ending:
            return {file for file in self._below[folder] if file.endswith(ending)}
        return {file for file in self._below[folder] if os.path.basename(file) == word}

    def _words(self, text: str) -> set[str]:
        """The words of a text file that could be names of files; none of a file that is no such text."""
        is_source = text.endswith(".py") and self._origins.of_file(text) == "foreign"
        if not is_source and not text.endswith(_TEXT_SUFFIXES):
            return set()
        stamp = stamp_of(text)
        longest = _LONGEST_SOURCE if is_source else _LONGEST_TEXT
        if stamp is None or stamp.size > longest:
            return set()
        if (text, stamp) not in self._texts:
            content = Path(text).read_text(encoding="utf-8", errors="replace")
            if is_source:
                words = set(_QUOTED.findall(content))
            else:
                words = {word for word in _WORD.findall(content) if "." in word or os.sep in word}
            self._texts[text, stamp] = words
        return self._texts[text, stamp]

    def _places_of(self, word: str, text: str) -> set[str]:
        """Places where a file of that name could lie."""
        folders = {os.path.dirname(text), str(self._base_folders.work)}
        if self._base_folders.plugin is not None:
            folders.add(str(self._base_folders.plugin))
        path = os.path.expanduser(word)
        return {os.path.normpath(os.path.join(folder, path)) for folder in folders}


def _can_be_missing(word: str) -> bool:
    """Whether a text in a source looks like the name of a file, and not like that of a module."""
    top = word.partition(".")[0]
    return (
        _FILE_NAME.fullmatch(word) is not None
        and top not in sys.modules
        and top not in sys.stdlib_module_names
    )


def _networks_in(folders: Iterable[str]) -> set[str]:
    """The files of networks that lie in folders."""
    return {
        os.path.join(folder, name)
        for folder in filter(os.path.isdir, folders)
        for name in os.listdir(folder)
        if name.lower().endswith(_NETWORKS)
    }


def _absent_before(module: str, file: str, folders: Sequence[str]) -> set[str]:
    """The files that Python would load in place of a module of a namespace package, in earlier folders of the path.

    Args:
        module: Its dotted name.
        file: Where it was found.
        folders: The import path.
    """
    package = sys.modules.get(module.partition(".")[0])
    # a package with an __init__.py lies in one folder
    if "." not in module or package is None or getattr(package, "__file__", None) is not None:
        return set()
    absent: set[str] = set()
    for folder in folders:
        if file.startswith(f"{folder}{os.sep}"):
            break
        place = os.path.join(folder, *module.split("."))
        candidates = {f"{place}.py", os.path.join(place, "__init__.py")}
        absent |= {path for path in candidates if not os.path.exists(path)}
    return absent


def _on_disk(file: str) -> str:
    """The file that a module was loaded from; that of the archive where it lies in one."""
    path = Path(file)
    return str(next((place for place in (path, *path.parents) if place.is_file()), path))
