"""`run`, `bench` and `runs list`: what a row says of its run, limits, labels, refusals, progress off a terminal."""

import functools
import hashlib
import http.server
import json
import re
import shutil
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from cli_errors import one_line

from dynslam_bench.cli import output, running
from dynslam_bench.cli import runs as run_rows
from dynslam_bench.cli.output import progress
from dynslam_bench.core.folders import WEIGHTS_VARIABLE
from dynslam_bench.geometry.trajectory_files import read_tum
from dynslam_bench.segmentation import build_segmenter
from dynslam_bench.segmentation.networks import checkpoints


def test_a_row_says_what_was_run_and_where_it_comes_from(cli, walk):
    command = ("run", "constant-velocity", walk, "--frames", "0:3", "--stride", "2", "--set", "frames=4")
    code, out, _ = cli(*command, "--label", "my control")
    assert code == 0 and "0:3, every 2nd" in out and "frames=4" in out and "from the store" not in out
    code, out, _ = cli(*command)
    assert code == 0 and "from the store" in out and "yes" in out.splitlines()[1]
    (row,) = json.loads(cli(*command, "--json")[1])
    assert row["from_store"] is True and row["settings"] == "frames=4" and row["frames"] == "0:3, every 2nd"
    assert row["repeat"] == "seed 0"
    listed = cli("runs", "list")[1]
    assert "0:3, every 2nd" in listed and "frames=4" in listed and "from the store" not in listed
    assert "my control" in cli("runs", "show")[1]
    cli(*command, "--label", "another name")
    assert "another name [constant-velocity" in cli("runs", "show")[1]


def test_frames_and_measured_time_are_said_before_the_run(cli, walk):
    command = ("run", "constant-velocity", walk, "--set")
    err = cli(*command, "frames=3")[2]
    assert err.splitlines()[0] == "1 run, 4 frames"
    err = cli(*command, "frames=4", "--offset", "0", "1")[2]
    first = err.splitlines()[0]
    told = re.fullmatch(
        r"2 runs, 7 frames, about (\S+) (s|ms) \(stored runs on this machine took (\S+) (s|ms) a frame\)", first
    )
    assert told, first
    whole, each = (float(told[n]) * {"s": 1.0, "ms": 0.001}[told[n + 1]] for n in (1, 3))
    (record,) = [row for row in json.loads(cli("runs", "list", "--json")[1]) if row["settings"] == "frames=3"]
    measured = json.loads((Path(record["folder"]) / "run.json").read_text())
    assert each == pytest.approx(measured["wall_s"] / 4, rel=0.06) and whole == pytest.approx(7 * each, rel=0.12)
    assert "frames" not in cli(*command, "frames=4")[2], "it is stored: nothing will be tracked"
    assert cli(*command, "frames=5", "--json")[2] == ""


def test_a_row_names_files_without_their_folders(cli, walk):
    command = ("run", f"replay:{walk / 'groundtruth.txt'}", walk, "--set", "tolerance_s=0.02")
    code, out, _ = cli(*command)
    assert code == 0 and "replay:groundtruth.txt" in out and str(walk) not in out
    (row,) = json.loads(cli(*command, "--json")[1])
    assert row["tracker"] == f"replay:{walk / 'groundtruth.txt'}", "scripts get the whole name"
    assert run_rows.shown_cell("settings", "a=1, s.source=onnx:/x/y z/net.onnx, v=/w/ORBvoc.txt, r=recorded:./m/n") == (
        "a=1, s.source=onnx:net.onnx, v=ORBvoc.txt, r=recorded:n"
    )


def test_a_recording_without_ground_truth_says_where_its_trajectory_is(cli, walk, tmp_path):
    shutil.copytree(walk, tmp_path / "mine")
    (tmp_path / "mine" / "groundtruth.txt").unlink()
    code, out, err = cli("run", "never-move", "mine")
    told = err.splitlines()[-1]
    assert code == 0 and "ok" in out and told.startswith("folder/mine has no ground truth")
    assert len(read_tum(Path(told.rpartition(": ")[2]))) == 4


def test_a_folder_whose_camera_is_not_known_says_how_to_name_it(cli, walk, tmp_path):
    shutil.copytree(walk, tmp_path / "mine")
    (tmp_path / "mine" / "camera.toml").rename("cam.toml")
    code, _, err = cli("run", "never-move", "mine")
    first, *options = err.splitlines()
    assert code == 1 and "the camera of" in first and len(options) == 2 and "tum-fr1" in options[0]
    assert cli("run", "never-move", "mine", "--camera", "cam.toml")[0] == 0


def test_runs_list_refuses_what_is_not_there(cli, walk):
    code, out, err = cli("runs", "list", "--results", "nowhere")
    assert code == 1 and out == "" and "there are no runs in" in one_line(err)
    assert cli("run", "never-move", walk)[0] == 0
    code, _, err = cli("runs", "list", "--status", "crashd")
    assert code == 1 and "unknown status 'crashd' (did you mean 'crashed'?)" in one_line(err)


def test_a_mistake_is_one_line_and_leaves_nothing(cli, walk):
    for arguments in (
        ("run", "mask-rcnn", walk, "--set", "segmentation.source=onnx:none.onnx"),
        ("run", "mask-rcnn", walk, "--set", "segmentation.source=oracle"),
        ("run", "replay:none.txt", walk),
        ("run", "orb-slam2", walk, "--map", "none.npz"),
        ("run", "orb-slam2", walk, "--localisation-only"),
        ("run", "never-move", walk, "--map", "none.npz"),
    ):
        code, _, err = cli(*arguments)
        assert code == 1 and one_line(err)
        assert "there are no runs" in cli("runs", "list")[2]


@pytest.fixture
def published(tmp_path, monkeypatch):
    """The COCO checkpoint as a file of a server on this machine, and an empty cache; the network is the embedded one.

    Returns the served file; it is requested only where somebody agrees.
    """
    served = tmp_path / "served"
    served.mkdir()
    content = checkpoints.embedded_weights().read_bytes()
    (served / "network.pth").write_bytes(content)
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(served))
    monkeypatch.setattr(http.server.SimpleHTTPRequestHandler, "log_message", lambda *_: None)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
    prefix = hashlib.sha256(content).hexdigest()[:8]
    stub = replace(checkpoints.COCO, url=f"http://127.0.0.1:{server.server_port}/network.pth", sha256_prefix=prefix)
    monkeypatch.setattr(build_segmenter.NetworkNotFetched, "checkpoint", stub)
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "weights"))
    yield tmp_path / "weights" / stub.file
    server.shutdown()
    server.server_close()


def test_masks_of_a_recording_are_downloaded_only_by_agreement(cli, walk, published, monkeypatch):
    command = ("run", "mask-rcnn", walk)
    code, out, err = cli(*command)
    first, *options = err.splitlines()
    assert code == 1 and not out and not published.exists() and "there are no runs" in cli("runs", "list")[2]
    assert first.startswith("error: no masks for 'folder/walk'") and "170 MB" in first
    assert len(options) == 4 and all(re.match("  - .{20,130}$", option) for option in options)
    questions = []
    monkeypatch.setattr(running, "can_ask", lambda: True)
    monkeypatch.setattr(running.typer, "confirm", lambda text, **_: questions.append(text))
    assert cli(*command)[0] == 1 and len(questions) == 1 and not published.exists(), "answered no"
    monkeypatch.setattr(running, "can_ask", lambda: False)
    code, out, _ = cli(*command, "--yes", "--json")
    assert code == 0 and published.is_file()
    (row,) = json.loads(out)
    assert (row["status"], row["segmentation"]) == ("ok", "coco")
    assert cli("run", "mask-rcnn", walk, "--frames", "0:3")[0] == 0, "nobody is asked again"


def test_who_agrees_on_a_terminal_gets_the_download(published, monkeypatch, capsys):
    monkeypatch.setattr(running, "can_ask", lambda: True)
    monkeypatch.setattr(running.typer, "confirm", lambda *_, **__: True)
    error = build_segmenter.NetworkNotFetched("no masks")
    assert running.agreed_to_fetch(error.checkpoint)
    told = capsys.readouterr().err
    assert "170 MB" in told and error.checkpoint.url in told and str(published.parent) in told


def test_bench_has_limits(cli, walk, tmp_path):
    (tmp_path / "small.toml").write_text(
        f'trackers = ["never-move"]\nsequences = ["{walk}"]\nframes = [0, 3]\n[limits]\nmemory_mb = 20\n'
    )
    code, out, _ = cli("bench", "small.toml", "--json")
    (row,) = json.loads(out)
    assert code == 3 and row["status"] == "out-of-memory" and "the limit is 20 MB" in row["reason"]
    code, out, _ = cli("bench", "small.toml", "--retry", "failed", "--memory-limit", "0", "--json")
    assert code == 0 and json.loads(out)[0]["status"] == "ok"
    code, out, _ = cli("bench", "small.toml", "--retry", "ok", "--time-limit", "0.0001", "--json")
    assert code == 3 and json.loads(out)[0]["status"] in ("timeout", "out-of-memory")


def test_sheet_and_video_of_a_stored_run_are_made(cli, walk, tmp_path):
    (row,) = json.loads(cli("run", "orb-slam2", walk, "--json")[1])
    folder = Path(row["folder"])
    assert row["status"] == "ok", row
    assert not (folder / "sheet.png").exists()
    (row,) = json.loads(cli("run", "orb-slam2", walk, "--sheet", "--json")[1])
    assert row["from_store"] is False and (folder / "sheet.png").is_file()
    (row,) = json.loads(cli("run", "orb-slam2", walk, "--sheet", "--json")[1])
    assert row["from_store"] is True
    assert not (folder / "video.webm").exists()
    (row,) = json.loads(cli("run", "orb-slam2", walk, "--video", "--json")[1])
    assert Path(row["folder"]) == folder and (folder / "video.webm").read_bytes().startswith(b"\x1aE\xdf\xa3")
    assert cli("run", "never-move", walk, "--sheet")[0] == 0
    assert "no sheet.png: the tracker offers neither keyframes nor a map" in cli("runs", "show")[1]
    assert json.loads(cli("run", "never-move", walk, "--sheet", "--json")[1])[0]["from_store"] is True


def test_a_map_that_cannot_be_had_is_said_and_no_success(cli, walk):
    for options in ((), ("--json",)):
        code, _, err = cli("run", "never-move", walk, "--save-map", *options)
        assert code == 3 and "no map.npz: tracker 'never-move' cannot save its map" in err
        assert err.count("\n") == (1 if options else 2), "without --json also how many frames it has"
    code, out, err = cli("run", "orb-slam2", walk, "--save-map")
    assert code == 0 and "no map.npz" not in err and "map.npz" in out


def test_a_run_that_was_lost_is_no_success(cli, walk):
    toys = Path(__file__).parents[1] / "envs" / "envs_toys.py"
    code, out, _ = cli("run", f"{toys}:SPEC", walk, "--set", "mode=lost", "--set", "at=1", "--json")
    assert json.loads(out)[0]["status"] == "lost" and code == 3


def test_people_who_watch_are_told_of_a_long_way_without_loop_closing(cli, walk, monkeypatch):
    notes: list[str] = []
    monkeypatch.setattr(running, "note", notes.append)

    def told(tracker, *settings, frames="0:4"):
        notes.clear()
        assert cli("run", tracker, walk, "--frames", frames, *settings)[0] in (0, 3)
        return [text for text in notes if "without loop closing" in text]

    assert not told("orb-slam2", frames="0:3"), "its way is short"
    monkeypatch.setattr(run_rows, "LONG_WAY_M", 0.001)
    (text,) = told("orb-slam2")
    assert text.startswith("1 of 1 runs went more than 0 m, the first 0 m on folder/walk, without")
    assert not told("orb-slam2"), "it was said when it was run"
    assert not told("orb-slam2", "--set", "backend.loop_closing.enabled=true")
    assert not told("orb-slam2-mono"), "its unit of length is not known"
    assert not told("constant-velocity"), "it has no loops to close"


def test_show_counts_frames_that_were_initialising_and_closed_loops(cli, walk):
    (row,) = json.loads(cli("run", "orb-slam2", walk, "--json")[1])
    out = cli("runs", "show")[1]
    assert "initialising" not in out and re.search(r"^loops closed +0$", out, re.MULTILINE), out
    folder = Path(row["folder"])
    record = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(record | {"n_initialising": 3}))
    heading, *lines = (folder / "frames.csv").read_text().splitlines()
    at = heading.split(",").index("stat_loops")
    cells = lines[-1].split(",")
    last = ",".join([*cells[:at], "2.0", *cells[at + 1 :]])
    (folder / "frames.csv").write_text("\n".join([heading, *lines[:-1], last, ""]))
    out = cli("runs", "show")[1]
    assert re.search(r"^initialising +3$", out, re.MULTILINE)
    assert re.search(r"^loops closed +2$", out, re.MULTILINE)
    (folder / "frames.csv").write_text("damaged")
    code, out, _ = cli("runs", "show")
    assert code == 0 and "loops" not in out
    cli("run", "never-move", walk)
    assert "loops" not in cli("runs", "show")[1]


def test_info_tells_a_program_what_it_may_set(cli):
    described = json.loads(cli("trackers", "info", "emfoa-oft", "--json")[1])["parameters"]
    by_name = {each["name"]: each for each in described}
    threshold = by_name["segmentation.confidence"]
    assert (threshold["low"], threshold["high"], threshold["scale"], threshold["online"]) == (0.1, 0.9, "linear", True)
    assert by_name["segmentation.schedule"]["choices"] == ["every", "every_nth", "keyframes"]
    assert by_name["segmentation.dilation_px"]["unit"] == "px"
    assert by_name["segmentation.source"] == {
        "name": "segmentation.source",
        "default": "auto",
        "tunable": False,
        "online": False,
    }


def test_info_says_what_a_preset_sets(cli):
    told = " ".join(cli("trackers", "info", "mask-rcnn")[1].split())
    assert "segmentation.schedule=every_nth, segmentation.n=2, segmentation.crowded_share=0.5)" in told
    facts = json.loads(cli("trackers", "info", "emfoa-oft", "--json")[1])
    assert facts["presets"] == {"fast": {"segmentation.schedule": "every_nth", "segmentation.n": 2, "flow.budget": 24}}


def test_progress_where_nobody_watches(capsys, monkeypatch):
    monkeypatch.setattr(output, "HEARTBEAT_S", 0.05)
    with progress("3 runs") as advance:
        advance(1.5, 3, "orb-slam2 on walk, frame 5 of 10")
        time.sleep(0.4)
    said = capsys.readouterr().err.splitlines()
    assert len(said) >= 2 and said[0].startswith("3 runs: 1.5 of 3, about ")
    assert "(orb-slam2 on walk, frame 5 of 10)" in said[0]
    with progress("reading runs") as advance:
        advance(2.0, 3)
        counted, deadline = "", time.monotonic() + 10
        while "2 of 3" not in counted and time.monotonic() < deadline:
            time.sleep(0.02)
            counted += capsys.readouterr().err
    assert "reading runs: 2 of 3, about " in counted
    capsys.readouterr()
    with progress("nothing"):
        pass
    assert capsys.readouterr().err == ""


def test_with_json_nothing_but_errors_goes_to_standard_error(cli, capsys, monkeypatch):
    monkeypatch.setattr(output, "HEARTBEAT_S", 0.01)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(output, "_for_scripts", True)
    with output.progress("things") as advance, output.heartbeat() as beat:
        advance(1, 3)
        time.sleep(0.1)
        beat("still there")
        output.note("one of them")
    assert capsys.readouterr().err == ""
    assert cli("protocols", "list", "--json")[2] == ""
    output.note("seen")  # that command is over
    assert capsys.readouterr().err == "seen\n"


@pytest.mark.parametrize("argument", ["abc", "-1"])
def test_limits_are_numbers(cli, walk, argument):
    assert cli("run", "never-move", walk, "--memory-limit", argument)[0] == 2
