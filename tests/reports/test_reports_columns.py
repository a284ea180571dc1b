"""What one column of a table is, the same frames of the same recording, and what columns and rows are called."""

import pytest
from reports_fake_store import add_run
from reports_rows import PROTOCOL, row, rows_of

from dynslam_bench.reports import build_report, compare
from dynslam_bench.reports.model.board import make_board, missing_commands
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.reports.model.names import make_labels, name_columns, shortened
from dynslam_bench.reports.model.row import command_line, run_command


def test_recordings_that_share_a_folders_name_keep_their_columns(store, tmp_path):
    for place, error in (("/data/chess/seq-01", 0.01), ("/data/fire/seq-01", 0.2)):
        for tracker in ("a", "b"):
            add_run(store, tracker, "folder/seq-01", error=error, content=place, block=place[6:11], place=place)
    paths = build_report(store, tmp_path / "report")
    table = {r["tracker"]: r for r in rows_of(paths.csv["per_sequence"])}
    assert float(table["a"]["chess/seq-01"]) < 0.05 < float(table["a"]["fire/seq-01"])
    assert len(rows_of(paths.csv["runs"])) == 4
    assert "Left out" not in paths.markdown.read_text()
    found = compare(store, store)
    assert {cells[1].text for cells in found.table.rows} == {"chess/seq-01", "fire/seq-01", "all 2 sequences"}


def test_columns_of_two_cameras_are_named_by_them(store):
    right = {"width": 640, "height": 480, "fx": 525.0, "fy": 525.0}
    add_run(store, "a", "folder/s", camera=right, block="right")
    add_run(store, "b", "folder/s", camera=right | {"fx": 400.0}, block="wrong")
    board = make_board(load_runs([store], PROTOCOL).rows)
    assert board.sequences == ["folder/s (camera 640x480, f 400 525)", "folder/s (camera 640x480, f 525 525)"]


def test_the_same_frames_are_one_column_in_every_spelling(store):
    add_run(store, "a", "synthetic/walking_xyz?frames=60", block="b1")
    add_run(store, "b", "synthetic/walking_xyz", frames=(0, 60), block="b1")
    add_run(store, "b", "synthetic/walking_xyz?noise=3", frames=(0, 60), block="b1", noise=3)
    board = make_board(load_runs([store], PROTOCOL).rows)
    assert board.sequences == ["synthetic/walking_xyz [0:60]"]
    assert [len(cells[board.sequences[0]].rows) for _, cells in sorted(board.cells.items())] == [1, 2]


def test_names_of_columns_are_never_alike():
    same = dict(sequence="folder/x", content="c" * 12)
    rows = [row(**same, block="b1"), row(**same, block="b2"), row(sequence="folder/x", content="d" * 12, block="b3")]
    names = name_columns(rows)
    assert len(set(names.values())) == 3
    assert all(name.startswith("folder/x (") for name in names.values())
    deep = [row(sequence="folder/x", block=str(i), place=p, frames=(0, 9)) for i, p in enumerate(["/a/1/x", "/b/1/x"])]
    assert list(name_columns(deep).values()) == ["a/1/x [0:9]", "b/1/x [0:9]"]


def test_sequences_are_grouped_from_static_to_dynamic():
    tags = {"z": ["static"], "b": ["high-dynamic"], "a": ["low-dynamic"], "c": ["high-dynamic"], "d": []}
    board = make_board([row(sequence=name, tags=names) for name, names in tags.items()])
    groups = [(name, board.groups[name]) for name in board.sequences]
    dynamic = [("a", "low dynamic"), ("b", "high dynamic"), ("c", "high dynamic")]
    assert groups == [("z", "static"), *dynamic, ("d", "other")]


@pytest.mark.parametrize(
    ("names", "short"),
    [
        (
            ["synthetic/walking_xyz?scene=0&frames=60", "synthetic/sitting_xyz?scene=0&frames=60"],
            "walking_xyz sitting_xyz",
        ),
        (["synthetic/walking_xyz?scene=0&frames=60", "synthetic/a?scene=1"], "walking_xyz?scene=0&frames=60 a?scene=1"),
        (["synthetic/a?scene=100&frames=60", "synthetic/a?scene=101&frames=60"], "a?scene=100 a?scene=101"),
        (["tum/fr3/a", "tum/fr1/a", "bonn/a"], "tum/fr3/a tum/fr1/a bonn/a"),
        (["tum/fr3/a [0:9]", "tum/fr3/b [0:9]"], "a [0:9] b [0:9]"),
        (["tum/fr3/a"], "tum/fr3/a"),
    ],
)
def test_names_lose_what_all_share(names, short):
    assert list(shortened(names)) == names and " ".join(shortened(names).values()) == short


def test_what_one_tracker_alone_was_asked_for_is_named_and_spelled_as_in_toml(store):
    given = "/home/me/mine.py:SPEC"
    for name, value in (("s/a", "True"), ("s/b", True)):
        add_run(store, "mine", name, overrides={"loop": value}, settings={"loop": True}, given=given)
    for tracker, name in (("a", "s/a"), ("a", "s/c"), ("b", "s/a")):
        add_run(store, tracker, name, overrides={"masks": "oracle"})
    rows = load_runs([store], PROTOCOL).rows
    assert sorted(make_board(rows).labels.values()) == ["a", "b", "mine · loop=true"]
    (mine,) = (each for each in rows if (each.tracker.id, each.sequence.id) == ("mine", "s/a"))
    assert run_command(mine) == f"dynslam-bench run {given} s/a --set loop=true"
    assert f"dynslam-bench run {given} s/c --set loop=true" in missing_commands(make_board(rows))


def test_commands_name_the_camera_of_a_folder_and_no_results_folder_of_one_machine(store):
    asked = ("dynslam-bench", "run", "ours", "mine", "--camera", "bonn", "--results", "/home/me/results")
    add_run(store, "ours", "folder/mine", place="/home/me/mine", command=asked)
    add_run(store, "mine", "s/a", command=asked)
    rows = {row.tracker.id: row for row in load_runs([store], PROTOCOL).rows}
    assert run_command(rows["ours"]) == "dynslam-bench run ours /home/me/mine --camera bonn"
    assert "--camera" not in run_command(rows["mine"]), "a sequence with an id says its camera"
    assert command_line(list(asked)) == "dynslam-bench run ours mine --camera bonn --results RESULTS"


@pytest.mark.parametrize(
    ("sources", "named"),
    [
        (
            ("onnx:/home/me/nets/yolov8n-seg.onnx", "recorded:/data/masks/", "none"),
            ("none", "onnx:yolov8n-seg", "recorded:masks"),
        ),
        (("onnx:/a/best.onnx", "onnx:/b/best.onnx"), ("onnx:/a/best.onnx", "onnx:/b/best.onnx")),
    ],
)
def test_labels_name_files_without_their_folders_unless_two_would_be_alike(sources, named):
    rows = [row(tracker="mask-rcnn", variant={"segmentation.source": source}) for source in sources]
    assert sorted(make_labels(rows).values()) == [f"MASK-RCNN · segmentation.source={name}" for name in named]
