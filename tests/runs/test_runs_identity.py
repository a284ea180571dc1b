"""What makes another run: every change of data, program, plug-in, weights or library that could change a result."""

import os
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from envs_toys import TARGET, write_folder

from dynslam_bench.core import PluginError, RunError, fingerprint
from dynslam_bench.runs import RunSpec, RunStore, identity, resolve, run_many, run_one

PLUGIN = """
from pathlib import Path
from dynslam_bench.contracts.tracker import TrackerSpec
PARAMETERS = Path(__file__).parent / "params" / "slam.yaml"
LAYERS = sorted(Path(__file__).parent.glob("weights/*"))
SPEC = TrackerSpec("mine", f"{__file__}:build", "mine")
def build(settings):
    import helper
    return helper.make(PARAMETERS.read_text())
"""


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def edit(path: Path, old: str, new: str) -> Callable[[], None]:
    """An edit that changes neither size nor time of modification."""

    def change() -> None:
        stat = path.stat()
        text = path.read_text()
        assert old in text and len(old) == len(new)
        path.write_text(text.replace(old, new))
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))

    return change


def uncompressed(path: Path, image: np.ndarray) -> None:
    cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 0])


def makes_another_run(spec: RunSpec, change: Callable[[], object]) -> bool:
    before = resolve(spec).run_id
    assert resolve(spec).run_id == before
    change()
    return resolve(spec).run_id != before


@pytest.mark.parametrize("name", ["depth", "colour", "truth", "stamps", "camera", "frame rate"])
def test_changed_data_is_another_run(name: str, tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "toy", 6)
    for file in (folder / "depth").glob("*.png"):
        uncompressed(file, cv2.imread(str(file), cv2.IMREAD_UNCHANGED))
    depth, colour = sorted((folder / "depth").iterdir())[3], sorted((folder / "rgb").iterdir())[3]
    change = {
        "depth": lambda: uncompressed(depth, cv2.imread(str(depth), cv2.IMREAD_UNCHANGED) // 5),
        "colour": lambda: cv2.imwrite(str(colour), cv2.imread(str(colour))[::-1]),
        "truth": edit(folder / "groundtruth.txt", "100.1", "100.2"),
        "stamps": edit(folder / "rgb.txt", "100.066667 rgb", "100.066668 rgb"),
        "camera": edit(folder / "camera.toml", "fx = ", "fx =1"),
        "frame rate": edit(folder / "camera.toml", "fps = 30", "fps = 15"),
    }[name]
    assert makes_another_run(RunSpec(tracker="never-move", sequence=str(folder)), change)


def plugin(tmp_path: Path) -> tuple[RunSpec, Path]:
    folder = tmp_path / "plugin"
    files = {
        "mine.py": PLUGIN,
        "helper.py": "def make(text):\n    return 1  # a note\n",
        "params/slam.yaml": "threshold: 1\nweights: net.bin\n",
        "params/net.bin": "1111",
        "weights/layer0": "3333",
        "notes.md": "nothing reads this",
        "results/runs/x/slam.yaml": "an output",
        "results/index.sqlite": "an output",
    }
    for name, text in files.items():
        write(folder / name, text)
    return RunSpec(tracker=f"{folder / 'mine.py'}:SPEC", sequence=str(write_folder(tmp_path / "toy", 4))), folder


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("mine.py", '"mine")', '"ours")'),
        ("helper.py", "return 1", "return 2"),
        ("params/slam.yaml", ": 1", ": 2"),
        ("params/net.bin", "1111", "2222"),
        ("weights/layer0", "3333", "4444"),
    ],
)
def test_a_changed_plug_in_is_another_run(file: str, old: str, new: str, tmp_path: Path) -> None:
    spec, folder = plugin(tmp_path)
    asked = resolve(spec)
    assert makes_another_run(spec, edit(folder / file, old, new))
    with pytest.raises(RunError, match="code of tracker 'mine' has changed since"):
        identity.check_unchanged(asked)


def test_code_of_this_package_that_changes_meanwhile_is_noticed(tmp_path: Path, monkeypatch) -> None:
    file = write(tmp_path / "core" / "a.py", "x = 1")
    monkeypatch.setattr("dynslam_bench.__path__", [str(tmp_path)])
    before = fingerprint.package_digest(["core"])
    assert not fingerprint.has_package_changed(["core"])
    file.write_text("x = 22")
    assert fingerprint.has_package_changed(["core"]) and fingerprint.package_digest(["core"]) == before


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("helper.py", "a note", "a word"),
        ("helper.py", "def make(text):\n", 'def make(text):\n    """What it does."""\n\n'),
        ("notes.md", "nothing", "nobody"),
        ("results/runs/x/slam.yaml", "output", "result"),
    ],
)
def test_comments_docstrings_and_what_no_code_names_change_nothing(
    file: str, old: str, new: str, tmp_path: Path
) -> None:
    spec, folder = plugin(tmp_path)
    path = folder / file
    assert not makes_another_run(spec, lambda: path.write_text(path.read_text().replace(old, new)))


@pytest.mark.parametrize(
    "named", ['"gain_%d.txt" % 3', '"gain" + "_3.txt"', 'f"gain_{3}.txt"', '"my gain_3.txt"', '"gain_3.txt"']
)
def test_a_data_file_counts_however_its_name_is_put_together(named: str, tmp_path: Path) -> None:
    spec, folder = plugin(tmp_path)
    write(folder / "helper.py", f"FILE = {named}\n")
    for name in ("gain_3.txt", "my gain_3.txt"):
        write(folder / name, "1111")
    assert makes_another_run(spec, edit(folder / ("my gain_3.txt" if "my" in named else "gain_3.txt"), "1111", "2222"))


@pytest.mark.parametrize(
    "statement",
    ["import os; import identity_toy_module", 'import importlib; importlib.import_module("identity_toy_module")'],
)
def test_an_import_counts_however_it_is_written(
    statement: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, folder = plugin(tmp_path)
    module = write(tmp_path / "elsewhere" / "identity_toy_module.py", "gain = 1\n")
    monkeypatch.syspath_prepend(str(module.parent))
    write(folder / "mine.py", f"{PLUGIN}\ndef later():\n    {statement}\n")
    assert makes_another_run(spec, edit(module, "1", "2"))


def test_what_a_plug_in_imports_from_elsewhere_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec, folder = plugin(tmp_path)
    library = write(tmp_path / "elsewhere" / "identity_toy_library" / "__init__.py", "gain = 1\n")
    monkeypatch.syspath_prepend(str(library.parents[1]))
    write(folder / "helper.py", "import identity_toy_library, numpy\n")
    assert makes_another_run(spec, lambda: library.write_text("gain = 2\n"))
    real = fingerprint.distribution_version
    newer = partial(
        monkeypatch.setattr,
        fingerprint,
        "distribution_version",
        lambda name: "0" if name == "numpy" else real(name),
    )
    assert makes_another_run(spec, newer)


def a_program(tmp_path: Path) -> Path:
    """A folder of a program with everything that commands name."""
    files = {
        "slam.py": 'import part\nopen("beside.json")\n',
        "part.py": "x = 1\n",
        "beside.json": "1111",
        "c.yaml": "vocabulary: voc.bin\n",
        "voc.bin": "1111",
        "maps/a.map": "1111",
        "package/__init__.py": "",
        "package/__main__.py": "x = 1\n",
        "run.sh": "#!/bin/sh\nexec python slam.py\n",
        "here.sh": '#!/bin/bash\npython "$(dirname "$0")/inner/main.py"\n',
        "sub.sh": "#!/bin/sh\ncd inner && python main.py\n",
        "inner/main.py": "x = 1\n",
        "script": "#!/usr/bin/env python3\nimport part\n",
    }
    for name, text in files.items():
        write(tmp_path / "program" / name, text).chmod(0o755)
    return tmp_path / "program"


@pytest.mark.parametrize(
    ("command", "file", "old", "new"),
    [
        ("{python} slam.py", "slam.py", "import part", "import  re "),
        ("{python} slam.py", "part.py", "1", "2"),
        ("{python} slam.py", "beside.json", "1", "2"),
        ("{python} slam.py --config=c.yaml", "c.yaml", "voc.", "Voc."),
        ("{python} slam.py --config c.yaml", "c.yaml", "voc.", "Voc."),
        ("{python} slam.py --config=c.yaml", "voc.bin", "1", "2"),
        ("{python} slam.py maps", "maps/a.map", "1", "2"),
        ("{python} slam.py --maps=maps", "maps/a.map", "1", "2"),
        ("{python} -m package", "package/__main__.py", "1", "2"),
        ("{python} -m part", "part.py", "1", "2"),
        ("./run.sh", "run.sh", "exec", "echo"),
        ("./run.sh", "part.py", "1", "2"),
        ("./here.sh", "inner/main.py", "1", "2"),
        ("./sub.sh", "inner/main.py", "1", "2"),
        ("./script", "part.py", "1", "2"),
    ],
)
def test_a_changed_program_is_another_run(command: str, file: str, old: str, new: str, tmp_path: Path) -> None:
    folder = a_program(tmp_path)
    spec = RunSpec(
        tracker=f"subprocess:{command.format(python=sys.executable)}",
        sequence=str(write_folder(tmp_path / "toy", 4)),
        settings={"folder": str(folder)},
    )
    assert makes_another_run(spec, edit(folder / file, old, new))


@pytest.mark.skipif(shutil.which("gcc") is None or shutil.which("ldd") is None, reason="needs gcc and ldd")
def test_a_rebuilt_shared_library_is_another_run(tmp_path: Path) -> None:
    folder = tmp_path / "native"
    write(folder / "part.c", "int part(void) { return 1; }\n")
    write(folder / "main.c", "int part(void); int main(void) { return part(); }\n")
    build = f"cd {folder} && gcc -shared -fPIC -o libpart.so part.c"
    assert os.system(f"{build} && gcc -o slam main.c -L. -lpart -Wl,-rpath,'$ORIGIN'") == 0
    spec = RunSpec(tracker=f"subprocess:{folder}/slam", sequence=str(write_folder(tmp_path / "toy", 4)))
    write(folder / "part.c", "int part(void) { return 2; }\n")
    assert makes_another_run(spec, lambda: os.system(build))


def test_data_and_programs_that_change_meanwhile_are_noticed_but_no_output(tmp_path: Path) -> None:
    program, folder = write(tmp_path / "slam.py", "x = 1"), write_folder(tmp_path / "toy", 4)
    asked = resolve(RunSpec(tracker=f"subprocess:{sys.executable} {program} {tmp_path}/out", sequence=str(folder)))
    write(tmp_path / "out", "poses")
    identity.check_unchanged(asked)
    write(program, "x = 22")
    shutil.copy(*sorted((folder / "rgb").iterdir())[:2])
    for begun, changed in ((False, "the program of tracker .*, sequence"), (True, "^sequence")):
        with pytest.raises(RunError, match=f"{changed} '.*has changed since"):
            identity.check_unchanged(asked, begun=begun)


def test_libraries_weights_and_own_code_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = RunSpec(tracker="orb-slam2", sequence=str(write_folder(tmp_path / "toy", 4)))
    ids = {resolve(spec).run_id}
    known = identity.versions()
    for name in identity.LIBRARIES:
        monkeypatch.setattr(identity, "versions", lambda name=name: known | {name: "another"})
        ids.add(resolve(spec).run_id)
    monkeypatch.undo()
    monkeypatch.setattr(fingerprint, "package_digest", lambda packages: "another")
    ids.add(resolve(spec).run_id)
    assert len(ids) == len(identity.LIBRARIES) + 2


def test_no_plug_in_takes_the_id_of_a_built_in_tracker(tmp_path: Path) -> None:
    file = write(tmp_path / "mine.py", PLUGIN.replace('"mine", f', '"orb-slam2", f'))
    with pytest.raises(PluginError, match="orb-slam2"):
        resolve(RunSpec(tracker=f"{file}:SPEC", sequence=str(write_folder(tmp_path / "toy", 4))))


def test_one_run_id_with_two_results_is_said_and_another_scheme_is_unverified(
    store: RunStore, toy_folder: str, caplog: pytest.LogCaptureFixture
) -> None:
    spec = RunSpec(tracker=TARGET, sequence=toy_folder, frames=(0, 6))
    record = run_one(spec, store)
    assert run_one(spec, store).notes == record.notes
    assert record.verified and "identity" not in record.program
    old = record.model_copy(update={"identity": record.identity | {"scheme": 0}})
    assert not old.verified and old.program["identity"] == "unverified"
    trajectory = store.folder(record.run_id) / "trajectory_online.txt"
    trajectory.write_text(trajectory.read_text().replace("0.0", "0.1"))
    (again,) = run_many([spec], results=store, retry=["ok"])
    assert again.run_id == record.run_id
    assert any("another trajectory" in note for note in again.notes)
    assert any(record.run_id in message for message in caplog.messages)
