"""Records what foreign code reads while a run is made: files, folders, modules, environment variables and programs.

Foreign are plug-ins, and libraries while a plug-in calls them (`origins`). Python announces what
they are about to do (`sys.addaudithook`); a mapping in place of ``os.environ`` announces the
variables that they look up.

Files that libraries open in machine code are not announced: by ``cv2.imread``, ``cv2.dnn.readNet``,
``onnxruntime``. In their place each file counts whose name is written in a plug-in's sources, or in
a small text file that foreign code opened. So does each image and network in a folder that it
listed. A file that sources name, or that a plug-in looks for, and that is not there counts as
absent. Files that are named by a descriptor of their folder are not seen, nor is what comes from
the network.

Of programs counts what `core.programs` shows, what their command lines name, and the environment
variables whose names are written in the command or in its files.

What a run makes is no input of it: its private folders, files that it writes before it reads them,
files that are written after a program was started.
"""

import hashlib
import importlib.util
import json
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import psutil

from dynslam_bench.core.errors import RunError
from dynslam_bench.core.folders import digest_cache_folder, stage_cache_folder
from dynslam_bench.core.programs import (
    DECLARED_VARIABLE,
    RESULT_VARIABLES,
    Command,
    is_counted,
    is_file_name,
    look_at,
)
from dynslam_bench.core.reads import (
    BYTE_CODE_FOLDER,
    SEARCH_PATHS,
    BaseFolders,
    Reads,
    content_now,
    digest_of,
    names_in,
)
from dynslam_bench.runs.process.announcing import (
    ALL_VARIABLES,
    MISSING,
    VARIABLE,
    VARIABLE_SET,
    listen,
)
from dynslam_bench.runs.process.collector import Collector, FileNote, is_code, stamp_of
from dynslam_bench.runs.process.origins import Origins

_SMALL_BYTES = 1 << 20
"""Files of up to so many bytes are digested when they are opened; larger ones, which take time, at the end."""
_FIRST_LOOK_S = 0.02
"""Seconds from the first program's start to the first look. A program that has ended before counts by its command."""
_LOOK_S = 0.5
"""Seconds between two looks at the programs when the first ones are over; each comes after twice the time."""
_FILE_CLOCK = 5 if sys.platform == "linux" else None
"""Number of the clock that stamps files: CLOCK_REALTIME_COARSE, which Python does not name. It moves on every 1 to 10
ms."""
_CLOCK_LAG_NS = 10_000_000
"""So far the clock that stamps files may be behind that of the system."""
_ADAPTERS = "dynslam_bench.trackers.adapters"
"""The modules of this package that start programs of others."""
_IMPORTING = ("<frozen importlib", "<frozen zipimport", os.path.dirname(importlib.__file__))
"""Beginnings of the files that search for modules and for metadata: these list all folders of the path."""
_RELATIVE_TO_DESCRIPTOR = ("shutil.py", "os.py", "<frozen os>")
"""These open files by their names in folders that they hold open; the announcement does not tell which folder."""
_ENVIRONMENT = re.compile(r"/proc/(?:self|\d+)/environ")
"""File in which Linux lists the variables of a process."""
_KERNELS = (".nbi", ".nbc")
"""Numba's compiled code, which follows from its source."""
_METADATA = re.compile(r"\.(?:dist|egg)-info(?:/|$)")
"""Folders in which a distribution is described."""
_VERSIONS = (f".dist-info{os.sep}METADATA", f".egg-info{os.sep}PKG-INFO")
"""Ends of the paths of files that tell the version of a distribution."""
_WORD_OF_CODE = re.compile(r"[^\s;|&<>()'\"`$,]+")
"""A word of a line of code that can be the name of a file."""
_LOG = "reads-{}.jsonl"
"""In the first private folder: what a forked process has read."""


class ReadRecorder:
    """Records what foreign code reads in this process, and in those that are forked from it, until it is finished.

    It belongs into the process that makes a run, and is started before a plug-in is loaded. One at
    a time is at work.

    Args:
        base_folders: The folders in which names of files begin.
        private: Folders of the run's own, at least one: what lies there is no input. Forked
            processes write their reads into the first one.
        plugins: Top-level names of the modules of installed plug-ins; their sources count by their
            bytes.

    Attributes:
        count: How many things were read so far.
    """

    def __init__(
        self, base_folders: BaseFolders, *, private: Iterable[Path], plugins: Collection[str] = ()
    ) -> None:
        self.count = 0
        self._base_folders = base_folders
        self._folders = list(private)
        self._plugins = plugins
        # threads in which the recorder itself is at work
        self._ignored_threads: set[int] = set()
        # the first fault of the recorder's own
        self._error: Exception | None = None
        self._ended = threading.Event()
        # age in seconds of each program when it was looked at last, by process id and birth
        self._age_at_look: dict[tuple[int, float], float] = {}
        self._watcher: threading.Thread | None = None
        # descriptor of the log of a forked process; -1 in the process that makes the run
        self._log = -1
        # the last record, with the reads and looks at programs that it is of
        self._so_far: tuple[Reads, tuple[float, ...]] | None = None
        # its digest, with the count of reads
        self._snapshot = (-1, "")
        self._handlers: dict[str, Callable[..., None]] = {
            "open": self._on_open,
            MISSING: self._on_missing,
            "mmap.__new__": self._on_map,
            "sqlite3.connect": self._on_database,
            "ctypes.dlopen": self._on_library,
            "os.listdir": self._on_list,
            "os.scandir": self._on_list,
            "import": self._on_import,
            VARIABLE: self._on_variable,
            ALL_VARIABLES: self._on_all_variables,
            VARIABLE_SET: self._on_variable_set,
            DECLARED_VARIABLE: self._on_declared_variable,
            "os.rename": self._on_rename,
            "os.link": self._on_rename,
            "os.symlink": self._on_symlink,
            "os.remove": self._on_remove,
            "os.truncate": self._on_truncate,
            "os.mkdir": self._on_mkdir,
            "subprocess.Popen": self._on_popen,
            "os.exec": self._on_exec,
            "os.posix_spawn": self._on_exec,
            "os.spawn": self._on_spawn,
            "os.system": self._on_system,
        }

    def start(self) -> None:
        """Begin to record."""
        private: list[str] = []
        for folder in (*self._folders, stage_cache_folder(), digest_cache_folder()):
            private.append(f"{os.path.abspath(folder)}{os.sep}")
            private.append(f"{os.path.realpath(folder)}{os.sep}")
        self._origins = Origins(self._base_folders.plugin, self._plugins)
        self._collector = Collector(self._base_folders, self._origins, tuple(private))
        self._notes = self._collector.notes
        listen(self.hear, self._handlers, self.begin_log)

    def stop(self) -> None:
        """Record no more; may be called more than once."""
        listen(None)
        self._ended.set()

    def finish(self) -> Reads:
        """Record no more, and give what was read; also of a run that failed.

        Raises:
            RunError: Something has changed while the run read it, so that nobody knows what it
                read.
        """
        # a last look at all programs, however young, while they still run
        self._look_at_programs(least_age_s=0.0)
        self.stop()
        # what processes forked from this one have logged
        self._add_forked()
        if self._error is not None:
            raise self._error
        modules = self._collector.modules()
        if changed := self._collector.changed(modules):
            raise RunError(
                f"{changed} has changed while the run read it",
                "the run is not stored; ask again, and let nothing change meanwhile what it reads",
            )
        return self._collector.collect(modules)

    def so_far(self) -> Reads:
        """The record of what was read so far; costs nothing where nothing was read since the last call.

        It may change until the end.
        """
        state = (self.count, *self._age_at_look.values())
        if self._so_far is None or self._so_far[1] != state:
            with self._ignoring_own_reads():
                self._so_far = (self._collector.collect(self._collector.modules()), state)
        return self._so_far[0]

    def snapshot(self) -> str:
        """Digest of everything that was read so far."""
        count, value = self._snapshot
        if count != self.count:
            count = self.count
            value = digest_of(self.so_far())
            self._snapshot = (count, value)
        return value

    # -- what is announced -------------------------------------------------------------------------

    def hear(self, frame: FrameType, event: str, arguments: tuple[Any, ...]) -> None:
        """Take an announcement; what a recorder itself does is not announced.

        Raises:
            FileNotFoundError: Byte code is not to be used.
        """
        thread = threading.get_ident()
        if thread in self._ignored_threads:
            return
        self._ignored_threads.add(thread)
        try:
            self._handlers[event](frame, *arguments)
        except _StaleByteCode:
            raise
        # a fault of the recorder's own, which must not become one of the plug-in
        except Exception as error:
            self._error = self._error or error
        finally:
            self._ignored_threads.discard(thread)

    @contextmanager
    def _ignoring_own_reads(self) -> Iterator[None]:
        """Hear nothing of what this thread does in the block."""
        thread = threading.get_ident()
        self._ignored_threads.add(thread)
        try:
            yield
        finally:
            self._ignored_threads.discard(thread)

    def _note(self, kind: str, name: str) -> None:
        """Count what was read; a forked process writes it down for the one that makes the run."""
        self.count += kind != "made"
        if self._log >= 0:
            os.write(self._log, f"{json.dumps([kind, name])}\n".encode())

    def _is_foreign(self, frame: FrameType | None) -> bool:
        """Whether foreign code is at work: it calls, or has started a thread in which nobody else's code is at work."""
        is_own = False
        while frame is not None:
            origin = self._origins.of_frame(frame)
            if origin == "foreign":
                return True
            is_own = is_own or origin == "own"
            frame = frame.f_back
        return not is_own and threading.current_thread() is not threading.main_thread()

    def _is_asked_by_foreign(self, frame: FrameType | None) -> bool:
        """Whether foreign code asks for a variable; what this package looks up for itself does not count.

        That holds where a plug-in has called this package, too.
        """
        while frame is not None:
            origin = self._origins.of_frame(frame)
            if origin in ("foreign", "own"):
                return origin == "foreign"
            frame = frame.f_back
        return threading.current_thread() is not threading.main_thread()

    # -- files -------------------------------------------------------------------------------------

    def _on_open(self, frame: FrameType, name: Any, mode: str | None, flags: int) -> None:
        """Note a file that is opened: as read, as made, or both."""
        if isinstance(name, int):  # it was seen when the descriptor was opened
            return
        path = _absolute(name)
        if path is None:
            return
        if _ENVIRONMENT.fullmatch(path):
            if self._is_asked_by_foreign(frame):
                self._note_all_variables()
            return
        if mode is None and not os.path.isabs(name) and _is_in(frame, _RELATIVE_TO_DESCRIPTOR):
            return
        if not flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC):
            self._read(frame, self._source_of(path))
            return
        # it is opened to be written, and perhaps read before
        if flags & os.O_RDWR and not flags & os.O_TRUNC:
            self._read(frame, path, whole=True)
        self._make(path)

    def _on_missing(self, frame: FrameType, name: Any) -> None:
        """Note a file that foreign code looked for and that is not there."""
        path = None if isinstance(name, int) else _absolute(name)
        if path is None or path in self._notes.missing or not self._counts_by_itself(path):
            return
        if self._collector.is_output(path) or not self._is_asked_by_foreign(frame.f_back):
            return
        self._notes.missing.add(path)
        self._note("missing", path)

    def _on_map(self, frame: FrameType, descriptor: int, *_: Any) -> None:
        """Note a file that is mapped into memory as read."""
        if path := _absolute(descriptor):
            self._read(frame, path)

    def _on_database(self, frame: FrameType, name: Any) -> None:
        """Note an SQLite file as read and as made."""
        text = os.fsdecode(name)
        if text.startswith("file:"):  # a URI, with options behind a question mark
            text = text.removeprefix("file:").partition("?")[0]
        if text not in ("", ":memory:") and (path := _absolute(text)):
            self._read(frame, path, whole=True)
            self._make(path)

    def _on_library(self, frame: FrameType, name: Any) -> None:
        """Note a library that is loaded as read."""
        # one without a folder is found among what is mapped into memory
        if not isinstance(name, str | bytes) or os.sep not in os.fsdecode(name):
            return
        if path := _absolute(name):
            self._read(frame, path)

    def _read(self, frame: FrameType, path: str, *, whole: bool = False) -> None:
        """Note a file that is about to be read.

        Args:
            frame: Who reads it.
            path: The file.
            whole: Whether its content is digested now, however large: it is about to be written,
                too.
        """
        if self._collector.is_output(path):  # it may be a link to what is none
            path = os.path.realpath(path)
        # metadata of a distribution count by their version
        if path.endswith(_VERSIONS):
            self._read_version(frame, os.path.dirname(path))
            return
        # a file that was noted before must not have changed since
        stamp = stamp_of(path)
        note = self._notes.files.get(path)
        if note is not None:
            self._collector.compare(path, note, stamp)
            return
        # only files that count, read by code of others, and not made by the run
        is_special = stamp is not None and not os.path.isfile(path)  # a folder, a pipe, a socket
        if is_special or not self._counts_by_itself(path) or not self._is_foreign(frame):
            return
        if self._collector.is_output(os.path.realpath(path)):
            return
        if self._collector.is_made_by_program(stamp):
            return

        # the content now where it is small or may change, else at the end
        note = FileNote(stamp)
        if stamp is not None and whole:
            note.digest = content_now(path)
        elif stamp is not None and stamp.size <= _SMALL_BYTES:
            note.digest = _sha256(path)
        self._notes.files[path] = note
        self._note("file", path)

    def _read_version(self, frame: FrameType, folder: str) -> None:
        """Note a distribution whose version is asked for, by the folder of its metadata."""
        if folder not in self._notes.metadata and self._is_asked_by_foreign(frame):
            self._notes.metadata.add(folder)
            self._note("metadata", folder)

    def _source_of(self, path: str) -> str:
        """The source of byte code, any other path as it is.

        Raises:
            FileNotFoundError: The source has changed after the byte code was written. Python would
                not see a change that left size and second of modification as they were; now it
                compiles the source.
        """
        if not path.endswith(".pyc") or BYTE_CODE_FOLDER not in path:
            return path
        try:
            source = importlib.util.source_from_cache(path)
        except ValueError:
            return path
        if self._origins.of_file(source) == "foreign":
            stamp = stamp_of(source)
            compiled = stamp_of(path)
            if (
                stamp is not None
                and compiled is not None
                and stamp.changed_ns >= compiled.modified_ns
            ):
                raise _StaleByteCode(path)
        return source

    def _counts_by_itself(self, path: str) -> bool:
        """Whether a file is none that counts in another way: by its distribution, as this package's code, as source."""
        if not is_file_name(path):
            return False
        if path.endswith(_KERNELS) or BYTE_CODE_FOLDER in path or _METADATA.search(path):
            return False
        if path in sys.path:  # an archive: it counts where a module is loaded from it
            return False
        return not is_code(path) or self._origins.of_file(path) == "foreign"

    def _make(self, path: str) -> None:
        """Note a file that is about to be written, moved or removed."""
        if self._collector.is_output(path):
            return
        note = self._notes.files.get(path)
        if note is not None and note.stamp is None:
            del self._notes.files[path]  # that it was missing is no input where the run makes it
            self.count += 1
        elif note is not None:
            note.digest = note.digest or content_now(path)
        for spelling in {path, os.path.realpath(path)} - self._notes.made:
            self._notes.made.add(spelling)
            self._note("made", spelling)

    def _on_rename(
        self, frame: FrameType, source: Any, target: Any, source_folder: int, target_folder: int
    ) -> None:
        """Note a renamed file as read under its old name and as made under both; a made folder stays one."""
        if path := _absolute(source, source_folder):
            self._read(frame, path)
            self._make(path)
        if path := _absolute(target, target_folder):
            self._make(path)
            if f"{_absolute(source, source_folder)}{os.sep}" in self._notes.made_folders:
                self._notes.made_folders += (f"{path}{os.sep}",)

    def _on_symlink(self, _: FrameType, __: Any, target: Any, folder: int) -> None:
        if path := _absolute(target, folder):
            self._make(path)

    def _on_remove(self, _: FrameType, name: Any, folder: int) -> None:
        if path := _absolute(name, folder):
            self._make(path)

    def _on_truncate(self, _: FrameType, name: Any, __: int) -> None:
        if path := _absolute(name):
            self._make(path)

    def _on_mkdir(self, _: FrameType, name: Any, __: int, folder: int) -> None:
        """Note a new folder: what lies in it was made by the run."""
        path = _absolute(name, folder)
        if path is not None and not os.path.lexists(path):
            self._make(path)
            self._notes.made_folders += (f"{path}{os.sep}",)

    def _on_list(self, frame: FrameType, name: Any) -> None:
        """Note the names in a folder that foreign code lists."""
        path = _absolute("." if name is None else name)
        if path is None or path in self._notes.folders or not is_file_name(path):
            return
        if _is_in(frame, _IMPORTING):
            return
        if self._collector.is_output(f"{path}{os.sep}") or not self._is_foreign(frame):
            return
        try:
            self._notes.folders[path] = names_in(path)
        except OSError:
            self._notes.folders[path] = None
        self._note("folder", path)

    # -- modules and variables ---------------------------------------------------------------------

    def _on_import(self, frame: FrameType, module: str, *_: Any) -> None:
        """Note a module that foreign code imports, by its top-level name."""
        top = module.partition(".")[0]
        if top in self._notes.modules or top in sys.stdlib_module_names:
            return
        if self._is_foreign(frame):
            self._notes.modules.add(top)
            self._note("module", top)

    def _on_variable(self, frame: FrameType, name: Any) -> None:
        if self._is_asked_by_foreign(frame.f_back):
            self._note_variables([_variable_name(name)])

    def _on_all_variables(self, frame: FrameType) -> None:
        if self._is_asked_by_foreign(frame.f_back):
            self._note_all_variables()

    def _on_variable_set(self, _: FrameType, name: Any) -> None:
        self._notes.made.add(f"${_variable_name(name)}")

    def _on_declared_variable(self, _: FrameType, name: str) -> None:
        self._note_variables([name])

    def _note_all_variables(self) -> None:
        if not self._notes.has_all_variables:
            self._notes.has_all_variables = True
            self._note("all variables", "")
        self._note_variables(self._collector.environment)

    def _note_variables(self, names: Iterable[str]) -> None:
        """Note environment variables that count and were not noted yet."""
        for name in names:
            is_known = name in self._notes.variables or f"${name}" in self._notes.made
            if is_counted(name) and name not in SEARCH_PATHS and not is_known:
                self._notes.variables.add(name)
                self._note("variable", name)

    # -- programs ----------------------------------------------------------------------------------

    def _on_popen(
        self, frame: FrameType, executable: Any, words: Any, folder: Any, environment: Any
    ) -> None:
        """Note a program that is started, and the variables that an adapter gives it."""
        given = [words] if isinstance(words, str | bytes | os.PathLike) else list(words)
        self._start_program(frame, [executable, *given[1:]], folder)
        # an adapter's program gets these variables and no others
        if environment is not None and _is_adapter(frame):
            self._note_variables(
                [name for name in map(os.fsdecode, environment) if is_counted(name)]
            )

    def _on_exec(
        self, frame: FrameType, path: Any, words: Any, _: Mapping[Any, Any] | None
    ) -> None:
        self._start_program(frame, [path, *list(words)[1:]])

    def _on_spawn(self, frame: FrameType, _: int, path: Any, words: Any, __: Any) -> None:
        self._start_program(frame, [path, *list(words)[1:]])

    def _on_system(self, frame: FrameType, command: Any) -> None:
        self._start_program(frame, ["/bin/sh", "-c", command])

    def _start_program(self, frame: FrameType, words: list[Any], folder: Any = None) -> None:
        """Note a program that is about to be started by foreign code, or for it by an adapter."""
        if not self._is_foreign(frame) and not _is_adapter(frame):
            return
        texts = [os.fsdecode(word) for word in words]
        # what a line of code names counts as arguments do: sh -c LINE, python -c LINE
        if "-c" in texts[1:-1]:
            texts += _WORD_OF_CODE.findall(texts[texts.index("-c", 1) + 1])
        command = Command(tuple(texts), _absolute("." if folder is None else folder) or os.getcwd())
        if command not in self._notes.commands:
            self._notes.commands[command] = _program_start_ns()
            self._note("command", json.dumps([texts, command.folder]))
        self._note_variables(RESULT_VARIABLES)
        if self._watcher is None:
            self._watcher = threading.Thread(target=self._watch, daemon=True)
            self._watcher.start()

    def _watch(self) -> None:
        """Look at the programs until the end; runs in a thread of its own, as the run may wait for a program."""
        self._ignored_threads.add(threading.get_ident())
        wait_s = _FIRST_LOOK_S
        while not self._ended.wait(wait_s):
            self._look_at_programs(wait_s / 2)
            wait_s = min(2 * wait_s, _LOOK_S)

    def _look_at_programs(self, least_age_s: float) -> None:
        """Note what the processes below this one are made of: each again when its age has doubled.

        Args:
            least_age_s: Younger ones have not loaded their libraries yet.
        """
        if not self._notes.commands:
            return
        with self._ignoring_own_reads():
            command_line = psutil.Process().cmdline()
            for process in psutil.Process().children(recursive=True):
                try:
                    born_s = process.create_time()
                    is_fork = process.cmdline() == command_line
                except psutil.Error:  # it has ended
                    continue
                if is_fork:  # it writes down itself what it reads
                    continue
                # look again when the process has grown twice as old
                key = (process.pid, born_s)
                age_s = time.time() - born_s
                if age_s >= max(least_age_s, 2 * self._age_at_look.get(key, 0.0)):
                    self._age_at_look[key] = age_s
                    look_at(process, self._collector.programs)

    # -- forked processes --------------------------------------------------------------------------

    def begin_log(self) -> None:
        """In a forked process: write down what is read, as it ends without a word."""
        self._ignored_threads.clear()  # threads of the other process
        with self._ignoring_own_reads():
            path = self._folders[0] / _LOG.format(os.getpid())
            self._log = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)

    def _add_forked(self) -> None:
        """Take over what forked processes have read and made."""
        entries: list[tuple[str, str]] = []
        for log in self._folders[0].glob(_LOG.format("*")):
            entries += [json.loads(line) for line in log.read_text().splitlines()]
        # what one of them has made is no input of another
        for kind, name in entries:
            if kind == "made":
                self._notes.made.add(name)
        for kind, name in entries:
            match kind:
                case "file" if name not in self._notes.files:
                    stamp = stamp_of(name)
                    self._notes.files[name] = FileNote(stamp)
                    if stamp is not None and stamp.changed_ns > self._collector.began_ns:
                        self._notes.changed.append(name)
                case "folder" if name not in self._notes.folders:
                    self._notes.folders[name] = names_in(name) if os.path.isdir(name) else None
                case "missing":
                    self._notes.missing.add(name)
                case "variable":
                    self._notes.variables.add(name)
                case "module":
                    self._notes.modules.add(name)
                case "all variables":
                    self._notes.has_all_variables = True
                case "metadata":
                    self._notes.metadata.add(name)
                case "command":
                    words, folder = json.loads(name)
                    command = Command(tuple(words), folder)
                    self._notes.commands.setdefault(command, self._collector.began_ns)


class _StaleByteCode(FileNotFoundError):
    """Raised in place of opening byte code that is older than its source."""


def _absolute(name: Any, folder: int = -1) -> str | None:
    """The absolute path of a file; None of a descriptor that is of no file.

    Args:
        name: A path, or a descriptor.
        folder: Descriptor of the folder in which a relative path begins; -1 for the working folder.
    """
    if isinstance(name, int):
        return _path_of_descriptor(name)
    path = os.fsdecode(name)
    if "\0" in path:  # no file can have that name
        return None
    if not os.path.isabs(path):
        base = os.getcwd() if folder == -1 else _path_of_descriptor(folder)
        if base is None:
            return None
        path = os.path.join(base, path)
    # a folder above a link is not the one before it
    return os.path.realpath(path) if ".." in path.split(os.sep) else os.path.normpath(path)


def _path_of_descriptor(descriptor: int) -> str | None:
    """The path of an open file; None where it has none or the system does not tell."""
    try:
        path = os.readlink(f"/proc/self/fd/{descriptor}")
    except OSError:
        return None
    return path if is_file_name(path) else None


def _program_start_ns() -> int:
    """The time (ns) that separates files written before a program starts from those written after.

    The former may be its inputs, the latter its outputs.
    It waits for the next tick of the clock that stamps files. Where that clock cannot be read it
    gives the time less the most that the clock may be behind: files of the last moments then count
    as written next.
    """
    if _FILE_CLOCK is None:
        return time.time_ns() - _CLOCK_LAG_NS
    tick_ns = time.clock_gettime_ns(_FILE_CLOCK)
    end_ns = time.monotonic_ns() + 2 * _CLOCK_LAG_NS
    while time.monotonic_ns() < end_ns:
        now_ns = time.clock_gettime_ns(_FILE_CLOCK)
        if now_ns != tick_ns:
            return now_ns
        time.sleep(0.0005)
    return time.time_ns() - _CLOCK_LAG_NS


def _sha256(path: str) -> str:
    """SHA-256 of a small file; empty where it cannot be read, which the reader is about to see."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError:
        return ""


def _variable_name(name: Any) -> str:
    """The name of an environment variable; anything else than a text or bytes is none, and fails where it is used."""
    return os.fsdecode(name) if isinstance(name, str | bytes) else ""


def _is_in(frame: FrameType, files: tuple[str, ...]) -> bool:
    """Whether a function is one of some files, by beginnings or ends of their paths."""
    file = frame.f_code.co_filename
    return file.startswith(files) or file.endswith(files)


def _is_adapter(frame: FrameType | None) -> bool:
    """Whether an adapter of this package calls."""
    while frame is not None:
        if str(frame.f_globals.get("__name__", "")).startswith(_ADAPTERS):
            return True
        frame = frame.f_back
    return False
