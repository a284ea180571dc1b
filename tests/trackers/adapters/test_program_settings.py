"""Settings, templates and containers that a program's TOML file declares."""

import json
import stat
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from dynslam_bench import api as db
from dynslam_bench.contracts import TrackerContext
from dynslam_bench.core.errors import DynslamError, SettingsError
from dynslam_bench.core.settings import apply_overrides, flatten, parameters
from dynslam_bench.envs.slam_env import SlamEnv
from dynslam_bench.geometry import Camera
from dynslam_bench.runs import RunSpec, resolve
from dynslam_bench.testing import CornerSequence
from dynslam_bench.trackers import TRACKERS, build_tracker
from dynslam_bench.trackers.adapters.program_file import (
    CAMERA_NAMES,
    BatchSettings,
    camera_values,
    fill,
    read_batch,
    read_declared,
    settings_class,
    text_of,
)
from dynslam_bench.trackers.registry import resolve_settings
from dynslam_bench.tuning import Study, StudySpec
from dynslam_bench.tuning.plan import StudyPlan

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
CAMERA = Camera(640, 480, 500.0, 510.0, 320.0, 240.0, (0.1, -0.2, 0.0, 0.0, 0.3), 5000.0)

FILE = """
name = "Toy"
version = "7"
license = "MIT"
command = ["{python}", "slam.py", "--features", "{features}", "settings.yaml", "{output}"]
environment = ["MODE={viewer}"]

[templates]
"settings.yaml" = "settings.yaml.in"

[settings.features]
default = 1000
low = 300
high = 3000
scale = "log"
limits = [10, 10000]
unit = "features"
meaning = "ORB features a frame"

[settings.viewer]
choices = ["on", "off"]
default = "off"

[settings.tracking.radius]
default = 2
low = 0.5
high = 8.0

[settings.loops]
default = true

[presets.fast]
features = 500
"tracking.radius" = 1.0
"""
TEMPLATE = """\
n: {features}
radius: {tracking.radius}
loops: {loops}
fx: {camera.fx}
shell: ${HOME} {{features}} {a: 1}
"""


@pytest.fixture
def slam(tmp_path):
    """Writes the file of a program, and returns the id of its tracker."""

    def write(text=FILE, template=TEMPLATE, code="", kind="batch"):
        (tmp_path / "slam.toml").write_text(text)
        if template is not None:
            (tmp_path / "settings.yaml.in").write_bytes(
                template if isinstance(template, bytes) else template.encode()
            )
        (tmp_path / "slam.py").write_text(textwrap.dedent(code))
        return f"{kind}:{tmp_path / 'slam.toml'}"

    return write


def test_a_file_s_settings_are_those_of_a_built_in(slam):
    spec = TRACKERS.get(slam())
    described = {parameter.name: parameter for parameter in parameters(spec.settings)}
    assert list(described) == ["features", "viewer", "tracking.radius", "loops"]
    features = described["features"]
    assert (features.kind, features.low, features.high, features.scale) == ("int", 300, 3000, "log")
    assert (features.unit, features.meaning) == ("features", "ORB features a frame")
    assert described["viewer"].choices == ("on", "off")
    assert described["tracking.radius"].kind == "float"
    assert described["loops"].kind == "bool"
    assert spec.presets == {"fast": {"features": 500, "tracking.radius": 1.0}}
    values = flatten(resolve_settings(spec, {"features": "20", "viewer": "on"}))
    assert (values["features"], values["viewer"], values["tracking.radius"]) == (20, "on", 2.0)


def test_settings_of_one_file_are_of_one_class(slam):
    name = slam()
    settings = resolve_settings(TRACKERS.get(name), {"features": 400})
    env = SlamEnv(CornerSequence(3), name, settings=settings)
    assert flatten(env.settings)["features"] == 400
    env.close()


@pytest.mark.parametrize(
    "values, words",
    [
        ({"features": 5}, "setting 'features' is 5: .*greater than or equal to 10"),
        ({"viewer": "maybe"}, "setting 'viewer' is 'maybe'"),
        ({"feature": 5}, "unknown setting 'feature'.*did you mean 'features'"),
        ({"tracking": 5}, "'tracking' is a group"),
    ],
)
def test_values_that_do_not_fit(slam, values, words):
    with pytest.raises(SettingsError, match=words):
        resolve_settings(TRACKERS.get(slam()), values)


def test_placeholders_are_replaced_and_the_rest_stays(slam, tmp_path):
    spec = TRACKERS.get(slam())
    settings = resolve_settings(spec, {"tracking.radius": 1e-5 * 1e5, "loops": False})
    document = read_batch(tmp_path / "slam.toml")
    filled = document.filled(settings, camera_values(CAMERA, 30.0) | {"output": "/out"})
    assert filled.words == [
        sys.executable,
        str(tmp_path / "slam.py"),
        "--features",
        "1000",
        "settings.yaml",
        "/out",
    ]
    assert filled.variables == {"MODE": "off"}
    assert filled.files["settings.yaml"].splitlines() == [
        "n: 1000",
        "radius: 1.0",
        "loops: false",
        "fx: 500.0",
        "shell: ${HOME} {features} {a: 1}",
    ]


def test_numbers_are_written_so_that_every_parser_reads_them():
    assert [text_of(value) for value in (1, 1.0, 1e-7, 1e22, True, "a b")] == [
        "1",
        "1.0",
        "1.0e-07",
        "1.0e+22",
        "true",
        "a b",
    ]
    assert fill("{a}{b}", {"a": "{b}", "b": "2"}) == "{b}2"  # values are no templates
    values = camera_values(CAMERA, 29.7)
    assert tuple(values) == CAMERA_NAMES
    assert (values["camera.fps"], values["camera.k3"], values["camera.bf"]) == ("30", "0.3", "37.5")


def test_a_setting_has_the_type_of_its_default():
    table = {
        "share": {"default": 0.5, "choices": [0.5, 1.0]},
        "flag": {"default": 1, "choices": [0, 1]},
        "wide": {"default": 1, "low": 0.5, "high": 2},
        "fixed": {"default": 5, "limits": [1, 9]},
        "text": {"default": "x y"},
    }
    kind = settings_class(BatchSettings, read_declared(table, "slam.toml"))
    assert [(one.name, one.kind) for one in parameters(kind)] == [
        ("share", "categorical"),
        ("flag", "categorical"),
        ("wide", "float"),
    ]
    texts = {"share": "1.0", "flag": "0", "wide": "2", "fixed": "3", "text": "z"}
    assert flatten(apply_overrides(kind(), texts)).items() >= {
        ("share", 1.0),
        ("flag", 0),
        ("wide", 2.0),
        ("fixed", 3),
        ("text", "z"),
    }
    for name, value in {"share": "0.7", "flag": "2", "fixed": "10", "text": "a\nb"}.items():
        with pytest.raises(SettingsError, match=f"setting '{name}'"):
            apply_overrides(kind(), {name: value})


@pytest.mark.parametrize("span, words", [([5, 100], "10"), ([300, 20000], "10000")])
def test_a_study_may_not_search_beyond_the_limits(slam, span, words):
    spec = StudySpec(
        name="mine",
        tracker=slam(),
        tune=("synthetic/walking_xyz?scene=0-2&frames=6",),
        held_out=("synthetic/walking_xyz?scene=100-105&frames=6",),
        space={"include": ("features",), "range": {"features": span}},
    )
    with pytest.raises(DynslamError, match=f"features.*{words}"):
        StudyPlan(spec)


def changed(text, old, new):
    assert old in text
    return text.replace(old, new)


BAD = {
    "unknown in the command": (
        changed(FILE, '"{features}"', '"{featurs}"'),
        TEMPLATE,
        r"\{featurs\} in command is neither.*did you mean 'features'.*\{\{featurs\}\}",
    ),
    "unknown in the template": (FILE, TEMPLATE + "x: {radius}\n", r"\{radius\} in template settings.yaml.in"),
    "unknown in the environment": (
        changed(FILE, "MODE={viewer}", "MODE={mode}"),
        TEMPLATE,
        r"\{mode\} in environment",
    ),
    "unused": (FILE, changed(TEMPLATE, "{loops}", "true"), "never know of loops"),
    "no template": (FILE, None, "no template .*settings.yaml.in"),
    "a binary template": (FILE, b"\x89PNG\r\n\xff\xfe{features}", "not a text file"),
    "a template with null bytes": (FILE, TEMPLATE + "\0", "null bytes"),
    "a template that goes elsewhere": (
        changed(FILE, '"settings.yaml" =', '"../settings.yaml" ='),
        TEMPLATE,
        "'../settings.yaml' is no file in the program's working folder",
    ),
    "half a range": (changed(FILE, "high = 3000\n", ""), TEMPLATE, "'features': a range needs both"),
    "an empty range": (changed(FILE, "low = 300\n", "low = 3000\n"), TEMPLATE, "low 3000 is not below"),
    "a default out of range": (
        changed(FILE, "default = 1000", "default = 200"),
        TEMPLATE,
        "the default 200 lies outside its range 300 to 3000",
    ),
    "a range out of the limits": (
        changed(FILE, "limits = [10, 10000]", "limits = [500, 10000]"),
        TEMPLATE,
        "300 lies outside its limits 500 to 10000",
    ),
    "no log of zero": (changed(FILE, "low = 300", "low = 0"), TEMPLATE, "log scale needs low above 0"),
    "no default": (changed(FILE, "default = 1000\n", ""), TEMPLATE, "'features': default"),
    "a default that is no choice": (
        changed(FILE, 'default = "off"', 'default = "of"'),
        TEMPLATE,
        "the default 'of' is none of its choices: on, off",
    ),
    "a range of texts": (
        changed(FILE, 'choices = ["on", "off"]', "low = 1"),
        TEMPLATE,
        "'viewer': the default is 'off', which has no range",
    ),
    "no table": (
        changed(FILE, "[settings.loops]\ndefault = true", "[settings]\nloops = true"),
        TEMPLATE,
        "not a table",
    ),
    "an unknown key": (changed(FILE, "unit =", "units ="), TEMPLATE, "unknown key 'units'.*did you mean 'unit'"),
    "a name that is taken": (
        changed(FILE, "[settings.loops]", "[settings.timeout_s]"),
        changed(TEMPLATE, "{loops}", "{timeout_s}"),
        "cannot be called 'timeout_s'",
    ),
    "a name of a place": (
        changed(FILE, "[settings.loops]", "[settings.camera]"),
        changed(TEMPLATE, "{loops}", "{camera}"),
        "cannot be called 'camera'",
    ),
    "a name that is none": (changed(FILE, "[settings.loops]", '[settings."a-b"]'), TEMPLATE, "'a-b'"),
    "a preset of unknown settings": (
        changed(FILE, "features = 500", "featurs = 500"),
        TEMPLATE,
        "preset 'fast' sets an unknown 'featurs'",
    ),
    "a preset of unfit values": (
        changed(FILE, "features = 500", "features = 5"),
        TEMPLATE,
        "preset 'fast': setting 'features'",
    ),
}  # fmt: skip


@pytest.mark.parametrize("text, template, words", BAD.values(), ids=BAD)
def test_faults_are_named_before_anything_runs(slam, text, template, words):
    if "loops = true" in text:  # a key before its tables
        text = text.replace("[settings]\nloops = true", "").replace(
            "[settings.features]", "[settings]\nloops = true\n[settings.features]"
        )
    with pytest.raises(SettingsError, match=words) as raised:
        resolve_settings(TRACKERS.get(slam(text, template)))
    assert "\n" not in str(raised.value)


def identity(name, **settings):
    spec = RunSpec(tracker=name, sequence="synthetic/walking_xyz", frames=(0, 2), settings=settings)
    return resolve(spec).run_id


def test_identity_is_what_decides(slam):
    """A setting's value and the template count; words about the program and unused ranges do not."""
    first = identity(slam())
    assert identity(slam(), features=1000) == first
    assert (
        identity(slam(changed(FILE, "ORB features", "number of features") + "# a comment\n"))
        == first
    )
    assert identity(slam(changed(FILE, "high = 3000", "high = 2000"))) == first
    assert identity(slam(changed(FILE, '"MIT"', '"GPL-3.0-only"'))) == first
    different = {
        identity(slam(), features=999),
        identity(slam(template=TEMPLATE + "more: 1\n")),
        identity(slam(changed(FILE, "default = 1000", "default = 999"))),
        identity(slam(changed(FILE, '"--features"', '"--points"'))),
        identity(slam(changed(FILE, 'version = "7"', 'version = "8"'))),
        identity(slam(changed(FILE, "MODE=", "MODUS="))),
        identity(slam(code="print(1)")),
    }
    # the first and the third have equal values, but another default is no other program
    assert len(different) == 6
    assert first not in different


def test_a_file_that_a_setting_names_counts(slam, tmp_path):
    (tmp_path / "words.bin").write_bytes(b"1")
    text = FILE + '\n[settings.vocabulary]\ndefault = "words.bin"\n'
    name = slam(text, TEMPLATE + "vocabulary: {here}/{vocabulary}\n")
    first = identity(name)
    (tmp_path / "words.bin").write_bytes(b"2")
    assert identity(name) != first


def test_a_batch_program_is_named_behind_its_id(slam, tmp_path):
    slam()
    with pytest.raises(SettingsError, match="write batch:"):
        resolve_settings(TRACKERS.get("batch"), {"program": str(tmp_path / "slam.toml")})


# -- containers ------------------------------------------------------------------------------------

ENGINE = """\
#!{python}
# Stands for docker or podman: knows one image, and runs its commands on this machine.
import json, os, sys
words = sys.argv[1:]
if words[:2] == ["image", "inspect"]:
    digest = open({digest!r}).read()
    if not digest:
        sys.exit("no such image")
    print(digest)
    sys.exit()
json.dump(words, open({seen!r}, "w"))
environment = dict(os.environ)
folder = "."
at = 1
while words[at].startswith("--"):
    if words[at] == "--env":
        name, _, value = words[at + 1].partition("=")
        environment[name] = value
    if words[at] in ("--workdir", "--pwd"):
        folder = words[at + 1]
    if words[at] == "--entrypoint":
        entry = words[at + 1]
    at += 1 if words[at] in ("--rm", "--interactive", "--cleanenv", "--no-home", "--nv") else 2
command = [entry, *words[at + 1 :]] if "--entrypoint" in words else words[at + 1 :]
os.chdir(folder)
os.execvpe(command[0], command, environment)
"""


@pytest.fixture(params=["docker", "podman", "apptainer"])
def engine(request, tmp_path, monkeypatch):
    """A program in the place of an engine; returns its name, what it was asked, and the file of the image's digest."""
    folder = tmp_path / "bin"
    folder.mkdir()
    seen = tmp_path / "seen.json"
    digest = tmp_path / "digest"
    digest.write_text("sha256:11")
    program = folder / request.param
    program.write_text(ENGINE.format(python=sys.executable, digest=str(digest), seen=str(seen)))
    program.chmod(program.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
    return request.param, seen, digest


def contained(engine_name, tmp_path):
    """The file of a program in an image of an engine."""
    image = "toy.sif" if engine_name == "apptainer" else "toy:1"
    (tmp_path / "toy.sif").write_bytes(b"image")
    head = f'image = "{image}"\nengine = "{engine_name}"\ngpu = true\n'
    return changed(FILE, 'version = "7"\n', f'version = "7"\n{head}')


def test_the_command_of_a_container(slam, engine, tmp_path):
    name, _, digest = engine
    slam(contained(name, tmp_path))
    document = read_batch(tmp_path / "slam.toml")
    settings = TRACKERS.get(f"batch:{tmp_path / 'slam.toml'}").settings()
    work = tmp_path / "run" / "work"
    command, _ = document.launched(
        document.filled(settings, {"output": str(work / "out.txt")}),
        {"OMP_NUM_THREADS": "2"},
        work=work,
        writable=[tmp_path / "run"],
    )
    text = " ".join(command)
    assert command[0] == name
    assert text.endswith(f"{tmp_path / 'slam.py'} --features 1000 settings.yaml {work / 'out.txt'}")
    assert "--env OMP_NUM_THREADS=2" in text
    assert "--env MODE=off" in text
    assert "LD_LIBRARY_PATH" not in text
    if name == "apptainer":
        assert text.startswith("apptainer exec --cleanenv --no-home --nv ")
        assert (
            f"--bind {tmp_path}:{tmp_path}:ro --bind {tmp_path / 'run'}:{tmp_path / 'run'}" in text
        )
        assert str(tmp_path / "toy.sif") in command
    else:
        assert f"--mount type=bind,source={tmp_path},target={tmp_path},readonly" in text
        assert f"source={tmp_path / 'run'},target={tmp_path / 'run'} " in text
        assert digest.read_text() in command  # not what the name stands for by then
        assert ("--gpus all" in text) == (name == "docker")


def test_the_image_is_a_part_of_the_identity(slam, engine, tmp_path, monkeypatch):
    name, _, digest = engine
    text = changed(contained(name, tmp_path), "MODE={viewer}", 'MODE={viewer}", "MY_MODE')
    tracker = slam(text)
    first = identity(tracker)
    assert identity(tracker) == first
    monkeypatch.setenv("MY_MODE", "slow")
    assert identity(tracker) != first
    monkeypatch.delenv("MY_MODE")
    assert identity(tracker) == first
    digest.write_text("sha256:22")
    (tmp_path / "toy.sif").write_bytes(b"another image")
    assert identity(tracker) != first


def test_an_image_or_an_engine_that_is_not_here(slam, engine, tmp_path, monkeypatch):
    name, _, digest = engine
    tracker = slam(contained(name, tmp_path))
    digest.write_text("")
    (tmp_path / "toy.sif").unlink()
    with pytest.raises(SettingsError, match=r"no image .*toy.*pull"):
        resolve_settings(TRACKERS.get(tracker))
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(SettingsError, match=f"needs {name}, which is not installed"):
        resolve_settings(TRACKERS.get(tracker))


# -- programs that run -----------------------------------------------------------------------------

WRITES = """
import os, sys
settings = dict(line.split(": ") for line in open("settings.yaml").read().splitlines()[:4])
assert sys.argv[1:3] == ["--features", settings["n"]] and os.environ["MODE"] in ("on", "off")
if int(settings["n"]) > 5000:
    sys.exit("features above 5000 are not supported")
rows = [line.split() for line in open(os.path.join("..", "sequence", "associations.txt"))]
step = 0.0 if os.environ["MODE"] == "off" else 0.001 * float(settings["radius"])
with open(sys.argv[-1], "w") as file:
    for number, row in enumerate(rows):
        file.write(f"{row[0]} {step * number} 0 0 0 0 0 1\\n")
"""


@pytest.mark.slow
def test_the_program_reads_its_settings_in_each_engine(slam, engine, tmp_path, toy_folder):
    name, seen, _ = engine
    tracker = slam(contained(name, tmp_path), code=WRITES)
    how = {"frames": (0, 6), "results": tmp_path / "results"}
    run = db.run(tracker, toy_folder, settings={"viewer": "on"}, **how)
    assert run.status == "ok", run.record.reason
    final = run.store.trajectory(run.record.run_id, "final")
    assert np.allclose(final.positions[:, 0], 0.002 * np.arange(6))
    assert json.loads(seen.read_text())[0] in ("run", "exec")


@pytest.mark.slow
def test_a_container_ends_with_its_run(slam, engine, tmp_path, toy_folder):
    name, _, _ = engine
    if name == "apptainer":
        pytest.skip("its processes are children of the run's")
    marker = tmp_path / "pid"
    code = f"import os, time\nopen({str(marker)!r}, 'w').write(str(os.getpid()))\ntime.sleep(600)\n"
    # what an engine's service has started is no child: it is in another session, and its parent has ended
    program = tmp_path / "bin" / name
    text = program.read_text().replace(
        "os.chdir(folder)\n",
        "os.chdir(folder)\nif os.fork():\n    import time; time.sleep(600)\nos.setsid()\n",
    )
    program.write_text(text)
    tracker = slam(contained(name, tmp_path), code=code)
    run = db.run(
        tracker,
        toy_folder,
        frames=(0, 3),
        settings={"timeout_s": 5},
        results=tmp_path / "r",
    )
    assert run.status == "timeout"
    pid = int(marker.read_text())
    assert _ends(pid)


def _ends(pid):
    """Whether a process ends within ten seconds."""
    import time

    for _ in range(100):
        if not Path(f"/proc/{pid}").exists():
            return True
        if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
            return True
        time.sleep(0.1)
    return False


@pytest.mark.slow
def test_a_value_that_the_program_refuses_is_a_row(slam, tmp_path, toy_folder):
    tracker = slam(code=WRITES)
    run = db.run(
        tracker,
        toy_folder,
        frames=(0, 3),
        settings={"features": 6000},
        results=tmp_path / "r",
    )
    assert run.status == "crashed"
    assert "features above 5000 are not supported" in run.record.reason


SERVED = """
name = "Served"
license = "MIT"
command = ["{python}", "slam.py", "settings.yaml"]
final = false

[templates]
"settings.yaml" = "settings.yaml.in"

[settings.step_m]
default = 0.5
low = 0.1
high = 1.0

[settings.group.count]
default = 3
low = 1
high = 5
"""
ANSWERS = """
import json, os, sys
step = float(open(sys.argv[1]).read().split(": ")[1])
for line in sys.stdin:
    request = json.loads(line)
    if request["op"] == "reset":
        assert request["settings"] == {"step_m": step, "group.count": 4}, request["settings"]
        assert os.listdir() == ["settings.yaml"]
        answer = {"ok": True}
    elif request["op"] == "track":
        index = request["index"]
        pose = [1, 0, 0, step * index, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        answer = {"index": index, "state": "ok", "T_world_cam": pose}
    else:
        break
    print(json.dumps(answer), flush=True)
"""


@pytest.mark.slow
def test_a_program_that_answers_frame_by_frame_gets_its_settings(slam):
    check_served(slam(SERVED, "step: {step_m}", ANSWERS, kind="subprocess"))


@pytest.mark.slow
def test_so_does_one_in_a_container(slam, engine, tmp_path):
    name, seen, _ = engine
    image = "toy.sif" if name == "apptainer" else "toy:1"
    (tmp_path / "toy.sif").write_bytes(b"image")
    text = changed(SERVED, "final = false", f'image = "{image}"\nengine = "{name}"')
    check_served(slam(text, "step: {step_m}", ANSWERS, kind="subprocess"))
    assert json.loads(seen.read_text())[0] in ("run", "exec")


def check_served(tracker_id):
    declared = parameters(TRACKERS.get(tracker_id).settings)
    assert [parameter.name for parameter in declared] == ["step_m", "group.count"]
    tracker = build_tracker(tracker_id, {"step_m": 0.25, "group.count": "4"}, TrackerContext())
    sequence = CornerSequence(3)
    for _ in range(2):  # each sequence begins in a new folder
        tracker.reset(sequence.camera, rng=np.random.default_rng(0))
        results = [tracker.track(sequence[index]) for index in range(3)]
        assert [float(result.T_world_cam[0, 3]) for result in results] == [0.0, 0.25, 0.5]
        tracker.close()


def test_a_missing_file_of_a_served_program(tmp_path):
    with pytest.raises(SettingsError, match=r"cannot read .*nowhere\.toml"):
        TRACKERS.get(f"subprocess:{tmp_path / 'nowhere.toml'}")
    assert (
        TRACKERS.get("subprocess:prog --config slam.toml").settings.__name__ == "SubprocessSettings"
    )


# -- studies ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_study_says_that_a_program_ignores_its_settings(slam, tmp_path, toy_folder):
    tracker = slam(code=WRITES)  # without its viewer it stands still
    study = {
        "name": "inert",
        "tracker": tracker,
        "tune": [f"{toy_folder}[0:10]?offsets=0-1"],
        "recorded": [],
        "offsets": [0],
        "trials": 4,
        "space": {"include": ["features", "tracking.radius"]},
    }
    summary = Study(results=tmp_path / "results", **study).run().finish()
    assert "nothing that the study set has an effect" in summary.conclusion
    assert "All 3 trials" in summary.conclusion
    assert summary.best is None or summary.best.evidence is None, "nothing was left to judge"


@pytest.mark.slow
def test_a_study_of_a_batch_program_compares_final_trajectories(slam, tmp_path, toy_folder):
    """A batch program has no others: its runs are no lost ones."""
    study = {
        "name": "final",
        "tracker": slam(code=WRITES),
        "tune": [f"{toy_folder}[0:10]?offsets=0-1"],
        "recorded": [],
        "offsets": [0],
        "trials": 4,
        "space": {"include": ["tracking.radius"], "fixed": {"viewer": "on"}},
    }
    tuner = Study(results=tmp_path / "results", **study).run()
    ratios = {trial.value for trial in tuner.study.trials}
    assert len(ratios) == 4, "each step length has an error of its own"
