"""What makes another run: every change of data, program, plug-in, weights or library that could change a result."""

import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.envs_toys import TARGET, write_folder

from dynslam_bench.core import PluginError, RunError
from dynslam_bench.core.plugins import has_imported_plugins
from dynslam_bench.runs import RunSpec, RunStore, identity, resolve, run_many, run_one
from dynslam_bench.runs.record import run_id_of
from dynslam_bench.runs.validity import Installation
from dynslam_bench.trackers import TRACKERS

pytestmark = pytest.mark.slow

PLUGIN = """
import os, sys
from pathlib import Path
import numpy as np
from dynslam_bench.contracts.tracker import TrackerSpec, TrackResult
sys.path.insert(0, str(Path(__file__).parent))
PARAMETERS = Path(__file__).parent / "params" / "slam.yaml"
SPEC = TrackerSpec("mine", f"{__file__}:Mine", "mine")
class Mine:
    \'\'\'A docstring that is used.\'\'\'
    def __init__(self, settings):
        import helper
        text = PARAMETERS.read_text() + self.__doc__ + os.environ.get("IDENTITY_TOY_MODE", "")
        for layer in sorted(Path(__file__).parent.glob("weights/*")):
            text += layer.read_text()
        gain = helper.gain(text)
        self.pose = np.eye(4)
        self.pose[0, 3] = gain
    def reset(self, camera, *, rng):
        pass
    def track(self, frame):
        return TrackResult(self.pose, "ok")
    def close(self):
        pass
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
        assert old in text
        assert len(old) == len(new)
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


def a_plug_in(tmp_path: Path, source: str = PLUGIN) -> tuple[RunSpec, Path]:
    """A plug-in that reads files of every kind, with other files beside it; and a recording for it."""
    folder = tmp_path / "plugin"
    files = {
        "mine.py": source,
        "helper.py": "def gain(text):\n    return len(text)  # a note\n",
        "params/slam.yaml": "threshold: 1\n",
        "weights/layer0": "3333",
        "notes.md": "nothing reads this",
        "results/runs/x/slam.yaml": "an output",
    }
    for name, text in files.items():
        write(folder / name, text)
    return RunSpec(
        tracker=f"{folder / 'mine.py'}:SPEC", sequence=str(write_folder(tmp_path / "toy", 4))
    ), folder


def made_again(spec: RunSpec, store: RunStore, change: Callable[[], object]) -> bool:
    """Whether a run is made again after a change; twice before it is taken from the store."""
    kinds: list[str] = []
    (first,) = run_many([spec], results=store)
    (again,) = run_many([spec], results=store, on_event=lambda event: kinds.append(event.kind))
    assert kinds == ["reused"]
    assert again.run_id == first.run_id
    assert first.status == "ok", first.reason
    change()
    kinds.clear()
    (later,) = run_many([spec], results=store, on_event=lambda event: kinds.append(event.kind))
    assert ("finished" in kinds) is (later.run_id != first.run_id)
    assert store.get(first.run_id) == first, "the earlier run stays"
    assert later.run_id[:12] == first.run_id[:12], "the same is asked for"
    return later.run_id != first.run_id


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("mine.py", '"mine")', '"ours")'),
        ("mine.py", "A docstring", "Another one"),
        ("helper.py", "a note", "a word"),
        ("params/slam.yaml", ": 1", ": 2"),
        ("weights/layer0", "3333", "4444"),
    ],
)
def test_a_plug_in_that_reads_something_else_is_another_run(
    file: str, old: str, new: str, tmp_path: Path, store: RunStore
) -> None:
    spec, folder = a_plug_in(tmp_path)
    assert made_again(spec, store, edit(folder / file, old, new))


def test_what_a_plug_in_does_not_read_makes_no_other_run(tmp_path: Path, store: RunStore) -> None:
    spec, folder = a_plug_in(tmp_path)

    def change() -> None:
        write(folder / "notes.md", "nobody reads this")
        write(folder / "results" / "runs" / "x" / "slam.yaml", "another output")
        os.utime(folder / "params" / "slam.yaml")

    assert not made_again(spec, store, change)


def test_a_change_that_is_undone_finds_the_first_run_again(tmp_path: Path, store: RunStore) -> None:
    spec, folder = a_plug_in(tmp_path)
    (first,) = run_many([spec], results=store)
    edit(folder / "params" / "slam.yaml", ": 1", ": 2")()
    (second,) = run_many([spec], results=store)
    edit(folder / "params" / "slam.yaml", ": 2", ": 1")()
    (third,) = run_many([spec], results=store)
    assert first.run_id == third.run_id
    assert second.run_id != first.run_id


@pytest.mark.parametrize("how", ["copied", "moved", "moved into a folder of the working folder"])
def test_a_plug_in_in_another_folder_finds_its_runs_again(
    how: str, tmp_path: Path, store: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, folder = a_plug_in(tmp_path)
    (first,) = run_many([spec], results=store)
    assert first.tracker.folder == str(folder)
    assert str(folder) not in first.public().to_json()

    other = tmp_path / "elsewhere" / "copy"
    shutil.copytree(folder, other)
    if how != "copied":
        shutil.rmtree(folder)
    if how.endswith("working folder"):
        monkeypatch.chdir(tmp_path / "elsewhere")
    moved = spec.model_copy(update={"tracker": f"{other / 'mine.py'}:SPEC"})
    (again,) = run_many([moved], results=store)
    assert again.run_id == first.run_id
    assert again.tracker.folder == str(other)
    assert again.tracker.given == moved.tracker
    assert Installation().what_changed(again) == ""

    edit(other / "helper.py", "a note", "a word")()
    assert Installation().what_changed(again) == "the file helper.py"
    (changed,) = run_many([moved], results=store)
    assert changed.run_id != first.run_id


@pytest.mark.parametrize("value", ["fast", "exact"])
def test_a_variable_that_a_plug_in_looks_up_counts(
    value: str, tmp_path: Path, store: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, _ = a_plug_in(tmp_path)
    assert made_again(spec, store, partial(monkeypatch.setenv, "IDENTITY_TOY_MODE", value))
    (stored,) = (store.get(run_id) for run_id in store.ids()[:1])
    assert value not in stored.to_json(), "a value may be a secret"


@pytest.mark.parametrize("copied", ["dict(os.environ)", "os.environ.copy()", "{**os.environ}"])
def test_a_plug_in_that_copies_all_variables_finds_its_runs_again(
    copied: str, tmp_path: Path, store: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, _ = a_plug_in(tmp_path, PLUGIN.replace("os.environ.get(", f"{copied}.get("))
    assert made_again(spec, store, partial(monkeypatch.setenv, "IDENTITY_TOY_MODE", "fast"))
    another = write(tmp_path / "other" / "other.py", "")
    monkeypatch.setenv("DYNSLAM_BENCH_PLUGINS", f"{another}:SPEC")
    TRACKERS.refresh()
    kinds: list[str] = []
    run_many([spec], results=store, on_event=lambda event: kinds.append(event.kind))
    assert kinds == ["reused"], "which plug-ins are listed is no input"


def test_a_variable_whose_name_begins_as_a_plug_in_expects_counts(
    tmp_path: Path, store: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_prefix = (
        "dict((key[8:], value) for key, value in os.environ.items() if key[:8] == 'TOY_SET_').get("
    )
    source = PLUGIN.replace("os.environ.get(", by_prefix)
    assert source != PLUGIN
    spec, _ = a_plug_in(tmp_path, source)
    assert made_again(spec, store, partial(monkeypatch.setenv, "TOY_SET_IDENTITY_TOY_MODE", "fast"))


def test_a_plug_in_that_is_only_listed_is_imported_by_nobody(
    tmp_path: Path, store: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, _ = a_plug_in(tmp_path)
    trace = tmp_path / "imported"
    other = write(
        tmp_path / "other" / "other.py",
        "import os, sys\n"
        f"if 'dynslam_bench.envs' in sys.modules: open({str(trace)!r}, 'a').write('a run, or who asked for it')\n"
        "from dynslam_bench.contracts import TrackerSpec\n"
        "SPEC = TrackerSpec('other', 'nowhere:Other', 'other')\n",
    )
    monkeypatch.setenv("DYNSLAM_BENCH_PLUGINS", f"{other}:SPEC")
    TRACKERS.refresh()
    try:
        records = run_many(
            [spec, RunSpec(tracker="never-move", sequence=spec.sequence)], results=store
        )
        store.frame()
    finally:
        TRACKERS.refresh()
    assert [record.status for record in records] == ["ok", "ok"]
    assert not trace.exists()


def test_an_id_of_another_identity_is_not_overwritten(tmp_path: Path, store: RunStore) -> None:
    spec = RunSpec(tracker="never-move", sequence=str(write_folder(tmp_path / "toy", 4)))
    (first,) = run_many([spec], results=store)
    other = first.model_copy(update={"identity": first.identity | {"content": "another"}})
    with store.work_folder(other.run_id) as work:
        stored = store.publish(work, other)
    assert stored.run_id != first.run_id
    assert stored.run_id == run_id_of(stored.identity)
    assert store.get(first.run_id) == first


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
def test_a_changed_program_is_another_run(
    command: str, file: str, old: str, new: str, tmp_path: Path
) -> None:
    folder = a_program(tmp_path)
    spec = RunSpec(
        tracker=f"subprocess:{command.format(python=sys.executable)}",
        sequence=str(write_folder(tmp_path / "toy", 4)),
        settings={"folder": str(folder)},
    )
    assert makes_another_run(spec, edit(folder / file, old, new))


@pytest.mark.skipif(
    shutil.which("gcc") is None or shutil.which("ldd") is None, reason="needs gcc and ldd"
)
def test_a_rebuilt_shared_library_is_another_run(tmp_path: Path) -> None:
    folder = tmp_path / "native"
    write(folder / "part.c", "int part(void) { return 1; }\n")
    write(folder / "main.c", "int part(void); int main(void) { return part(); }\n")
    build = f"cd {folder} && gcc -shared -fPIC -o libpart.so part.c"
    assert os.system(f"{build} && gcc -o slam main.c -L. -lpart -Wl,-rpath,'$ORIGIN'") == 0
    spec = RunSpec(
        tracker=f"subprocess:{folder}/slam", sequence=str(write_folder(tmp_path / "toy", 4))
    )
    write(folder / "part.c", "int part(void) { return 2; }\n")
    assert makes_another_run(spec, lambda: os.system(build))


def test_data_and_programs_that_change_meanwhile_are_noticed_but_no_output(tmp_path: Path) -> None:
    program = write(tmp_path / "slam.py", "x = 1")
    folder = write_folder(tmp_path / "toy", 4)
    asked = resolve(
        RunSpec(
            tracker=f"subprocess:{sys.executable} {program} {tmp_path}/out", sequence=str(folder)
        )
    )
    write(tmp_path / "out", "poses")
    identity.check_unchanged(asked)
    write(program, "x = 22")
    shutil.copy(*sorted((folder / "rgb").iterdir())[:2])
    for begun, changed in ((False, "the program of tracker .*, sequence"), (True, "^sequence")):
        with pytest.raises(RunError, match=f"{changed} '.*has changed since"):
            identity.check_unchanged(asked, begun=begun)


PROGRAM = """
import os, sys
from pathlib import Path
lines = [line.split() for line in Path(sys.argv[1], "rgb.txt").read_text().splitlines() if line[0] != "#"]
x = float(os.environ.get("IDENTITY_TOY_GAIN", 0)) + float(os.environ.get("IDENTITY_TOY_" + "OTHER", 0))
Path("trajectory.txt").write_text("".join(f"{stamp} {x} 0 0 0 0 0 1\\n" for stamp, _ in lines))
"""


@pytest.mark.parametrize(
    ("variable", "counts"), [("IDENTITY_TOY_GAIN", True), ("IDENTITY_TOY_OTHER", False)]
)
def test_a_program_gets_the_variables_that_it_declares_and_their_values_count(
    variable: str, counts: bool, tmp_path: Path, store: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "program" / "slam.py", PROGRAM)
    lines = [
        'name = "toy"',
        'command = ["{python}", "slam.py", "{sequence}"]',
        'environment = ["IDENTITY_TOY_GAIN"]',
    ]
    file = write(tmp_path / "program" / "toy.toml", "\n".join(lines))
    spec = RunSpec(tracker=f"batch:{file}", sequence=str(write_folder(tmp_path / "toy", 4)))
    assert made_again(spec, store, partial(monkeypatch.setenv, variable, "2")) is counts
    trajectory = store.folder(store.ids()[-1]) / "trajectory_final.txt"
    assert trajectory.is_file()


@pytest.mark.parametrize("module", sorted(identity.LIBRARIES.values()))
def test_another_module_before_an_installed_library_is_another_run(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = RunSpec(tracker="orb-slam2", sequence=str(write_folder(tmp_path / "toy", 4)))
    shadow = write(tmp_path / "shadow" / module / "__init__.py", "")
    assert makes_another_run(spec, partial(monkeypatch.syspath_prepend, str(shadow.parents[1])))
    assert makes_another_run(spec, partial(shadow.write_text, "x = 1"))


@pytest.mark.parametrize("variable", ["LD_LIBRARY_PATH", "LD_PRELOAD"])
def test_where_the_linker_looks_makes_another_run(
    variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = RunSpec(tracker="orb-slam2", sequence=str(write_folder(tmp_path / "toy", 4)))
    assert makes_another_run(spec, partial(monkeypatch.setenv, variable, str(tmp_path)))


def test_own_code_that_changes_meanwhile_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = resolve(RunSpec(tracker="orb-slam2", sequence=str(write_folder(tmp_path / "toy", 4))))
    identity.check_unchanged(asked)
    graph = identity.read_module_graph()
    code = graph.modules["dynslam_bench.slam.tracking"]
    edited = {**graph.modules, "dynslam_bench.slam.tracking": replace(code, digest="another")}
    monkeypatch.setattr(identity, "read_module_graph", lambda: type(graph)(edited))
    with pytest.raises(
        RunError, match="the code of dynslam-bench has changed since this process began"
    ):
        identity.check_unchanged(asked)


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
    assert record.verified
    assert "identity" not in record.program
    old = record.model_copy(update={"identity": record.identity | {"scheme": 0}})
    assert not old.verified
    assert old.program["identity"] == "unverified"
    trajectory = store.folder(record.run_id) / "trajectory_online.txt"
    trajectory.write_text(trajectory.read_text().replace("0.0", "0.1"))
    (again,) = run_many([spec], results=store, retry=["ok"])
    assert again.run_id == record.run_id
    assert any("another trajectory" in note for note in again.notes)
    assert any(record.run_id in message for message in caplog.messages)


def test_a_plug_in_that_patches_numpy_changes_no_score(
    tmp_path: Path, store: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dynslam_bench.runs.store.has_imported_plugins", has_imported_plugins)
    patching = (
        PLUGIN
        + "\nif 'dynslam_bench.envs' in __import__('sys').modules:\n    np.sqrt = lambda x: 2 * x\n"
    )
    spec, _ = a_plug_in(tmp_path, patching)
    other = RunSpec(tracker="never-move", sequence=spec.sequence)
    (alone,) = run_many([other], results=store)
    before = store.score(alone).metrics
    original = np.sqrt
    try:
        together = RunStore(tmp_path / "together")
        _, beside = run_many([spec, other], results=together)
        assert np.sqrt is not original, "the plug-in has patched numpy in this process"
        assert together.score(beside).metrics == before
    finally:
        np.sqrt = original


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_plug_in_that_patches_numpy_reaches_no_run_of_another(
    order: tuple[int, int], tmp_path: Path, store: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dynslam_bench.runs.store.has_imported_plugins", has_imported_plugins)
    spec, _ = a_plug_in(tmp_path)
    patching = PLUGIN + "\nnp.cbrt = lambda _: 9.0\n"
    looking = PLUGIN.replace("= gain", "= np.cbrt(8.0)")
    assert looking != PLUGIN
    trackers = {
        name: write(tmp_path / name / f"{name}.py", source.replace('"mine"', f'"{name}"'))
        for name, source in (("patching", patching), ("looking", looking))
    }
    for file in trackers.values():
        write(file.parent / "helper.py", "def gain(text):\n    return len(text)\n")
        write(file.parent / "params" / "slam.yaml", "threshold: 1\n")
    # one is imported by this process, which asks for both
    specs = [spec.model_copy(update={"tracker": f"{file}:SPEC"}) for file in trackers.values()]
    original = np.cbrt
    try:
        records = run_many([specs[index] for index in order], results=store)
        assert np.cbrt is not original, "the plug-in has patched numpy in this process"
    finally:
        np.cbrt = original
    (looked,) = [record for record in records if record.tracker.id == "looking"]
    assert looked.status == "ok", looked.reason
    assert store.trajectory(looked.run_id).positions[0, 0] == 2.0
