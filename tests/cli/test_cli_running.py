"""`run`, `bench` and `runs list`: what a row says of its run, limits, labels, refusals, progress off a terminal."""

import csv
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import pandas as pd
import pytest
from helpers import hostile
from helpers.cli_program import one_line
from helpers.envs_toys import write_folder
from helpers.reports_fake_store import add_run
from helpers.waiting import until

from dynslam_bench import cli as program
from dynslam_bench.cli import app, demo, output, running, runs
from dynslam_bench.cli.demo import compiled_ahead, culling_effect
from dynslam_bench.cli.output import report_table, table
from dynslam_bench.core import WEIGHTS_VARIABLE, RunError
from dynslam_bench.core.fingerprint import this_machine
from dynslam_bench.core.number_text import mm
from dynslam_bench.core.records import digest
from dynslam_bench.core.sanitise import printable
from dynslam_bench.geometry.trajectory_files import read_tum
from dynslam_bench.reports.model.row import RunRow
from dynslam_bench.reports.tables.table import Column, Table, TableCell
from dynslam_bench.runs import RunEvent, RunSpec, RunStore, run_many
from dynslam_bench.runs.process.fork_server import START_VARIABLE
from dynslam_bench.segmentation.networks import checkpoints
from dynslam_bench.trackers import TRACKERS

pytestmark = pytest.mark.slow


def test_a_row_names_the_part_the_settings_and_its_origin(cli, facts, walk):
    command = (
        "run",
        "constant-velocity",
        walk,
        "--frames",
        "0:3",
        "--stride",
        "2",
        "--set",
        "frames=4",
    )
    assert "from the store" not in cli(*command, "--label", "my control")[1]
    assert "from the store" in cli(*command)[1]
    (row,) = facts(*command)
    assert row["from_store"] is True
    assert row["settings"] == "frames=4"
    assert row["frames"] == "0:3, every 2nd"
    assert "0:3, every 2nd" in cli("runs", "list")[1]
    assert "my control" in cli("runs", "show")[1]


def test_the_number_of_frames_and_the_expected_time_are_written_before_the_run(
    cli, walk, monkeypatch
):
    command = ("run", "constant-velocity", walk, "--set")
    unknown = (
        "1 run, 4 frames; a system's first run on a machine compiles its code for up to a minute"
    )
    assert cli(*command, "frames=3")[2].splitlines()[0] == unknown
    first = cli(*command, "frames=4", "--offset", "0", "1")[2].splitlines()[0]
    assert re.fullmatch(
        r"2 runs, 7 frames, about 0:00:0\d by the frame times of stored runs", first
    )
    assert "frames" not in cli(*command, "frames=4")[2], "it is stored: nothing will be tracked"
    assert cli(*command, "frames=5", "--json")[2] == ""
    # the stored runs are those of another machine
    other = this_machine().model_copy(update={"cpu": "another"})
    monkeypatch.setattr("dynslam_bench.core.fingerprint.this_machine", lambda: other)
    assert "compiles its code" in cli(*command, "frames=6")[2].splitlines()[0]


def test_a_row_names_files_without_their_folders(cli, facts, walk):
    command = ("run", f"replay:{walk / 'groundtruth.txt'}", walk, "--set", "tolerance_s=0.02")
    code, out, _ = cli(*command)
    assert code == 0
    assert "replay:groundtruth.txt" in out
    assert str(walk) not in out
    (row,) = facts(*command)
    assert row["tracker"] == f"replay:{walk / 'groundtruth.txt'}", "scripts get the whole name"
    assert runs.shown_cell(
        "settings", "a=1, s.source=onnx:/x/y z/net.onnx, v=/w/ORBvoc.txt, r=recorded:./m/n"
    ) == ("a=1, s.source=onnx:net.onnx, v=ORBvoc.txt, r=recorded:n")


def test_a_recording_without_ground_truth_says_where_its_trajectory_is(cli, tmp_path):
    write_folder(tmp_path / "mine", 4, has_truth=False)
    code, _, err = cli("run", "never-move", "mine")
    assert code == 0
    assert len(read_tum(Path(err.splitlines()[-1].rpartition(": ")[2]))) == 4


@pytest.mark.parametrize("named", ["recording", "./recording", "{}/recording"])
def test_what_a_folder_is_taken_for_is_said_once(cli, tmp_path, named):
    folder = write_folder(tmp_path / "recording", 4)
    camera = folder / "camera.toml"
    camera.write_text(camera.read_text().replace("fps = 30", "fps = 3"))
    code, out, err = cli("run", "never-move", named.format(tmp_path))
    assert code == 0, err
    assert err.count("taken for layout tum: colour in rgb") == 1
    assert (out + err).count("fps = 3 is stated") == 1
    assert "warning: recording: fps = 3 is stated" in out


def test_a_folder_whose_camera_is_not_known_names_the_choices(cli, walk, tmp_path):
    shutil.copytree(walk, tmp_path / "mine")
    (tmp_path / "mine" / "camera.toml").rename("cam.toml")
    for command in (("run", "never-move", "mine"), ("sequences", "verify", "mine")):
        code, _, err = cli(*command)
        error, *cures = err.splitlines()
        assert code == 1
        assert error.startswith("error: ")
        assert "tum-fr1" in cures[0]
        assert cures[2].startswith("width = "), "two cures, then a camera.toml to copy"
        assert cli(*command, "--camera", "cam.toml")[0] == 0


@pytest.fixture
def fetched(tmp_path, monkeypatch):
    """Where the COCO checkpoint lies once it is fetched; a copy of the embedded network takes its place."""
    file = tmp_path / "weights" / checkpoints.COCO.file
    file.parent.mkdir()
    monkeypatch.setattr(
        checkpoints, "fetch_checkpoint", lambda _: shutil.copy(checkpoints.embedded_weights(), file)
    )
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(file.parent))
    return file


def test_masks_of_a_recording_are_downloaded_only_by_agreement(cli, walk, fetched, monkeypatch):
    command = ("run", "mask-rcnn", walk, "--frames", "0:2")
    code, out, err = cli(*command)
    assert code == 1, "an error and five cures"
    assert not out, "an error and five cures"
    assert not fetched.exists(), "an error and five cures"
    assert len(err.splitlines()) == 6, "an error and five cures"
    monkeypatch.setattr(running, "is_interactive", lambda: True)
    monkeypatch.setattr(running.typer, "confirm", lambda *_, **__: False)
    code, _, err = cli(*command)
    assert code == 1
    assert "170 MB" in err
    assert "BSD-3-Clause" in err
    assert not fetched.exists()
    monkeypatch.setattr(running.typer, "confirm", lambda *_, **__: True)
    assert cli(*command)[0] == 0
    assert fetched.is_file()
    monkeypatch.setattr(running.typer, "confirm", pytest.fail)
    assert cli(*command)[0] == 0, "nobody is asked again, and the run is stored"
    fetched.unlink()
    monkeypatch.setattr(
        checkpoints, "fetch_checkpoint", lambda _: fetched.with_suffix(".asked").touch()
    )
    assert cli(*command, "--yes", "--seed", "1")[0] == 1
    assert fetched.with_suffix(".asked").exists()


def test_bench_has_limits(cli, walk, tmp_path):
    (tmp_path / "small.toml").write_text(
        f'trackers = ["never-move"]\nsequences = ["{walk}"]\nframes = [0, 3]\n[limits]\nmemory_mb = 20\n'
    )
    for options, code, statuses in (
        ((), 3, ("out-of-memory",)),
        (("--retry", "failed", "--memory-limit", "0"), 0, ("ok",)),
        (("--retry", "ok", "--time-limit", "0.0001"), 3, ("timeout", "out-of-memory")),
    ):
        ended, out, _ = cli("bench", "small.toml", *options, "--json")
        assert ended == code
        assert json.loads(out)[0]["status"] in statuses


def test_a_part_without_runs_is_no_error(cli, walk, tmp_path):
    (tmp_path / "small.toml").write_text(f'trackers = ["never-move"]\nsequences = ["{walk}"]\n')
    assert cli("bench", "small.toml", "--shard", "7/64") == (
        0,
        "this part of the suite holds no runs\n",
        "",
    )
    assert cli("bench", "small.toml", "--shard", "7/64", "--json") == (0, "[]\n", "")


def test_pictures_of_a_stored_run_are_made(facts, walk):
    folder = Path(facts("run", "orb-slam2", walk)[0]["folder"])
    names = {"frame_000000.webp", "sheet.png", "video.webm"}
    assert not names & {path.name for path in folder.iterdir()}
    for from_store in (False, True):
        (row,) = facts("run", "orb-slam2", walk, "--snapshots", "--sheet", "--video")
        assert row["from_store"] is from_store
        assert Path(row["folder"]) == folder
        assert names <= {path.name for path in folder.iterdir()}


def test_a_map_that_cannot_be_had_is_no_success(cli, walk):
    code, _, err = cli("run", "never-move", walk, "--save-map", "--json")
    assert code == 3
    assert err.startswith("no map.npz: ")
    assert err.count("\n") == 1
    code, out, _ = cli("run", "orb-slam2", walk, "--save-map")
    assert code == 0
    assert "map.npz" in out


def test_a_run_that_was_lost_is_no_success(cli, walk):
    toys = Path(__file__).parents[1] / "helpers" / "envs_toys.py"
    code, out, _ = cli("run", f"{toys}:SPEC", walk, "--set", "mode=lost", "--set", "at=1", "--json")
    assert json.loads(out)[0]["status"] == "lost"
    assert code == 3


def test_progress_off_a_terminal_is_a_line_now_and_then(capsys, monkeypatch):
    monkeypatch.setattr(output, "HEARTBEAT_S", 0.05)
    heard: list[str] = []

    def told() -> str:
        heard.append(capsys.readouterr().err)
        return "".join(heard)

    with output.progress("3 runs") as advance:
        advance(1.5, 3, "orb-slam2 on walk, frame 5 of 10")
        until(lambda: told().count("\n") >= 2)
    lines = told().splitlines()
    assert len(lines) >= 2
    assert lines[0].startswith("3 runs: 1.5 of 3, about ")
    assert "(orb-slam2 on walk, frame 5 of 10)" in lines[0]
    with output.progress("report") as advance:
        heard.clear()
        advance(1280, 1500)
        until(lambda: "\n" in told())
    assert told().startswith("report: 1280 of 1500, about ")


def test_with_json_nothing_but_errors_goes_to_standard_error(cli, capsys, monkeypatch):
    monkeypatch.setattr(output, "HEARTBEAT_S", 0.01)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(output, "_json_mode", True)
    with output.progress("things") as advance:
        advance(1, 3)
        time.sleep(0.1)
        output.note("one of them")
    assert capsys.readouterr().err == ""
    assert cli("protocols", "list", "--json")[2] == ""
    output.note("text")  # that command is over
    assert capsys.readouterr().err == "text\n"


def test_runs_are_filtered_sorted_and_coloured(cli, facts, walk, monkeypatch):
    assert cli("run", "never-move", walk)[0] == 0
    assert cli("run", "constant-velocity", walk, "--frames", "0:3")[0] == 0
    assert cli("run", hostile.TARGET, walk, "--set", "mode=raise")[0] == 3
    listed = facts("runs", "list")
    (crashed,) = (row for row in listed if row["status"] == "crashed")
    assert crashed["coverage"] == 0.5, "two poses have an error, the run has none"
    assert crashed["ate_rmse_m"] is None, "two poses have an error, the run has none"
    assert [row["tracker"] for row in facts("runs", "list", "--tracker", "never")] == ["never-move"]
    assert facts("runs", "list", "--sequence", "elsewhere") == []
    errors = [row["ate_rmse_m"] for row in facts("runs", "list", "--sort", "-ate")]
    assert errors[0] >= errors[1]
    assert errors[2] is None
    assert [row["tracker"] for row in facts("runs", "list", "--sort", "tracker")] == sorted(
        r["tracker"] for r in listed
    )
    code, out, _ = cli("runs", "list")
    assert code == 0
    assert "1 of 3 runs are not ok: 1 crashed." in out
    assert "\033" not in out
    assert "did you mean 'coverage'" in one_line(cli("runs", "list", "--sort", "coverge")[2])
    assert "1 run failed: Hostile · mode=raise crashed (1)." in cli("report")[1]
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    out = cli("runs", "list")[1]
    assert "\033[31mcrashed\033[0m" in out
    assert "\033[32mok\033[0m" in out
    assert crashed["run_id"] not in out
    assert crashed["run_id"][:8] in out
    monkeypatch.setenv("NO_COLOR", "1")
    assert "\033" not in cli("runs", "list")[1]
    assert cli("runs", "rm", "--failed") == (0, f"{crashed['run_id']}\n", "")


def test_a_monocular_tracker_is_scored_with_its_scale_unless_told_otherwise(cli, facts, walk):
    code, _, err = cli("run", "orb-slam2-mono", walk)
    assert code in (0, 3)
    assert "scored under tum-rgbd/v1-sim3" in err.splitlines()[0]
    (row,) = facts("run", "orb-slam2-mono", walk, code=code)
    assert row["protocol"] == "tum-rgbd/v1-sim3"
    (row,) = facts("run", "orb-slam2-mono", walk, "--protocol", "tum-rgbd/v1", code=code)
    assert row["protocol"] == "tum-rgbd/v1"
    assert row["ate_rmse_m"] is None
    assert running.default_protocol("never-move") == "tum-rgbd/v1"


def test_progress_names_what_is_written_behind_the_last_frame():
    spec = RunSpec(tracker="never-move", sequence="walk", video=True, sheet=True)
    texts = [
        running.event_text(
            RunEvent("progress", "id", spec, 1, partial={"frames_done": done, "frames": 9})
        )
        for done in (8, 9)
    ]
    assert texts[0].endswith(", frame 8 of 9")
    assert texts[1].endswith(", writing trajectories, video.webm, sheet.png")


# Ctrl-C, SIGTERM and SIGHUP in long commands: they stop at once, say how to go on, and exit with
# the shell's code.


HERE = Path(__file__).resolve().parents[1]
SUITE = (
    "trackers = [{tracker!r}]\nsequences = [{folder!r}]\nframes = [0, 4]\n"
    '[settings]\nmode = "hang"\nat = 0\npids = {pids!r}\n'
)
STUDY = (
    "tracker = {tracker!r}\ntune = [{folder!r}]\ntrials = 4\nseeds = [0]\noffsets = [0]\n"
    '[space.fixed]\nmode = "hang"\nat = 0\npids = {pids!r}\n'
)


def attentive():
    """Programs that a script starts in the background ignore Ctrl-C, below `nohup` the end of the terminal too."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.parametrize(
    ("verb", "text", "number", "start"),
    [("bench", SUITE, signal.SIGHUP, "fork"), ("tune run", STUDY, signal.SIGINT, "fresh")],
)
def test_a_signal_stops_what_would_run_for_minutes(walk, tmp_path, verb, text, number, start):
    tracker = tmp_path / "waits.py"
    tracker.write_text(
        f"import sys; sys.path.insert(0, {str(HERE)!r})\n"
        "from pathlib import Path\n"
        "from dynslam_bench.core.settings import tunable\n"
        "from dynslam_bench.trackers import TrackerSpec\n"
        "import os\n"
        "from helpers import hostile\n"
        "class WaitsSettings(hostile.HostileSettings):\n"
        "    patience: float = tunable(0.5, low=0.1, high=1.0, meaning='of no use')\n"
        "class Waits(hostile.Hostile):\n"
        "    def act(self, mode):\n"
        "        self.note(os.getpid())\n"
        "        super().act(mode)\n"
        "SPEC = TrackerSpec('waits', f'{__file__}:Waits', 'Waits', settings=WaitsSettings)\n"
    )
    pids = tmp_path / "pids"
    (tmp_path / "what.toml").write_text(
        text.format(tracker=f"{tracker}:SPEC", folder=str(walk), pids=str(pids)).replace("'", '"')
    )
    program = subprocess.Popen(
        [sys.executable, "-m", "dynslam_bench", *verb.split(), "what.toml"],
        cwd=tmp_path,
        env=os.environ | {START_VARIABLE: start},
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=attentive,
    )
    try:
        until(
            lambda: (
                program.poll() is not None or (pids.is_file() and pids.read_text().endswith("\n"))
            ),
            300,
        )
        assert program.poll() is None, program.stderr.read()
        program.send_signal(number)
        _, err = program.communicate(timeout=120)
    finally:
        program.kill()
    assert program.returncode == 128 + number, err
    assert "the same command goes on from there" in err, err
    assert not Path(f"/proc/{pids.read_text().split()[0]}").exists()
    assert not list(tmp_path.glob("results/runs/*")), "what was interrupted is no outcome"


def test_sigterm_ends_with_the_shells_code():
    code = (
        "from dynslam_bench import cli; from dynslam_bench.cli import app; from os import getpid, kill; "
        f"app.start = lambda: kill(getpid(), {signal.SIGTERM:d}); cli.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 128 + signal.SIGTERM
    assert done.stderr == "interrupted\n"


@pytest.mark.parametrize(
    "error", [ValueError("schema: KeyboardInterrupt"), RunError("cannot load")]
)
def test_an_error_that_a_library_makes_of_an_interrupt_is_an_interrupt(monkeypatch, capsys, error):
    monkeypatch.setattr(app, "app", Mock(side_effect=error))
    monkeypatch.setattr(app, "interrupted", lambda: True)
    with pytest.raises(SystemExit, match="130"):
        app.start(["eval"])
    assert capsys.readouterr().err.startswith("interrupted")


# The demonstration: its closing sentences, and kernels compiled ahead.


def row(
    tracker: str, ate_m: float, sequence: str = "synthetic/walking_xyz?scene=100&frames=100"
) -> RunRow:
    return RunRow.model_validate({
        "run_id": digest([tracker, sequence], 16), "status": "ok", "n_frames": 100, "n_tracked": 100, "coverage": 1.0,
        "tracker": {"id": tracker, "label": tracker},
        "sequence": {"id": sequence, "part": "0" * 16, "frames": 100, "duration_s": 3, "fps": 30, "ground_truth": True,
                     "block": "0" * 16},
        "protocol_id": "p", "protocol_digest": "d", "hold_last_pose_ate_m": ate_m,
    })  # fmt: skip


@pytest.mark.parametrize(
    ("culled_m", "verdict"), [(0.004, "5.0 times smaller"), (0.018, ""), (0.06, "3.0 times larger")]
)
def test_the_verdict_is_that_of_the_numbers(culled_m: float, verdict: str) -> None:
    rows = [row("orb-slam2", 0.02), row("mask-rcnn", culled_m), row("never-move", 0.1)]
    first, *rest = culling_effect(
        [*rows, row("orb-slam2", 0.003, "synthetic/sitting_xyz?scene=104")]
    )
    assert "20.0 mm" in first
    assert f"{mm(culled_m)} mm" in first
    assert verdict in first
    assert ("times" in first) == bool(verdict), "no sentence where nothing was culled"
    assert len(rest) == 1, "no sentence where nothing was culled"


NOTHING_IS_LEFT = """
import sys
from numba.core.dispatcher import Dispatcher
from dynslam_bench.cli.demo import compile_kernels
from dynslam_bench.envs import SlamEnv
from dynslam_bench.testing import CornerSequence

def ready():
    modules = [module for name, module in sys.modules.items() if name.startswith("dynslam_bench")]
    kernels = {value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)}
    return {(kernel.py_func.__qualname__, signature) for kernel in kernels for signature in kernel.signatures}

compile_kernels()
before = ready()
env = SlamEnv(CornerSequence(12), "emfoa-oft", settings={"segmentation.source": "oracle"})
env.reset(seed=0)
while not env.step(env.neutral_action)[3]:
    pass
print(len(before) > 20, sorted(name for name, _ in ready() - before))
"""


def test_nothing_is_left_for_the_first_run_to_compile() -> None:
    done = subprocess.run([sys.executable, "-c", NOTHING_IS_LEFT], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1:] == ["True []"], done.stdout + done.stderr


def test_the_compiling_process_ends_when_rendering_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        demo.subprocess, "Popen", lambda *_, popen=subprocess.Popen, **__: popen(["sleep", "600"])
    )
    began = time.monotonic()
    with pytest.raises(KeyError), compiled_ahead():
        raise KeyError
    assert time.monotonic() - began < 300


def test_why_kernels_were_not_compiled_ahead_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    failing = [sys.executable, "-S", "-c", "raise OSError('no space left')"]
    monkeypatch.setattr(
        demo.subprocess,
        "Popen",
        lambda *_, popen=subprocess.Popen, **options: popen(failing, **options),
    )
    with compiled_ahead():
        pass
    (line,) = capsys.readouterr().err.splitlines()
    assert "OSError: no space left" in line


def test_the_list_fits_one_screen_and_holds_every_tracker(cli, facts):
    rows = {row["id"]: row for row in facts("trackers", "list")}
    assert {"never-move", "orb-slam2", "mask-rcnn", "emfoa-oft", "orbslam3"} <= set(rows)
    lines = cli("trackers", "list")[1].splitlines()
    assert len(lines) < 50
    shown = "\n".join(lines)
    assert [name for name in rows if "?" not in name and f"  {name} " not in shown] == []
    assert [
        name for name in rows if name.partition("?")[2] and name[name.index("?") :] not in shown
    ] == []


def test_info_describes_settings_and_presets_on_one_screen(cli, facts):
    lines = cli("trackers", "info", "emfoa-oft")[1].splitlines()
    assert 24 < len(lines) <= 55
    assert any(line.startswith("flow.budget ") for line in lines)
    described = facts("trackers", "info", "emfoa-oft")
    by_name = {setting["name"]: setting for setting in described["parameters"]}
    threshold = by_name["segmentation.confidence"]
    assert (threshold["low"], threshold["high"], threshold["scale"]) == (0.1, 0.9, "linear")
    assert by_name["segmentation.source"]["tunable"] is False
    assert described["presets"]["fast"]["flow.budget"] == 24


def test_trackers_info_tells_what_others_report_and_where(facts):
    reported = facts("trackers", "info", "dynaslam")["reported"]
    row = next(
        r
        for r in reported
        if r["sequence"] == "tum/fr3/walking_xyz" and r["source"] == "DynaSLAM paper"
    )
    assert (row["metric"], row["value"]) == ("ate_rmse_m", 0.015)
    claims = facts("trackers", "info", "di-slam")["reported"]
    assert claims
    assert all("claimed by the paper" in r["remarks"] for r in claims)
    assert facts("trackers", "info", "never-move")["reported"] == []


@pytest.fixture
def plugin(cli, monkeypatch, tmp_path):
    """Writes a plug-in and puts it on the list of them."""

    def write(name, text):
        (tmp_path / name).write_text(text)
        monkeypatch.setenv("DYNSLAM_BENCH_PLUGINS", f"./{name}:SPEC")
        TRACKERS.refresh()

    yield write
    monkeypatch.undo()
    TRACKERS.refresh()


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("raises.py", "import nothing_of_this_name", "No module named 'nothing_of_this_name'"),
        ("exits.py", "import sys; sys.exit(0)", "that ends the process (exit code 0)"),
        ("ends.py", "import os; os._exit(0)", "that ends the process (exit code 0)"),
    ],
)
def test_a_broken_plugin_is_explained_and_ends_neither_run_nor_list(
    cli, facts, walk, plugin, name, text, reason
):
    plugin(name, text)
    code, out, _ = cli("trackers", "doctor")
    assert code == 0
    assert f"{name}:SPEC" in out
    assert reason in out
    assert "never-move" in {row["id"] for row in facts("trackers", "list")}
    code, out, err = cli("run", f"./{name}:SPEC", walk)
    assert code == 1
    assert out == ""
    assert reason in one_line(err)


def test_a_new_tracker_passes_its_checks_and_runs(cli, facts, walk):
    code, out, _ = cli("trackers", "new", "My SLAM-2")
    assert code == 0
    assert Path("my_slam_2.py").is_file()
    assert "trackers test ./my_slam_2.py:SPEC" in out
    code, out, _ = cli("trackers", "test", "./my_slam_2.py:SPEC", "--frames", "2")
    assert code == 0, out
    *checks, total = [line for line in out.splitlines() if line]
    assert {line.split()[0] for line in checks} == {"passed", "skipped"}
    assert total == f"tracker 'my-slam-2': 0 of {len(checks)} checks failed"
    assert len(checks) > 10
    (row,) = facts("run", "./my_slam_2.py:SPEC", walk, "--set", "features=300")
    assert row["status"] == "ok"
    assert row["ate_rmse_m"] < 0.01
    assert "exists already" in one_line(cli("trackers", "new", "my-slam-2")[2])
    assert "is no name" in one_line(cli("trackers", "new", "../evil")[2])


def test_a_faulty_tracker_fails_with_4(facts, tmp_path):
    (tmp_path / "faulty.py").write_text(
        "from dynslam_bench.trackers import TrackerSpec\n"
        "class Faulty:\n"
        "    def __init__(self, settings): pass\n"
        "    def reset(self, camera, *, rng): pass\n"
        "    def track(self, frame): return None\n"
        "SPEC = TrackerSpec('faulty', f'{__file__}:Faulty', 'Faulty')\n"
    )
    report = facts("trackers", "test", "faulty.py:SPEC", code=4)
    (fault,) = [check["message"] for check in report["checks"] if check["status"] == "failed"]
    assert report["ok"] is False
    assert "gave a NoneType, not a TrackResult" in fault


ROWS = [
    ["run", "tracker", "sequence", "ATE (mm)", "masks"],
    [
        "0123456789abcdef",
        "emfoa-oft",
        "synthetic/walking_halfsphere?scene=0&frames=600",
        "0.01234",
        "embedded",
    ],
]


@pytest.mark.parametrize("width", [400, 120, 100, 80, 60, 40])
def test_a_table_is_no_wider_than_the_terminal_and_cuts_no_word(monkeypatch, width):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setattr(output, "_terminal_width", lambda: width)
    head, row, *left_out = table(ROWS[0], ROWS[1:]).splitlines()
    assert max(len(head), len(row)) <= width
    shown = row.split()
    assert shown == ROWS[1][: len(shown)], "no id is cut"
    assert bool(left_out) == (len(shown) < len(ROWS[1]))
    if left_out:
        note = f"(no room for: {', '.join(ROWS[0][len(shown) :])}; dynslam-bench --wide shows all)"
        assert " ".join(left_out) == note, "the note wraps at blanks"
        assert max(map(len, left_out)) <= width
    assert len(shown) == {400: 5, 120: 5, 100: 5, 80: 3, 60: 2, 40: 2}[width]


def test_texts_are_wrapped_at_blanks(monkeypatch):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setattr(output, "_terminal_width", lambda: 40)
    meaning = "the number of features that each frame keeps after culling"
    lines = table(["setting", "meaning"], [["features.n_features", meaning]]).splitlines()
    assert max(map(len, lines)) <= 40
    assert " ".join(line[21:] for line in lines[1:]) == meaning
    assert lines[1].startswith("features.n_features  ")


def test_numbers_are_never_cut(monkeypatch):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setattr(output, "_terminal_width", lambda: 30)
    spread = "12.34 ±0.56, F skipped 98 %"
    assert table(["ATE (mm)"], [[spread]]).splitlines()[1] == spread
    lines = table(["tracker", "ATE (mm)"], [["x" * 28, spread]]).splitlines()
    assert lines[1] == "x" * 28
    assert lines[2].startswith("(no room for: ATE (mm);")
    monkeypatch.setattr(output, "_wide", True)
    assert table(["tracker", "ATE (mm)"], [["x" * 28, spread]]).splitlines()[1].endswith(spread)


def test_what_names_a_column_or_fills_a_cell_reaches_no_terminal_as_an_escape():
    assert table(["tum/\x1b[2J", "\u202ea"], [["x\ny", "\x9b1m"], [1.5, True]]).splitlines() == [
        r"tum/\x1b[2J  \u202ea",
        r"x y          \x9b1m",
        "1.5          yes",
    ]


def test_a_reports_table_has_no_markup():
    source = Table(
        "t",
        "title",
        "caption",
        [Column("a_b"), Column("empty")],
        [[TableCell("x|y_*"), TableCell()]],
    )
    assert report_table(source) == "a_b\nx|y_*"


def test_a_terminal_shows_as_many_digits_of_an_id_as_name_the_run():
    """Runs of one request share twelve digits; older ids have sixteen, and none may begin like another."""
    one = "0123456789ab" + "c" * 8
    other = "0123456789ab" + "cd" * 4
    alone = "f" * 20
    old = "0123456a00000000"
    assert runs.short_ids([one, other, alone, old, one]) == {
        one: "0123456789abcc",
        other: "0123456789abcd",
        alone: "ffffffff",
        old: "0123456a",
    }
    assert runs.short_ids([]) == {}


def test_an_error_of_the_tracked_frames_alone_is_marked(capsys):
    for coverage in (0.5, 1.0):
        row = dict.fromkeys(runs.COLUMNS.values(), "x") | {"ate_rmse_m": 0.1, "coverage": coverage}
        runs.show_rows(
            [row | {"static_camera_ate_rmse_m": 0.2, "false_motion_max_m": None}], None, "p"
        )
        assert ("of the tracked frames alone" in capsys.readouterr().out) == (coverage < 1)


def test_no_motion_of_a_fixed_camera_is_shown_and_nothing_is_worse_than_it(capsys):
    numbers = {
        "static_camera_ate_rmse_m": 0.0,
        "coverage": 1.0,
        "from_store": False,
        "status": "ok",
    }
    for error in (0.0, 0.002):
        row = (
            dict.fromkeys(runs.COLUMNS.values(), "")
            | numbers
            | {"ate_rmse_m": error, "false_motion_max_m": error}
        )
        runs.show_rows([row], None, "p")
        out = capsys.readouterr().out.splitlines()
        assert len(out) == 2
        assert "ATE (mm)" in out[0]
        assert "false motion (mm)" in out[0]
        assert "from the store" not in out[0]


def test_report_prints_its_message_the_leaderboard_and_its_place(cli, walk, tmp_path):
    (tmp_path / "mine.toml").write_text(
        f"trackers = ['never-move', 'constant-velocity']\nsequences = ['{walk}']\n"
    )
    assert cli("bench", "mine.toml")[0] == 0
    code, out, _ = cli("report")
    lines = out.splitlines()
    assert code == 0
    # the answer in millimetres, also where nobody can be ranked
    assert lines[0].startswith("1 sequence: constant velocity ")
    assert "No tracker can be ranked." in lines
    assert any(line.split()[:2] == ["#", "tracker"] for line in lines)
    assert lines[-2].startswith("Geometric mean of the ATE over that of")
    assert lines[-1].endswith("results/report/index.html")
    code, out, err = cli("report", "--reference", "orb-slam2")
    assert code == 1
    assert "there is no run of the reference 'orb-slam2'" in one_line(err)
    code, out, _ = cli("report", "compare", "results", "results")
    assert code == 0
    assert "\\_" not in out
    assert "| tracker" not in out
    assert "1 sequence" in out


def test_the_sequences_to_rank_on_are_a_switch(cli, tmp_path):
    store = RunStore(tmp_path / "results")
    for name in ("s/a", "s/b"):
        add_run(store, "orb-slam2", name)
        add_run(store, "ours", name, error=0.02)
    add_run(store, "ours", "s/c", error=0.02)
    assert cli("report", "results", "-o", "common")[0] == 0
    assert cli("report", "results", "-o", "all", "--on", "all")[0] == 0
    common, everything = ((tmp_path / name / "report.md").read_text() for name in ("common", "all"))
    assert "The ranking stands on the 2 of 3 sequences that all ranked trackers have." in common
    assert "| 1–2 | 2/2 | orb-slam2 |" in common
    assert "Not ranked, since they lack sequences: orb-slam2." in everything
    assert "| – lacks sequences | 2/2 | orb-slam2 |" in everything
    assert "--on all" in (tmp_path / "all" / "reproduce.html").read_text()
    code, _, error = cli("report", "results", "--on", "some")
    assert (code, error) == (1, "error: --on is 'common' or 'all', got 'some'\n")


def test_compare_as_json_has_no_nan_and_says_what_differs(cli, tmp_path):
    for place, value in (("a", 1), ("b", 2)):
        add_run(RunStore(tmp_path / place), "ours", "s/a", overrides={"x": value})
    code, out, _ = cli("report", "compare", "a", "b", "--json")
    found = json.loads(out, parse_constant=pytest.fail)  # NaN is no JSON
    assert code == 0
    assert list(found["differences"].values()) == [["x: 1 in A, 2 in B"]]
    assert [ratio["low"] for ratio in found["overall"].values()] == [None]
    assert list(found["verdicts"].values()) == ["cannot tell"]
    assert [sentences[0][:6] for sentences in found["findings"].values()] == ["B has "]
    shown = " ".join(cli("report", "compare", "a", "b")[1].split())
    assert "cannot tell" in shown
    assert "6 are the fewest for a claim" in shown


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("run orb-sl", {"orb-slam2"}),
        ("run orb-slam2 tum/fr3/walking_x", {"tum/fr3/walking_xyz"}),
        ("run orb-slam2 x --set features.n_fea", {"features.n_features="}),
        ("run nonsense x --set fea", set()),
        ("bench smo", {"smoke"}),
        ("report --protocol tum-rgbd/v1-", {"tum-rgbd/v1-random-pairs"}),
        ("runs list --status out", {"out-of-memory"}),
        ("trackers info never", {"never-move"}),
    ],
)
def test_the_shell_completes(cli, monkeypatch, words, expected):
    monkeypatch.setenv("_DYNSLAM_BENCH_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", f"dynslam-bench {words}")
    monkeypatch.setenv("COMP_CWORD", str(len(words.split())))
    code, out, _ = cli()
    found = set(out.split())
    assert code == 0, out
    assert expected <= found if expected else not found, out


def test_published_numbers_are_listed_with_whose_they_are(cli, facts):
    code, out, _ = cli("published", "rgbd_dataset_freiburg3_walking_xyz")
    lines = [" ".join(line.split()) for line in out.splitlines()]
    spans = lines[: lines.index("")]
    errors = lines[lines.index("") :]
    assert code == 0
    assert "NGD-SLAM SE(3) or not stated 3 15 34.6 2.31 15" in spans
    rows = [line for line in errors if line.startswith("NGD-SLAM")]
    assert (
        "15 authors leaderboard page of arXiv 2405.07392 SE(3) or not stated 2024 Ryzen 7 4800H, no GPU"
        in rows[0]
    )
    assert "34.6 third party re-run on a Jetson" in rows[2]
    assert "not stated Jetson" in rows[2]
    shown = facts("published", "tum/fr3/walking_xyz", "--protocol", "droid-w/v1")
    values = [line["ate_rmse_m"] for line in shown["numbers"]]
    assert values == sorted(values)
    assert {line["alignment"] for line in shown["numbers"]} == {"Sim(3)"}
    for arguments, text in (
        (["bonn/crowdd"], "did you mean 'bonn/crowd'"),
        (["bonn/crowd", "--protocol", "kitti"], "leave --protocol out"),
        (["bonn/crowd", "--protocol", "kiti"], "did you mean 'kitti'"),
    ):
        code, _, err = cli("published", *arguments)
        assert code == 1
        assert text in one_line(err)


# Terminals that cannot show every character: output with question marks, and no traceback.


LABEL = "caf\xe9 \u2013 \U0001f600"


def test_a_report_is_shown_on_a_terminal_that_lacks_characters(
    cli, walk: Path, tmp_path: Path, monkeypatch
) -> None:
    options = "--tracker", "theirs", "--label", LABEL, "--sequence", walk, "--online"
    assert cli("import", walk / "groundtruth.txt", *options)[0] == 0
    terminal = io.TextIOWrapper(io.BytesIO(), encoding="latin-1")
    monkeypatch.setattr(program, "_SIGNALS", ())  # pytest handles its own
    monkeypatch.setattr(sys, "argv", ["dynslam-bench", "report", "results", "-o", str(tmp_path)])
    monkeypatch.setattr(sys, "stdout", terminal)
    with pytest.raises(SystemExit, match="0"):
        program.main()
    shown = terminal.buffer.getvalue()
    assert "caf" in shown.decode("latin-1")
    assert b"?" in shown
    assert LABEL in (tmp_path / "report.md").read_text(encoding="utf-8")


# Records that somebody else made, on a terminal: no escape sequence, no traceback, and the others
# are shown.


HOSTILE = "\x1b[2J\x1b]0;owned\x07\u202egnp\n"


@pytest.fixture(scope="module")
def stored(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs, the latest of which holds escape sequences in all of its texts."""
    folder = tmp_path_factory.mktemp("results")
    _, last = run_many(
        [RunSpec(tracker="never-move", sequence=str(walk), seed=seed) for seed in (0, 1)],
        results=folder,
    )
    path = folder / "runs" / last.run_id / "run.json"
    record = json.loads(path.read_text())
    record |= {
        "reason": HOSTILE,
        "notes": [HOSTILE],
        "command": [HOSTILE],
        "overrides": {HOSTILE: HOSTILE},
    }
    record["tracker"] |= {"id": HOSTILE, "label": HOSTILE}
    record["sequence"] |= {"id": HOSTILE}
    path.write_text(json.dumps(record))
    return folder


@pytest.fixture
def results(stored: Path, tmp_path: Path) -> Path:
    return shutil.copytree(stored, tmp_path / "results", symlinks=True)


def hostile_run(results: Path) -> str:
    return next(
        path.parent.name for path in results.glob("runs/*/run.json") if "owned" in path.read_text()
    )


def harmless(text: str) -> bool:
    return not set(text) & {"\x1b", "\x07", "\u202e"}


@pytest.mark.parametrize(
    "arguments", [("list",), ("show", "RUN"), ("list", "--json"), ("show", "RUN", "--json")]
)
def test_names_are_shown_as_text(cli, results: Path, arguments: tuple[str, ...]) -> None:
    run = hostile_run(results)
    code, out, err = cli(
        "runs", *[run if word == "RUN" else word for word in arguments], "--results", results
    )
    assert code == 0
    assert harmless(out + err)
    assert "owned" in out


def test_errors_are_shown_as_text(cli, results: Path) -> None:
    code, out, err = cli("runs", "show", HOSTILE, "--results", results)
    assert code == 1
    assert harmless(out + err)
    assert err.startswith("error: there is no run")
    assert err.count("\n") == 1


def test_one_unreadable_record_is_named_and_the_others_are_listed(cli, results: Path) -> None:
    (results / "runs" / hostile_run(results) / "run.json").write_bytes(b"\xff\xfe")
    code, out, err = cli("runs", "list", "--results", results)
    assert code == 0
    assert "never-move" in out
    assert err.startswith("unreadable: ")
    assert err.count("\n") == 1
    assert "is not a text file" in err


@pytest.mark.parametrize("command", ["export", "report", "compare"])
def test_a_table_says_that_it_leaves_out_an_unreadable_run(
    cli, results: Path, tmp_path: Path, command: str
) -> None:
    (results / "runs" / hostile_run(results) / "run.json").write_bytes(b"")
    arguments = {
        "export": ("runs", "export", tmp_path / "all.csv", "--results", results),
        "report": ("report", results, "-o", tmp_path),
        "compare": ("report", "compare", results, results, "-o", tmp_path),
    }
    code, _, err = cli(*arguments[command])
    assert code == 0
    assert "warning: 1 runs cannot be read and are left out" in err


def test_half_characters_of_the_command_line_end_in_one_line(cli, results: Path) -> None:
    code, _, err = cli("run", "caf\udce9", "synthetic/walking_xyz", "--results", results)
    assert code == 1
    assert "caf\\udce9" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("suffix", ["csv", "CSV", "parquet"])
def test_all_runs_are_written_as_one_table(cli, stored: Path, tmp_path: Path, suffix: str) -> None:
    target = tmp_path / f"runs.{suffix}"
    frame = RunStore(stored).frame()
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
    assert cli("runs", "export", target, "--results", stored) == (0, f"{target}\n", "")
    read = pd.read_csv(target) if suffix != "parquet" else pd.read_parquet(target)
    assert list(read.columns) == list(frame.columns)
    assert read["ate_rmse_m"].tolist() == frame["ate_rmse_m"].tolist()
    assert suffix != "parquet" or read.dtypes.equals(frame.dtypes)


@pytest.mark.parametrize(
    "word", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", "=HYPERLINK('http://x')"]
)
def test_no_cell_of_an_exported_table_is_a_formula(
    cli, results: Path, tmp_path: Path, word: str
) -> None:
    """Words of anybody's program and folder stand in the table that is opened in a spreadsheet."""
    path = results / "runs" / hostile_run(results) / "run.json"
    record = json.loads(path.read_text())
    record |= {"reason": word, "status": "crashed", "overrides": {word: word}}
    record["tracker"] |= {"id": word, "label": word}
    path.write_text(json.dumps(record))
    target = tmp_path / "runs.csv"
    assert cli("runs", "export", target, "--results", results)[0] == 0
    cells = [cell for row in csv.reader(target.read_text().splitlines()) for cell in row]
    shown = [cell for cell in cells if "'" + printable(word) == cell]
    assert len(shown) >= 3, "tracker, label and reason"
    assert not any(cell.startswith(("=", "+", "@", "\t", "\r")) for cell in cells)
    numbers = [cell for cell in cells if cell.startswith("-")]
    assert all(re.fullmatch(r"-[\d.e+-]+", cell) for cell in numbers)


def test_a_table_without_pyarrow_or_of_another_kind_is_one_line(
    cli, stored: Path, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for name, words in (("runs.parquet", "[parquet]"), ("runs.xlsx", ".csv or .parquet")):
        code, _, err = cli("runs", "export", tmp_path / name, "--results", stored)
        assert code == 1
        assert words in err
        assert err.count("\n") == 1
        assert not (tmp_path / name).exists()
