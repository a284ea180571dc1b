"""What a terminal shows: tables as wide as it is, no Markdown, a leaderboard, grouped help, completion."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from cli_helpers import one_line

from dynslam_bench.cli import output, runs
from dynslam_bench.cli.output import report_table, table
from dynslam_bench.reports.tables.table import Column, Table, TableCell
from dynslam_bench.runs import RunSpec, RunStore, run_many

ROWS = [
    ["run", "tracker", "sequence", "ATE (m)", "masks"],
    ["0123456789abcdef", "emfoa-oft", "synthetic/walking_halfsphere?scene=0&frames=600", "0.01234", "embedded"],
]


@pytest.mark.parametrize("width", [400, 100, 80, 60, 40, 20])
def test_a_table_is_no_wider_than_the_terminal(monkeypatch, width):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setattr(output, "_terminal_width", lambda: width)
    head, row, *left_out = table(ROWS[0], ROWS[1:]).splitlines()
    assert max(len(head), len(row)) <= width and row.startswith("012345")
    assert bool(left_out) == ("masks" not in head)
    if width == 400:
        assert [head.split("  ")[0], *row.split()] == ["run", *ROWS[1]]
    if width == 80:
        assert row.split()[2:] == ["synthetic/walkin…ne=0&frames=600", "0.01234", "embedded"] and not left_out
    if width == 40:
        assert left_out == ["(no room for: ATE (m), masks)"]


def test_numbers_are_never_shortened(monkeypatch):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setattr(output, "_terminal_width", lambda: 30)
    spread = "12.34 ±0.56, F skipped 98 %"
    assert table(["tracker", "ATE (mm)"], [["x" * 80, 1.5], ["y", 23.0]]).splitlines()[-1].split() == ["y", "23"]
    assert table(["ATE (mm)"], [[spread]]).splitlines()[1] == spread
    lines = table(["tracker", "ATE (mm)"], [["x" * 80, spread]]).splitlines()
    assert lines[1] == "x" * 15 + "…" + "x" * 14 and lines[2] == "(no room for: ATE (mm))"


def test_what_names_a_column_or_fills_a_cell_reaches_no_terminal_as_an_escape():
    lines = table(["tum/\x1b[2J", "\u202ea"], [["x\ny", "\x9b1m"], [1.5, True]]).splitlines()
    assert lines == [r"tum/\x1b[2J  \u202ea", r"x y          \x9b1m", "1.5          yes"]


def test_a_reports_table_has_no_markup():
    source = Table("t", "title", "caption", [Column("a_b"), Column("empty")], [[TableCell("x|y_*"), TableCell()]])
    assert report_table(source) == "a_b\nx|y_*"


def test_an_error_of_the_tracked_frames_alone_is_marked(capsys):
    for coverage in (0.5, 1.0):
        row = dict.fromkeys(runs.COLUMNS.values(), "x") | {"ate_rmse_m": 0.1, "coverage": coverage}
        row |= {"false_motion_max_m": None}
        runs.show_rows([row | {"static_camera_ate_rmse_m": 0.2}], None, "p")
        assert ("of the tracked frames alone" in capsys.readouterr().out) == (coverage < 1)


def test_no_motion_of_a_fixed_camera_is_shown_and_nothing_is_worse_than_it(capsys):
    numbers = {"static_camera_ate_rmse_m": 0.0, "coverage": 1.0, "from_store": False, "status": "ok"}
    for error in (0.0, 0.002):
        row = dict.fromkeys(runs.COLUMNS.values(), "") | numbers | {"ate_rmse_m": error, "false_motion_max_m": error}
        runs.show_rows([row], None, "p")
        out = capsys.readouterr().out.splitlines()
        assert len(out) == 2 and "ATE (m)" in out[0] and "false motion (m)" in out[0] and "from the store" not in out[0]


def test_report_prints_its_message_the_leaderboard_and_its_place(cli, walk, tmp_path):
    trackers = ("never-move", "constant-velocity")
    (tmp_path / "mine.toml").write_text(f"trackers = {list(trackers)}\nsequences = ['{walk}']\n")
    assert cli("bench", "mine.toml")[0] == 0
    code, out, _ = cli("report")
    lines = out.splitlines()
    assert code == 0 and lines[0] == "No tracker can be ranked." and len(lines) == 6
    assert lines[1].split()[:2] == ["#", "tracker"]
    assert lines[-2].startswith("Geometric mean of the ATE over that of")
    assert lines[-1].endswith("results/report/index.html")
    code, out, err = cli("report", "--reference", "orb-slam2")
    assert code == 1 and "there is no run of the reference 'orb-slam2'" in one_line(err)
    code, out, _ = cli("report", "compare", "results", "results")
    assert code == 0 and "\\_" not in out and "| tracker" not in out and "all 1 sequences" in out


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
    assert code == 0 and (expected <= found if expected else not found), out


def test_published_numbers_are_listed_with_whose_they_are(cli, facts):
    code, out, _ = cli("published", "rgbd_dataset_freiburg3_walking_xyz")
    lines = [" ".join(line.split()) for line in out.splitlines()]
    spans, errors = lines[: lines.index("")], lines[lines.index("") :]
    assert code == 0 and "NGD-SLAM SE(3) or not stated 3 15 34.6 2.31 15" in spans
    rows = [line for line in errors if line.startswith("NGD-SLAM")]
    assert "15 authors leaderboard page of arXiv 2405.07392 SE(3) or not stated 2024 Ryzen 7 4800H, no GPU" in rows[0]
    assert "34.6 third party re-run on a Jetson" in rows[2] and "not stated Jetson" in rows[2]
    shown = facts("published", "tum/fr3/walking_xyz", "--protocol", "droid-w/v1")
    values = [line["ate_rmse_m"] for line in shown["numbers"]]
    assert values == sorted(values) and {line["alignment"] for line in shown["numbers"]} == {"Sim(3)"}
    for arguments, text in (
        (["bonn/crowdd"], "did you mean 'bonn/crowd'"),
        (["bonn/crowd", "--protocol", "kitti"], "leave --protocol out"),
        (["bonn/crowd", "--protocol", "kiti"], "did you mean 'kitti'"),
    ):
        code, _, err = cli("published", *arguments)
        assert code == 1 and text in one_line(err)


# Terminals that cannot show every character: output with question marks, and no traceback.


LABEL = "caf\xe9 \u2013 \U0001f600"


def test_a_report_is_shown_on_a_terminal_that_lacks_characters(cli, walk: Path, tmp_path: Path) -> None:
    options = "--tracker", "theirs", "--label", LABEL, "--sequence", walk, "--online"
    assert cli("import", walk / "groundtruth.txt", *options)[0] == 0
    command = [sys.executable, "-m", "dynslam_bench", "report", "results", "-o", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, env=os.environ | {"PYTHONIOENCODING": "latin-1"})
    assert done.returncode == 0
    assert [line for line in done.stderr.splitlines() if not line.endswith(b"so far")] == []
    assert "caf" in done.stdout.decode("latin-1") and b"?" in done.stdout
    assert LABEL in (tmp_path / "report.md").read_text(encoding="utf-8")


# Records that somebody else made, on a terminal: no escape sequence, no traceback, and the others are shown.


HOSTILE = "\x1b[2J\x1b]0;owned\x07\u202egnp\n"


@pytest.fixture(scope="module")
def stored(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs, the latest of which holds escape sequences in all of its texts."""
    folder = tmp_path_factory.mktemp("results")
    specs = [RunSpec(tracker="never-move", sequence=str(walk), seed=seed) for seed in (0, 1)]
    _, last = run_many(specs, results=folder)
    path = folder / "runs" / last.run_id / "run.json"
    record = json.loads(path.read_text())
    record |= {"reason": HOSTILE, "notes": [HOSTILE], "command": [HOSTILE], "overrides": {HOSTILE: HOSTILE}}
    record["tracker"] |= {"id": HOSTILE, "label": HOSTILE}
    record["sequence"] |= {"id": HOSTILE}
    path.write_text(json.dumps(record))
    return folder


@pytest.fixture
def results(stored: Path, tmp_path: Path) -> Path:
    return shutil.copytree(stored, tmp_path / "results", symlinks=True)


def hostile_run(results: Path) -> str:
    return next(path.parent.name for path in results.glob("runs/*/run.json") if "owned" in path.read_text())


def harmless(text: str) -> bool:
    return not set(text) & {"\x1b", "\x07", "\u202e"}


@pytest.mark.parametrize("arguments", [("list",), ("show", "RUN"), ("list", "--json"), ("show", "RUN", "--json")])
def test_names_are_shown_as_text(cli, results: Path, arguments: tuple[str, ...]) -> None:
    run = hostile_run(results)
    code, out, err = cli("runs", *[run if word == "RUN" else word for word in arguments], "--results", results)
    assert code == 0 and harmless(out + err) and "owned" in out


def test_errors_are_shown_as_text(cli, results: Path) -> None:
    code, out, err = cli("runs", "show", HOSTILE, "--results", results)
    assert code == 1 and harmless(out + err) and err.startswith("error: there is no run")
    assert err.count("\n") == 1


def test_one_unreadable_record_is_named_and_the_others_are_listed(cli, results: Path) -> None:
    (results / "runs" / hostile_run(results) / "run.json").write_bytes(b"\xff\xfe")
    code, out, err = cli("runs", "list", "--results", results)
    assert code == 0 and "never-move" in out
    assert err.startswith("unreadable: ") and err.count("\n") == 1 and "is not a text file" in err


def test_half_characters_of_the_command_line_end_in_one_line(cli, results: Path) -> None:
    code, _, err = cli("run", "caf\udce9", "synthetic/walking_xyz", "--results", results)
    assert code == 1 and "caf\\udce9" in err and err.count("\n") == 1


@pytest.mark.parametrize("suffix", ["csv", "CSV", "parquet"])
def test_all_runs_are_written_as_one_table(cli, stored: Path, tmp_path: Path, suffix: str) -> None:
    target, frame = tmp_path / f"runs.{suffix}", RunStore(stored).frame()
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
    assert cli("runs", "export", target, "--results", stored) == (0, f"{target}\n", "")
    read = pd.read_csv(target) if suffix != "parquet" else pd.read_parquet(target)
    assert list(read.columns) == list(frame.columns) and read["ate_rmse_m"].tolist() == frame["ate_rmse_m"].tolist()
    assert suffix != "parquet" or read.dtypes.equals(frame.dtypes)


def test_a_table_without_pyarrow_or_of_another_kind_is_one_line(cli, stored: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for name, words in (("runs.parquet", "[parquet]"), ("runs.xlsx", ".csv or .parquet")):
        code, _, err = cli("runs", "export", tmp_path / name, "--results", stored)
        assert code == 1 and words in err and err.count("\n") == 1 and not (tmp_path / name).exists()
