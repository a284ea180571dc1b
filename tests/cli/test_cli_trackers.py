"""The command line's verbs for trackers: list, info, doctor, new, test."""

import json
from pathlib import Path

import pytest
from cli_helpers import one_line

from dynslam_bench.trackers import TRACKERS


def test_the_list_fits_one_screen_and_holds_every_tracker(cli, facts):
    rows = {row["id"]: row for row in facts("trackers", "list")}
    assert {"never-move", "orb-slam2", "mask-rcnn", "emfoa-oft", "orbslam3"} <= set(rows)
    lines = cli("trackers", "list")[1].splitlines()
    assert len(lines) < 50
    shown = "\n".join(lines)
    assert [name for name in rows if "?" not in name and f"  {name} " not in shown] == []
    assert [name for name in rows if name.partition("?")[2] and name[name.index("?") :] not in shown] == []


def test_info_describes_settings_and_presets_on_one_screen(cli, facts):
    lines = cli("trackers", "info", "emfoa-oft")[1].splitlines()
    assert 24 < len(lines) <= 50 and any(line.startswith("flow.budget ") for line in lines)
    described = facts("trackers", "info", "emfoa-oft")
    by_name = {setting["name"]: setting for setting in described["parameters"]}
    threshold = by_name["segmentation.confidence"]
    assert (threshold["low"], threshold["high"], threshold["scale"]) == (0.1, 0.9, "linear")
    assert by_name["segmentation.source"]["tunable"] is False and described["presets"]["fast"]["flow.budget"] == 24


def test_trackers_info_tells_what_others_report_and_where(facts):
    reported = facts("trackers", "info", "dynaslam")["reported"]
    row = next(r for r in reported if r["sequence"] == "tum/fr3/walking_xyz" and r["source"] == "DynaSLAM paper")
    assert (row["metric"], row["value"]) == ("ate_rmse_m", 0.015)
    claims = facts("trackers", "info", "di-slam")["reported"]
    assert claims and all("claimed by the paper" in r["remarks"] for r in claims)
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
def test_a_broken_plugin_is_explained_and_ends_neither_run_nor_list(cli, facts, walk, plugin, name, text, reason):
    plugin(name, text)
    code, out, _ = cli("trackers", "doctor")
    assert code == 0 and f"{name}:SPEC" in out and reason in out
    assert "never-move" in {row["id"] for row in facts("trackers", "list")}
    code, out, err = cli("run", f"./{name}:SPEC", walk)
    assert code == 1 and out == "" and reason in one_line(err)


def test_a_new_tracker_passes_its_checks_and_runs(cli, facts, walk):
    code, out, _ = cli("trackers", "new", "My SLAM-2")
    assert code == 0 and Path("my_slam_2.py").is_file() and "trackers test ./my_slam_2.py:SPEC" in out
    code, out, _ = cli("trackers", "test", "./my_slam_2.py:SPEC", "--frames", "4")
    assert code == 0, out
    *checks, total = [line for line in out.splitlines() if line]
    assert {line.split()[0] for line in checks} == {"passed", "skipped"}
    assert total == f"tracker 'my-slam-2': 0 of {len(checks)} checks failed" and len(checks) > 10
    (row,) = facts("run", "./my_slam_2.py:SPEC", walk, "--set", "features=300")
    assert row["status"] == "ok" and row["ate_rmse_m"] < 0.01
    assert "exists already" in one_line(cli("trackers", "new", "my-slam-2")[2])
    assert "is no name" in one_line(cli("trackers", "new", "../evil")[2])


def test_a_faulty_tracker_fails_with_4(cli, tmp_path):
    (tmp_path / "faulty.py").write_text(
        "from dynslam_bench.trackers import TrackerSpec\n"
        "class Faulty:\n"
        "    def __init__(self, settings): pass\n"
        "    def reset(self, camera, *, rng): pass\n"
        "    def track(self, frame): return None\n"
        "SPEC = TrackerSpec('faulty', f'{__file__}:Faulty', 'Faulty')\n"
    )
    code, out, _ = cli("trackers", "test", "faulty.py:SPEC")
    assert code == 4 and "gave a NoneType, not a TrackResult" in out
    code, out, _ = cli("trackers", "test", "faulty.py:SPEC", "--json")
    assert code == 4 and json.loads(out)["ok"] is False
