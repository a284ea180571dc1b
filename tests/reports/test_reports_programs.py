"""Which program of a tracker ranks, which programs share a row, and what a row says of programs and computers."""

from __future__ import annotations

import re
import sys
from datetime import datetime, timedelta, timezone
from functools import cache
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import pytest
from helpers.reports_fake_store import (
    MACHINE,
    PROTOCOL,
    add_run,
    columns_of,
    page_data,
    row,
    rows_of,
)

from dynslam_bench.core.fingerprint import path_digest
from dynslam_bench.reports import ReportData, build_report, compare, load_board
from dynslam_bench.reports.figures import speed_figure
from dynslam_bench.reports.html import page
from dynslam_bench.reports.model.board import Board, make_board
from dynslam_bench.reports.model.load import load_runs
from dynslam_bench.reports.model.programs import choose_runs
from dynslam_bench.reports.model.summary import reservations
from dynslam_bench.reports.tables.leaderboard import leaderboard, time_table
from dynslam_bench.runs import RunSpec
from dynslam_bench.runs.identity import libraries, resolve, source_digests
from dynslam_bench.runs.record import IDENTITY_SCHEME, RunRecord
from dynslam_bench.runs.store import RunStore
from dynslam_bench.runs.validity import NOT_RECORDED, Installation

TRACKER = "dynslam_bench.trackers.adapters.controls:NeverMove"
RENDERED = "dynslam_bench.sequences.synthetic.sequence"
RECORDED = "dynslam_bench.sequences.readers.tum"
SCENES = [f"synthetic/walking_xyz?scene={scene}" for scene in range(8)]
YESTERDAY = (datetime.now(timezone.utc) - timedelta(days=1)).isoformat()
LAST_YEAR = (datetime.now(timezone.utc) - timedelta(days=365)).isoformat()
NEXT_YEAR = (datetime.now(timezone.utc) + timedelta(days=365)).isoformat()


@cache
def libraries_here() -> dict[str, str]:
    return libraries()


def made_here(reader: str = RENDERED, **changes: Any) -> dict[str, Any]:
    """The identity of a run that would be taken again here, with some entries in place of its own."""
    parts = sorted([TRACKER, reader])
    program = {
        "scheme": IDENTITY_SCHEME,
        "tracker_version": "1",
        "parts": parts,
        "source": source_digests(parts),
        "requires": {},
        "libraries": libraries_here(),
        "weights": {},
    }
    return program | changes


def made_elsewhere(code: str = "0", reader: str = RENDERED, **changes: Any) -> dict[str, Any]:
    """The identity of a run by other code of the tracker."""
    identity = made_here(reader, **changes)
    return identity | {"source": identity["source"] | {TRACKER: code * 16}}


def add(
    store: RunStore, scene: str, identity: dict[str, Any], result: int = 1, **options: Any
) -> str:
    """A run of the tracker ``mine``; runs of equal `result` on one scene have equal trajectories."""
    return add_run(
        store,
        "mine",
        scene,
        copy_of=result,
        identity=identity,
        **({"started": LAST_YEAR} | options),
    )


def rows_by_label(board: Board) -> dict[str, list[str]]:
    """The scenes of each row of the tracker ``mine``, by the remark on its programs."""
    keys = [key for key in board.labels if board.first(key).tracker.id == "mine"]
    return {board.first(key).program_remark: sorted(board.cells[key]) for key in keys}


def ratio_words(store: RunStore, pairs: list[tuple[str, str]]) -> str:
    """What a row says of the errors of some runs over those of others."""
    ratios = []
    for run_id, other_id in pairs:
        errors = [
            store.score(store.read(name), PROTOCOL).metrics["ate_rmse_m"]
            for name in (run_id, other_id)
        ]
        ratios.append(errors[0] / errors[1])
    return f"ATE × {geometric_mean(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"


# -- programs with equal results -------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("common", [5, 6])
def test_programs_with_five_equal_results_share_a_row(store: RunStore, common: int) -> None:
    for scene in SCENES[:7]:
        add(store, scene, made_elsewhere())
    for scene in SCENES[:common]:
        add(store, scene, made_here(), started=YESTERDAY)
    board = load_board(store)
    assert rows_by_label(board) == {f"2 programs, equal on {common} runs": sorted(SCENES[:7])}
    (key,) = board.ranked
    assert board.labels[key] == "mine"
    assert all(run.is_current for run in board.rows)
    made_now = {board.sequence(run) for run in board.rows if run.started == YESTERDAY}
    assert made_now == set(SCENES[:common])


@pytest.mark.slow
@pytest.mark.parametrize(("common", "words"), [(1, "1 run"), (4, "4 runs")])
def test_programs_with_four_equal_results_have_a_row_each(
    store: RunStore, common: int, words: str
) -> None:
    for scene in SCENES[:7]:
        add(store, scene, made_elsewhere())
    for scene in SCENES[:common]:
        add(store, scene, made_here(), started=YESTERDAY)
    board = load_board(store)
    remark = f"other code: equal on {words}, fewer than 5"
    assert rows_by_label(board) == {"": sorted(SCENES[:common]), remark: sorted(SCENES[common:7])}
    assert [board.first(key).program_remark for key in board.ranked] == [""]
    other = next(key for key in board.labels if board.first(key).program_remark == remark)
    assert re.fullmatch("mine · code [0-9a-f]{8}", board.labels[other])
    assert board.unranked_why(other) == "by another program"


def test_programs_without_a_run_in_common_say_so(store: RunStore) -> None:
    add(store, SCENES[0], made_elsewhere())
    add(store, SCENES[1], made_here())
    assert rows_by_label(load_board(store)) == {
        "": [SCENES[1]],
        "other code: no run in common": [SCENES[0]],
    }


@pytest.mark.slow
@pytest.mark.parametrize("differing", [1, 3])
def test_programs_that_differ_have_a_row_each_that_says_by_how_much(
    store: RunStore, differing: int
) -> None:
    pairs = []
    for at, scene in enumerate(SCENES[:7]):
        changed = {"error": 0.02} if at < differing else {}
        pairs.append(
            (add(store, scene, made_elsewhere(), **changed), add(store, scene, made_here()))
        )
    left = add(store, SCENES[7], made_elsewhere())
    verb = "differs" if differing == 1 else "differ"
    words = f"code: {differing} of 7 runs {verb}, {ratio_words(store, pairs)}"
    assert rows_by_label(load_board(store)) == {
        "": sorted(SCENES[:7]),
        f"other {words}": [SCENES[7]],
    }
    store.remove(left)
    assert rows_by_label(load_board(store)) == {f"superseded {words}": sorted(SCENES[:7])}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"libraries": {"numpy": "1"}}, "libraries"),
        ({"weights": {"coco": "aaaa"}}, "weights"),
        ({"libraries": {"numpy": "1"}, "tracker_version": "0"}, "code and libraries"),
        ({"libraries": {"numpy": "1"}, "tracker_version": "0", "weights": {"coco": "aaaa"}},
         "code, libraries and weights"),
    ],
)  # fmt: skip
def test_a_row_says_in_what_its_program_differs(
    store: RunStore, changes: dict[str, Any], words: str
) -> None:
    add(store, SCENES[0], made_here(weights={"coco": "bbbb"}), started=YESTERDAY)
    add(store, SCENES[1], made_here(weights={"coco": "bbbb"}, **{}) | changes)
    assert f"other {words}: no run in common" in rows_by_label(load_board(store))


@pytest.mark.slow
def test_a_crash_where_another_program_succeeded_is_a_difference(store: RunStore) -> None:
    for scene in SCENES[:6]:
        add(store, scene, made_elsewhere())
        add(store, scene, made_here(), status="crashed" if scene == SCENES[0] else "ok")
    add(store, SCENES[7], made_elsewhere())
    (remark,) = [remark for remark in rows_by_label(load_board(store)) if remark]
    assert remark.startswith("other code: 1 of 6 runs differs, ATE × ")


@pytest.mark.slow
def test_equal_failures_are_no_evidence(store: RunStore) -> None:
    for at, scene in enumerate(SCENES[:7]):
        status = "crashed" if at < 3 else "ok"
        add(store, scene, made_elsewhere(), status=status)
        add(store, scene, made_here(), status=status)
    add(store, SCENES[7], made_elsewhere())
    assert rows_by_label(load_board(store)) == {
        "": sorted(SCENES[:7]),
        "other code: equal on 4 runs, fewer than 5": [SCENES[7]],
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("results", "remark"),
    [
        ([1, 1, 1, 1, 1, 1], "other code: equal on 1 run, fewer than 5"),
        ([1, 2, 3, 4, 1, 1], "other code: equal on 4 runs, fewer than 5"),
        ([1, 2, 3, 4, 5, 1], "2 programs, equal on 5 runs"),
    ],
)
def test_copies_of_one_result_under_several_seeds_count_once(
    store: RunStore, results: list[int], remark: str
) -> None:
    for seed, result in enumerate(results):
        add(store, SCENES[0], made_elsewhere(), result, seed=seed)
        add(store, SCENES[0], made_here(), result, seed=seed)
    add(store, SCENES[1], made_elsewhere())
    assert remark in rows_by_label(load_board(store))


@pytest.mark.slow
def test_trackers_that_are_not_deterministic_never_share_a_row(store: RunStore) -> None:
    pairs = []
    for scene in SCENES[:7]:
        options: dict[str, Any] = {"deterministic": False}
        pairs.append(
            (
                add(store, scene, made_elsewhere(), **options),
                add(store, scene, made_here(), **options),
            )
        )
    add(store, SCENES[7], made_elsewhere(), deterministic=False)
    assert rows_by_label(load_board(store)) == {
        "": sorted(SCENES[:7]),
        f"other code: not deterministic, 7 runs in common, {ratio_words(store, pairs)}": [
            SCENES[7]
        ],
    }


@pytest.mark.slow
def test_runs_whose_ids_are_not_verified_never_share_a_row(store: RunStore) -> None:
    for scene in SCENES[:7]:
        add(store, scene, made_here() | {"scheme": IDENTITY_SCHEME - 1}, started=YESTERDAY)
        add(store, scene, made_here())
    add(store, SCENES[7], made_here() | {"scheme": IDENTITY_SCHEME - 1}, started=YESTERDAY)
    board = load_board(store)
    assert {board.labels[run.variant_key] for run in board.rows if not run.is_current} == {
        "mine · identity unverified"
    }
    assert sum(run.is_current for run in board.rows) == 7


@pytest.mark.slow
def test_programs_share_a_row_only_where_all_pairs_agree(store: RunStore) -> None:
    """The second is equal to the first; the third is equal to the first, and differs from the second elsewhere."""
    for scene in SCENES[:5]:
        add(store, scene, made_here())
        add(store, scene, made_elsewhere("2"), started=YESTERDAY)
        add(store, scene, made_elsewhere("3"))
    add(store, SCENES[5], made_elsewhere("2"), started=YESTERDAY)
    for scene in SCENES[5:7]:
        add(store, scene, made_elsewhere("3"), result=2)
    remarks = rows_by_label(load_board(store))
    assert remarks["2 programs, equal on 5 runs"] == sorted(SCENES[:6])
    (other,) = [
        remark for remark in remarks if remark.startswith("other code: 1 of 6 runs differs, ATE × ")
    ]
    assert remarks[other] == [SCENES[6]]


@pytest.mark.slow
def test_programs_that_agree_with_one_another_by_way_of_a_third_share_a_row(
    store: RunStore,
) -> None:
    for scene in SCENES[:5]:
        add(store, scene, made_here())
    for scene in SCENES[:8]:
        add(store, scene, made_elsewhere("2"))
    for scene in SCENES[3:8]:
        add(store, scene, made_elsewhere("3"))
    add(store, "synthetic/sitting_xyz", made_elsewhere("3"))
    assert rows_by_label(load_board(store)) == {
        "3 programs, equal on 8 runs": sorted(["synthetic/sitting_xyz", *SCENES]),
    }


@pytest.mark.slow
def test_the_remark_stands_on_the_first_page_and_in_the_tables(
    store: RunStore, tmp_path: Path
) -> None:
    for scene in SCENES[:6]:
        add(store, scene, made_elsewhere())
    for scene in SCENES[:5]:
        add(store, scene, made_here())
    paths = build_report(store, tmp_path / "report")
    remark = "2 programs, equal on 5 runs"
    assert remark in paths.html.read_text()
    assert [line["rows"] for line in rows_of(paths.csv["leaderboard"])] == [f"{remark} 6 run here"]
    assert {line["program_remark"] for line in rows_of(paths.csv["runs"])} == {remark}


# -- which program ranks ---------------------------------------------------------------------------


def test_the_program_that_is_installed_ranks_though_another_is_newer_by_the_clock(
    store: RunStore,
) -> None:
    add(store, SCENES[0], made_here(), started=LAST_YEAR)
    add(store, SCENES[1], made_elsewhere(), started=YESTERDAY)
    loaded = load_runs([store], PROTOCOL)
    assert {run.sequence.id: run.is_current for run in loaded.rows} == {
        SCENES[0]: True,
        SCENES[1]: False,
    }
    assert loaded.not_installed == {}


def test_in_a_cell_the_run_of_the_installed_program_counts_though_another_is_newer(
    store: RunStore,
) -> None:
    installed = add(store, SCENES[0], made_here(), started=LAST_YEAR)
    add(store, SCENES[0], made_elsewhere(), result=2, started=YESTERDAY)
    loaded = load_runs([store], PROTOCOL)
    assert [run.run_id for run in loaded.rows] == [installed]
    assert loaded.superseded == 1


def test_of_runs_of_one_program_the_newest_counts(store: RunStore) -> None:
    add(store, SCENES[0], made_here(), started=LAST_YEAR)
    newest = add(store, SCENES[0], made_here(), started=YESTERDAY)
    assert [run.run_id for run in load_runs([store], PROTOCOL).rows] == [newest]


@pytest.mark.slow
def test_a_result_that_came_back_counts_in_place_of_one_between(store: RunStore) -> None:
    """What is installed equals an early program; the run of a program between them has another result."""
    for scene in SCENES[:5]:
        add(store, scene, made_here())
    for scene in SCENES[:6]:
        add(store, scene, made_elsewhere("1"), started=LAST_YEAR)
        add(store, scene, made_elsewhere("2"), result=2, started=YESTERDAY)
    board = load_board(store)
    assert {run.started for run in board.rows} == {LAST_YEAR}
    (remark,) = rows_by_label(board)
    assert remark.startswith(
        "2 programs, equal on 5 runs; superseded code: 6 of 6 runs differ, ATE × "
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "started",
    ["2031-01-01T00:00:00+00:00", NEXT_YEAR, "2999-12-31T00:00:00Z"],
    ids=["2031", "next year", "2999"],
)
def test_a_start_in_the_future_is_never_preferred_and_is_named(
    store: RunStore, tmp_path: Path, started: str
) -> None:
    if datetime.now(timezone.utc) >= datetime.fromisoformat(started.replace("Z", "+00:00")):
        pytest.skip("it is no date in the future any more")
    add(store, SCENES[0], made_elsewhere("1"), started=YESTERDAY)
    add(store, SCENES[1], made_elsewhere("2"), started=started)
    ahead = add(store, SCENES[0], made_elsewhere("2"), started=started)
    loaded = load_runs([store], PROTOCOL)
    assert {run.started: run.is_current for run in loaded.rows} == {YESTERDAY: True, started: False}
    assert {run.run_id for run in loaded.in_future} >= {ahead}
    text = build_report(store, tmp_path / "report").html.read_text()
    assert (
        "Dated in the future, and so counted as the oldest: mine on synthetic/walking_xyz?scene="
        in text
    )
    assert ahead in text


def test_a_clock_that_is_minutes_ahead_is_no_future(store: RunStore) -> None:
    soon = (datetime.now(timezone.utc) + timedelta(minutes=2)).isoformat()
    add(store, SCENES[0], made_elsewhere("1"), started=YESTERDAY)
    add(store, SCENES[1], made_elsewhere("2"), started=soon)
    loaded = load_runs([store], PROTOCOL)
    assert loaded.in_future == []
    assert {run.started: run.is_current for run in loaded.rows} == {YESTERDAY: False, soon: True}


@pytest.mark.parametrize("started", ["", "yesterday", "2026-13-45"])
def test_a_start_that_is_no_date_counts_as_the_oldest(store: RunStore, started: str) -> None:
    add(store, SCENES[0], made_elsewhere("1"), started=LAST_YEAR)
    add(store, SCENES[1], made_elsewhere("2"), started=started)
    rows = load_runs([store], PROTOCOL).rows
    assert {run.started: run.is_current for run in rows} == {LAST_YEAR: True, started: False}


@pytest.mark.slow
def test_where_none_of_several_programs_is_installed_the_newest_ranks_and_the_report_says_so(
    store: RunStore, tmp_path: Path
) -> None:
    add(store, SCENES[0], made_elsewhere("1"), started=LAST_YEAR)
    add(store, SCENES[1], made_elsewhere("2"), started=YESTERDAY)
    loaded = load_runs([store], PROTOCOL)
    assert {run.started: run.is_current for run in loaded.rows} == {
        LAST_YEAR: False,
        YESTERDAY: True,
    }
    assert list(loaded.not_installed.values()) == [
        "the code of dynslam_bench.trackers.adapters.controls"
    ]
    text = build_report(store, tmp_path / "report").markdown.read_text()
    assert "none of several is the one installed here: mine · code " in text


def test_one_program_on_two_kinds_of_sequences_has_one_row(store: RunStore) -> None:
    """The parts of the tracker are the same; each kind of sequence has a reader of its own."""
    for made_by in (made_here, made_elsewhere):
        add(store, SCENES[0] + made_by.__name__, made_by(reader=RENDERED))
        add(store, f"tum/{made_by.__name__}", made_by(reader=RECORDED))
    board = load_board(store)
    assert sorted(rows_by_label(board).values()) == [
        [SCENES[0] + "made_elsewhere", "tum/made_elsewhere"],
        [SCENES[0] + "made_here", "tum/made_here"],
    ]


def test_programs_elsewhere_are_told_apart_by_the_parts_that_their_sequences_share(
    store: RunStore,
) -> None:
    """A bank: an early program on both kinds of sequences, a late one on one kind only."""
    add(store, SCENES[0], made_elsewhere("1", RENDERED))
    add(store, "tum/a", made_elsewhere("1", RECORDED))
    add(store, SCENES[1], made_elsewhere("2", RENDERED), started=YESTERDAY)
    assert sorted(rows_by_label(load_board(store)).values()) == [[SCENES[0], "tum/a"], [SCENES[1]]]


def test_an_import_is_no_program(store: RunStore) -> None:
    for seed in (0, 1):
        add_run(
            store,
            "mine",
            SCENES[0],
            seed,
            kind="imported",
            identity={"scheme": IDENTITY_SCHEME, "file": str(seed)},
        )
    loaded = load_runs([store], PROTOCOL)
    assert [(run.is_current, run.program_remark, run.split_by) for run in loaded.rows] == [
        (True, "", {})
    ] * 2


def test_results_are_compared_by_the_row_that_ranks(tmp_path: Path) -> None:
    before = RunStore(tmp_path / "before")
    after = RunStore(tmp_path / "after")
    add(before, SCENES[0], made_elsewhere(), error=0.08)
    add(after, SCENES[0], made_elsewhere(), error=0.08, seed=1)
    add(after, SCENES[0], made_here(), error=0.01)
    comparison = compare(before, after)
    (ratio,) = comparison.overall.values()
    assert ratio.ratio < 0.2


# -- what is installed -----------------------------------------------------------------------------


def record_of(identity: dict[str, Any], **changes: Any) -> RunRecord:
    return RunRecord.model_validate(
        row(**changes).model_dump(include=set(RunRecord.model_fields)) | {"identity": identity}
    )


def test_a_run_by_what_is_installed_has_not_changed() -> None:
    installation = Installation()
    assert installation.what_changed(record_of(made_here())) == ""
    assert installation.what_changed(record_of({}, kind="imported")) == ""


@pytest.mark.parametrize(
    ("identity", "words"),
    [
        ({}, NOT_RECORDED),
        ({"scheme": IDENTITY_SCHEME}, NOT_RECORDED),
        ({"scheme": IDENTITY_SCHEME, "parts": "x", "source": "y", "libraries": 3}, NOT_RECORDED),
        (made_here(source={}), "the code of the environment"),
        (made_elsewhere(), "the code of dynslam_bench.trackers.adapters.controls"),
        (made_here(libraries={}), "numpy"),
        (made_here(requires={"no_such_package": "1.0"}), "the package no_such_package"),
        (made_here(requires={"no.such.package": "1.0"}), "the package no.such.package"),
        (made_here(weights={"features.file": "0" * 16}), "the weights of features.file"),
        (made_here(files="0" * 16), NOT_RECORDED),
    ],
)
def test_what_has_changed_since_a_run_is_named(identity: dict[str, Any], words: str) -> None:
    assert Installation().what_changed(record_of(identity)) == words


def test_another_version_of_a_library_is_named() -> None:
    other = made_here(libraries=libraries_here() | {"scipy": "0.1 files 00000000"})
    assert Installation().what_changed(record_of(other)) == "scipy"


@pytest.mark.parametrize("prefix", ["", "onnx:"])
def test_a_file_that_a_setting_names_counts_by_its_content(tmp_path: Path, prefix: str) -> None:
    file = tmp_path / "net.onnx"
    file.write_text("first")
    identity = made_here(weights={"net": path_digest(file)[:16]})
    settings = {"settings": {"net": f"{prefix}{file}"}}
    assert Installation().what_changed(record_of(identity, **settings)) == ""
    file.write_text("second")
    assert Installation().what_changed(record_of(identity, **settings)) == "the weights of net"
    file.unlink()
    assert Installation().what_changed(record_of(identity, **settings)) == "the weights of net"


@pytest.mark.slow
@pytest.mark.parametrize("part", ["boards_plugin:SPEC", "{folder}/boards_plugin.py:SPEC"])
def test_no_plug_in_is_imported_to_tell_whether_it_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, store: RunStore, part: str
) -> None:
    (tmp_path / "boards_plugin.py").write_text("raise SystemExit('it was imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    parts = [part.format(folder=tmp_path)]
    for at, version in enumerate("12"):
        identity = made_here(
            parts=parts, source=source_digests(parts), reads={"files": {}}, tracker_version=version
        )
        add(store, SCENES[at], identity)
    build_report(store, tmp_path / "report")
    assert "boards_plugin" not in sys.modules


def test_runs_on_rendered_and_recorded_sequences_name_the_same_parts_of_a_tracker(
    toy_folder: str,
) -> None:
    runs = [
        resolve(RunSpec(tracker="orb-slam2", sequence=sequence))
        for sequence in ("synthetic/walking_xyz?frames=4", toy_folder)
    ]
    rendered, recorded = (run.identity["source"] for run in runs)
    shared = {part for part in rendered if recorded.get(part) == rendered[part]}
    assert shared == {
        "the environment",
        "dynslam_bench.features.orb:OrbExtractor",
        "dynslam_bench.trackers.systems.composition:build",
    }
    assert {*rendered} - shared == {RENDERED}


def test_a_report_does_not_say_file_by_file_what_plug_ins_read(
    store: RunStore, tmp_path: Path
) -> None:
    add(store, SCENES[0], made_here(reads={"files": {"/home/me/secret.txt": "0" * 64}}))
    paths = build_report(store, tmp_path / "report")
    assert "secret" not in paths.data.read_text()
    assert "reads" not in ReportData.read(paths.data).rows[0].identity


def test_choosing_among_many_runs_looks_at_each_program_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked_at = []
    compare_program = Installation._compare

    def counted(self: Installation, *args: Any) -> str:
        looked_at.append(args)
        return compare_program(self, *args)

    monkeypatch.setattr(Installation, "_compare", counted)
    rows = [
        row("mine", f"s{at}", identity=identity, files={"trajectory_online.txt": str(at)})
        for at in range(200)
        for identity in (made_here(), made_elsewhere())
    ]
    assert len(choose_runs(rows).rows) == 200
    assert len(looked_at) == 2


# -- ids of 20 digits, and of 16 -------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("run_id", ["0123456789abcdef", "0123456789abcdef0123"])
def test_pages_lead_to_runs_whose_ids_have_20_digits_or_16(
    store: RunStore, tmp_path: Path, run_id: str
) -> None:
    add_run(store, "mine", "s/a", run_id=run_id)
    paths = build_report(store, tmp_path / "report")
    folder = paths.html.parent
    assert f'href="run.html#{run_id}"' in (folder / "errors.html").read_text()
    assert page_data(folder, f"run-{run_id}")["id"] == run_id
    script = (Path(page.__file__).parent / "templates" / "run.js").read_text()
    (pattern,) = re.findall(r"/(\^\[0-9a-f\]\S*\$)/\.test", script)
    assert re.fullmatch(pattern, run_id)
    assert not re.fullmatch(pattern, run_id + "0")


def test_imports_of_several_files_have_names_of_their_own(store: RunStore) -> None:
    """They are asked for alike, and their ids begin alike."""
    for end in ("00000001", "00000002"):
        add_run(store, "orb-slam3", "s/a", kind="imported", run_id=f"0123456789ab{end}")
    repeats = load_board(store).frame()["repeat"]
    assert sorted(repeats) == ["import 000001", "import 000002"]


# -- times of several computers --------------------------------------------------------------------

FAST = MACHINE.model_copy(update={"cpu": "Fast CPU"})
SLOW = MACHINE.model_copy(update={"cpu": "Slow CPU"})
ON_FAST = "Fast CPU, 2 cores, 8 GB, Linux 6 x86_64"
ON_SLOW = "Slow CPU, 2 cores, 8 GB, Linux 6 x86_64"
OTHERS = {
    "processor": {"cpu": "Another CPU"},
    "cores": {"cores": 4},
    "memory": {"memory_gb": 16.0},
    "system": {"system": "Linux 7 x86_64"},
    "gpu": {"gpu": "a GPU"},
}


def seconds(each: float) -> dict[str, Any]:
    return {"timings": {"total": {"median_s": each, "p95_s": each, "mean_s": each}}}


def on_two_computers(**changes: Any) -> Board:
    """A tracker with three runs of 20 ms on a fast computer, and two of 50 and 70 ms on a slow one."""
    times = {0: 0.020, 1: 0.020, 2: 0.020, 3: 0.050, 4: 0.070}
    rows = [
        row("mine", f"s{at}", machine=(FAST if at < 3 else SLOW), **seconds(time), **changes)
        for at, time in times.items()
    ]
    return make_board(rows)


def test_the_time_of_a_row_is_that_of_the_computer_with_most_runs(tmp_path: Path) -> None:
    table = leaderboard(on_two_computers(), PROTOCOL)
    ((speed,),) = columns_of(table, "× real time")
    assert (speed.text, speed.small) == ("1.67‖", "20.0 ms‖")
    assert speed.value == pytest.approx(1 / (30 * 0.020))
    assert speed.tip == f"20.0 ms on {ON_FAST} (3 runs); 60.0 ms on {ON_SLOW} (2 runs)"
    assert f"Times are those of {ON_FAST}; ‖ of rows with runs on other computers" in table.caption


@pytest.mark.parametrize("differing", OTHERS)
def test_computers_that_differ_in_anything_are_two(differing: str) -> None:
    other = MACHINE.model_copy(update=OTHERS[differing])
    rows = [row("mine", name, machine=MACHINE, **seconds(0.02)) for name in "ab"]
    rows.append(row("mine", "c", machine=other, **seconds(0.5)))
    ((speed,),) = columns_of(leaderboard(make_board(rows), PROTOCOL), "× real time")
    assert (speed.text, speed.small) == ("1.67‖", "20.0 ms‖")


def test_rows_are_compared_on_the_computer_with_most_runs_of_the_board() -> None:
    """One tracker has more runs on the slow computer; the fast one made more runs of the board."""
    rows = [row("one", f"s{at}", machine=FAST, **seconds(0.02)) for at in range(5)]
    rows += [row("two", "s0", machine=FAST, **seconds(0.03))]
    rows += [row("two", f"s{at}", machine=SLOW, **seconds(0.3)) for at in range(1, 5)]
    rows += [row("three", f"s{at}", machine=SLOW, **seconds(0.4)) for at in range(1)]
    board = make_board(rows)
    names, speeds = columns_of(leaderboard(board, PROTOCOL), "tracker", "× real time")
    cells = {name.text: speed for name, speed in zip(names, speeds, strict=True)}
    assert {name: cell.small for name, cell in cells.items()} == {
        "ONE": "20.0 ms",
        "TWO": "30.0 ms‖",
        "THREE": "400.0 ms‖",
    }
    assert cells["ONE"].tip == ""
    assert cells["THREE"].tip == f"400.0 ms on {ON_SLOW} (1 run)"


def test_runs_on_one_computer_carry_no_mark(tmp_path: Path) -> None:
    board = make_board([row("mine", name, machine=FAST, **seconds(0.02)) for name in "abc"])
    table = leaderboard(board, PROTOCOL)
    ((speed,),) = columns_of(table, "× real time")
    assert (speed.text, speed.small, speed.tip) == ("1.67", "20.0 ms", "")
    assert "‖" not in table.caption


def test_the_papers_table_of_times_holds_those_of_one_computer() -> None:
    rows = [
        row("mine", "s", offset=at, machine=machine, error=0.1 + at / 100, **seconds(time))
        for at, (machine, time) in enumerate([(FAST, 0.02), (FAST, 0.02), (SLOW, 0.5)])
    ]
    rows.append(row("other", "s", machine=SLOW, **seconds(0.5)))
    rows += [row("other", "t", machine=FAST, **seconds(0.03))]
    table = time_table(make_board(rows))
    assert table is not None
    times = {cells[0].text: [cell.text for cell in cells[3::3]] for cells in table.rows}
    assert times == {"MINE": ["20.0", ""], "OTHER": ["", "30.0"]}
    assert f"on {ON_FAST} alone" in table.caption


def test_the_pareto_front_joins_trackers_that_were_timed_on_one_computer() -> None:
    rows = [row("one", name, error=0.1, machine=FAST, **seconds(0.02)) for name in "ab"]
    rows += [row("two", name, error=0.05, machine=FAST, **seconds(0.04)) for name in "ab"]
    rows += [row("three", name, error=0.01, machine=SLOW, **seconds(0.001)) for name in "a"]
    rows += [row("three", name, error=0.01, machine=SLOW, **seconds(0.001)) for name in "b"]
    figure = speed_figure(make_board(rows))
    assert figure is not None
    front = next(trace for trace in figure.data if trace.name == "Pareto front")
    assert len(front.x) == 2
    assert max(front.x) == pytest.approx(1 / (30 * 0.02), rel=1e-4)
    assert sorted(trace.name for trace in figure.data if trace.mode == "markers") == [
        "ONE",
        "THREE ‖",
        "TWO",
    ]


@pytest.mark.slow
def test_the_first_page_has_the_time_on_one_computer(store: RunStore, tmp_path: Path) -> None:
    for at in range(3):
        add_run(store, "mine", f"s/{at}", machine=FAST, frame_s=0.02)
    add_run(store, "mine", "s/3", machine=SLOW, frame_s=0.9)
    text = build_report(store, tmp_path / "report").html.read_text()
    assert (
        f'title="20.0 ms on {ON_FAST} (3 runs); 900.0 ms on {ON_SLOW} (1 run)">20.0‖</td>' in text
    )
    assert f"Times are those of {ON_FAST}; ‖ of rows with runs on other computers" in text


def test_quoting_times_of_several_computers_has_a_reservation() -> None:
    sentence = "Frame times of 2 computers are not comparable."
    assert sentence in reservations(on_two_computers().rows)
    assert not any("computers" in text for text in reservations(on_two_computers().rows[:3]))
