"""Trajectory files at every entrance: units of stamps, headings, lost digits, warnings and hints."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.cli_program import one_line
from helpers.envs_toys import ToySequence, write_folder, write_sequence
from helpers.evaluation_walks import followed, lap, noisy, rows_of, scaled, walk

from dynslam_bench.geometry import Trajectory, se3, write_tum
from dynslam_bench.runs.exchange.formats import write_bag, write_pose_table

UNIX = 1305031102.175304
TRUTH = lap()
ESTIMATE = followed(TRUTH)
DIGITS = {"s": 0, "ms": 3, "us": 6, "ns": 9}


def stamps(unit, start=0.0):
    """The stamps of the lap as a file has them in a unit."""
    ns = np.round((start + TRUTH.timestamps) * 1e9).astype(np.int64).tolist()
    return [f"{stamp / 10 ** (9 - DIGITS[unit]):.6f}" for stamp in ns]


@pytest.fixture
def files(tmp_path):
    """Writes estimate and truth with stamps of a unit, each below a heading; returns their paths."""

    def write(unit, start=0.0, heading="", true_unit=None, true_start=None):
        true_stamps = stamps(true_unit or unit, start if true_start is None else true_start)
        (tmp_path / "estimate.txt").write_text(heading + rows_of(ESTIMATE, stamps(unit, start)))
        (tmp_path / "truth.txt").write_text(
            (heading if true_unit is None else "") + rows_of(TRUTH, true_stamps)
        )
        return tmp_path / "estimate.txt", tmp_path / "truth.txt"

    return write


@pytest.fixture
def right(files, facts):
    """The metrics of the same trajectories in seconds."""
    return facts("eval", *files("s"))["metrics"]


@pytest.mark.parametrize(
    ("unit", "start"), [("us", 0.0), ("ns", 0.0), ("ms", UNIX), ("us", UNIX), ("ns", UNIX)]
)
def test_units_are_named_and_every_error_is_that_of_seconds(cli, facts, files, right, unit, start):
    pair = files(unit, start)
    found = facts("eval", *pair)["metrics"]
    assert found == pytest.approx(right, rel=1e-4, abs=1e-6)
    code, out, _ = cli("eval", *pair)
    assert code == 0
    for whose in ("estimate", "ground truth"):
        assert re.search(
            rf"{whose}: stamps are [0-9.]+ apart by the median: taken as \w+seconds \(30 Hz\)", out
        )


@pytest.mark.parametrize(("unit", "true_unit"), [("ns", "s"), ("ms", "ns"), ("s", "us")])
def test_each_file_has_a_unit_of_its_own(facts, files, right, unit, true_unit):
    pair = files(unit, UNIX, true_unit=true_unit)
    assert facts("eval", *pair)["metrics"]["ate_rmse_m"] == pytest.approx(
        right["ate_rmse_m"], rel=1e-3
    )


@pytest.mark.parametrize("command", ["eval", "protocols compare", "import"])
def test_where_the_unit_is_not_told_both_readings_are_and_the_cure_works(
    cli, facts, files, right, command
):
    def words(pair):
        if command == "import":
            return ["import", pair[0], "--tracker", "x", "--sequence", "mine", "--truth", pair[1]]
        return [*command.split(), *pair]

    code, out, err = cli(*words(files("ms")))
    assert (code, out) == (1, "")
    assert (
        "33.3333 apart by the median: milliseconds (30 Hz) or seconds (one pose in 33.3 s)?"
        in one_line(err)
    )
    heading = re.search("'(# timestamp .*)'", err)[1] + "\n"
    found = facts(*words(files("ms", heading=heading)))
    ate = found["metrics"]["ate_rmse_m"] if command == "eval" else found[0].get("ate_rmse_m")
    assert ate is None or ate == pytest.approx(right["ate_rmse_m"], rel=1e-4)


@pytest.mark.parametrize("unit", ["us", "ns"])
def test_import_takes_truths_in_any_unit(facts, files, right, unit):
    estimate, truth = files(unit)
    (row,) = facts("import", estimate, "--tracker", "x", "--sequence", "mine", "--truth", truth)
    assert row["ate_rmse_m"] == pytest.approx(right["ate_rmse_m"], rel=1e-4)
    notes = facts("runs", "show")["record"]["notes"]
    assert sum("apart by the median: taken as" in note for note in notes) == 2


def test_import_takes_a_truth_in_the_formats_of_eval(cli, facts, files, right, tmp_path):
    estimate, _ = files("s", UNIX)
    write_pose_table(tmp_path, "euroc", Trajectory(UNIX + TRUTH.timestamps, TRUTH.T_world_cam))
    words = "--tracker", "x", "--sequence", "mine", "--truth", tmp_path / "data.csv"
    assert facts("import", estimate, *words)[0]["ate_rmse_m"] == pytest.approx(
        right["ate_rmse_m"], rel=1e-3
    )


@pytest.mark.parametrize("form", ["{:g}", "{:.6e}"])
def test_lost_digits_are_told_wherever_the_file_is_read(cli, files, tmp_path, form):
    pair = files("s", UNIX)
    pair[0].write_text(
        rows_of(ESTIMATE, [form.format(UNIX + stamp) for stamp in TRUTH.timestamps.tolist()])
    )
    folder = write_folder(tmp_path / "toy", 6)
    for words in (
        ["eval", *pair],
        ["protocols", "compare", *pair],
        ["import", pair[0], "--tracker", "x", "--sequence", "mine", "--truth", pair[1]],
        ["import", pair[1], "--tracker", "x", "--sequence", "mine", "--truth", pair[0]],
        ["run", f"replay:{pair[0]}", folder],
    ):
        code, _, err = cli(*words)
        assert code == 1
        assert "149 of 150 lines of" in one_line(err)
        assert "digits were lost" in err


# -- warnings and hints, wherever an error is shown


@pytest.mark.parametrize(
    ("change", "remark"),
    [
        (
            lambda truth: truth.select(np.array([0, 7, 29])),
            "warning: .*little-truth: only 3 of 30 poses",
        ),
        (
            lambda truth: _far(truth),
            "warning: .*far-positions: 2 of 29 steps of the ground truth are faster",
        ),
        (
            lambda truth: Trajectory(np.arange(30) + 0.25, truth.T_world_cam),
            "ground truth within 0.02 s",
        ),
    ],
    ids=["3 of 30 frames", "1e9 m away", "another clock"],
)
def test_a_run_and_the_list_of_runs_tell_what_a_run_shows(cli, facts, tmp_path, change, remark):
    scene = ToySequence(30)
    scene.ground_truth = change(scene.ground_truth)
    folder = write_sequence(tmp_path / "toy", scene)
    for words in (["run", "never-move", folder], ["runs", "list"], ["runs", "show"]):
        code, out, _ = cli(*words)
        assert code == 0
        assert re.search(remark, out), (words, out)


def _far(truth):
    poses = truth.T_world_cam.copy()
    poses[7, 0, 3] = 1e9
    return truth.with_poses(poses)


@pytest.mark.parametrize(
    ("change", "remark"),
    [
        (lambda estimate: scaled(estimate, 1000), "hint: .*scale: .*millimetres"),
        (lambda estimate: scaled(estimate, 1.4), "hint: .*scale: .*with the factor 0.7"),
        (
            lambda estimate: scaled(estimate, 0.01),
            "warning: .*static-camera: the error of .* % of a static camera's",
        ),
        (
            lambda estimate: estimate.select(slice(0, 40, 20)),
            "warning: .*little-truth: only 2 poses",
        ),
    ],
    ids=["millimetres", "a scale factor", "nearly static", "two poses"],
)
def test_files_are_scored_with_the_same_lines_at_every_entrance(cli, tmp_path, change, remark):
    write_tum(tmp_path / "estimate.txt", change(ESTIMATE))
    write_tum(tmp_path / "truth.txt", TRUTH)
    pair = Path("estimate.txt"), Path("truth.txt")
    imported = ["import", pair[0], "--tracker", "x", "--sequence", "mine", "--truth", pair[1]]
    for words in (
        ["eval", *pair],
        ["protocols", "compare", *pair],
        imported,
        ["runs", "list"],
        ["runs", "show"],
    ):
        code, out, _ = cli(*words)
        # an import of poses for less than half of the time is that of a lost camera
        assert code == (3 if words is imported and len(change(ESTIMATE)) == 2 else 0)
        assert re.search(remark, out), (words, out)


@pytest.mark.slow
def test_many_remarks_are_cut_and_equal_ones_are_said_once(cli, facts, tmp_path):
    write_tum(tmp_path / "truth.txt", TRUTH)
    for number in range(13):
        write_tum(tmp_path / f"{number}.txt", scaled(ESTIMATE, 1.2 + 0.03 * max(number, 1)))
        options = "--tracker", f"t{number}", "--sequence", "mine", "--truth", "truth.txt"
        assert cli("import", f"{number}.txt", *options)[0] == 0
    lines = cli("runs", "list")[1].splitlines()
    remarks = [line for line in lines if line.startswith(("hint: ", "warning: "))]
    assert len(remarks) == 10
    assert remarks[0].startswith("hint: t0 on mine and 1 more run: scale: ")
    assert lines[-1] == "2 more such lines: `dynslam-bench runs show RUN` has those of a run."
    assert all(row["remarks"] for row in facts("runs", "list"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "topics", [["/estimate/pose", "/ground_truth/pose"], ["/ground_truth/pose"]]
)
def test_topics_of_bags_are_chosen_as_the_hint_says(cli, facts, tmp_path, topics):
    pytest.importorskip("rosbags")
    (tmp_path / "bag").mkdir()
    write_bag(tmp_path / "bag", {"estimate": ESTIMATE, "ground_truth": TRUTH})
    write_tum(tmp_path / "estimate.txt", ESTIMATE)
    pair = (
        (tmp_path / "bag", tmp_path / "bag")
        if len(topics) > 1
        else (tmp_path / "estimate.txt", tmp_path / "bag")
    )
    code, _, err = cli("eval", *pair)
    assert code == 1
    assert "choose one with --topic" in one_line(err)
    chosen = [word for topic in topics for word in ("--topic", topic)]
    assert 0.005 < facts("eval", *pair, *chosen)["metrics"]["ate_rmse_m"] < 0.02
    assert cli("protocols", "compare", *pair, *chosen)[0] == 0


def test_the_hints_of_conventions_can_be_followed(cli, tmp_path):
    """Each file is brought in order as its hint says; then there is none."""
    write_tum(tmp_path / "truth.txt", TRUTH)
    axes = np.diag([1.0, -1.0, -1.0, 1.0])
    faults = {
        "inverted-poses": se3.inverse(ESTIMATE.T_world_cam),
        "camera-axes": ESTIMATE.T_world_cam @ axes,
        "scale": scaled(ESTIMATE, 100).T_world_cam,
    }
    cures = {
        "inverted-poses": lambda poses: se3.inverse(poses),
        "camera-axes": lambda poses: poses @ axes,
        "scale": lambda poses: se3.from_matrix(poses[:, :3, 3] / 100, poses[:, :3, :3]),
    }
    for name, poses in faults.items():
        for given, hinted in ((poses, True), (cures[name](poses), False)):
            write_tum(tmp_path / "estimate.txt", ESTIMATE.with_poses(given))
            code, out, _ = cli("eval", "estimate.txt", "truth.txt")
            assert code == 0
            assert (f"hint: {name}: " in out) == hinted, (name, out)


# -- several estimates


def test_eval_takes_several_estimates_and_draws_them(cli, tmp_path):
    truth = walk(n=90)
    files = [tmp_path / name for name in ("first.txt", "second.txt", "truth.txt")]
    write_tum(files[0], noisy(truth))
    write_tum(files[1], noisy(truth, seed=2))
    write_tum(files[2], truth)
    code, out, err = cli("eval", *files, "--plot", tmp_path / "plot.png")
    assert code == 0, err
    assert (tmp_path / "plot.png").is_file()
    rows = [line.split() for line in out.splitlines() if line.startswith(("first", "second"))]
    assert [row[:2] for row in rows] == [["first.txt", "90"], ["second.txt", "90"]]

    code, out, err = cli("eval", *files, "--json")
    facts = json.loads(out)
    assert [fact["file"] for fact in facts] == [str(path) for path in files[:2]]
    alone = [json.loads(cli("eval", path, files[2], "--json")[1]) for path in files[:2]]
    assert [fact["metrics"] for fact in facts] == [fact["metrics"] for fact in alone]


def test_eval_of_one_estimate_shows_every_statistic(cli, tmp_path):
    truth = walk(n=90)
    write_tum(tmp_path / "first.txt", noisy(truth))
    write_tum(tmp_path / "truth.txt", truth)
    files = tmp_path / "first.txt", tmp_path / "truth.txt"
    metrics = json.loads(cli("eval", *files, "--json")[1])["metrics"]
    out = cli("eval", *files)[1]
    assert len(out.splitlines()) < 14
    numbers = set(out.split())
    # lengths in millimetres; JSON alone has sums of squares
    shown = {name: value for name, value in metrics.items() if "_sse_" not in name}
    scaled_by = {name: 1000 if name.endswith("_m") else 1 for name in shown}
    assert len(shown) > 30
    assert [
        name for name, value in shown.items() if f"{scaled_by[name] * value:.4g}" not in numbers
    ] == []
    assert "ate (mm)" in out


def test_a_table_of_trajectories_is_a_board_in_one_command(cli, tmp_path):
    """Partial trajectories keep their row, with how many sequences and how much of the time they are of."""
    # two recordings, the second one on a path of twice the size
    for name, size in (("a", 1.0), ("b", 2.0)):
        write_tum(tmp_path / f"truth_{name}.txt", scaled(TRUTH, size))
        write_tum(tmp_path / f"whole_{name}.txt", scaled(ESTIMATE, size))
    write_tum(tmp_path / "half_a.txt", ESTIMATE.select(slice(0, len(ESTIMATE) // 2)))
    entries = [
        ("whole", "a", "whole_a.txt"),
        ("whole", "b", "whole_b.txt"),
        ("also", "a", "whole_a.txt"),
        ("also", "b", "whole_b.txt"),
        ("half", "a", "half_a.txt"),
    ]
    table = [
        f'[[trajectory]]\ntracker = "{tracker}"\nsequence = "mine/{name}"\n'
        f'file = "{file}"\ntruth = "truth_{name}.txt"\n'
        for tracker, name, file in entries
    ]
    (tmp_path / "people.toml").write_text("\n".join(table))
    code, out, err = cli("report", "people.toml")
    assert code == 0, err
    assert "5 trajectories added" in err
    rows = [line for line in out.splitlines() if "imported)  " in line]
    lines = {name: next(row for row in rows if name in row) for name in ("whole", "half")}
    assert "2/2" in lines["whole"]
    assert "1 of 2" in lines["half"]
    # the frames are not known: in place of the coverage stands the share of the truth's time
    assert "50 % of the truth's time" in lines["half"]
    assert "100 % of the truth's time" in lines["whole"]
    records = [path.read_text() for path in (tmp_path / "people" / "runs").glob("*/run.json")]
    shares = [json.loads(record)["truth_share"] for record in records]
    assert sorted(shares) == pytest.approx([0.5, 1, 1, 1, 1], abs=0.01)
    assert {json.loads(record)["coverage"] for record in records} == {None}
