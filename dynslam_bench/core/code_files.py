"""Files that a program is made of: its code, and the data files beside it that its code names."""

import ast
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

from dynslam_bench.core.module_graph import parsed

CODE = (".py", ".so", ".pyd", ".dylib", ".dll")
"""Endings of the names of Python sources and native libraries."""
_TEXT = (
    ".py",
    ".sh",
    ".bash",
    ".pl",
    ".rb",
    ".lua",
    ".js",
    ".jl",
    ".yaml",
    ".yml",
    ".toml",
    ".json",
    ".cfg",
    ".conf",
    ".ini",
    ".xml",
    ".txt",
    ".c",
    ".cc",
    ".cpp",
    ".cu",
    ".h",
    ".hpp",
)
"""Endings of scripts, sources, configurations and lists, which may name other files."""
_SOURCES = (b".c", b".cc", b".cpp", b".cxx", b".cu", b".h", b".hpp", b".hxx", b".inl", b".ipp")
"""A compiled program holds the names of its sources, which it does not read."""
_LARGEST_TEXT = 1 << 20
"""Bytes of the largest text that is searched for names of files."""
_LARGEST_BINARY = 1 << 22
"""Bytes of the largest compiled program that is searched: 4 MB take a tenth of a second."""
_ELF = b"\x7fELF"
"""First bytes of compiled programs of Linux."""
_NAME_IN_BINARY = re.compile(rb"[\w./~+\-]{1,300}\.[A-Za-z]\w{0,9}")
"""The name of a file with an ending."""
_WORD = re.compile(rb"[\w./~+\-]+")
"""A word that could be a path, quoted or not."""
_QUOTED = re.compile(rb"[\"']([\w.+\-]+)(?:/[^\"'\n]*)?[\"']")
"""A text in quotes that could be a path, of which the first part is taken."""
_FORMAT = re.compile(rb"%[-+0-9.]*[a-zA-Z]")
"""A placeholder of printf: what stands before and after it are words of their own."""
_SYSTEM = (
    "/usr/",
    "/bin/",
    "/sbin/",
    "/lib",
    "/etc/",
    "/dev/",
    "/proc/",
    "/sys/",
    "/opt/local/",
    "/System/",
)
"""Folders of the operating system's files."""
_STORE = ("index.sqlite", "sequences", "latest")
"""A folder with ``runs/`` and one of these is a results folder."""
_RECORDING = ("rgb.txt", "groundtruth.txt", "rgb.csv", "mav0", "color.txt", "associations.txt")
"""A folder with one of these is a recording."""
_IMAGES = (".png", ".jpg", ".jpeg", ".pgm", ".tif", ".tiff", ".exr", ".npy")
"""How the images of recordings end."""
_MANY_IMAGES = 10
"""A folder of a recording with so many images holds its frames."""


def is_code(file: Path) -> bool:
    """Whether a file is Python source or a native library."""
    return (file.suffix in CODE or ".so." in file.name) and file.is_file()


def imports_outside_folder(file: Path) -> set[str]:
    """Top-level names of the modules outside its folder that a module imports, itself or through others of the folder.

    The identity of a program covers these modules, too. The standard library is among them.

    Args:
        file: A ``.py`` file, whose folder is taken to be on the path when it is imported.

    Raises:
        OSError: A file cannot be read.
    """
    imported = set[str]()
    outside = set[str]()
    waiting = [file]
    while waiting:
        # what the files that were found last import
        names = imported_modules(waiting) - imported
        imported |= names
        waiting = []
        for name in names:
            # a name is a module or a package of the folder, or it lies outside
            module = file.parent / f"{name}.py"
            package = file.parent / name
            if module.is_file():
                waiting.append(module)
            elif package.is_dir():
                waiting += files_below(package)
            else:
                outside.add(name)
    return outside


def program_files(folder: Path) -> list[Path]:
    """The files below a folder that decide what its code does.

    These are all code files, and each other file of which the name, or its end with a dot in it, is
    written in one of the text files among them: ``"net.onnx"``, ``HERE / "params" / "slam.yaml"``,
    ``f"{name}_v2.yaml"``. So are all files of a folder whose name a Python source quotes:
    ``glob("weights/*")``. Hidden folders, virtual environments, results folders and the images of
    recordings are left out.

    Args:
        folder: For example that of a plug-in's file.

    Raises:
        OSError: The folder cannot be read.
    """
    # all code counts
    everything = list(files_below(folder))
    code = {file for file in everything if is_code(file)}

    # what Python sources quote may be the name of a folder, all of whose files count
    quoted: set[str] = set()
    for file in filter(is_python, code):
        quoted |= {name.decode() for name in _QUOTED.findall(file.read_bytes())}

    # of all other files, those that the code names
    counted = []
    others = []
    for file in everything:
        if file in code or file.relative_to(folder).parts[0] in quoted:
            counted.append(file)
        else:
            others.append(file)
    return counted + _named(counted, others)


def imported_modules(files: Iterable[Path]) -> set[str]:
    """Top-level names of the modules that Python sources import, by statements or by names in ``import_module``.

    Raises:
        OSError: A file cannot be read.
    """
    modules: set[str] = set()
    for file in filter(is_python, files):
        try:
            nodes = list(ast.walk(parsed(file.read_bytes())))
        except (SyntaxError, ValueError, RecursionError):  # of another version of Python
            continue
        for node in nodes:
            # import statements, and calls whose first argument is a module's name
            if isinstance(node, ast.Import):
                modules |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                modules.add(node.module or "")
            elif isinstance(node, ast.Call):
                function = ast.unparse(node.func)
                argument = node.args[0] if node.args else None
                is_import = function.endswith(("import_module", "__import__"))
                if is_import and isinstance(argument, ast.Constant):
                    modules.add(str(argument.value))
    # the first part of each
    return {name.partition(".")[0].partition(" ")[0] for name in modules} - {""}


def is_python(file: Path) -> bool:
    """Whether a file is Python source: by its suffix, or by the first line of a script without one."""
    if file.suffix == ".py":
        return True
    if file.suffix or not _is_file(file):
        return False
    with file.open("rb") as opened:
        first = opened.readline(200)
    return first.startswith(b"#!") and b"python" in first


def files_below(folder: Path, *, in_recording: bool = False) -> Iterator[Path]:
    """All files below a folder, but for hidden ones, virtual environments, results folders and images of recordings.

    Args:
        folder: The folder.
        in_recording: Whether it lies in a recording: then folders of many images are left out.

    Raises:
        OSError: The folder cannot be read.
    """
    for entry in sorted(folder.iterdir()):
        if entry.name.startswith((".", "__pycache__")):
            continue
        if entry.is_file():
            yield entry
        elif entry.is_dir() and not _is_left_out(entry) and not leads_back(entry):
            # a recording may hold a program's files, too
            is_recording = in_recording or any((entry / name).exists() for name in _RECORDING)
            if not (is_recording and _holds_images(entry)):
                yield from files_below(entry, in_recording=is_recording)


def _holds_images(folder: Path) -> bool:
    """Whether a folder holds as many images as those of a recording do."""
    with os.scandir(folder) as entries:
        images = (entry for entry in entries if entry.name.lower().endswith(_IMAGES))
        return sum(1 for _ in islice(images, _MANY_IMAGES)) == _MANY_IMAGES


def files_of_command(command: Sequence[str], folder: Path | None = None) -> list[Path]:
    """The files that decide what a command does.

    These are its program with the libraries it is linked with, and the files and folders among its
    arguments (also behind ``=``). The code of ``python -m MODULE`` counts, and so does what scripts
    and configuration files name. With a Python script all code in its folder counts, and what it
    imports from elsewhere but installed distributions. Files of the operating system are left out.

    Args:
        command: Program and arguments.
        folder: Its working folder; None for the current one.
    """
    if not command:
        return []
    base = Path() if folder is None else folder
    program = _program_of(command[0], base)
    files: list[Path] = []

    # the program with its libraries, and what its arguments name
    if program is not None and _is_file(program):
        files += [program, *_linked_libraries(program.resolve())]
    for word in command[1:]:
        files += _files_of_argument(word, base)
    if program is not None and program.name.startswith("python") and "-m" in command[:-1]:
        files += _module_files(command[command.index("-m") + 1], base)

    # what scripts and configurations among them name, shell scripts also the files beside them
    named = _with_named_files(files, base)
    shell_scripts = [file for file in named if _is_shell_script(file)]
    for script in shell_scripts:
        named += _named([script], list(files_below(script.parent)))

    # Python scripts: the code in their folders, and what they import from elsewhere
    scripts = [file for file in named if is_python(file) and not _is_of_system(file)]
    code: list[Path] = []
    for script_folder in sorted({script.parent for script in scripts}):
        code += program_files(script_folder)
    modules: set[str] = set()
    for script in scripts:
        modules |= imports_outside_folder(script)
    for module in sorted(modules - set(sys.stdlib_module_names)):
        code += [file for file in _module_files(module, base) if not is_installed(file)]

    return list(dict.fromkeys(file.resolve() for file in (*named, *code)))


def _program_of(word: str, base: Path) -> Path | None:
    """The file of a command's first word; None where a bare name is not on ``PATH``."""
    if os.sep in word:
        return base / Path(word).expanduser()
    program = shutil.which(word)
    return None if program is None else Path(program)


def _files_of_argument(word: str, base: Path) -> list[Path]:
    """The file, or the files of the folder, that an argument or its part behind ``=`` names."""
    texts = [text for text in (word, word.partition("=")[2]) if text]
    files: list[Path] = []
    for path in {base / Path(text).expanduser() for text in texts}:
        if os.path.isdir(path):  # noqa: PTH112 - it takes words that cannot be a path
            files += files_below(path)
        elif _is_file(path):
            files.append(path)
    return files


def _is_shell_script(file: Path) -> bool:
    if file.suffix:
        return file.suffix in (".sh", ".bash")
    return _is_file(file) and _names_interpreter(file)


def _module_files(module: str, base: Path) -> list[Path]:
    """The code of a module in the working folder or on ``PYTHONPATH``, else as this interpreter finds it."""
    top = module.partition(".")[0]
    search_path = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    for place in (base, *(Path(folder) for folder in search_path if folder)):
        if (place / top).is_dir():
            return program_files(place / top)
        if (place / f"{top}.py").is_file():
            return program_files(place)
    with suppress(ImportError, ValueError):
        folders = getattr(find_spec(top), "submodule_search_locations", None) or ()
        files: list[Path] = []
        for place in map(Path, folders):
            if not is_installed(place):
                files += files_below(place)
        return files
    return []


def is_installed(path: Path) -> bool:
    """Whether a path belongs to an installed distribution, which its version tells."""
    return any(part in ("site-packages", "dist-packages") for part in path.parts)


def _linked_libraries(program: Path) -> list[Path]:
    """The shared libraries of a program that are none of the operating system's, as ``ldd`` finds them."""
    if _is_of_system(program) or shutil.which("ldd") is None:
        return []
    # lines of `ldd` read "libname.so => /path/libname.so (0x...)"
    listed = subprocess.run(
        ["ldd", str(program)], capture_output=True, text=True, check=False
    ).stdout
    paths = [Path(match) for match in re.findall(r"=> (/.+) \(0x", listed)]
    return [path for path in paths if not _is_of_system(path) and path.is_file()]


def _with_named_files(files: Iterable[Path], base: Path) -> list[Path]:
    """Files, and those that scripts and configurations among them name, relative to themselves or to `base`."""
    reached: dict[Path, None] = {}
    waiting = list(files)
    while waiting:
        file = waiting.pop(0)
        if file in reached:
            continue
        reached[file] = None
        # words that may name a file beside it, or in the working folder
        path_like = sorted(word for word in _words(file) if "." in word or "/" in word)
        for word in path_like:
            path = Path(word).expanduser() if word.startswith("~/") else Path(word)
            places = {file.parent / path, base / path}  # an absolute path stays as it is
            waiting += [place for place in places if not _is_of_system(place) and _is_file(place)]
    return list(reached)


def _named(code: list[Path], others: list[Path]) -> list[Path]:
    """Files among `others` that the code names; what they name in turn counts, too."""
    files: list[Path] = []
    waiting = list(code)
    while waiting and others:
        words: set[str] = set()
        for file in waiting:
            words |= {word.rpartition("/")[2] for word in _words(file)}
        # f"{name}_v2.yaml" names every file that ends so
        ends = tuple(word for word in words if "." in word)
        waiting = [file for file in others if file.name in words or file.name.endswith(ends)]
        others = [file for file in others if file not in set(waiting)]
        files += waiting
    return files


def _words(file: Path) -> set[str]:
    """The words of a script, configuration or compiled program that could be names of files."""
    try:
        # scripts and configurations are text; the rest may be a compiled program
        is_text = file.suffix in _TEXT or (not file.suffix and _names_interpreter(file))
        if not is_text:
            return _words_of_binary(file)
        if file.stat().st_size > _LARGEST_TEXT:
            return set()
        text = _FORMAT.sub(b" ", file.read_bytes())
        return {word.decode(errors="replace").rstrip(".") for word in _WORD.findall(text)}
    except OSError:
        return set()


def _names_interpreter(file: Path) -> bool:
    """Whether a file is a script: its first line names what runs it.

    Raises:
        OSError: It cannot be read.
    """
    with file.open("rb") as opened:
        return opened.read(2) == b"#!"


def _words_of_binary(file: Path) -> set[str]:
    """The texts in a compiled program that are written as names of files with an ending.

    Raises:
        OSError: It cannot be read.
    """
    if file.stat().st_size > _LARGEST_BINARY or _is_of_system(file.resolve()):
        return set()
    with file.open("rb") as opened:
        if opened.read(len(_ELF)) != _ELF:
            return set()
    # strings of a compiled program end with a null byte
    texts = set(file.read_bytes().split(b"\0"))
    names = filter(_NAME_IN_BINARY.fullmatch, texts)
    return {name.decode() for name in names if not name.endswith(_SOURCES)}


def _is_of_system(path: Path) -> bool:
    return str(path).startswith(_SYSTEM)


def _is_file(path: Path) -> bool:
    return os.path.isfile(path) and os.access(path, os.R_OK)  # noqa: PTH113 - it takes words that cannot be a path


def leads_back(entry: Path) -> bool:
    """Whether a folder is a link to one that it lies in: following it would never end."""
    if not entry.is_symlink():
        return False
    return entry.resolve() in (entry.parent.resolve() / entry.name).parents


def _is_left_out(folder: Path) -> bool:
    """Whether a folder is a virtual environment or a results folder."""
    is_store = (folder / "runs").is_dir() and any((folder / name).exists() for name in _STORE)
    return is_store or (folder / "pyvenv.cfg").exists()
