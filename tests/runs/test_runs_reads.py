"""What a run's foreign code read: each change of it is noticed, and nothing else is."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
import pytest

from dynslam_bench.core.programs import ProgramReads, is_counted, look_at, program_environment
from dynslam_bench.core.reads import BaseFolders, Reads, Verifier, digest_of, search_now

pytestmark = pytest.mark.slow

SERVER = Path(__file__).with_name("reads_server.py")


class Child:
    """A process that forks another for each recording; its code has no file, so that it is nobody's.

    Args:
        path: Folders that come first on its import path.
        preloaded: A module that it imports before it forks.
    """

    def __init__(self, path: Sequence[str] = (), preloaded: str = "sys") -> None:
        code = (
            f"import {preloaded}; exec(compile(open({str(SERVER)!r}).read(), '<server>', 'exec'))"
        )
        pipe = subprocess.PIPE
        environment = dict(os.environ)
        if path:  # else the recording process has the same variables as this one
            places = [*path, *filter(None, [environment.get("PYTHONPATH")])]
            environment["PYTHONPATH"] = os.pathsep.join(places)
        self.process = subprocess.Popen(
            [sys.executable, "-c", code], stdin=pipe, stdout=pipe, text=True, env=environment
        )

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait(10)

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        print(json.dumps(request), file=self.process.stdin, flush=True)
        return self.answer()

    def answer(self) -> dict[str, Any]:
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        assert "broken" not in answer, answer["broken"]
        return answer

    def resume(self) -> None:
        print(file=self.process.stdin, flush=True)


@pytest.fixture(scope="module")
def child() -> Iterator[Child]:
    child = Child()
    yield child
    child.close()


@dataclass
class Bench:
    """A plug-in's folder, a working folder and a home of a test, and the process that records.

    Attributes:
        path: Folders that come first on the import path.
        environment: Variables of the run.
    """

    child: Child
    root: Path
    path: list[str] = field(default_factory=list)
    environment: dict[str, str] = field(default_factory=dict)
    plugins: list[str] = field(default_factory=list)

    @property
    def plugin(self) -> Path:
        return self.root / "plugin" / "mine.py"

    @property
    def work(self) -> Path:
        return self.root / "work"

    @property
    def base_folders(self) -> BaseFolders:
        return BaseFolders(self.plugin.parent, self.work)

    def write(self, name: str, text: str) -> Path:
        file = self.root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        return file

    def job(self, source: str, target: str = "", **arguments: Any) -> dict[str, Any]:
        self.write("plugin/mine.py", source)
        for folder in ("work", "private"):
            (self.root / folder).mkdir(exist_ok=True)
        return {
            "plugin": target or str(self.plugin),
            "work": str(self.work),
            "private": str(self.root / "private"),
            "path": self.path,
            "environment": self.environment,
            "plugins": self.plugins,
            "arguments": arguments,
        }

    def record(self, source: str, target: str = "", **arguments: Any) -> Reads:
        answer = self.child.ask(self.job(source, target, **arguments))
        assert "fault" not in answer, answer
        reads = Reads.model_validate(answer["reads"])
        assert self.changed(reads) == ""
        assert Reads.parse(reads.to_json(), "reads") == reads
        return reads

    def changed(self, reads: Reads) -> str:
        verifier = Verifier([*self.path, *sys.path], {**os.environ, **self.environment})
        return verifier.changed(reads, self.base_folders)


@pytest.fixture
def bench(child: Child, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(child, tmp_path)


def edit(path: Path, text: str) -> None:
    """Write another text of equal length, and leave the time of modification as it was."""
    status = path.stat()
    assert status.st_size == len(text)
    path.write_text(text)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with programs in C: one opens ``settings.cfg``, one loads ``libpart.so``, and waits for a line."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler")
    folder = tmp_path_factory.mktemp("compiled")
    sources = {
        "opens": '#include <stdio.h>\nint main() { return fopen("settings.cfg", "r") == 0; }',
        "loads": "#include <stdio.h>\n#include <dlfcn.h>\n"
        "int main(int count, char **words) "
        '{ void *part = dlopen(words[1], 2); puts("ready"); fflush(stdout); getchar(); return part == 0; }',
        "libmode.so": '#include <stdlib.h>\nint mode() { return getenv("MY_SLAM_MODE") != 0; }',
        "libpart.so": "int part() { return 1111; }",
    }
    for name, source in sources.items():
        (folder / "source.c").write_text(source)
        options = ["-shared", "-fPIC"] if name.endswith(".so") else []
        words = [compiler, *options, "source.c", "-o", name, "-ldl"]
        subprocess.run(words, cwd=folder, check=True)
    return folder


# -- files and folders -----------------------------------------------------------------------------

READ_ALL = """
from pathlib import Path
def run(files):
    named = files.values() if isinstance(files, dict) else files
    for name in named:
        Path(name).read_bytes()
"""


@pytest.mark.parametrize(
    "files",
    [
        ["a.bin", "parts/b.bin"],
        {"left": "a.bin", "right": "parts/b.bin"},
    ],
    ids=["list or tuple", "dictionary"],
)
@pytest.mark.parametrize("edited", ["a.bin", "parts/b.bin"])
def test_files_in_settings_of_any_form(files: Any, edited: str, bench: Bench) -> None:
    for name in ("a.bin", "parts/b.bin"):
        bench.write(f"work/{name}", "1111")
    reads = bench.record(READ_ALL, files=files)
    assert set(reads.files) == {"plugin:/mine.py", "work:/a.bin", "work:/parts/b.bin"}
    edit(bench.work / edited, "2222")
    assert bench.changed(reads) == f"the file {edited}"


# the name of a file that no source writes: it would count without being opened
NAME = "net" + ".bin"


@pytest.mark.parametrize(
    "read",
    [
        "open(NAME).read()",
        "open(NAME.encode(), 'rb').read()",
        "import io; io.FileIO(NAME).readall()",
        "import os; os.read(os.open(NAME, os.O_RDONLY), 4)",
        "import os; open(os.path.join(os.getcwd(), 'sub', '..', NAME)).read()",
        "from pathlib import Path; Path(NAME).resolve().read_text()",
        "import numpy; numpy.fromfile(NAME, numpy.uint8)",
        "import numpy; numpy.memmap(NAME, numpy.uint8)",
        "import numpy; numpy.memmap(NAME, numpy.uint8, mode='c')",
        "import mmap; file = open(NAME); mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)",
        "import shutil, tempfile; open(shutil.copy(NAME, tempfile.mkdtemp())).read()",
        "import os, tempfile; link = tempfile.mkdtemp() + '/x'; os.symlink(os.path.abspath(NAME), link); open(link)",
        "from concurrent.futures import ThreadPoolExecutor as Pool; list(Pool(2).map(open, [NAME]))",
        "import threading; thread = threading.Thread(target=open, args=[NAME]); thread.start(); thread.join()",
        "import multiprocessing as m; m.get_context('fork').Pool(1).map(open_it, [NAME])",
        "import os; pid = os.fork() or (open(NAME), os._exit(0)); os.waitpid(pid, 0)",
        "import pathlib; from dynslam_bench.core import read_bytes; read_bytes(pathlib.Path(NAME))",
        "text = open(NAME, 'r+').read()",
        "import sqlite3; sqlite3.connect(NAME)",
        "import ctypes; ctypes.CDLL('./' + NAME)",
        "import subprocess; subprocess.run(['cat', NAME])",
        "import subprocess; subprocess.run(f'cat < {NAME} | wc', shell=True)",
        "import os; os.system('cat ' + NAME)",
    ],
)
def test_a_bare_name_in_the_working_folder_however_it_is_opened(read: str, bench: Bench) -> None:
    bench.write(f"work/{NAME}", "1111")
    bench.write("work/sub/x", "")
    source = f"NAME = 'net' + '.bin'\ndef open_it(name):\n    open(name).read()\ndef run():\n    try:\n        {read}\n"
    reads = bench.record(
        source
        + "    except OSError:\n        assert 'CDLL' in open_it.__doc__\n".replace(
            "open_it.__doc__", repr(read)
        )
    )
    assert f"work:/{NAME}" in (*reads.files, *reads.programs)
    assert set(reads.files) <= {"plugin:/mine.py", f"work:/{NAME}"}
    edit(bench.work / NAME, "2222")
    assert bench.changed(reads).startswith(f"the file {NAME}")


@pytest.mark.parametrize(
    "read",
    [
        "[open(os.path.join(FOLDER, name)) for name in os.listdir(FOLDER)]",
        "[open(entry.path) for entry in os.scandir(FOLDER)]",
        "[file.read_text() for file in pathlib.Path(FOLDER).iterdir()]",
        "[file.read_text() for file in pathlib.Path(FOLDER).glob('*')]",
        "[file.read_text() for file in pathlib.Path(FOLDER).rglob('*.txt')]",
        "[open(name) for name in glob.glob(FOLDER + '/*')]",
        "[open(os.path.join(place, name)) for place, _, names in os.walk(FOLDER) for name in names]",
    ],
)
def test_a_folder_that_a_text_names(read: str, bench: Bench) -> None:
    for name in ("associations.txt", "b.txt"):
        bench.write(f"work/maps/{name}", "1111")
    source = f"import glob, os, pathlib\ndef run(folder):\n    {read}\n".replace("FOLDER", "folder")
    reads = bench.record(source, folder="maps")
    assert set(reads.files) == {
        "plugin:/mine.py",
        "work:/maps/associations.txt",
        "work:/maps/b.txt",
    }
    assert set(reads.folders) == {"work:/maps"}
    edit(bench.work / "maps" / "associations.txt", "2222")
    assert bench.changed(reads) == "the file maps/associations.txt"
    edit(bench.work / "maps" / "associations.txt", "1111")
    assert bench.changed(reads) == ""
    bench.write("work/maps/c.txt", "")
    assert bench.changed(reads) == "the names in the folder maps"


def test_a_folder_that_is_missing(bench: Bench) -> None:
    source = "import os\ndef run(folder):\n    try:\n        os.listdir(folder)\n    except OSError:\n        pass\n"
    reads = bench.record(source, folder="maps")
    assert reads.folders == {"work:/maps": ""}
    (bench.work / "maps").mkdir()
    assert bench.changed(reads) == "the names in the folder maps"


@pytest.mark.parametrize(
    "config", ["weights: net.bin", '{"weights": "net.bin"}', "[model]\nweights = '../work/net.bin'"]
)
@pytest.mark.parametrize("is_opened", [True, False], ids=["by Python", "in machine code"])
def test_a_configuration_that_names_weights(config: str, is_opened: bool, bench: Bench) -> None:
    suffix = ".json" if config.startswith("{") else ".yaml"
    bench.write(f"work/slam{suffix}", config)
    bench.write(f"work/{NAME}", "1111")
    source = "def run(config, name):\n    open(config).read()\n    if name:\n        open(name)\n"
    reads = bench.record(source, config=f"slam{suffix}", name=NAME if is_opened else "")
    assert set(reads.files) == {"plugin:/mine.py", f"work:/slam{suffix}", f"work:/{NAME}"}
    edit(bench.work / NAME, "2222")
    assert bench.changed(reads) == f"the file {NAME}"


@pytest.mark.parametrize("name", ["0001.png", "net.ONNX"])
def test_a_listed_folder_whose_images_are_opened_in_machine_code(name: str, bench: Bench) -> None:
    bench.write(f"work/masks/{name}", "1111")
    reads = bench.record(
        "import os\ndef run(folder):\n    return os.listdir(folder)\n", folder="masks"
    )
    assert set(reads.files) == {"plugin:/mine.py", f"work:/masks/{name}"}
    edit(bench.work / "masks" / name, "2222")
    assert bench.changed(reads) == f"the file masks/{name}"


def test_a_source_that_names_a_file_which_is_opened_in_machine_code(bench: Bench) -> None:
    bench.write("plugin/mask.png", "1111")
    bench.write("plugin/other.png", "1111")
    source = "import os\nHERE = os.path.dirname(__file__)\ndef run():\n    return os.path.join(HERE, 'mask.png')\n"
    reads = bench.record(source)
    assert set(reads.files) == {"plugin:/mine.py", "plugin:/mask.png"}
    edit(bench.plugin.parent / "mask.png", "2222")
    assert bench.changed(reads) == "the file mask.png"


@pytest.mark.parametrize("beside", ["associations.txt", "rgb.txt", "runs/x.json"])
@pytest.mark.parametrize("named", ["'net.onnx'", "'nets/net.onnx'", "f'{name}.onnx'"])
def test_a_network_beside_a_list_of_images(named: str, beside: str, bench: Bench) -> None:
    """The folder looks like a recording or like results; it is opened in machine code."""
    bench.write("plugin/nets/net.onnx", "1111")
    bench.write(f"plugin/nets/{beside}", "1111")
    reads = bench.record(f"def run(name):\n    return {named}\n", name="net")
    edit(bench.plugin.parent / "nets/net.onnx", "2222")
    assert bench.changed(reads) == "the file nets/net.onnx"


@pytest.mark.parametrize(
    "named", ["'net.onnx'", "'nets/' + name + '.onnx'", "f'{name}.onnx'", "'%s.onnx' % name"]
)
def test_a_network_below_the_folder_of_a_source(named: str, bench: Bench) -> None:
    """It is opened in machine code, by a name that is put together."""
    bench.write("plugin/nets/net.onnx", "1111")
    bench.write("plugin/nets/net.txt", "1111")
    bench.write("plugin/.hidden/net.onnx", "1111")
    reads = bench.record(f"def run(name):\n    return {named}\n", name="net")
    assert set(reads.files) == {"plugin:/mine.py", "plugin:/nets/net.onnx"}
    edit(bench.plugin.parent / "nets/net.onnx", "2222")
    assert bench.changed(reads) == "the file nets/net.onnx"


def test_networks_in_a_folder_that_a_configuration_names(bench: Bench) -> None:
    bench.write("work/slam.json", '{"folder": "models/small", "name": "net"}')
    bench.write("work/models/small/net.onnx", "1111")
    bench.write("work/models/other.onnx", "1111")
    reads = bench.record("def run():\n    open('slam.json').read()\n")
    assert set(reads.files) == {
        "plugin:/mine.py",
        "work:/slam.json",
        "work:/models/small/net.onnx",
    }
    edit(bench.work / "models/small/net.onnx", "2222")
    assert bench.changed(reads) == "the file models/small/net.onnx"


@pytest.mark.parametrize("name", ["net.bin", "mask.png", "first.cfg"])
def test_a_configuration_that_names_a_file_in_a_folder_below_it(name: str, bench: Bench) -> None:
    bench.write("work/slam.ini", f"[model]\nfile = {name}")
    bench.write(f"work/models/{name}", "1111")
    reads = bench.record("def run():\n    open('slam.ini').read()\n")
    edit(bench.work / "models" / name, "2222")
    assert bench.changed(reads) == f"the file models/{name}"


@pytest.mark.parametrize("name", ["a\\0b", "x" * 300, "loop", "."])
def test_names_that_no_file_can_have(name: str, bench: Bench) -> None:
    bench.write("work/b", "")
    (bench.work / "loop").symlink_to("loop")
    source = "def run(name):\n    try:\n        open(name)\n    except (OSError, ValueError):\n        pass\n"
    bench.record(source, name=name.replace("\\0", "\0"))


@pytest.mark.parametrize(
    "look",
    [
        "open(name).read()",
        "from pathlib import Path; Path(name).read_bytes()",
        "import numpy; numpy.load(name)",
    ],
)
def test_a_file_that_is_missing(look: str, bench: Bench) -> None:
    source = f"def run(name):\n    try:\n        {look}\n    except OSError:\n        pass\n"
    reads = bench.record(source, name="net.bin")
    assert reads.files["work:/net.bin"] == ""
    bench.write("work/net.bin", "1111")
    assert bench.changed(reads) == "the file net.bin"


@pytest.mark.parametrize(
    "look", ["os.path.exists('tuned.yaml')", "pathlib.Path('tuned.yaml').is_file()"]
)
def test_a_file_that_is_missing_and_never_opened(look: str, bench: Bench) -> None:
    reads = bench.record(f"import os, pathlib\ndef run():\n    return {look}\n")
    assert set(reads.files.values()) >= {""}
    bench.write("work/tuned.yaml", "x: 1")
    assert bench.changed(reads) == "the file tuned.yaml"


@pytest.mark.parametrize(
    "look",
    [
        "os.path.exists('op' + 'tional')",
        "os.path.isfile('op' + 'tional')",
        "Path('op' + 'tional').is_dir()",
        "Path('op' + 'tional').exists()",
        "os.fork() and os.wait() or (os.path.exists('op' + 'tional'), os._exit(0))",
    ],
)
@pytest.mark.parametrize("appears", ["file", "folder"])
def test_a_file_or_folder_that_is_looked_for_and_not_there(
    look: str, appears: str, bench: Bench
) -> None:
    source = f"import os\nfrom pathlib import Path\ndef run():\n    return {look}\n"
    reads = bench.record(source)
    assert reads.files["work:/optional"] == ""
    bench.write("work/optional" if appears == "file" else "work/optional/a", "1111")
    assert bench.changed(reads) == "the file optional"


@pytest.mark.parametrize(
    "make",
    [
        "open('out.png', 'w').close()",
        "os.mkdir('out.png')",
        "import cv2, numpy; cv2.imwrite('out.png', numpy.zeros((2, 2)))",
    ],
)
def test_what_a_run_looks_for_and_then_makes_is_no_input(make: str, bench: Bench) -> None:
    source = f"import os\ndef run():\n    if not os.path.exists('out.png'):\n        {make}\n"
    assert "work:/out.png" not in bench.record(source).files


@pytest.mark.parametrize("text", ["$WEIGHTS/net.bin", "${WEIGHTS}/net.bin", "~/net.bin"])
def test_a_variable_in_a_path(text: str, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def point_to(folder: str) -> None:
        bench.environment |= {"WEIGHTS": str(bench.root / folder), "HOME": str(bench.root / folder)}
        monkeypatch.setenv("HOME", str(bench.root / folder))

    for folder in ("first", "second"):
        bench.write(f"{folder}/net.bin", folder)
    point_to("first")
    source = (
        "import os\ndef run(text):\n    open(os.path.expanduser(os.path.expandvars(text))).read()\n"
    )
    reads = bench.record(source, text=text)
    assert "~/net.bin" in reads.files
    point_to("second")
    assert bench.changed(reads) == (
        "the file ~/net.bin" if "~" in text else "the environment variable WEIGHTS"
    )


# -- environment variables -------------------------------------------------------------------------


LOOKS = [
    "os.environ.get('MY_SLAM_MODE')",
    "os.environ['MY_SLAM_MODE'] if 'MY_SLAM_MODE' in os.environ else ''",
    "'MY_SLAM_MODE' in os.environ",
    "os.getenv('MY_SLAM_MODE')",
    "os.getenvb(b'MY_SLAM_MODE')",
    "os.environb.get(b'MY_SLAM_MODE')",
    "os.path.expandvars('$MY_SLAM_MODE/x')",
    "os.path.expandvars(b'$MY_SLAM_MODE/x')",
    "__import__('ctypes').CDLL(None).getenv(b'MY_SLAM_MODE')",
    "__import__('string').Template('$MY_SLAM_MODE').safe_substitute(os.environ)",
]
LISTINGS = [
    "os.environ.copy()",
    "dict(os.environ)",
    "{**os.environ}",
    "os.environ | {}",
    "[key for key in os.environ]",
    "list(os.environ.items())",
    "dict(os.environb)",
    *(["open('/proc/self/environ').read()"] if sys.platform == "linux" else []),
]


@pytest.mark.parametrize("look", LOOKS)
def test_a_variable_that_is_not_set_and_that_a_plug_in_looks_up(look: str, bench: Bench) -> None:
    reads = bench.record(f"import os\ndef run():\n    return {look}\n")
    assert reads.environment == {"$MY_SLAM_MODE": ""}
    bench.environment["MY_SLAM_MODE"] = "slow"
    assert bench.changed(reads) == "the environment variable MY_SLAM_MODE"


@pytest.mark.parametrize(
    "copy", ["os.environ.copy()", "dict(os.environ)", "{**os.environ}", "os.environ | {}"]
)
def test_a_variable_that_is_not_set_and_looked_up_in_a_copy(copy: str, bench: Bench) -> None:
    reads = bench.record(
        f"import os\ndef run():\n    copied = {copy}\n    return copied.get('MY_SLAM_MODE')\n"
    )
    assert reads.environment["$MY_SLAM_MODE"] == ""
    bench.environment["MY_SLAM_MODE"] = "slow"
    assert bench.changed(reads) == "the environment variable MY_SLAM_MODE"


@pytest.mark.parametrize(
    "look",
    [
        "[value for name, value in os.environ.items() if name.startswith('MYSLAM_')]",
        "{name[7:].lower(): os.environ[name] for name in os.environ if name[:7] == 'MYSLAM_'}",
        "sorted(filter(__import__('re').compile('^MYSLAM_').match, os.environ.copy()))",
        "[name for name in os.environb if name.startswith(b'MYSLAM_')]",
        "any('slam_' in name.lower() for name in dict(os.environ))",
    ],
)
def test_a_variable_that_is_set_later_and_looked_for_by_the_beginning_of_its_name(
    look: str, bench: Bench
) -> None:
    bench.environment["ANOTHER"] = "1"
    reads = bench.record(f"import os\ndef run():\n    return {look}\n")
    assert "HOME" not in reads.to_json()
    # what names the session is no input
    bench.environment["SSH_TTY"] = "/dev/pts/7"
    assert bench.changed(reads) == ""
    bench.environment["MYSLAM_GAIN"] = "2"
    assert bench.changed(reads) == "the list of environment variables"


@pytest.mark.parametrize("look", LOOKS + LISTINGS)
def test_a_variable_that_a_plug_in_looks_up(look: str, bench: Bench) -> None:
    bench.environment["MY_SLAM_MODE"] = "fast"
    reads = bench.record(f"import os\ndef run():\n    return {look}\n")
    assert "$MY_SLAM_MODE" in reads.environment
    assert "HOME" not in reads.to_json()
    assert "fast" not in reads.to_json()
    bench.environment["MY_SLAM_MODE"] = "slow"
    assert bench.changed(reads) == "the environment variable MY_SLAM_MODE"
    del bench.environment["MY_SLAM_MODE"]
    assert bench.changed(reads) == "the environment variable MY_SLAM_MODE"


@pytest.mark.parametrize(
    ("source", "counts"),
    [
        ("import os, library\ndef run():\n    library.mode()\n", True),
        ("import os\ndef run():\n    os.environ['MODE'] = '1'; os.environ['MODE']\n", False),
        ("import os\ndef run():\n    os.environ.pop('MODE', None)\n", True),
        (
            "import os\ndef run():\n    os.environ['HOME'], os.environ['PATH'], os.environ.get('DISPLAY')\n",
            False,
        ),
        (
            "from dynslam_bench.core import find_data_root\ndef run():\n    find_data_root()\n",
            False,
        ),
        ("import tempfile\ndef run():\n    tempfile.mkdtemp()\n", False),
    ],
)
def test_whose_look_at_a_variable_counts(source: str, counts: bool, bench: Bench) -> None:
    bench.write("path/library.py", "import os\ndef mode():\n    return os.environ.get('MODE')\n")
    bench.path.append(str(bench.root / "path"))
    bench.environment["MODE"] = "fast"
    assert set(bench.record(source).environment) == ({"$MODE"} if counts else set())


def test_a_variable_that_a_native_library_of_the_plug_in_looks_up(
    bench: Bench, compiled: Path
) -> None:
    bench.environment["MY_SLAM_MODE"] = "fast"
    bench.environment["ANOTHER"] = "1"
    source = "import ctypes\ndef run(library):\n    ctypes.CDLL(library).mode()\n"
    reads = bench.record(source, library=str(compiled / "libmode.so"))
    assert {"$MY_SLAM_MODE"} == set(reads.environment)
    bench.environment["MY_SLAM_MODE"] = "slow"
    assert bench.changed(reads) == "the environment variable MY_SLAM_MODE"


def test_a_secret_is_neither_stored_nor_hidden_from_the_comparison(bench: Bench) -> None:
    bench.environment["MY_API_KEY"] = "s3cret-value"
    reads = bench.record("import os\ndef run():\n    return os.environ['MY_API_KEY']\n")
    stored = reads.to_json()
    assert "s3cret" not in stored
    assert Reads.parse(stored, "reads").environment == reads.environment
    bench.environment["MY_API_KEY"] = "another"
    assert bench.changed(reads) == "the environment variable MY_API_KEY"


# -- modules ---------------------------------------------------------------------------------------


def on_path(bench: Bench, folder: str = "path") -> None:
    (bench.root / folder).mkdir(exist_ok=True)
    bench.path.append(str(bench.root / folder))


IMPORTS = "def run():\n    import library\n    return library.VALUE\n"


@pytest.mark.parametrize(
    ("name", "text", "edited"),
    [
        ("library.py", "VALUE = 1\n", "VALUE = 2\n"),
        ("library.py", '"""One."""\nVALUE = __doc__\n', '"""Two."""\nVALUE = __doc__\n'),
        ("library.py", "VALUE = 1  # one\n", "VALUE = 1  # two\n"),
        ("library/__init__.py", "VALUE = 1\n", "VALUE = 2\n"),
    ],
)
def test_a_module_without_a_distribution_counts_by_its_bytes(
    name: str, text: str, edited: str, bench: Bench
) -> None:
    on_path(bench)
    file = bench.write(f"path/{name}", text)
    reads = bench.record(IMPORTS)
    assert str(file) in reads.files
    assert "library" not in reads.distributions
    edit(file, edited)
    assert bench.changed(reads) == f"the file {file}"


@pytest.mark.parametrize(
    "where", ["beside the plug-in", "in a package", "in a namespace package", "in an archive"]
)
def test_modules_wherever_they_are_loaded_from(where: str, bench: Bench) -> None:
    import zipfile

    name = "library.py"
    source = "VALUE = 1\n"
    match where:
        case "beside the plug-in":
            file = bench.write(f"plugin/{name}", source)
            first = f"import os, sys\nsys.path.insert(0, os.path.dirname(__file__))\n{IMPORTS}"
        case "in a package" | "in a namespace package":
            on_path(bench)
            file = bench.write(f"path/package/{name}", source)
            if where == "in a package":
                bench.write("path/package/__init__.py", "")
            first = IMPORTS.replace("import library", "from package import library")
        case _:
            file = bench.root / "path.zip"
            with zipfile.ZipFile(file, "w") as archive:
                archive.writestr(name, source)
            bench.path.append(str(file))
            first = IMPORTS
    reads = bench.record(first)
    if where == "in an archive":
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr(name, "VALUE = 2\n")
    else:
        edit(file, "VALUE = 2\n")
    assert bench.changed(reads).endswith(file.name)


def test_a_docstring_of_the_plug_in_counts(bench: Bench) -> None:
    source = 'def run():\n    """Gain 3."""\n    return run.__doc__\n'
    reads = bench.record(source)
    edit(bench.plugin, source.replace("3", "4"))
    assert bench.changed(reads) == "the file mine.py"


def test_byte_code_that_is_older_than_its_source_is_not_run(bench: Bench) -> None:
    on_path(bench)
    file = bench.write("path/library.py", "VALUE = 1\n")
    source = "def run(name):\n    import library\n    open(name + str(library.VALUE))\n"
    for value in (1, 2):
        bench.write(f"work/gain{value}", "")
    subprocess.run(
        [sys.executable, "-m", "compileall", "-q", str(file)], check=True, env={**os.environ}
    )
    assert list(file.parent.glob("__pycache__/*.pyc"))
    assert "work:/gain1" in bench.record(source, name="gain").files
    edit(file, "VALUE = 2\n")
    assert "work:/gain2" in bench.record(source, name="gain").files


def install(folder: Path, version: str, content: str) -> None:
    """Install a distribution as pip does."""
    import hashlib
    import shutil

    shutil.rmtree(folder, ignore_errors=True)
    metadata = folder / f"library_of_mine-{version}.dist-info"
    files = {
        "library/__init__.py": f"VALUE = {content!r}\n",
        f"{metadata.name}/METADATA": f"Version: {version}\n",
    }
    lines = []
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
        lines.append(f"{name},sha256={hashlib.sha256(text.encode()).hexdigest()},{len(text)}")
    lines += [
        f"{metadata.name}/RECORD,,",
        "library/__pycache__/__init__.cpython-311.pyc,,",
        "../../bin/library,,",
    ]
    (metadata / "RECORD").write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("version", "content", "changed"),
    [
        ("1.0", "one", ""),
        ("1.0", "two", "library-of-mine 1.0"),
        ("1.1", "one", "library-of-mine 1.0"),
        ("", "", "the place of the module library"),
    ],
)
def test_a_dependency_that_is_installed_anew(
    version: str, content: str, changed: str, bench: Bench
) -> None:
    on_path(bench, "site")
    install(bench.root / "site", "1.0", "one")
    reads = bench.record(IMPORTS)
    assert reads.distributions["library-of-mine"].startswith("1.0 ")
    assert reads.modules["library"] == "installed"
    assert list(reads.files) == ["plugin:/mine.py"]
    if version:
        install(bench.root / "site", version, content)
    else:
        import shutil

        shutil.rmtree(bench.root / "site")
    assert bench.changed(reads) == changed


@pytest.mark.parametrize(
    "body",
    [
        "importlib.metadata.version('library-of-mine')",
        "importlib.metadata.distribution('Library_of.mine').version",
        "importlib.metadata.metadata('library_of_mine')['Version']",
        "threading.Thread(target=importlib.metadata.version, args=['library-of-mine']).start()",
        "os.waitpid(os.fork() or ask(), 0)",
    ],
)
def test_a_version_that_is_asked_for_without_an_import(body: str, bench: Bench) -> None:
    on_path(bench, "site")
    install(bench.root / "site", "1.0", "one")
    source = f"""
import importlib.metadata, os, threading
def ask():
    importlib.metadata.version('library-of-mine')
    os._exit(0)
def run():
    {body}
"""
    reads = bench.record(source)
    assert reads.distributions["library-of-mine"].startswith("1.0 ")
    assert "library" not in reads.modules
    assert not [name for name in reads.files if "dist-info" in name]
    install(bench.root / "site", "2.0", "one")
    assert bench.changed(reads) == "library-of-mine 1.0"


def test_listing_what_is_installed_is_no_question_for_a_version(bench: Bench) -> None:
    on_path(bench, "site")
    install(bench.root / "site", "1.0", "one")
    reads = bench.record(
        "import importlib.metadata\ndef run():\n    importlib.metadata.entry_points(group='x')\n"
    )
    assert "library-of-mine" not in reads.distributions


@pytest.mark.parametrize("name", ["library.py", "library/__init__.py"])
def test_another_module_of_that_name_earlier_on_the_path(name: str, bench: Bench) -> None:
    on_path(bench, "first")
    on_path(bench, "site")
    install(bench.root / "site", "1.0", "one")
    reads = bench.record(IMPORTS)
    file = bench.write(f"first/{name}", "VALUE = 2\n")
    assert bench.changed(reads) == "the place of the module library"
    again = bench.record(IMPORTS)
    assert str(file) in again.files
    assert "library-of-mine" not in again.distributions
    edit(file, "VALUE = 3\n")
    assert bench.changed(again) == f"the file {file}"


@pytest.mark.parametrize("module", ["part", "inner.part"])
def test_a_module_of_a_namespace_package_in_an_earlier_folder(module: str, bench: Bench) -> None:
    name = f"spread/{module.replace('.', '/')}.py"
    bench.write("first/spread/another.py", "")
    bench.write(f"second/{name}", "VALUE = 1111")
    bench.path += [str(bench.root / "first"), str(bench.root / "second")]
    reads = bench.record(f"from spread.{module} import VALUE\ndef run():\n    pass\n")
    bench.write(f"first/{name}", "VALUE = 2222")
    assert bench.changed(reads) == f"the file {bench.root / 'first' / name}"


def test_a_module_that_could_not_be_imported(bench: Bench) -> None:
    on_path(bench)
    source = "def run():\n    try:\n        import library\n    except ImportError:\n        pass\n"
    reads = bench.record(source)
    assert reads.modules["library"] == ""
    bench.write("path/library.py", "")
    assert bench.changed(reads) == "the place of the module library"


def test_another_plug_in_that_patches_a_library_shows(bench: Bench) -> None:
    on_path(bench)
    file = bench.write("path/patcher.py", "import numpy\nnumpy.my_mean = 1\n")
    alone = bench.record("import numpy\ndef run():\n    pass\n")
    both = bench.record("import numpy, patcher\ndef run():\n    pass\n")
    assert str(file) not in alone.files
    assert str(file) in both.files


def test_the_sources_of_an_installed_plug_in_count_by_their_bytes(bench: Bench) -> None:
    on_path(bench, "site-packages")
    install(bench.root / "site-packages", "1.0", "one")
    bench.write("site-packages/library/__init__.py", "def run(name):\n    open(name)\n")
    bench.write(f"work/{NAME}", "1111")
    bench.plugins.append("library")
    reads = bench.record("", "library", name=NAME)
    file = bench.root / "site-packages/library/__init__.py"
    assert set(reads.files) == {f"work:/{NAME}", str(file)}
    edit(file, "def run(name):\n    open(other)\n".replace("other", "nnnn"))
    assert bench.changed(reads) == f"the file {file}"


def test_another_library_that_was_loaded_before_the_run(tmp_path: Path) -> None:
    file = tmp_path / "first" / "cv2.py"
    file.parent.mkdir()
    file.write_text("__version__ = '0'\n")
    child = Child([str(file.parent)], "cv2")
    bench = Bench(child, tmp_path, environment={"PYTHONPATH": ""})
    bench.path.append(str(file.parent))
    reads = bench.record("import cv2\ndef run():\n    pass\n")
    child.close()
    assert str(file) in reads.files
    assert not [name for name in reads.distributions if name.startswith("opencv")]
    edit(file, "__version__ = '1'\n")
    assert bench.changed(reads) == f"the file {file}"


def test_a_library_that_was_installed_anew_after_it_was_loaded(tmp_path: Path) -> None:
    install(tmp_path / "site", "1.0", "one")
    child = Child([str(tmp_path / "site")], "library")
    bench = Bench(child, tmp_path, [str(tmp_path / "site")], {"PYTHONPATH": ""})
    assert "library-of-mine" in bench.record(IMPORTS).distributions
    install(tmp_path / "site", "1.0", "two")
    answer = child.ask(bench.job(IMPORTS))
    child.close()
    assert "the installed library-of-mine has changed" in answer["fault"]


def test_search_paths_are_compared(bench: Bench) -> None:
    reads = bench.record("def run():\n    pass\n")
    assert set(reads.search) == {"PYTHONPATH", "LD_LIBRARY_PATH", "LD_PRELOAD"}
    for name in ("PYTHONPATH", "LD_LIBRARY_PATH", "LD_PRELOAD"):
        bench.environment[name] = str(bench.root)
        assert bench.changed(reads) == name
        del bench.environment[name]


def test_what_opencv_adds_to_the_search_path_of_its_process_does_not_count(tmp_path: Path) -> None:
    base_folders = BaseFolders(None, tmp_path)
    added = "/env/lib/python3.11/site-packages/cv2/../../lib64:"
    assert search_now("LD_LIBRARY_PATH", {"LD_LIBRARY_PATH": added}, base_folders) == ""
    assert (
        search_now("LD_LIBRARY_PATH", {"LD_LIBRARY_PATH": f"{added}{tmp_path}/lib"}, base_folders)
        == "work:/lib"
    )
    assert program_environment((), {"LD_LIBRARY_PATH": f"{added}/opt/lib"}) == {
        "LD_LIBRARY_PATH": "/opt/lib"
    }


# -- what changes while it is read -----------------------------------------------------------------

TWICE = "def run(name):\n    open(name, 'rb').read()\ndef again():\n    pass\n"


def record_while(bench: Bench, source: str, change: Any, **arguments: Any) -> str:
    """The fault of a recording during which something is changed."""
    assert bench.child.ask(bench.job(source, **arguments)) == {"paused": True}
    change()
    bench.child.resume()
    bench.child.answer()
    return str(bench.child.answer().get("fault", ""))


def link(path: Path, target: str) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to(target)


@pytest.mark.parametrize("size", [4, 3 << 20], ids=["small", "large"])
@pytest.mark.parametrize("through", ["file", "folder"])
def test_links_that_are_another_for_a_while(size: int, through: str, bench: Bench) -> None:
    for version in ("a", "b"):
        bench.write(f"work/{version}/net.bin", version * size)
    current = bench.work / "current"
    targets = {"a": "a", "b": "b"} if through == "folder" else {"a": "a/net.bin", "b": "b/net.bin"}
    name = "current/net.bin" if through == "folder" else "current"
    link(current, targets["a"])
    reads = bench.record(TWICE.partition("def again")[0], name=name)
    assert reads.links == {f"work:/{name}": "work:/a/net.bin"}
    link(current, targets["b"])
    assert bench.changed(reads) == f"the file {name}"
    fault = record_while(bench, TWICE, lambda: link(current, targets["a"]), name=name)
    assert f"{name} has changed while the run read it" in fault


@pytest.mark.parametrize("content", ["2222", "1111", None])
def test_a_file_that_is_written_while_it_is_read(content: str | None, bench: Bench) -> None:
    file = bench.write(f"work/{NAME}", "1111")
    change = file.unlink if content is None else lambda: file.write_text(content)
    fault = record_while(bench, TWICE, change, name=NAME)
    assert ("has changed while the run read it" in fault) == (content != "1111")


def test_a_file_that_appears_while_it_is_looked_for(bench: Bench) -> None:
    source = "import os\ndef run(name):\n    try:\n        open(name)\n    except OSError: pass\ndef again(): pass\n"
    fault = record_while(bench, source, lambda: bench.write(f"work/{NAME}", "1111"), name=NAME)
    assert f"{NAME} has changed" in fault


def test_a_source_that_is_edited_while_the_run_lasts(bench: Bench) -> None:
    bench.write(f"work/{NAME}", "1111")
    fault = record_while(
        bench, TWICE, lambda: edit(bench.plugin, TWICE.replace("rb", "br")), name=NAME
    )
    assert "mine.py has changed" in fault


def test_the_snapshot_grows_with_what_is_read(bench: Bench) -> None:
    bench.write(f"work/{NAME}", "1111")
    reading = "def run(name):\n    global NAME\n    NAME = name\ndef again():\n    open(NAME)\n"
    for source, grows in ((reading, True), (reading.replace("open(NAME)", "pass"), False)):
        assert bench.child.ask(bench.job(source, name=NAME)) == {"paused": True}
        bench.child.resume()
        assert bench.child.answer() == {"grown": [grows, grows]}
        assert "reads" in bench.child.answer()


# -- what does not count ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "body",
    [
        "file = tempfile.mkdtemp() + '/x'; open(file, 'w').write('1'); open(file).read()",
        "tempfile.TemporaryFile().read()",
        "tempfile.NamedTemporaryFile().read()",
        "open(NAME, 'w').write('1'); open(NAME).read()",
        "open(NAME, 'a').write('1')",
        "open(NAME, 'x').write('1'); pathlib.Path(NAME).resolve().read_text()",
        "open('t', 'w').write('1'); os.replace('t', NAME); open(NAME).read()",
        "os.makedirs('out/a'); os.system('echo 1 > out/a/x'); open('out/a/x').read()",
        "os.system('echo 1 > ' + NAME); open(NAME).read()",
        "numpy.save('x.npy', numpy.zeros(3)); numpy.load('x.npy')",
        "os.mkdir('out'); os.listdir('out'); [open('out/' + name) for name in os.listdir('out')]",
        "cache(NAME); cache(NAME)",
        "open('/proc/self/maps').read(); open('/dev/null').read(); os.listdir('/proc/self')",
        "r, w = os.pipe(); os.close(w); open(r).read()",
        "import decimal, xml.dom.minidom, wsgiref; importlib.metadata.version('numpy'); inspect.getsource(inspect)",
        "os.mkfifo(NAME); os.open(NAME, os.O_RDONLY | os.O_NONBLOCK); cache('/'); cache('.')",
        "traceback.format_stack(); warnings.warn('x')",
        "shutil.copytree(os.path.dirname(__file__), tempfile.mkdtemp() + '/x'); shutil.rmtree(tempfile.mkdtemp())",
    ],
)
def test_what_the_run_makes_is_no_input(body: str, bench: Bench) -> None:
    source = f"""
import importlib.metadata, inspect, os, pathlib, shutil, tempfile, traceback, warnings
import numpy
NAME = 'net' + '.bin'
def cache(name):
    try:
        return open(name).read()
    except IsADirectoryError:
        pass
    except OSError:
        open(name, 'w').write('1')
def run():
    {body}
"""
    reads = bench.record(source)
    assert list(reads.files) == ["plugin:/mine.py"]
    assert "$TMPDIR" not in reads.environment


def test_what_nobody_read_does_not_count(bench: Bench) -> None:
    on_path(bench)
    bench.write("path/library.py", "VALUE = 1\n")
    bench.write(f"work/{NAME}", "1111")
    reads = bench.record(READ_ALL, files=[NAME])
    bench.write("work/other.bin", "")
    bench.write("plugin/notes.md", "")
    bench.write("path/library.py", "VALUE = 2\n")
    bench.environment["MY_SLAM_MODE"] = "fast"
    os.utime(bench.work / NAME)
    os.utime(bench.plugin)
    (bench.plugin.parent / "__pycache__").mkdir()
    assert bench.changed(reads) == ""


def test_reads_are_equal_in_another_place_of_equal_layout(
    bench: Bench, tmp_path_factory: pytest.TempPathFactory
) -> None:
    other = Bench(bench.child, tmp_path_factory.mktemp("other"))
    for place in (bench, other):
        place.write(f"work/{NAME}", "1111")
        place.write("work/maps/a.txt", "1111")
    source = "import os\ndef run(name):\n    open(name); os.listdir('maps')\n"
    assert digest_of(bench.record(source, name=NAME)) == digest_of(other.record(source, name=NAME))


# -- programs --------------------------------------------------------------------------------------

START = "import subprocess\ndef run(words, folder=None):\n    subprocess.run(words, cwd=folder)\n"


def a_tool(bench: Bench, name: str = "bin/tool") -> Path:
    file = bench.write(name, "#!/bin/sh\nexit 0  # 1111\n")
    file.chmod(0o755)
    return file


@pytest.mark.parametrize(
    ("words", "edited"),
    [
        (["../bin/tool"], "bin/tool"),
        (["../bin/tool", "slam.yaml"], "work/slam.yaml"),
        (["../bin/tool", "--config=slam.yaml"], "work/slam.yaml"),
        (["../bin/tool", "--config", "slam.yaml"], "work/net.bin"),
        (["../bin/tool", "maps"], "work/maps/a/associations.txt"),
        (["/bin/sh", "-c", "../bin/tool < slam.yaml"], "bin/tool"),
        (["/bin/sh", "-c", "cat<net.bin"], "work/net.bin"),
        ([sys.executable, "-c", "print(open('net.bin').read())"], "work/net.bin"),
        (
            [sys.executable, "-W", "ignore", "-c", 'open("maps/a/associations.txt")'],
            "work/maps/a/associations.txt",
        ),
        ([sys.executable, "script.py"], "work/script.py"),
        ([sys.executable, "script.py"], "work/part.py"),
    ],
)
def test_what_a_program_is_made_of(words: list[str], edited: str, bench: Bench) -> None:
    a_tool(bench)
    texts = {
        "slam.yaml": "weights: net.bin",
        "net.bin": "1111",
        "maps/a/associations.txt": "1111",
        "part.py": "# 1111",
    }
    for name, text in (texts | {"script.py": "import part  # 1111"}).items():
        bench.write(f"work/{name}", text)
    reads = bench.record(START, words=words)
    file = bench.root / edited
    text = file.read_text()
    edit(file, text.replace("1111", "2222").replace("net", "bet"))
    is_folder = "maps" in words
    shown = "the content of the folder maps" if is_folder else edited.removeprefix("work/")
    assert bench.changed(reads).endswith(f"{shown} of a program")


@pytest.mark.parametrize(
    "words", [["ls", "/"], ["ls", "."], ["ls", ".."], ["true", "~"], ["true", sys.prefix]]
)
def test_a_folder_that_is_too_wide_is_not_read_whole(words: list[str], bench: Bench) -> None:
    bench.write("work/a", "1111")
    reads = bench.record(START, words=words)
    assert not [name for name in reads.programs if name.endswith("/") or name == "work:/a"]


def test_a_program_is_searched_on_the_path(bench: Bench) -> None:
    tool = a_tool(bench, "second/tool")
    bench.environment["PATH"] = os.pathsep.join(
        [str(bench.root / "first"), str(tool.parent), os.environ["PATH"]]
    )
    reads = bench.record(START, words=["tool"])
    assert reads.search["command tool"] == str(tool)
    edit(tool, tool.read_text().replace("1", "2"))
    assert bench.changed(reads) == f"the file {tool} of a program"
    edit(tool, tool.read_text().replace("2", "1"))
    assert bench.changed(reads) == ""
    a_tool(bench, "first/tool")
    assert bench.changed(reads) == "the place of the command tool"


def test_what_a_program_maps_into_memory_and_where_it_runs(bench: Bench) -> None:
    code = "import mmap, sys; file = open(sys.argv[1] + '.bin'); m = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ)\n"
    bench.write("work/sub/program.py", f"{code}print('ready', flush=True)\nsys.stdin.readline()\n")
    bench.write(f"work/sub/{NAME}", "1111")
    source = """
import subprocess
def run(words):
    program = subprocess.Popen(words, cwd='sub', stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    program.stdout.readline()
"""
    reads = bench.record(source, words=[sys.executable, "program.py", "net"])
    assert {f"work:/sub/{NAME}", "work:/sub/program.py"} < reads.programs.keys()
    edit(bench.work / "sub" / NAME, "2222")
    assert bench.changed(reads) == f"the file sub/{NAME} of a program"


@pytest.mark.parametrize(
    "words",
    [
        ["/bin/sh", "-c", "echo $MY_SLAM_MODE"],
        ["/bin/sh", "mode.sh"],
        [sys.executable, "mode.py"],
        [sys.executable, "-c", "import os; os.environ.get('MY_SLAM_MODE')"],
    ],
)
@pytest.mark.parametrize("value", ["slow", None])
def test_an_environment_variable_that_a_program_looks_up(
    words: list[str], value: str | None, bench: Bench
) -> None:
    bench.write("work/mode.sh", "echo ${MY_SLAM_MODE}")
    bench.write("work/mode.py", "import os; os.getenv('MY_SLAM_MODE')")
    bench.environment |= {"ANOTHER": "1"} | ({} if value is None else {"MY_SLAM_MODE": value})
    reads = bench.record(START, words=words)
    bench.environment["ANOTHER"] = "2"
    assert bench.changed(reads) == ""
    bench.environment["MY_SLAM_MODE"] = "fast"
    assert bench.changed(reads) == "the environment variable MY_SLAM_MODE"


def test_a_file_that_a_compiled_program_names(bench: Bench, compiled: Path) -> None:
    bench.write("work/settings.cfg", "1111")
    bench.write("work/source.c", "1111")
    reads = bench.record(START, words=[str(compiled / "opens")])
    edit(bench.work / "source.c", "2222")
    assert bench.changed(reads) == ""
    edit(bench.work / "settings.cfg", "2222")
    assert bench.changed(reads) == "the file settings.cfg of a program"


def test_a_file_in_a_list_that_a_script_names(bench: Bench) -> None:
    bench.write("work/list.txt", "maps/a.bin\n")
    bench.write("work/maps/a.bin", "1111")
    bench.write("work/all.sh", "#!/bin/sh\ncat $(cat list.txt)")
    reads = bench.record(START, words=["/bin/sh", "all.sh"])
    edit(bench.work / "maps/a.bin", "2222")
    assert bench.changed(reads) == "the file maps/a.bin of a program"


LOADED = """
import subprocess
def run(words):
    program = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    program.stdout.readline()
"""
REPLACED = """
import subprocess
def run(words, library, built):
    program = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    program.stdout.readline()
    subprocess.run(["cp", "--remove-destination", built, library])
"""


def test_a_library_that_a_program_loads(bench: Bench, compiled: Path) -> None:
    library = shutil.copy(compiled / "libpart.so", bench.write("work/part", "").parent)
    words = [str(compiled / "loads"), f"./{Path(library).name}"]
    reads = bench.record(LOADED, words=words)
    Path(library).write_bytes(Path(library).read_bytes() + b"1")
    assert bench.changed(reads) == f"the file {Path(library).name} of a program"


def test_a_library_of_a_program_that_is_rebuilt_meanwhile(bench: Bench, compiled: Path) -> None:
    (bench.root / "elsewhere").mkdir()
    library = shutil.copy(compiled / "libpart.so", bench.root / "elsewhere")
    words = [str(compiled / "loads"), str(library)]
    answer = bench.child.ask(
        bench.job(REPLACED, words=words, library=str(library), built=str(compiled / "opens"))
    )
    assert f"the file {library} of a program has changed while" in answer["fault"]


def test_an_environment_variable_that_every_program_gets(bench: Bench) -> None:
    reads = bench.record(START, words=["true"])
    bench.environment["MY_SLAM_MODE"] = "fast"
    assert bench.changed(reads) == ""
    bench.environment["LC_ALL"] = "de_DE.UTF-8"
    assert bench.changed(reads) == "the environment variable LC_ALL"


def test_what_a_program_writes_is_no_input(bench: Bench) -> None:
    for name in ("in/a", "out/old"):
        bench.write(f"work/{name}", "1111")
    reads = bench.record(START, words=["cp", "in/a", "out"])
    assert {name for name in reads.programs if name.startswith("work:")} == {
        "work:/in/a",
        "work:/out/old",
    }


def test_the_environment_of_a_program() -> None:
    variables = {
        "PATH": "/bin",
        "LC_ALL": "C",
        "OMP_NUM_THREADS": "2",
        "MY_SLAM_MODE": "fast",
        "SSH_TTY": "x",
    }
    assert program_environment((), variables) == {
        "PATH": "/bin",
        "LC_ALL": "C",
        "OMP_NUM_THREADS": "2",
    }
    assert program_environment(["MY_SLAM_MODE", "UNSET"], variables)["MY_SLAM_MODE"] == "fast"
    assert [name for name in variables if is_counted(name)] == ["LC_ALL", "MY_SLAM_MODE"]


def test_what_a_process_shows() -> None:
    shown = ProgramReads()
    look_at(psutil.Process(), shown)
    assert os.path.realpath(sys.executable) in shown.files
    assert len(shown.commands) == 1


# -- comparing many runs ---------------------------------------------------------------------------


def test_a_verifier_looks_at_each_thing_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dynslam_bench.core import reads as module

    looked: list[str] = []
    real = module.content_now
    monkeypatch.setattr(module, "content_now", lambda path: looked.append(path) or real(path))
    base_folders = BaseFolders(None, tmp_path)
    records = []
    for number in range(4):
        for name in ("shared", f"own{number}"):
            (tmp_path / name).write_text(name)
        digests = {
            f"work:/{name}": real(str(tmp_path / name)) for name in ("shared", f"own{number}")
        }
        records.append(Reads(files=digests))
    verifier = Verifier()
    assert [verifier.changed(record, base_folders) for record in records] == [""] * 4
    assert len(looked) == 5
    (tmp_path / "own2").write_text("another")
    assert [Verifier().changed(record, base_folders) for record in records] == [
        "",
        "",
        "the file own2",
        "",
    ]
