"""The command line: exit codes, one-line errors, JSON, quiet pipes; a verb does what its function does."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import toy_tracker
from helpers.cli_program import PROGRAM, one_line
from helpers.envs_toys import write_sequence
from helpers.evaluation_walks import noisy
from helpers.evaluation_walks import walk as random_walk

import dynslam_bench as db
from dynslam_bench.cli.app import expand_lists
from dynslam_bench.core.errors import RunError, SettingsError
from dynslam_bench.core.stage_cache import StageCache
from dynslam_bench.evaluation import evaluate_files
from dynslam_bench.geometry import Trajectory, read_tum, se3, write_kitti, write_tum
from dynslam_bench.geometry.se3 import inverse
from dynslam_bench.sequences import open_sequence
from dynslam_bench.sequences.synthetic import SYNTHETIC_IDS, open_synthetic
from dynslam_bench.testing import TurningSequence

ROOT = Path(__file__).resolve().parents[2]


def commands(command=PROGRAM, words=()):
    """Every command and group of the program, with the words that lead to it."""
    yield words, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, (*words, name))


@pytest.mark.parametrize("words", [words for words, _ in commands()], ids=" ".join)
def test_the_help_of_every_command_fits_one_screen(cli, monkeypatch, words):
    monkeypatch.setenv("COLUMNS", "100")
    code, out, _ = cli(*words, "--help")
    assert code == 0
    assert "Usage: dynslam-bench" in out
    assert len(out.strip().splitlines()) <= 45


def test_version(cli):
    assert cli("--version") == (0, f"dynslam-bench {db.__version__}\n", "")


def test_usage_errors_exit_with_2(cli):
    limits = [["run", "never-move", "x", "--memory-limit", argument] for argument in ("abc", "-1")]
    for arguments in (
        ["nonsense"],
        ["run"],
        ["run", "orb-slam2", "x", "--jobs", "0"],
        ["sequences", "info"],
        *limits,
    ):
        code, _, err = cli(*arguments)
        assert code == 2
        assert "Traceback" not in err


RENDERED = "synthetic/sitting_xyz?frames=3"
BAD_OPTIONS = {
    "--frames 2:2": "2:2", "--degrade blur=-1": "blur", "--degrade blur=nan": "blur", "--degrade blur=x": "blur",
    "--degrade blurr=1": "blurr", "--camera tum-fr9": "camera", "--device gpu": "gpu", "--time-limit -1": "time",
    "--retry craashed": "craashed", "--map none.npz": "backend.map.file", "--frames 0:1": "1 frames",
}  # fmt: skip
BAD_FILES = {
    "nested.toml": "features.count",
    "table.toml": "features.nothing",
    "broken.toml": "not valid TOML",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "orb-slam", "synthetic/walking_xyz"], "unknown tracker 'orb-slam' (did you mean"),
        (["run", "never-move", "tum/fr3/walkin_xyz"], "did you mean 'tum/fr3/walking_xyz'"),
        (["run", "never-move", "tum/fr3/walking_xyz"], "sequences fetch tum/fr3/walking_xyz"),
        (
            ["run", "orb-slam2", "synthetic/walking_xyz", "--set", "features.nonsense=3"],
            "unknown setting",
        ),
        (
            ["run", "orb-slam2", "synthetic/walking_xyz", "--set", "features"],
            "is not an assignment",
        ),
        (
            ["run", "orb-slam2", "synthetic/walking_xyz", "--settings", "none.toml"],
            "cannot read none.toml",
        ),
        (["run", "orb-slam2", RENDERED, "--localisation-only"], "needs a map"),
        (["run", "replay:none.txt", RENDERED], "none.txt"),
        (["run", "orb-slam2", "synthetic/walking_xyz", "--preset", "fast"], "has no preset 'fast'"),
        (["run", "orb-slam2", "synthetic/walking_xyz", "--frames", "9"], "is no range of frames"),
        (["run", "orb-slam2", "synthetic/walking_xyz", "--protocol", "tum"], "tum-rgbd/v1"),
        (["bench", "smoky"], "did you mean 'smoke'"),
        (["eval", "a.txt", "b.txt"], "cannot read a.txt"),
        (["sequences", "fetch", "bonn/crowdy"], "did you mean 'bonn/crowd'"),
        (["sequences", "fetch", "bonn/x*"], "no public sequence matches 'bonn/x*'"),
        (["sequences", "info", "bonn/crowdy"], "did you mean"),
        (["trackers", "info", "orb"], "unknown tracker 'orb'"),
        (["trackers", "test", "./none.py:SPEC"], "no file"),
        (["report"], "there are no runs in"),
        (["runs", "show", "abc"], "there are no runs in"),
        (["runs", "rm"], "no run was named"),
        (["report", "compare", "a", "b"], "a"),
        (["segmenter", "evaluate", "nonsense:"], "nonsense"),
        (["sequences", "list", "tum/fr9"], "no sequence matches 'tum/fr9' (did you mean"),
        (["sequences", "list", "--tag", "dynamic"], "no sequence has the tag 'dynamic'"),
        (["sequences", "list", "tum/fr3/wlking_xyz"], "did you mean 'tum/fr3/walking_xyz'"),
        (["runs", "rm", "--failed", "--results", "nowhere"], "there are no runs in"),
        (["runs", "list", "--results", "nowhere"], "there are no runs in"),
        (["runs", "list", "--status", "crashd", "--results", "nowhere"], "did you mean 'crashed'"),
        (["report", "compare", "nowhere", "nowhere"], "nowhere"),
        (["bench", "smoke", "--tracker", "orb-slm2"], "did you mean 'orb-slam2'"),
        *[
            (["run", "never-move", RENDERED, *options.split()], word)
            for options, word in BAD_OPTIONS.items()
        ],
        *[
            (["run", "orb-slam2", RENDERED, "--settings", name], word)
            for name, word in BAD_FILES.items()
        ],
    ],
)
def test_user_errors_are_one_line_and_exit_with_1(cli, tmp_path, arguments, words):
    (tmp_path / "nested.toml").write_text("[features]\ncount = 1\n")
    (tmp_path / "table.toml").write_text(
        "tracker = 'orb-slam2'\n[settings]\n'features.nothing' = 1\n"
    )
    (tmp_path / "broken.toml").write_text("a = \n")
    code, out, err = cli(*arguments)
    assert code == 1
    assert out == ""
    assert words in one_line(err)
    assert not list(tmp_path.glob("results/runs/*"))


def test_sequences_list(cli, facts):
    listed = [row["id"] for row in facts("sequences", "list", "tum/fr3/walking*")]
    assert "tum/fr3/walking_xyz" in listed
    assert all(name.startswith("tum/fr3/walking") for name in listed)
    whole, starred = (cli("sequences", "list", pattern) for pattern in ("tum/fr3", "tum/fr3/*"))
    assert whole == starred, "a folder's name stands for its sequences"
    assert whole[0] == 0, "a folder's name stands for its sequences"
    assert sorted(row["id"] for row in facts("sequences", "list", "--here")) == sorted(
        SYNTHETIC_IDS
    )
    code, out, _ = cli("sequences", "list", "bonn/*", "--tag", "low-dynamic", "--here")
    assert code == 0, "no table without a match"
    assert len(out.splitlines()) == 1, "no table without a match"


def test_sequences_info(facts, walk):
    found = facts("sequences", "info", "tum/fr1/360_validation")
    assert found["ground_truth"] == "not public"
    assert found["here"] is False
    assert found["url"].endswith("360_validation.tgz")
    found = facts("sequences", "info", walk)
    assert found["frames"] == 4
    assert found["ground_truth_poses"] == 4


def test_sequences_verify(cli, facts, walk, tmp_path):
    assert cli("sequences", "verify", walk)[0] == 0
    copy = shutil.copytree(walk, tmp_path / "copy")
    last = sorted((copy / "rgb").iterdir())[-1]
    last.write_bytes(last.read_bytes()[:-30])
    assert cli("sequences", "verify", copy)[0] == 4
    (report,) = facts("sequences", "verify", copy, code=4)
    assert report["ok"] is False
    assert last.name in report["faults"][0]


@pytest.mark.slow
def test_a_faulty_recording_is_found_by_the_doctor_and_named_after_a_bad_run(cli, facts, tmp_path):
    scene = TurningSequence(34)
    sound = write_sequence(tmp_path / "sound", scene)
    scene.ground_truth = Trajectory(scene.timestamps, inverse(scene.ground_truth.T_world_cam))
    faulty = write_sequence(tmp_path / "faulty", scene)
    found = facts("sequences", "doctor", faulty, code=4)
    findings = found["findings"]
    assert "truth-inverted" in {finding["id"] for finding in findings}
    assert found["verdict"] == "1 fault: not ready"
    code, out, _ = cli("sequences", "doctor", sound)
    assert code == 0
    assert out.endswith(": ready\n")
    _, _, err = cli("run", "constant-velocity", faulty)
    assert f"sequences doctor {faulty}" in err
    assert findings[0]["text"] in err
    assert "sequences doctor" not in cli("run", "constant-velocity", sound)[2]


@pytest.mark.slow
def test_sequences_render(cli, tmp_path):
    name = "synthetic/sitting_static?scene=1&frames=2"
    code, out, _ = cli("sequences", "render", name, "--data-root", tmp_path / "data")
    assert code == 0
    assert Path(out.strip()).is_relative_to(tmp_path / "data")
    assert len(open_sequence(name, data_root=tmp_path / "data")) == 2


@pytest.mark.slow
def test_run_show_report_compare_and_remove(cli, facts, walk, tmp_path):
    """One store through its life."""
    code, out, _ = cli("run", "never-move", walk, "--seed", "0", "1", "--frames", "0:3")
    shown = [re.split(r"\s{2,}", line) for line in out.splitlines()]
    for row, seed in zip(shown[1:3], ("seed 0", "seed 1"), strict=True):
        assert {"ok", "0:3", seed} <= set(row)
    remark = "warning: never-move on .* and 1 more run: little-truth: only 3 poses have ground truth: the alignment .*"
    assert re.fullmatch(remark, "".join(shown[3]))
    assert len(shown) == 4
    runs = facts("runs", "list")
    assert [(run["tracker"], run["seed"], run["coverage"]) for run in runs] == [
        ("never-move", 0, 1.0),
        ("never-move", 1, 1.0),
    ]
    stored = sorted(path.stat().st_mtime_ns for path in tmp_path.glob("results/runs/*/run.json"))
    # nothing is made again
    assert cli("run", "never-move", walk, "--seed", "0", "1", "--frames", ":3")[0] == 0
    assert stored == sorted(
        path.stat().st_mtime_ns for path in tmp_path.glob("results/runs/*/run.json")
    )
    assert cli("runs", "show", runs[0]["run_id"][:8])[0] == 0
    shown = facts("runs", "show", "latest")
    assert shown["record"]["status"] == "ok"
    assert shown["metrics"]["online"]["metrics"]["ate_rmse_m"] > 0
    code, out, _ = cli("report", "results", "-o", "page")
    assert code == 0
    assert out.strip().endswith("page/index.html")
    assert Path("page/index.html").is_file()
    assert facts("report")["html"].endswith("results/report/index.html")
    assert cli("report", "compare", "results", "page")[0] == 0
    code, out, _ = cli("runs", "rm", *[run["run_id"] for run in runs])
    assert code == 0
    assert out.split() == [run["run_id"] for run in runs]
    assert facts("runs", "list") == []


def test_eval_and_protocols(cli, facts, walk, tmp_path):
    truth = walk / "groundtruth.txt"
    code, out, _ = cli("eval", truth, truth)
    assert code == 0
    assert out.startswith(
        "ATE (rmse) 0.000 mm over 4 poses, 100.0 % of the truth's time [tum-rgbd/v1"
    )
    found = facts("eval", truth, truth, "--protocol", "evo-default")
    assert found["protocol_id"] == "evo-default"
    assert found["metrics"]["ate_rmse_m"] < 1e-9
    code, out, _ = cli("protocols", "list")
    assert code == 0
    assert "kitti" in out


def test_kitti_trajectories_with_their_stamps(cli, facts, walk, tmp_path):
    truth = walk / "groundtruth.txt"
    write_kitti(tmp_path / "kitti.txt", read_tum(truth))
    assert (
        facts("eval", tmp_path / "kitti.txt", truth, "--timestamps", truth)["metrics"]["ate_rmse_m"]
        < 1e-6
    )
    options = ("--tracker", "theirs", "--sequence", walk, "--timestamps", truth)
    assert facts("import", tmp_path / "kitti.txt", *options)[0]["ate_rmse_m"] < 1e-6
    code, _, err = cli("eval", tmp_path / "kitti.txt", truth)
    assert code == 1
    assert "--timestamps FILE" in one_line(err)


def test_doctor(facts):
    assert {"program", "weights", "folder", "device"} <= {row["part"] for row in facts("doctor")}


def test_envs(facts):
    assert {"dynslam/Sequence-v0", "dynslam/bonn-crowd-v0"} <= set(facts("envs"))


def test_cache(cli, facts, monkeypatch, tmp_path):
    monkeypatch.setenv("DYNSLAM_BENCH_CACHE", str(tmp_path / "stages"))
    monkeypatch.setenv("DYNSLAM_BENCH_DATA", str(tmp_path / "data"))
    StageCache().put("masks", "ab" * 16, {"a": np.zeros(10)}, 0.5)
    current = open_synthetic("synthetic/walking_xyz?scene=3", tmp_path / "data").store.folder
    files = {
        "kernels_bytes": tmp_path / "stages/kernels/one.kernel",
        "renderings_bytes": current / "rgb/1.png",
        "other_renderings_bytes": current.with_name("walking_xyz@3-00000000") / "rgb/1.png",
    }
    for file in files.values():
        file.parent.mkdir(parents=True)
        file.write_bytes(b"1111")
    for entries in ({"masks": 1}, {}):
        usage = facts("cache", "info")
        assert usage["entries_by_stage"] == entries
        assert (usage["bytes"] > 0) == bool(entries)
        assert [usage[name] for name in files] == ([4, 4, 4] if entries else [0, 4, 0])
        assert cli("cache", "clear", "--yes")[0] == 0


@pytest.mark.slow
def test_a_scheduler_that_is_not_there_is_one_line(cli, walk, tmp_path):
    (tmp_path / "mine.toml").write_text(
        f"trackers = ['never-move', 'constant-velocity']\nsequences = ['{walk}']\n"
    )
    code, _, err = cli("bench", "mine.toml", "--scheduler", "tcp://127.0.0.1:9")
    assert code == 1
    assert "distributed" in err or "no Dask scheduler answers" in err


@pytest.mark.slow
def test_audit_of_the_paper(cli, facts, tmp_path):
    findings = facts("report", "audit-paper")
    assert findings
    assert {"check", "printed", "expected", "holds"} <= set(findings[0])
    assert cli("report", "audit-paper", "-o", "audit.md")[0] == 0
    assert (tmp_path / "audit.md").is_file()


def test_help_all_shows_every_option(cli):
    short = cli("run", "--help")[1]
    whole = cli("run", "--help-all")[1]
    (run,) = [command for words, command in commands() if words == ("run",)]
    options = {name for parameter in run.params for name in parameter.opts if name.startswith("--")}
    assert [name for name in options if name not in whole] == []
    assert "--realtime" not in short


STUDY = f"""
name = "tiny"
tracker = "{toy_tracker.__file__}:SPEC"
tune = ["1"]
confirm = ["2"]
held_out = ["3"]
seeds = [0]
offsets = [0]
trials = 2
top = 1
[space]
include = ["gain"]
"""


@pytest.mark.slow
def test_a_study(cli, facts, tmp_path):
    for name in (1, 2, 3):
        toy_tracker.make_sequence(tmp_path / str(name), name)
    Path("study.toml").write_text(STUDY)
    plan = facts("tune", "space", "study.toml")
    (parameter,) = plan["settings"]
    assert parameter["name"] == "gain"
    assert plan["preview"]["needed"] > 2
    assert "there is no study 'tiny'" in one_line(cli("tune", "best", "study.toml")[2])
    found = facts("tune", "run", "study.toml")
    assert Path(found["page"]).is_file()
    assert found["summary"]["trials"]["complete"] == 2
    assert facts("tune", "status", "study.toml")["complete"] == 2
    assert "has its 2 trials" in cli("tune", "worker", "study.toml")[1]
    more = facts("tune", "extend", "study.toml", "--trials", "1")
    assert (
        more["summary"]["trials"]["complete"]
        == 3
        == facts("tune", "status", "study.toml")["complete"]
    )
    assert "not judged" in cli("tune", "best", "study.toml", "--trial", "0")[1]
    assert cli("tune", "best", "study.toml", "-o", "preset.toml")[0] == 0
    assert (
        facts("run", f"{toy_tracker.__file__}:SPEC", "1", "--settings", "preset.toml")[0]["status"]
        == "ok"
    )
    assert facts("tune", "status", "study.toml")["conclusion"] == more["summary"]["conclusion"]
    Path("study.toml").write_text(STUDY.replace("gain", "gian"))
    assert "did you mean 'gain'" in one_line(cli("tune", "space", "study.toml")[2])


@pytest.mark.parametrize(
    ("line", "expanded"),
    [
        ("run --seed 0 1 2 x", "run --seed 0 --seed 1 --seed 2 x"),
        ("--seed 4 5 --offset 0 2", "--seed 4 --seed 5 --offset 0 --offset 2"),
        ("--seed 4 --jobs 2 7", "--seed 4 --jobs 2 7"),
        ("a --seed 1 --seed 2 3", "a --seed 1 --seed 2 --seed 3"),
    ],
)
def test_seed_lists(line, expanded):
    assert expand_lists(line.split()) == expanded.split()


HEAVY = ("torch", "cv2", "numpy", "scipy", "pandas", "optuna", "gymnasium", "numba", "gtsam")


@pytest.mark.slow
def test_help_loads_nothing_heavy():
    code = (
        "import sys\nfrom dynslam_bench.cli.app import start\n"
        "for words in ([], ['run'], ['report']):\n    try: start([*words, '--help'])\n    except SystemExit: pass\n"
        f"sys.stderr.write(' '.join(m for m in {HEAVY!r} if m in sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stderr == ""
    assert done.stdout.count("Usage: dynslam-bench") == 3


@pytest.mark.slow
def test_output_to_a_closed_pipe_is_no_error():
    done = subprocess.run(
        ["bash", "-c", f"{sys.executable} -m dynslam_bench sequences list | head -1"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=True,
    )
    assert done.stderr == "", "the first data set"
    assert done.stdout.startswith("7-Scenes"), "the first data set"


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device without space")
def test_output_to_a_full_device_is_one_line():
    command = [sys.executable, "-m", "dynslam_bench", "sequences", "list"]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT, check=False
        )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1


# `eval` takes every format that it names.


@pytest.fixture
def pair(tmp_path):
    """An estimate and its ground truth, which lie in ``estimate.txt`` and ``truth.txt``, too."""
    truth = random_walk(n=90)
    write_tum(tmp_path / "truth.txt", truth)
    write_tum(tmp_path / "estimate.txt", noisy(truth))


def test_hints_are_shown_of_files_runs_and_boards(cli, tmp_path):
    sequence = "synthetic/walking_rpy?frames=60"
    truth = open_sequence(sequence).ground_truth
    noise = se3.exp(np.random.default_rng(0).normal(0, 1e-3, (60, 6)))
    write_tum(tmp_path / "truth.txt", truth)
    write_tum(
        tmp_path / "inverted.txt",
        Trajectory(truth.timestamps, se3.inverse(truth.T_world_cam @ noise)),
    )
    files = tmp_path / "inverted.txt", tmp_path / "truth.txt"
    code, out, err = cli("eval", *files)
    assert code == 0, err
    assert "hint: inverted-poses: " in out, err
    code, out, err = cli("eval", *files, "--json")
    assert [hint["id"] for hint in json.loads(out)["hints"]] == ["inverted-poses"]
    assert json.loads(out)["metrics"] == pytest.approx(evaluate_files(*files).metrics)
    results = "--results", tmp_path / "results"
    code, _, err = cli("import", files[0], "--tracker", "theirs", "--sequence", sequence, *results)
    assert code == 0, err
    assert "hint: inverted-poses: " in cli("runs", "show", *results)[1]
    code, _, err = cli("report", tmp_path / "results", "-o", tmp_path / "report")
    assert code == 0, err
    text = (tmp_path / "report" / "report.md").read_text()
    assert "‡" in text
    assert "inverted-poses 1" in text


def test_a_protocol_for_some_sequences_says_so(cli, pair):
    code, out, _ = cli("eval", "estimate.txt", "truth.txt", "--protocol", "droid-w/v1-bonn")
    assert code == 0
    assert "droid-w/v1-bonn means something for bonn/* only" in out


def test_the_protocol_of_a_published_number_is_marked(cli, facts, pair):
    command = ("protocols", "compare", "estimate.txt", "truth.txt")
    rows = {row["label"]: row["rmse_m"] for row in facts(*command)}
    printed = f"{rows['evo_ape -as']:.9f}"
    code, out, _ = cli(*command, "--published", printed)
    marked = [line for line in out.splitlines() if " agrees " in line]
    assert code == 0
    assert any(line.startswith("ATE     evo_ape -as") for line in marked)
    assert all(
        row["agrees"] == (f"{row['rmse_m']:.9f}" == printed)
        for row in facts(*command, "--published", printed)
    )
    code, out, _ = cli(*command, "--published", "77")
    assert code == 0
    assert "No row agrees with 77 m; the nearest is" in out.splitlines()[-1]
    code, _, err = cli(*command, "--published", "7cm")
    assert code == 1
    assert "as it was printed" in one_line(err)


# The public interface for Python: lazy, typed names, each with the result of its command.


@pytest.mark.slow
def test_a_suite_its_report_and_its_frame(walk: Path, tmp_path: Path) -> None:
    suite = tmp_path / "mine.toml"
    suite.write_text(f"trackers = ['never-move', 'constant-velocity']\nsequences = ['{walk}']\n")
    results = tmp_path / "results"
    runs = db.bench(suite, results=results)
    assert [run.status for run in runs] == ["ok", "ok"]
    assert all(run.metrics["ate_rmse_m"] > 0 for run in runs)
    assert len(runs[0].trajectory) == len(runs[0].frames()) == 4
    assert (runs[0].folder / "run.json").is_file()
    assert db.run("never-move", walk, results=results).record.run_id == runs[0].record.run_id, (
        "it is stored already"
    )
    assert sorted(db.load(results)["tracker"]) == ["constant-velocity", "never-move"]
    assert db.report(results).html == results / "report" / "index.html"


def test_unfit_options_are_errors_of_the_user(walk: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="colour"):
        db.run("never-move", walk, results=tmp_path, colour=1)
    with pytest.raises(SettingsError, match="no preset 'slow'"):
        db.run("orb-slam2", walk, results=tmp_path, preset="slow")
    assert not list(tmp_path.glob("runs/*"))


def test_names_are_listed_and_loaded_on_first_use() -> None:
    assert set(dir(db)) == {
        "bench",
        "gate",
        "load",
        "report",
        "run",
        "sequence",
        "trackers",
        "tune",
        "__version__",
    }
    with pytest.raises(AttributeError, match="nothing"):
        _ = db.nothing
