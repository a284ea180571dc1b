"""Sealed rounds: what is refused, and a whole round that two machines play."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from types import SimpleNamespace

import pytest

from dynslam_bench import rounds
from dynslam_bench.core import DynslamError, RunError, file_sha256
from dynslam_bench.core.fingerprint import this_machine
from dynslam_bench.core.reads import Reads
from dynslam_bench.evaluation import get_protocol
from dynslam_bench.rounds.bits import check_bits
from dynslam_bench.rounds.board import BoardRow
from dynslam_bench.rounds.entering import _check_own_files, check_is_new
from dynslam_bench.rounds.files import (
    Program,
    RoundFolder,
    Row,
    Trial,
    open_round,
    renderer_versions,
)
from dynslam_bench.rounds.opening import _extend_gitignore, salt_place, work_tree_of
from dynslam_bench.rounds.programs import (
    difference,
    folder_listing,
    foreign_read,
    other_folder,
    program_of,
)
from dynslam_bench.rounds.rows import ScoredRow, agreement
from dynslam_bench.rounds.running import check_runner, network
from dynslam_bench.rounds.verifying import _faults_of_pairs, _other_request, checked_rows
from dynslam_bench.runs.record import RunRecord
from dynslam_bench.sequences.synthetic import parse_synthetic_id
from dynslam_bench.testing.template import write_tracker_template

SALT = bytes(range(32))
NOW = datetime(2026, 11, 29, 12, tzinfo=timezone.utc)
HERE = Path(__file__)


def written(root: Path, **changes: object) -> RoundFolder:
    """A round in a folder, and its salt beside it."""
    values = {
        "name": "2026a",
        "families": ["walking_xyz", "crowd_xyz"],
        "scenes": 2,
        "frames": 6,
        "protocol": "tum-rgbd/v1",
        "protocol_digest": get_protocol("tum-rgbd/v1").digest(),
        "salt_sha256": hashlib.sha256(SALT).hexdigest(),
        "renderer": renderer_versions(["walking_xyz", "crowd_xyz"]),
        "probes": {},
    }
    made = rounds.Round.model_validate(values | changes)
    root.mkdir(parents=True, exist_ok=True)
    (root / "round.json").write_text(made.to_json())
    Path(f"{root}.salt").write_text(SALT.hex() + "\n")
    return open_round(root)


def entered(opened: RoundFolder, name: str, **changes: object) -> None:
    """Write an entry as `enter` does, without running anything."""
    values = {
        "name": name,
        "round_sha256": opened.sha256,
        "protocol": opened.round.protocol,
        "tracker": "never-move",
        "program": Program(settings={}, code={}),
        "checks": ["spec"],
        "trial": Trial(sequence="synthetic/walking_xyz", run_id="0" * 20, status="ok"),
        "entered": "2026-11-29T12:00:00+00:00",
        "machine": this_machine(),
        "versions": {},
    }
    entry = rounds.Entry.model_validate(values | changes)
    file = opened.entry_file(name)
    file.parent.mkdir(exist_ok=True)
    file.write_text(entry.to_json())


def test_scenes_come_from_salt_name_family_and_index(tmp_path: Path) -> None:
    opened = written(tmp_path / "r")
    sequences = opened.round.sequences(SALT)
    assert len(set(sequences)) == 4
    parsed = [parse_synthetic_id(sequence) for sequence in sequences]
    assert [(scene.name, scene.frames, scene.split) for scene in parsed] == [
        ("walking_xyz", 6, "held-out"),
        ("walking_xyz", 6, "held-out"),
        ("crowd_xyz", 6, "held-out"),
        ("crowd_xyz", 6, "held-out"),
    ]
    assert opened.round.label_of(sequences[3], SALT) == "crowd_xyz 1"
    other = written(tmp_path / "s", name="2026b")
    assert not set(other.round.sequences(SALT)) & set(sequences)
    assert not set(opened.round.sequences(bytes(32))) & set(sequences)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "a b"}, "name"),
        ({"families": ["walking_xy"]}, "did you mean 'walking_xyz'"),
        ({"families": []}, "families"),
        ({"scenes": 0}, "scenes"),
        ({"frames": 1}, "frames"),
        ({"deadline": "Christmas"}, "'Christmas' is no time"),
        ({"deadline": "2026-12-24T12:00"}, "no time zone"),
        ({"tolerance": 2.0}, "tolerance"),
        ({"protocol": "tum"}, "tum"),
    ],
)
def test_a_round_that_does_not_fit_is_refused_before_a_salt_is_drawn(
    changes: dict[str, object], words: str, tmp_path: Path
) -> None:
    values = {"name": "2026a", "families": ["walking_xyz"], "scenes": 1, "frames": 4} | changes
    with pytest.raises(DynslamError, match=words):
        rounds.new_round(tmp_path / "r", **values)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_the_salt_is_not_put_into_the_folder_that_is_published(tmp_path: Path) -> None:
    values = {"name": "2026a", "families": ["walking_xyz"], "scenes": 1, "frames": 4}
    with pytest.raises(RunError, match="is published"):
        rounds.new_round(tmp_path / "r", **values, salt_file=tmp_path / "r" / "salt")  # type: ignore[arg-type]


def test_a_salt_that_does_not_fit_the_commitment_reveals_nothing(tmp_path: Path) -> None:
    opened = written(tmp_path / "r")
    salt_file = tmp_path / "r.salt"
    for text, words in (
        (bytes(32).hex(), "it is another salt"),
        (SALT.hex()[:-2], "has 62 hexadecimal digits, expected 64"),
        (SALT.hex() + "20", "has 66 hexadecimal digits, expected 64"),
        ("x" * 64, "no hexadecimal digits"),
    ):
        salt_file.write_text(text)
        with pytest.raises(DynslamError, match=words):
            rounds.reveal(opened.root, salt_file)
    with pytest.raises(DynslamError, match="there is no salt"):
        rounds.reveal(opened.root, tmp_path / "none")
    assert not opened.is_revealed

    # a salt that was changed in the published file
    salt_file.write_text(SALT.hex())
    rounds.reveal(opened.root, salt_file)
    published = opened.root / "reveal.json"
    published.write_text(published.read_text().replace(SALT.hex(), bytes(32).hex()))
    with pytest.raises(RunError, match=r"salt in reveal.json .* committed to"):
        check_runner(open_round(opened.root), "alice")
    published.write_text(published.read_text().replace(bytes(32).hex(), "00"))
    with pytest.raises(DynslamError, match="has 2 hexadecimal digits, expected 64"):
        check_runner(open_round(opened.root), "alice")


def test_the_deadline_separates_entering_and_revealing(tmp_path: Path) -> None:
    opened = written(tmp_path / "r", deadline="2026-11-29T12:00Z")
    before = NOW - timedelta(seconds=1)
    with pytest.raises(RunError, match="received until 2026-11-29T12:00:00"):
        rounds.reveal(opened.root, tmp_path / "r.salt", now=before)
    with pytest.raises(RunError, match="an entry would be late"):
        rounds.enter(opened.root, "never-move", name="still", now=NOW)
    rounds.reveal(opened.root, tmp_path / "r.salt", now=NOW)
    with pytest.raises(RunError, match=r"was revealed at .* would be late"):
        rounds.enter(opened.root, "never-move", name="still", now=before)
    with pytest.raises(RunError, match="is revealed already"):
        rounds.reveal(opened.root, tmp_path / "r.salt", now=NOW)


def test_an_entry_that_was_entered_after_the_deadline_is_not_revealed(tmp_path: Path) -> None:
    opened = written(tmp_path / "r", deadline="2026-11-29T12:00Z")
    entered(opened, "late", entered="2026-11-29T14:00:00+02:00")
    with pytest.raises(RunError, match=r"'late' was entered at 2026-11-29T12:00:00.* it is late"):
        rounds.reveal(opened.root, tmp_path / "r.salt", now=NOW)
    entered(opened, "late", entered="2026-11-29T11:59:59+00:00")
    assert "late" in rounds.reveal(opened.root, tmp_path / "r.salt", now=NOW).entries


def test_results_of_another_reveal_are_refused(tmp_path: Path) -> None:
    opened = revealed(tmp_path / "r", "still")
    results_of(opened, "alice", [], reveal_sha256="0" * 64)
    with pytest.raises(RunError, match=r"is of another reveal\.json"):
        opened.read_results("alice")


def test_the_folder_of_an_entry_is_frozen_with_every_file(tmp_path: Path) -> None:
    folder = tmp_path / "entries" / "mine"
    (folder / "net").mkdir(parents=True)
    (folder / "mine.py").write_text("a")
    (folder / "net" / "weights.bin").write_bytes(b"b")
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "mine.pyc").write_bytes(b"c")
    listing = folder_listing(folder)
    assert list(listing) == ["mine.py", "net/weights.bin"]
    entry = rounds.Entry.model_construct(name="mine", folder=listing)
    assert other_folder(entry, tmp_path) == ""
    (folder / "net" / "weights.bin").write_bytes(b"c")
    assert other_folder(entry, tmp_path) == "entries/mine/net/weights.bin was changed"
    (folder / "net" / "weights.bin").unlink()
    assert other_folder(entry, tmp_path) == "entries/mine/net/weights.bin is missing"
    (folder / "answers.txt").write_text("d")
    assert other_folder(entry, tmp_path) == "entries/mine/answers.txt is extra"
    (folder / "answers.txt").unlink()
    (folder / "answers.txt").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RunError, match="is a link"):
        other_folder(entry, tmp_path)


def test_a_run_reads_no_file_of_the_round_but_its_own(tmp_path: Path) -> None:
    folder = {"mine.py": "1", "net.bin": "2"}

    def read(**files: str) -> str:
        names = {name.replace("__", "/"): content for name, content in files.items()}
        reads = Reads(files={f"work:/{name}": content for name, content in names.items()})
        return foreign_read("mine", folder, {"reads": reads.model_dump()})

    assert foreign_read("mine", folder, {}) == ""
    assert read(**{"entries/mine/net.bin": "2", "entries/mine/sought": ""}) == ""
    assert read(**{"entries/mine/net.bin": "3"}) == "entries/mine/net.bin"
    assert read(**{"entries/other/net.bin": "2"}) == "entries/other/net.bin"
    assert read(**{"reveal.json": "5"}) == "reveal.json"
    reads = Reads(files={"plugin:/mine.py": "1", "plugin:/answers": "7", "/usr/lib/a.so": "8"})
    assert foreign_read("mine", folder, {"reads": reads.model_dump()}) == "plugin:/answers"


def test_files_of_an_entry_lie_in_its_folder_before_anything_runs(tmp_path: Path) -> None:
    opened = written(tmp_path / "r")
    slam = tmp_path / "slam"
    slam.write_text("#!/bin/sh\n")
    slam.chmod(0o755)
    own = opened.root / "entries" / "mine"
    with pytest.raises(RunError, match=r"do not lie in entries/mine"):
        _check_own_files(opened, "subprocess", {"command": str(slam)}, own)
    own.mkdir(parents=True)
    shutil.copy(slam, own / "slam")
    _check_own_files(opened, "subprocess", {"command": str(own / "slam")}, own)
    _check_own_files(opened, "never-move", {}, own)


def test_damaged_entries_of_others_are_skipped_with_a_remark(tmp_path: Path) -> None:
    opened = written(tmp_path / "r")
    entered(opened, "still")
    opened.entry_file("broken").write_text("{")
    lines: list[str] = []
    with pytest.raises(RunError, match="entry 'still' is the same"):
        check_is_new(opened, "never-move", opened.read_entry("still").program, lines.append)
    assert "entry 'broken' is not compared" in lines[0]


def test_a_gitignore_is_extended_and_a_salt_in_a_work_tree_is_noticed(tmp_path: Path) -> None:
    file = tmp_path / ".gitignore"
    file.write_text("*.bag\nreport/")
    for _ in range(2):
        _extend_gitignore(file)
        assert file.read_text().splitlines() == [
            "*.bag",
            "report/",
            "index.sqlite",
            ".*.claim",
            ".merging",
        ]
    (tmp_path / "a" / ".git").mkdir(parents=True)
    assert work_tree_of(tmp_path / "a" / "b" / "r.salt") == tmp_path / "a"
    assert work_tree_of(tmp_path / "b" / "r.salt") is None
    assert salt_place(tmp_path / "r", tmp_path / "r" / "sub" / ".." / ".." / "s") == tmp_path / "s"
    values = {"name": "2026a", "families": ["walking_xyz"], "scenes": 1, "frames": 4}
    with pytest.raises(RunError, match="is published"):
        rounds.new_round(tmp_path / "r", **values, salt_file=tmp_path / "sub" / ".." / "r" / "x")  # type: ignore[arg-type]


def test_only_interfaces_that_are_up_are_a_network(monkeypatch: pytest.MonkeyPatch) -> None:
    states = {"lo": SimpleNamespace(isup=True), "sit0": SimpleNamespace(isup=False)}
    monkeypatch.setattr("psutil.net_if_stats", lambda: states)
    assert network() == "none"
    states["eth0"] = SimpleNamespace(isup=True)
    assert network() == "open"


def test_a_command_is_started_again_without_a_network_only_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from dynslam_bench.cli import rounds as commands

    started: list[dict[str, str]] = []
    monkeypatch.setattr("dynslam_bench.rounds.running.network", lambda: "open")
    monkeypatch.setattr(commands.shutil, "which", lambda _: "/usr/bin/unshare")
    monkeypatch.setattr(commands.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=0))
    monkeypatch.setattr(commands.os, "execvpe", lambda *words: started.append(words[2]))
    commands._leave_network()
    assert len(started) == 1
    monkeypatch.setattr(commands.os, "environ", started[0])
    commands._leave_network()
    assert len(started) == 1


def test_names_of_entries_and_runners_are_plain_and_free(tmp_path: Path) -> None:
    opened = written(tmp_path / "r")
    entered(opened, "still")
    with pytest.raises(RunError, match="'still' already"):
        rounds.enter(opened.root, "never-move", name="still")
    for name in ("../still", "still\n", ".still"):
        with pytest.raises(RunError, match="no name of an entry"):
            rounds.enter(opened.root, "never-move", name=name)
    rounds.reveal(opened.root, tmp_path / "r.salt")
    with pytest.raises(RunError, match="no name of a runner"):
        rounds.run(opened.root, by="a/b")
    with pytest.raises(RunError, match="no name of a runner"):
        rounds.run(opened.root, by="alice\n")


def test_an_entry_counts_as_it_was_when_the_round_was_revealed(tmp_path: Path) -> None:
    opened = written(tmp_path / "r")
    entered(opened, "still")
    rounds.reveal(opened.root, tmp_path / "r.salt")
    entered(opened, "late")
    assert opened.received_entry("still").tracker == "never-move"
    assert opened.late_entries() == ["late"]
    with pytest.raises(RunError, match=r"'late' is not listed .*\(listed: still\)"):
        opened.received_entry("late")
    entered(opened, "still", tracker="constant-velocity")
    with pytest.raises(RunError, match="'still' was changed after the reveal"):
        opened.received_entry("still")
    opened.entry_file("still").unlink()
    with pytest.raises(RunError, match="'still' is missing"):
        opened.received_entry("still")


def test_one_tracker_with_the_same_settings_enters_once(tmp_path: Path) -> None:
    opened = written(tmp_path / "r")
    entered(opened, "still")
    program = opened.read_entry("still").program
    with pytest.raises(RunError, match="entry 'still' is the same tracker"):
        check_is_new(opened, "never-move", program)
    check_is_new(opened, "never-move", program.model_copy(update={"settings": {"n": 1}}))


def test_an_entry_of_another_protocol_or_round_is_refused_by_name(tmp_path: Path) -> None:
    opened = written(tmp_path / "r")
    entered(opened, "other", protocol="evo-default")
    with pytest.raises(RunError, match="'other' is for protocol 'evo-default'"):
        rounds.reveal(opened.root, tmp_path / "r.salt")
    entered(opened, "other", round_sha256="0" * 64)
    with pytest.raises(RunError, match="entry 'other' is of another round"):
        rounds.reveal(opened.root, tmp_path / "r.salt")
    entered(opened, "other")
    opened.entry_file("other").rename(opened.entry_file("another"))
    with pytest.raises(RunError, match="names itself 'other'"):
        rounds.reveal(opened.root, tmp_path / "r.salt")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"renderer": {"renderer": 5, "walking_xyz": 0}},
            "made with version 5 of the renderer, here it is 6",
        ),
        (
            {"renderer": {"renderer": 6, "walking_xyz": 0, "crowd_xyz": 7}},
            "made with version 7 of family 'crowd_xyz'",
        ),
        ({"renderer": {}}, "made with version None of the renderer"),
        ({"protocol_digest": "0" * 12}, "protocol 'tum-rgbd/v1' has the digest"),
    ],
)
def test_a_round_of_another_release_is_not_played(
    changes: dict[str, object], words: str, tmp_path: Path
) -> None:
    opened = written(tmp_path / "r", **changes)
    rounds.reveal(opened.root, tmp_path / "r.salt")
    for verb in (rounds.run, rounds.verify):
        with pytest.raises(RunError, match=words):
            verb(opened.root, by="alice")
    with pytest.raises(RunError, match=words):
        rounds.enter(written(tmp_path / "s", **changes).root, "never-move", name="still")


def test_what_is_missing_or_damaged_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="is no round"):
        rounds.report(tmp_path)
    opened = written(tmp_path / "r")
    with pytest.raises(RunError, match="not revealed yet"):
        rounds.run(opened.root, by="alice")
    (tmp_path / "r" / "round.json").write_text("{")
    with pytest.raises(RunError, match=r"round.json is not a valid Round"):
        rounds.report(opened.root)
    opened = written(tmp_path / "r")
    rounds.reveal(opened.root, tmp_path / "r.salt")
    with pytest.raises(DynslamError, match="no results yet"):
        rounds.report(opened.root)
    # another round.json beside the reveal
    written(tmp_path / "r", rules="no networks")
    with pytest.raises(RunError, match=r"reveal.json is of another round"):
        rounds.report(opened.root)


def test_programs_differ_by_settings_code_weights_and_files() -> None:
    frozen = Program(settings={"n": 1}, code={"a.b:C": "1"}, weights={"w": "1"}, files={"f": "1"})
    assert difference(frozen, frozen) == ""
    # a file that the run on another scene did not read
    assert difference(frozen, frozen.model_copy(update={"files": {}})) == ""
    for field, value, words in (
        ("settings", {"n": 2}, "the setting n, which was 1 and is 2,"),
        ("settings", {}, "the setting n"),
        ("code", {"a.b:C": "2"}, "the code of a.b"),
        ("weights", {"w": "2"}, "the weights of w"),
        ("files", {"f": "2"}, "f"),
    ):
        assert words in difference(frozen, frozen.model_copy(update={field: value}))


def test_an_entry_is_frozen_with_its_own_files_and_its_package() -> None:
    reads = Reads(
        files={
            "work:/entries/mine/a.py": "1",
            "work:/entries/mine/looked_for": "",
            "work:/entries/other/b.py": "2",
            "plugin:/c.py": "3",
            "/usr/lib/libm.so.6": "4",
        },
        programs={"work:/entries/mine/slam": "5"},
    )
    identity = {
        "settings": {"file": "/home/a/round/entries/mine/net.onnx", "n": 3},
        "source": {"the environment": "6"},
        "parts": ["numpy.linalg:norm", "plugin:/c.py:SPEC"],
        "tracker_version": "2",
        "weights": {"file": "7"},
        "reads": reads.model_dump(),
    }
    program = program_of("mine", identity)
    assert program.settings == {"file": "entries/mine/net.onnx", "n": 3}
    assert program.files == {
        "work:/entries/mine/a.py": "1",
        "plugin:/c.py": "3",
        "work:/entries/mine/slam": "5",
    }
    assert program.weights == {"file": "7"}
    assert program.code.keys() == {"the environment", "package numpy", "its version"}
    assert program.code["package numpy"]


# -- results of others -----------------------------------------------------------------------------


def results_of(
    opened: RoundFolder, by: str, rows: list[tuple[str, str]], **changes: object
) -> Path:
    """Write the description of a runner's bank."""
    values = {
        "by": by,
        "round_sha256": opened.sha256,
        "reveal_sha256": opened.reveal_sha256,
        "scenes": {},
        "rows": [
            {"entry": entry, "sequence": sequence, "run_id": "0" * 20} for entry, sequence in rows
        ],
        "network": "none",
        "made": "2026-11-29T12:00:00+00:00",
        "machine": this_machine(),
        "versions": {},
    }
    file = opened.bank(by) / "results.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(rounds.Results.model_validate(values | changes).to_json())
    return file


def revealed(root: Path, *names: str) -> RoundFolder:
    """A round with entries that is revealed."""
    opened = written(root)
    for name in names:
        entered(opened, name)
    rounds.reveal(root, f"{root}.salt")
    return open_round(root)


def test_each_entry_has_each_scene_once_but_in_a_sample(tmp_path: Path) -> None:
    opened = revealed(tmp_path / "r", "still")
    first, *others = opened.sequences
    rows = [("still", first), ("still", first), ("still", others[0])]
    results_of(opened, "alice", rows)
    faults = _faults_of_pairs(opened, opened.read_results("alice"))
    assert faults == [
        "still on walking_xyz 0 has 2 rows",
        "still lacks 2 of 4 scenes: crowd_xyz 0, crowd_xyz 1",
    ]
    results_of(opened, "bob", rows[1:], sample=True)
    assert _faults_of_pairs(opened, opened.read_results("bob")) == []


@pytest.mark.parametrize("content", [b"{", b"\xff\xfe", b"[]"])
def test_damaged_results_of_one_runner_are_a_fault_of_that_runner(
    content: bytes, tmp_path: Path
) -> None:
    opened = revealed(tmp_path / "r", "still")
    file = results_of(opened, "alice", [])
    file.write_bytes(content)
    rows, faults = checked_rows(opened, "alice", render=False)
    assert rows == []
    (fault,) = faults
    assert fault.startswith("alice: ")
    # one who calls himself otherwise than his folder
    shutil.copyfile(results_of(opened, "bob", []), file)
    assert "names 'bob' as its runner" in checked_rows(opened, "alice", render=False)[1][0]
    with pytest.raises(DynslamError, match="no row of round 2026a can be scored"):
        rounds.report(opened.root)


def test_a_run_must_be_what_the_round_asks_for() -> None:
    asked = {"tracker": "never-move", "seed": 0, "stride": 1, "device": "cpu", "degrade": {}}
    identity = asked | {"device": "cuda:0"}

    def fault(kind: str = "run", **changes: object) -> str:
        record = RunRecord.model_construct(kind=kind, identity=identity | changes)
        return _other_request(record, asked)

    assert fault() == ""
    assert fault(seed=3) == "it was run with seed 3, the round asks for 0"
    assert "stride 2" in fault(stride=2)
    assert "degrade {'blur': 1}" in fault(degrade={"blur": 1})
    assert "tracker 'orb-slam2'" in fault(tracker="orb-slam2")
    assert fault("imported") == "it is no run, but imported"


def test_rows_agree_only_with_one_status_and_coverage(tmp_path: Path) -> None:
    opened = revealed(tmp_path / "r", "still")
    row = Row(entry="still", sequence=opened.sequences[0], run_id="0" * 20)
    one = ScoredRow("alice", row, "lost", None, 0.25)
    assert agreement(opened, one, replace(one, by="bob"))[0] == "reproduced"
    assert agreement(opened, one, replace(one, status="ok"))[0] == "differs"
    assert agreement(opened, one, replace(one, coverage=0.5))[0] == "differs"
    assert agreement(opened, one, replace(one, ate_m=0.1))[0] == "differs"


def test_the_board_ranks_complete_entries_first_and_an_error_of_zero_before_any() -> None:
    values = {"coverage": 1.0, "of_scenes": 4, "not_ok": 0, "run_by": "alice"}
    rows = [
        BoardRow("none", None, scenes=4, **values),  # type: ignore[arg-type]
        BoardRow("part", 0.0, scenes=3, **values),  # type: ignore[arg-type]
        BoardRow("best", 0.0, scenes=4, **values),  # type: ignore[arg-type]
        BoardRow("good", 0.1, scenes=4, **values),  # type: ignore[arg-type]
    ]
    rows.sort(key=lambda row: row.rank)
    assert [row.entry for row in rows] == ["best", "good", "none", "part"]
    assert rows[-1].cells[2:4] == ("100.0 %", "3 of 4")


# -- a whole round ---------------------------------------------------------------------------------


def first_machine(root: Path) -> None:
    """The organiser and three entrants: commitment, entries, reveal, and all runs."""
    rounds.new_round(root, name="test", families=["walking_xyz"], scenes=2, frames=4)
    write_tracker_template("mine", root / "entries" / "mine")
    rounds.enter(root, "never-move", name="still")
    rounds.enter(root, "orb-slam2", name="orb", settings={"features.n_features": 700})
    rounds.enter(root, "entries/mine/mine.py:SPEC", name="mine")

    # this machine with other bits
    of = open_round(root).round
    probes = dict.fromkeys(of.probes, "0" * 64)
    with pytest.raises(RunError, match=r"renders other bits: .*scene=0&frames=2"):
        check_bits(of.model_copy(update={"probes": probes}))

    rounds.reveal(root, f"{root}.salt")
    made = rounds.run(root, by="alice")
    assert len(made.made) == 6
    assert not made.failed
    assert not made.refused


def second_machine(root: Path) -> None:
    """A verifier: all is in order, then it is tampered with."""
    verification = rounds.verify(root, by="bob", sample=2)
    assert verification.faults == []
    assert [again.agreement for again in verification.rerun] == ["identical"] * 6
    shutil.copyfile(root / "entries" / "still.json", root / "entries" / "late.json")
    board = rounds.report(root)
    assert "Not listed in reveal.json, not run: late." in board.remarks
    assert {row.entry for row in board.rows} == {"still", "orb", "mine"}
    assert all(row.reproduced == {"bob": (2, 2, 2)} for row in board.rows)
    assert board.faults == []
    assert "run by" in board.markdown.read_text()
    assert board.html.is_file()

    changed_trajectory(root)
    better_trajectory(root)
    changed_truth(root)
    changed_records(root)
    changed_tracker(root)
    late_entry(root)


def row_of(root: Path, entry: str) -> tuple[Path, Path]:
    """The folder of one of alice's runs, and that of its sequence's part."""
    bank = root / "results" / "alice"
    rows = json.loads((bank / "results.json").read_text())["rows"]
    run_id = next(row["run_id"] for row in rows if row["entry"] == entry)
    record = json.loads((bank / "runs" / run_id / "run.json").read_text())
    return bank / "runs" / run_id, bank / "sequences" / record["sequence"]["part"]


def forge(root: Path, run: Path, changed: Path) -> None:
    """Bring all checksums up to date after a file was changed, as a forger would."""
    bank = root / "results" / "alice"
    part = json.loads((run / "run.json").read_text())["sequence"]["part"]
    for file in bank.glob("runs/*/run.json"):
        record = json.loads(file.read_text())
        if file.parent == run or (record["sequence"]["part"] == part and changed.parent != run):
            record["files"][changed.name] = file_sha256(changed)
            file.write_text(json.dumps(record))
    lines = (bank / "SHA256SUMS").read_text().splitlines()
    names = [line.partition("  ")[2] for line in lines]
    sums = [f"{file_sha256(bank / name)}  {name}\n" for name in names]
    (bank / "SHA256SUMS").write_text("".join(sums))


def changed_trajectory(root: Path) -> None:
    run, _ = row_of(root, "still")
    file = run / "trajectory_online.txt"
    before = file.read_text()
    file.write_text(before.replace(" 0 0 0 0", " 0 0.001 0 0", 1) + "# changed\n")
    verification = rounds.verify(root, by="bob", sample=0)
    assert any(
        "trajectory_online.txt" in fault and run.name in fault for fault in verification.faults
    )
    file.write_text(before)


def better_trajectory(root: Path) -> None:
    """A forged trajectory with right checksums shows when the run is made again."""
    run, part = row_of(root, "still")
    backup = root.parent / "alice"
    shutil.copytree(root / "results" / "alice", backup)
    shutil.copyfile(part / "groundtruth.txt", run / "trajectory_online.txt")
    forge(root, run, run / "trajectory_online.txt")
    assert rounds.verify(root, by="bob", sample=0).ok
    verification = rounds.verify(root, by="bob", sample=2)
    (fault,) = verification.faults
    assert "still on walking_xyz" in fault
    assert "0.00 mm was published, run again it is" in fault
    restore(root, backup)


def changed_truth(root: Path) -> None:
    """A truth that makes the errors smaller is not that of the scene."""
    run, part = row_of(root, "still")
    backup = root.parent / "alice"
    shutil.copytree(root / "results" / "alice", backup)
    shutil.copyfile(run / "trajectory_online.txt", part / "groundtruth.txt")
    forge(root, run, part / "groundtruth.txt")
    verification = rounds.verify(root, by="bob", sample=0)
    assert (
        sum("ground truth is not that of the scene" in fault for fault in verification.faults) == 3
    )
    restore(root, backup)


def changed_records(root: Path) -> None:
    """Status, coverage, kind and digests of scenes are not the runner's word; nor is it free to leave out scenes."""
    run, _ = row_of(root, "still")
    backup = root.parent / "alice"
    for changes, words in (
        ({"coverage": 0.5}, "it says poses at 2 of 4 frames, its trajectory has 4"),
        ({"status": "lost"}, "it says lost, its trajectory says ok"),
        ({"kind": "imported"}, "it is no run, but imported"),
    ):
        shutil.copytree(root / "results" / "alice", backup)
        record = json.loads((run / "run.json").read_text())
        (run / "run.json").write_text(json.dumps(record | changes))
        forge(root, run, run / "trajectory_online.txt")
        faults = rounds.verify(root, by="bob", sample=0).faults
        assert any(words in fault for fault in faults), faults
        restore(root, backup)
    shutil.copytree(root / "results" / "alice", backup)
    file = root / "results" / "alice" / "results.json"
    results = json.loads(file.read_text())
    file.write_text(json.dumps(results | {"scenes": {}, "rows": results["rows"][1:]}))
    faults = rounds.verify(root, by="bob", sample=0).faults
    assert sum("has no digest in results.json" in fault for fault in faults) == 2
    assert sum("lacks 1 of 2 scenes" in fault for fault in faults) == 1
    assert len(faults) == 3
    restore(root, backup)


def restore(root: Path, backup: Path) -> None:
    shutil.rmtree(root / "results" / "alice")
    backup.rename(root / "results" / "alice")


def changed_tracker(root: Path) -> None:
    file = root / "entries" / "mine" / "mine.py"
    before = file.read_text()
    file.write_text(before + "\n# better\n")
    words = "the tracker of entry 'mine' is not the frozen one: entries/mine/mine.py was changed"
    with pytest.raises(RunError, match=words):
        rounds.run(root, by="carol", entries=["mine"])
    assert any(words in fault for fault in rounds.verify(root, by="bob", sample=0).faults)
    file.write_text(before)


def late_entry(root: Path) -> None:
    with pytest.raises(RunError, match=r"entry 'late' is not listed in reveal\.json"):
        rounds.run(root, by="carol", entries=["late"])
    # rows of an entry that is not listed
    results = root / "results" / "alice" / "results.json"
    results.write_text(results.read_text().replace('"entry": "still"', '"entry": "late"'))
    verification = rounds.verify(root, by="bob", sample=0)
    assert (
        sum("late on" in fault and "does not list" in fault for fault in verification.faults) == 2
    )


def played(machine: str, folder: Path) -> None:
    """Play one machine's part in a process of its own, with a folder and a cache of rendered frames of its own."""
    tests = os.pathsep.join((str(HERE.parent), os.environ.get("PYTHONPATH", "")))
    own = {"PYTHONPATH": tests, "DYNSLAM_BENCH_DATA": str(folder / "data")}
    code = (
        f"from pathlib import Path; import test_rounds as t; t.{machine}(Path('round').absolute())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env=os.environ | own,
        text=True,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-4000:]


@pytest.mark.slow
def test_two_machines_play_a_whole_round(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    played("first_machine", tmp_path / "one")
    root = tmp_path / "one" / "round"
    git = ["git", "-c", "user.name=alice", "-c", "user.email=alice@example.org"]
    subprocess.run([*git, "init", "-q"], cwd=root, check=True)
    subprocess.run([*git, "add", "."], cwd=root, check=True)
    subprocess.run([*git, "commit", "-qm", "Run the round"], cwd=root, check=True)
    subprocess.run([*git, "clone", "-q", root, tmp_path / "two" / "round"], check=True)
    played("second_machine", tmp_path / "two")
