"""What a terminal shows: tables as wide as it is, no Markdown, a leaderboard, grouped help, completion."""

import json

import pytest
from cli_errors import one_line

from dynslam_bench.cli import output
from dynslam_bench.cli import runs as run_rows
from dynslam_bench.cli.output import fitted, write_table
from dynslam_bench.reports.tables.table import Column, Table, TableCell

ROWS = [
    ["run", "tracker", "sequence", "ATE (m)", "masks"],
    ["0123456789abcdef", "emfoa-oft", "synthetic/walking_halfsphere?scene=0&frames=600", "0.01234", "embedded"],
]


@pytest.mark.parametrize("width", [400, 100, 80, 60, 40, 20])
def test_a_table_is_no_wider_than_the_terminal(width):
    cut, left_out = fitted(ROWS, ["sequence", "run"], ["masks"], width)
    assert all(sum(map(len, row)) + 2 * (len(row) - 1) <= width for row in cut)
    assert len(cut[0]) + len(left_out) == 5 and set(cut[0]) | set(left_out) >= {"run", "masks"} - set(left_out)
    if width == 400:
        assert (cut, left_out) == (ROWS, [])
    if width == 80:
        assert left_out == [] and cut[1][0] == "0123456789abcdef" and cut[1][2].endswith("…")
    if width == 40:
        assert left_out[0] == "masks" and cut[1][0].startswith("0123456")


def test_on_a_terminal_what_has_no_room_is_named(capsys, monkeypatch):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setattr(output, "_terminal_width", lambda: 40)
    write_table(ROWS[0], ROWS[1:], shrink=("sequence", "run"), spare=("masks",))
    lines = capsys.readouterr().out.replace("\033[1m", "").replace("\033[0m", "").splitlines()
    assert len(lines) == 3 and all(len(line) <= 40 for line in lines[:2])
    assert lines[2].startswith("(no room for: masks")


def test_what_names_a_column_or_fills_a_cell_reaches_no_terminal_as_an_escape(capsys):
    write_table(["tum/\x1b[2J", "\u202ea"], [["x\ny", "\x9b1m"], [1.5, True]])
    assert capsys.readouterr().out.splitlines() == [r"tum/\x1b[2J  \u202ea", r"x y          \x9b1m", "1.5          yes"]


def test_a_reports_table_has_no_markup(capsys):
    table = Table(
        "t", "A_title", "One | caption * of [it]. " * 9, [Column("a_b", numeric=False)], [[TableCell("x|y_*")]]
    )
    output.write_report_table(table)
    out = capsys.readouterr().out
    assert "\\" not in out and "x|y_*" in out and out.startswith("A_title\na_b\n")
    assert max(map(len, out.splitlines())) <= 120


def test_an_error_of_the_tracked_frames_alone_is_said_to_be_one(capsys):
    def shown(coverage):
        row = dict.fromkeys((*run_rows.TITLES, *run_rows.WHERE_SAID), "x") | {"ate_rmse_m": 0.1, "coverage": coverage}
        row |= {"static_camera_ate_rmse_m": 0.2}
        run_rows.show_rows([row], None, "p", as_json=False)
        return capsys.readouterr().out

    assert "of the tracked frames alone" in shown(0.5) and "tracked frames" not in shown(1.0)


def test_report_prints_five_lines_and_its_place(cli, walk, tmp_path):
    trackers = ("never-move", "constant-velocity")
    (tmp_path / "mine.toml").write_text(f"trackers = {list(trackers)}\nsequences = ['{walk}']\n")
    assert cli("bench", "mine.toml")[0] == 0
    code, out, _ = cli("report")
    lines = out.splitlines()
    assert code == 0 and lines[0].split()[:2] == ["#", "tracker"] and len(lines) == 5
    assert lines[-2].startswith("Geometric mean of the ATE over that of")
    assert lines[-1].endswith("results/report/index.html")
    code, out, err = cli("report", "--reference", "orb-slam2")
    assert code == 1 and "there is no run of the reference 'orb-slam2'" in one_line(err)
    code, out, _ = cli("report", "compare", "results", "results")
    assert code == 0 and "\\_" not in out and "| tracker" not in out and "all 1 sequences" in out


def test_help_is_grouped(cli):
    out = cli("--help")[1]
    places = [out.index(title) for title in ("Begin here", "Run and measure", "Report and tune", "Extend and care")]
    assert places == sorted(places) and "─ Commands" not in out
    out = cli("run", "--help")[1]
    assert all(title in out for title in ("Which frames", "The tracker's settings", "The machine", "What is kept"))


def test_sequences_are_listed_by_data_set_and_the_heading_holds_for_all_of_them(cli):
    listed = json.loads(cli("sequences", "list", "--json")[1])
    groups = {each["dataset"]: [] for each in listed}
    for each in listed:
        groups[each["dataset"]].append(each)
    out = cli("sequences", "list")[1]
    blocks = [block.splitlines() for block in out.strip().split("\n\n")]
    assert [len(block) - 2 for block in blocks] == [len(group) for group in groups.values()] and len(blocks) == 9
    for (heading, columns, *rows), (title, group) in zip(blocks, groups.items(), strict=True):
        assert len({(each["license"], each["layout"], each["by_hand"]) for each in group}) == 1, title
        assert heading.startswith(f"{title} ({len(group)} listed, ") and f"licence: {group[0]['license']}" in heading
        assert ("layout: " in heading) == (title != "rendered rooms with exact poses, masks and flow")
        assert [row.split()[0] for row in rows] == [each["id"] for each in group]
        assert columns.split()[:4] == ["sequence", "here", "size", "tags"] and all(each["size"] for each in group)
    static = cli("sequences", "list", "synthetic/*", "--tag", "static")[1]
    assert "synthetic/fast_spin" in static and "synthetic/fast_walking" not in static


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


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["sequences", "list", "--tag", "dynamic"], "no sequence has the tag 'dynamic' (known: "),
        (["sequences", "list", "tum/fr3/wlking_xyz"], "did you mean 'tum/fr3/walking_xyz'"),
        (["runs", "rm", "--failed", "--results", "nowhere"], "there are no runs in"),
        (["runs", "list", "--results", "nowhere"], "there are no runs in"),
        (["run", "replay:nowhere.txt", "synthetic/sitting_xyz?frames=3"], "nowhere.txt"),
        (["run", "never-move", "synthetic/sitting_xyz?frames=3", "--frames", "2:2"], "2:2"),
        (["run", "never-move", "synthetic/sitting_xyz?frames=3", "--degrade", "blur=-1"], "blur"),
        (["run", "never-move", "synthetic/sitting_xyz?frames=3", "--camera", "tum-fr9"], "camera"),
        (["run", "never-move", "synthetic/sitting_xyz?frames=3", "--device", "gpu"], "gpu"),
        (["run", "never-move", "synthetic/sitting_xyz?frames=3", "--time-limit", "-1"], "time"),
        (["run", "never-move", "synthetic/sitting_xyz?frames=3", "--retry", "craashed"], "craashed"),
        (["run", "never-move", "synthetic/sitting_xyz?frames=3", "--seed", "-1"], "seed"),
        (["run", "never-move", "synthetic/sitting_xyz?frames=3", "--degrade", "blur=nan"], "blur"),
        (["bench", "smoke", "--tracker", "orb-slm2"], "did you mean 'orb-slam2'"),
        (["report", "compare", "nowhere", "nowhere"], "nowhere"),
    ],
)
def test_wrong_input_is_refused_in_one_line(cli, tmp_path, arguments, words):
    code, out, err = cli(*arguments)
    assert code in (1, 2) and out == "" and words in err and "Traceback" not in err, err
    assert not (tmp_path / "results").exists() or not list((tmp_path / "results").glob("runs/*"))


def test_a_folder_without_a_camera_needs_one_named(cli, walk, tmp_path):
    import shutil

    copy = shutil.copytree(walk, tmp_path / "walk")
    (copy / "camera.toml").rename(tmp_path / "mine.toml")
    code, _, err = cli("sequences", "verify", copy)
    assert code == 1 and "is not known" in err and err.count("--camera") == 2
    assert cli("sequences", "verify", copy, "--camera", tmp_path / "mine.toml")[0] == 0
    code, _, err = cli("sequences", "verify", copy, "--camera", "tum-fr9")
    assert code == 1 and "tum-fr9" in one_line(err)
